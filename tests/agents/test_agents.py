"""Networks, TD3 loss, and trained policies with their files."""

import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.objectives import SoftUpdate
from torchrl.objectives import TD3Loss as StockTD3Loss

from magrl.agents import (
    FieldPolicy,
    PolicyConfig,
    TD3Loss,
    load_policy,
    make_actor,
    make_critic,
    make_recurrent_actor,
    optimize,
    saturation_penalty,
    save_policy,
)
from magrl.agents.networks import make_mlp
from magrl.envs import PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv, Scenario, Tasks
from magrl.evaluation.rollout import evaluation_rollout
from magrl.files import save_tensors
from magrl.transforms import AlignmentReward, FieldGradient, GradientHeading, ObservationView

CELLS = (16, 16)


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=5, seed=3)


@pytest.fixture(scope="module")
def view(env) -> ObservationView:
    return env.observation_view()


@pytest.fixture
def policy(view) -> FieldPolicy:
    return FieldPolicy(PolicyConfig(view, CELLS))


def make_loss(size: int = 13, *, policy_noise: float = 0.1) -> TD3Loss:
    actor, critic = make_actor(size, CELLS), make_critic(size, CELLS)
    return TD3Loss(actor, critic, gamma=0.9, policy_noise=policy_noise, noise_clip=0.5)


def transitions(size: int = 13, count: int = 32) -> TensorDict:
    """Return random transitions, of which every fourth ends its episode."""
    ended = (torch.arange(count) % 4 == 0).unsqueeze(-1)
    following = {"observation": torch.randn(count, size), "reward": torch.randn(count, 1), "done": ended}
    return TensorDict(
        observation=torch.randn(count, size),
        action=torch.rand(count, 2) * 2 - 1,
        next=TensorDict(following | {"terminated": ended.clone()}, [count]),
        batch_size=[count],
    )


# Observation and action


@pytest.mark.parametrize("difference", [True, False])
@pytest.mark.parametrize("heading", [True, False])
def test_observation_is_what_the_view_says(env, difference: bool, heading: bool) -> None:
    view = env.observation_view(observe_heading=heading, observe_difference=difference)
    observed = Compose(*view.observation_transforms())(env.reset())
    assert observed["observation"].shape == (5, view.size)
    low, high = torch.tensor(view.field_low), torch.tensor(view.field_high)
    torch.testing.assert_close(observed["observation"][:, :3], 2 * (observed["field"] - low) / (high - low) - 1)
    assert observed["observation"].abs().max() <= 4


def test_policy_reads_no_privileged_key(env, policy) -> None:
    state = env.rollout(3)["next"][:, -1]
    action = policy(state.clone())["action"]
    scrambled = state.clone()
    for key in {*PRIVILEGED_KEYS} - {"region"}:
        value = scrambled[key]
        scrambled[key] = ~value if value.dtype == torch.bool else torch.full_like(value, math.nan)
    scrambled["field_gradient"] = torch.full((5, 3, 2), math.nan)
    scrambled["gradient_heading"] = torch.full((5, 1), math.nan)
    assert torch.equal(policy(scrambled)["action"], action)
    without = state.select(*PUBLIC_KEYS)
    assert torch.equal(policy(without)["action"], action)
    assert not set(policy.in_keys) & set(PRIVILEGED_KEYS)


def test_training_observation_reads_no_privileged_key(env, view) -> None:
    """The networks read ``observation`` alone, which does not depend on the values of privileged keys."""
    guidance = [FieldGradient(env.field), GradientHeading(), AlignmentReward(weight=3.0, offset=math.pi / 4)]
    transforms = Compose(*guidance, *view.observation_transforms())
    state = TransformedEnv(GeomagneticNavEnv(num_envs=5, seed=3), transforms).reset()
    scrambled = state.clone()
    for key in (*PRIVILEGED_KEYS[:-1], "field_gradient", "gradient_heading", "gradient_heading_valid"):
        scrambled[key] = torch.zeros_like(scrambled[key])
    again = Compose(*view.observation_transforms())(scrambled.exclude("observation"))
    assert torch.equal(again["observation"], state["observation"])
    assert make_actor(view.size, CELLS).in_keys == ["observation"]


def test_policy_acts_alike_in_the_plain_and_in_the_training_environment(view, policy) -> None:
    plain = GeomagneticNavEnv(num_envs=5, seed=9)
    transforms = Compose(*view.observation_transforms(), view.action_transform())
    training = TransformedEnv(GeomagneticNavEnv(num_envs=5, seed=9), transforms)
    one, other = plain.rollout(6, policy), training.rollout(6, policy.actor)
    assert torch.equal(one["next", "position"], other["next", "position"])


def test_action_covers_its_bounds(view) -> None:
    ends = view.action_transform().denormalize("action", torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]]))
    torch.testing.assert_close(ends, torch.tensor([[0.0, -math.pi / 2], [50.0, math.pi / 2], [25.0, 0.0]]))


def test_new_actor_is_not_saturated(env, view) -> None:
    torch.manual_seed(0)
    policy = FieldPolicy(PolicyConfig(view, CELLS))
    actions = policy.act.normalize("action", env.rollout(4, policy)["action"])
    assert actions.abs().max() < 0.95


def test_evaluation_flies_one_episode_of_each(env, policy) -> None:
    start = torch.tensor([[-2.0, 162.0], [-5.0, 165.0]], dtype=torch.float64)
    target = torch.tensor([[-8.0, 164.0], [-7.0, 168.0]], dtype=torch.float64)
    scenario = Scenario(tasks=Tasks(start, target), field=env.field)
    rollout = evaluation_rollout(GeomagneticNavEnv(scenario, num_envs=2, max_steps=7, seed=0), policy)
    assert rollout.shape == (2, 7)
    assert torch.equal(rollout["start_position"][:, 0], start)
    assert rollout["next", "truncated"][:, -1].all()
    assert not rollout["action"].requires_grad


# Policy files


@pytest.mark.parametrize("layer_norm", [True, False])
def test_save_and_load_give_the_same_actions(env, view, tmp_path: Path, layer_norm: bool) -> None:
    policy = FieldPolicy(PolicyConfig(view, CELLS, layer_norm=layer_norm))
    save_policy(tmp_path / "policy.pt", policy)
    loaded = load_policy(tmp_path / "policy.pt")
    assert loaded.config == policy.config
    state = env.reset()
    assert torch.equal(loaded(state.clone())["action"], policy(state.clone())["action"])


@pytest.mark.parametrize("memory_size", [0, 4])
def test_every_kind_of_policy_is_restored_by_its_file(env, tmp_path: Path, memory_size: int) -> None:
    """One format and one function for all: the file tells the kind."""
    view = env.observation_view(observe_heading=not memory_size)
    save_policy(tmp_path / "policy.pt", FieldPolicy(PolicyConfig(view, (8,), memory_size=memory_size)))
    loaded = load_policy(tmp_path / "policy.pt")
    assert loaded.config.memory_size == memory_size
    assert ("step_count" in loaded.in_keys) == (memory_size > 0)
    assert env.rollout(2, loaded)["action"].isfinite().all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c | {"format": 99}, "a policy of format 99; this version reads format 2"),
        (lambda c: c | {"extra": 1}, "must hold format, config and weights"),
        (lambda _: {}, "must hold format, config and weights"),
        (lambda _: [1, 2], "must hold format, config and weights"),
        (lambda c: c | {"config": {"num_cells": (16,)}}, "must hold exactly"),
        (lambda c: c | {"config": None}, "must hold exactly"),
        (lambda c: c | {"weights": [1]}, "must hold exactly"),
        (lambda c: c | {"config": c["config"] | {"num_cells": (8, 8)}}, "do not have the shapes"),
        (lambda c: c | {"config": c["config"] | {"num_cells": (0,)}}, "num_cells must be whole numbers"),
        (lambda c: c | {"config": c["config"] | {"num_cells": ("a",)}}, "num_cells must be whole numbers"),
        (lambda c: c | {"config": c["config"] | {"num_cells": ()}}, "num_cells must be whole numbers"),
        (lambda c: c | {"config": c["config"] | {"memory_size": 8}}, "do not have the shapes"),
        (lambda c: c | {"config": c["config"] | {"memory_size": -1}}, "memory_size"),
        (lambda c: c | {"config": c["config"] | {"view": {}}}, "does not hold a valid policy"),
        (
            lambda c: c | {"config": c["config"] | {"view": c["config"]["view"] | {"field_low": (0.0, math.nan, 0.0)}}},
            "field_low must be 3 finite numbers",
        ),
        (lambda c: c | {"weights": {k: v * math.nan for k, v in c["weights"].items()}}, "is not finite"),
        (lambda c: c | {"weights": {}}, "do not have the shapes"),
    ],
)
def test_damaged_policy_is_refused(policy, tmp_path: Path, change, message: str) -> None:
    path = tmp_path / "policy.pt"
    save_policy(path, policy)
    save_tensors(change(torch.load(path, weights_only=True)), path)
    with pytest.raises(ValueError, match=message) as error:
        load_policy(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    "content",
    [
        {"format": 1, "config": {"num_cells": (16, 16), "layer_norm": True}, "weights": {}},
        {"recurrent_format": 1, "config": {"num_cells": (16, 16)}, "memory_size": 64, "weights": {}},
    ],
    ids=["feedforward", "recurrent"],
)
def test_policies_of_earlier_versions_are_refused(tmp_path: Path, content: dict) -> None:
    save_tensors(content, tmp_path / "policy.pt")
    with pytest.raises(ValueError, match=r"policy\.pt is a policy of format 1; this version reads format 2: train it"):
        load_policy(tmp_path / "policy.pt")


def test_missing_policy_and_foreign_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no policy file at .*none\.pt"):
        load_policy(tmp_path / "none.pt")
    (tmp_path / "text.pt").write_text("not an archive")
    with pytest.raises(ValueError, match="not a policy file"):
        load_policy(tmp_path / "text.pt")
    with pytest.raises(TypeError, match="is saved with the transforms of its environment"):
        save_policy(tmp_path / "text.pt", make_actor(13, (8,)))


# Loss


def test_loss_bootstraps_with_the_smaller_target() -> None:
    """Eqs. 3-9 and 3-10 by hand, without noise."""
    torch.manual_seed(0)
    loss, batch = make_loss(policy_noise=0.0), transitions()
    value, extra = loss.value_loss(batch.clone())

    def values(params, observation, action):
        data = TensorDict(observation=observation, action=action, batch_size=[32])
        with params.to_module(loss.qvalue_network):
            return loss.qvalue_network(data)["state_action_value"]

    with torch.no_grad(), loss.target_actor_network_params.to_module(loss.actor_network):
        action = loss.actor_network(batch["next"].select("observation"))["action"]
    targets = loss.target_qvalue_network_params
    smaller = torch.minimum(*(values(targets[i], batch["next", "observation"], action) for i in range(2)))
    target = (batch["next", "reward"] + 0.9 * ~batch["next", "terminated"] * smaller).detach()
    current = [values(loss.qvalue_network_params[i], batch["observation"], batch["action"]) for i in range(2)]
    expected = sum(((q - target) ** 2).mean() for q in current)
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(extra["target_value"], target)


def test_target_policy_smoothing_is_clipped() -> None:
    """With a large noise of a small clip, the target is that of the smallest and largest clipped noise."""
    torch.manual_seed(0)
    actor, critic, batch = make_actor(13, CELLS), make_critic(13, CELLS), transitions()
    exact = TD3Loss(actor, critic, gamma=0.9, policy_noise=0.0, noise_clip=0.5)
    near = TD3Loss(actor, critic, gamma=0.9, policy_noise=100.0, noise_clip=1e-4)
    near.load_state_dict(exact.state_dict())
    target, noisy = (loss.value_loss(batch.clone())[1]["target_value"] for loss in (exact, near))
    assert not torch.equal(target, noisy)
    torch.testing.assert_close(target, noisy, rtol=0, atol=1e-3)


def ours_and_stock() -> tuple[TD3Loss, StockTD3Loss]:
    """Return our loss after a few updates, and TorchRL's with the same weights and targets."""
    torch.manual_seed(0)
    ours = make_loss()
    update = SoftUpdate(ours, tau=0.1)
    optimizer = torch.optim.Adam([*ours.actor_parameters(), *ours.critic_parameters()], lr=1e-2)
    for _ in range(3):
        batch = transitions()
        optimize(ours.value_loss(batch)[0] + ours.actor_loss(batch)[0], optimizer)
        update.step()
    spec = {"action_spec": Bounded(-1.0, 1.0, (2,)), "loss_function": "l2", "policy_noise": 0.1, "noise_clip": 0.5}
    stock = StockTD3Loss(make_actor(13, CELLS), make_critic(13, CELLS), deactivate_vmap=True, **spec)
    stock.make_value_estimator(gamma=0.9)
    SoftUpdate(stock, tau=0.1)
    stock.load_state_dict(ours.state_dict())
    return ours, stock


def test_bfloat16_rounds_the_hidden_layers_alone() -> None:
    """Losses agree to the three digits of the type. Both have gradients in float32, and the loss is not rounded."""
    torch.manual_seed(0)
    actor, critic, batch = make_actor(13, (64, 64)), make_critic(13, (64, 64)), transitions()
    options = {"gamma": 0.9, "policy_noise": 0.0, "noise_clip": 0.5}
    exact, rounded = (TD3Loss(actor, critic, **options, precision=kind) for kind in ("float32", "bfloat16"))
    rounded.load_state_dict(exact.state_dict())
    for name, weights in (("value_loss", "critic_parameters"), ("actor_loss", "actor_parameters")):
        losses = [getattr(loss, name)(batch.clone())[0] for loss in (exact, rounded)]
        assert losses[0].dtype == losses[1].dtype == torch.float32
        assert losses[0] != losses[1]
        torch.testing.assert_close(*losses, rtol=0.01, atol=0.01)
        gradients = [
            torch.autograd.grad(value, getattr(loss, weights)())
            for value, loss in zip(losses, (exact, rounded), strict=True)
        ]
        for one, other in zip(*gradients, strict=True):
            assert one.dtype == other.dtype == torch.float32
            assert (one - other).norm() < 0.1 * one.norm()


def test_first_and_last_layer_keep_float32() -> None:
    """A difference of inputs that bfloat16 rounds off, and outputs between two of its numbers."""
    network = make_mlp(1, 1, (1,), layer_norm=False)
    with torch.no_grad():
        for weight in network.parameters():
            weight.copy_(torch.ones_like(weight))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        outputs = network(torch.tensor([[1.0], [1.0 + 2**-12]]))
    assert outputs.dtype == torch.float32
    assert (outputs[1] - outputs[0]).item() == pytest.approx(2**-12)


def test_the_key_of_the_end_can_be_chosen() -> None:
    """With ``done`` in its place, a step limit counts as the end: no value after it."""
    torch.manual_seed(0)
    loss, batch = make_loss(policy_noise=0.0), transitions()
    batch["next", "terminated"] = torch.zeros(32, 1, dtype=torch.bool)
    batch["next", "done"] = torch.ones(32, 1, dtype=torch.bool)
    assert not torch.equal(loss.value_loss(batch)[1]["target_value"], batch["next", "reward"])
    loss.set_keys(terminated="done")
    assert torch.equal(loss.value_loss(batch)[1]["target_value"], batch["next", "reward"])


def test_loss_is_that_of_torchrl() -> None:
    """Values and gradients of both losses, to rounding, after updates of weights and targets."""
    batch, computed = transitions(), []
    for loss in ours_and_stock():
        torch.manual_seed(1)
        value, actor = loss.value_loss(batch.clone())[0], loss.actor_loss(batch.clone())[0]
        policy = [p for p in loss.actor_network_params.parameters() if p.requires_grad]
        if isinstance(loss, TD3Loss):
            gradients = torch.autograd.grad(value, loss.critic_parameters())
            critics = [torch.stack(pair) for pair in zip(gradients[:10], gradients[10:], strict=True)]
        else:
            critics = torch.autograd.grad(value, list(loss.qvalue_network_params.parameters()))
        computed.append([value, actor, *critics, *torch.autograd.grad(actor, policy)])
    assert len(computed[0]) == 2 + 10 + 10  # two hidden layers with their normalization, and the last
    for ours, stock in zip(*computed, strict=True):
        torch.testing.assert_close(ours, stock, rtol=1e-6, atol=1e-8)


def test_optimizers_train_the_parameters_of_the_loss() -> None:
    """The parameters share the memory of the stock class's, so that targets and checkpoints follow the updates."""
    loss = make_loss()
    names = {name: value.clone() for name, value in loss.state_dict().items() if isinstance(value, torch.Tensor)}
    for weight in (*loss.critic_parameters(), *loss.actor_parameters()):
        weight.data += 1
    changed = {name for name, value in loss.state_dict().items() if name in names and not names[name].equal(value)}
    trained = {name for name in names if not name.startswith("target_") and "action_" not in name}
    assert changed == {name for name in trained if "weight" in name or "bias" in name}
    assert changed


def test_soft_update_moves_the_targets_by_tau() -> None:
    loss = make_loss()
    update = SoftUpdate(loss, tau=0.25)  # which makes targets equal to the weights
    before = loss.target_qvalue_network_params.clone()
    with torch.no_grad():
        for weight in (*loss.critic_parameters(), *loss.actor_parameters()):
            weight += 1
    update.step()
    for key, target in loss.target_qvalue_network_params.items(True, True):
        torch.testing.assert_close(target, before[key] + 0.25)
    batch = transitions()
    seen = loss.networks.target_critics[0](torch.cat((batch["observation"], batch["action"]), -1))
    with loss.target_qvalue_network_params[0].to_module(loss.qvalue_network):
        expected = loss.qvalue_network(batch)["state_action_value"]
    torch.testing.assert_close(seen, expected)


def test_saturation_penalty_is_the_mean_square_of_the_logits() -> None:
    loss, batch = make_loss(), transitions()
    penalty = saturation_penalty(loss.actor_loss(batch)[1]["logits"])
    torch.testing.assert_close(penalty, loss.actor_network(batch.select("observation"))["logits"].square().mean())
    penalty.backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in loss.actor_parameters())


def test_optimize_clips_the_gradient_of_some_parameters() -> None:
    clipped, free = (torch.nn.Parameter(torch.zeros(2)) for _ in range(2))
    optimizers = [torch.optim.SGD([weight], lr=1.0) for weight in (clipped, free)]
    optimize((torch.tensor([30.0, 40.0]) * (clipped + free)).sum(), *optimizers, clip=[clipped], max_norm=5.0)
    torch.testing.assert_close(clipped.detach(), torch.tensor([-3.0, -4.0]))
    torch.testing.assert_close(free.detach(), torch.tensor([-30.0, -40.0]))
    assert clipped.grad is None
    assert free.grad is None


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"gamma": 1.5}, ValueError, "gamma must be a finite number from 0 up to 1, got 1.5"),
        ({"policy_noise": -1.0}, ValueError, "policy_noise"),
        ({"noise_clip": math.nan}, ValueError, "noise_clip"),
        ({"actor": None}, TypeError, "actor must be a TensorDictSequential"),
        ({"critic": None}, TypeError, "critic must be a ValueOperator"),
    ],
)
def test_bad_options_of_the_loss_are_refused(change: dict, error: type, message: str) -> None:
    options = {"actor": make_actor(3, (4,)), "critic": make_critic(3, (4,)), "gamma": 0.9}
    options |= {"policy_noise": 0.1, "noise_clip": 0.5} | change
    actor, critic = options.pop("actor"), options.pop("critic")
    with pytest.raises(error, match=message):
        TD3Loss(actor, critic, **options)


def test_bad_sizes_of_networks_are_refused(view) -> None:
    for size, cells in ((0, (8,)), (13, (0,)), (13, (1.5,)), (13, (10**9,))):
        with pytest.raises(ValueError, match="must be a whole number from 1 up to 655"):
            make_actor(size, cells)
        with pytest.raises(ValueError, match="must be a whole number from 1 up to 655"):
            make_critic(size or -2, cells)
    with pytest.raises(ValueError, match="memory_size"):
        make_recurrent_actor(view, (8,), 0)
