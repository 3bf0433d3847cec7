"""Networks, loss, and the trained policy as a navigator."""

import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.objectives import SoftUpdate, TD3Loss

from magrl import td3
from magrl.checkpoints import save_tensors
from magrl.env import PRIVILEGED_KEYS, GeomagneticNavEnv
from magrl.tasks import Tasks


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=5, seed=3)


def config(env: GeomagneticNavEnv, **options) -> td3.PolicyConfig:
    return td3.policy_config(env, (16, 16), **({"layer_norm": True} | options))


@pytest.mark.parametrize("difference", [True, False])
@pytest.mark.parametrize("heading", [True, False])
def test_observation_is_what_the_configuration_says(env, difference: bool, heading: bool) -> None:
    view = config(env, observe_heading=heading, observe_difference=difference)
    seen = Compose(*td3.observation_transforms(view))(env.reset())
    assert seen["observation"].shape == (5, td3.observation_size(view))
    low, high = torch.tensor(view.field_low), torch.tensor(view.field_high)
    torch.testing.assert_close(seen["observation"][:, :3], 2 * (seen["field"] - low) / (high - low) - 1)
    assert seen["observation"].abs().max() <= 4


def test_policy_reads_no_privileged_key(env) -> None:
    policy = td3.FieldPolicy(config(env))
    state = env.rollout(3)["next"][:, -1]
    action = policy(state.clone())["action"]
    scrambled = state.clone()
    for key in PRIVILEGED_KEYS:
        value = scrambled[key]
        scrambled[key] = ~value if value.dtype == torch.bool else torch.full_like(value, math.nan)
    scrambled["field_gradient"] = torch.full((5, 3, 2), math.nan)
    scrambled["gradient_heading"] = torch.full((5, 1), math.nan)
    assert torch.equal(policy(scrambled)["action"], action)
    without = state.select(*td3.PUBLIC_KEYS)
    assert torch.equal(policy(without)["action"], action)
    assert not set(policy.in_keys) & set(PRIVILEGED_KEYS)


def test_training_observation_reads_no_privileged_key(env) -> None:
    """The networks see ``observation`` alone, and that is the same whatever the privileged keys hold."""
    guidance = td3.guidance_transforms(env, 3.0, math.pi / 4)
    view = Compose(*guidance, *td3.observation_transforms(config(env)))
    state = TransformedEnv(GeomagneticNavEnv(num_envs=5, seed=3), view).reset()
    scrambled = state.clone()
    for key in (*PRIVILEGED_KEYS, "field_gradient", "gradient_heading", "gradient_heading_valid"):
        scrambled[key] = torch.zeros_like(scrambled[key])
    again = Compose(*td3.observation_transforms(config(env)))(scrambled.exclude("observation"))
    assert torch.equal(again["observation"], state["observation"])
    assert td3.make_actor(config(env)).in_keys == ["observation"]


def test_policy_acts_alike_in_the_plain_and_in_the_training_environment(env) -> None:
    view = config(env)
    policy = td3.FieldPolicy(view)
    plain = GeomagneticNavEnv(num_envs=5, seed=9)
    seen = TransformedEnv(
        GeomagneticNavEnv(num_envs=5, seed=9), Compose(*td3.observation_transforms(view), td3.action_transform(view))
    )
    one, other = plain.rollout(6, policy), seen.rollout(6, policy.actor)
    assert torch.equal(one["next", "position"], other["next", "position"])


def test_action_covers_its_bounds(env) -> None:
    act = td3.action_transform(config(env))
    ends = act.denormalize("action", torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]]))
    torch.testing.assert_close(ends, torch.tensor([[0.0, -math.pi / 2], [50.0, math.pi / 2], [25.0, 0.0]]))


@pytest.mark.parametrize("layer_norm", [True, False])
def test_save_and_load_give_the_same_actions(env, tmp_path: Path, layer_norm: bool) -> None:
    policy = td3.FieldPolicy(config(env, layer_norm=layer_norm))
    td3.save_policy(tmp_path / "policy.pt", policy)
    loaded = td3.load_policy(tmp_path / "policy.pt")
    assert loaded.config == policy.config
    state = env.reset()
    assert torch.equal(loaded(state.clone())["action"], policy(state.clone())["action"])


def test_policy_of_another_shape_is_refused(env, tmp_path: Path) -> None:
    path = tmp_path / "policy.pt"
    td3.save_policy(path, td3.FieldPolicy(config(env)))
    content = torch.load(path, weights_only=True)
    content["config"]["num_cells"] = (8, 8)
    save_tensors(content, path)
    with pytest.raises(ValueError, match="policy of another shape"):
        td3.load_policy(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c | {"format": 99}, "format 99"),
        (lambda c: c | {"extra": 1}, "must hold format, config and weights"),
        (lambda c: c | {"config": {"num_cells": (16,)}}, "must hold exactly"),
        (lambda c: c | {"config": c["config"] | {"num_cells": (0,)}}, "num_cells"),
        (lambda c: c | {"config": c["config"] | {"field_low": (0.0, float("nan"), 0.0)}}, "finite"),
        (lambda _: {}, "must hold format"),
    ],
)
def test_damaged_policy_is_refused(env, tmp_path: Path, change, message: str) -> None:
    path = tmp_path / "policy.pt"
    td3.save_policy(path, td3.FieldPolicy(config(env)))
    save_tensors(change(torch.load(path, weights_only=True)), path)
    with pytest.raises(ValueError, match=message):
        td3.load_policy(path)


def test_no_policy_and_no_archive(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="policy file"):
        td3.load_policy(tmp_path / "none.pt")
    (tmp_path / "text.pt").write_text("not an archive")
    with pytest.raises(ValueError, match="not a policy file"):
        td3.load_policy(tmp_path / "text.pt")


def transitions(view: td3.PolicyConfig, count: int = 32) -> TensorDict:
    size = td3.observation_size(view)
    flag = torch.zeros(count, 1, dtype=torch.bool)
    following = {"observation": torch.randn(count, size), "reward": torch.randn(count, 1), "done": flag}
    return TensorDict(
        observation=torch.randn(count, size),
        action=torch.rand(count, 2) * 2 - 1,
        next=TensorDict(following | {"terminated": flag}, [count]),
        batch_size=[count],
    )


def test_loss_bootstraps_with_the_smaller_target(env) -> None:
    """Eqs. 3-9 and 3-10 by hand, with the noise off."""
    torch.manual_seed(0)
    view = config(env)
    actor, critic = td3.make_actor(view), td3.make_critic(view)
    loss = td3.make_loss(actor, critic, gamma=0.9, policy_noise=0.0, noise_clip=0.5)
    batch = transitions(view)
    value, _ = loss.value_loss(batch.clone())

    def values(params, observation, action):
        data = TensorDict(observation=observation, action=action, batch_size=[32])
        with params.to_module(loss.qvalue_network):
            return loss.qvalue_network(data)["state_action_value"].squeeze(-1)

    with torch.no_grad(), loss.target_actor_network_params.to_module(loss.actor_network):
        action = loss.actor_network(batch["next"].select("observation"))["action"]
    targets = loss.target_qvalue_network_params
    smaller = torch.minimum(*(values(targets[i], batch["next", "observation"], action) for i in range(2)))
    target = (batch["next", "reward"].squeeze(-1) + 0.9 * smaller).detach()
    current = [values(loss.qvalue_network_params[i], batch["observation"], batch["action"]) for i in range(2)]
    expected = sum(((q - target) ** 2).mean() for q in current)
    torch.testing.assert_close(value, expected)


def lean_and_torchrl(view: td3.PolicyConfig) -> tuple[td3.LeanTD3Loss, TD3Loss]:
    """Our loss after a few updates, and TorchRL's with the same weights."""
    torch.manual_seed(0)
    lean = td3.make_loss(td3.make_actor(view), td3.make_critic(view), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
    update = td3.LeanSoftUpdate(lean, tau=0.1)
    weights = [p for p in lean.actor_network_params.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam([*weights, *lean.critic_parameters()], lr=1e-2)
    for _ in range(3):
        batch = transitions(view)
        (lean.value_loss(batch)[0] + lean.actor_loss(batch)[0]).backward()
        optimiser.step()
        optimiser.zero_grad()
        update.step()
    spec = {"action_spec": Bounded(-1.0, 1.0, (2,)), "loss_function": "l2", "policy_noise": 0.1, "noise_clip": 0.5}
    theirs = TD3Loss(td3.make_actor(view), td3.make_critic(view), deactivate_vmap=True, **spec)
    theirs.make_value_estimator(gamma=0.9)
    SoftUpdate(theirs, tau=0.1)
    theirs.load_state_dict(lean.state_dict())
    return lean, theirs


def test_lean_loss_is_that_of_torchrl(env) -> None:
    """Values and gradients of both losses, to rounding, after updates of weights and targets."""
    view = config(env)
    batch, seen = transitions(view), []
    for loss in lean_and_torchrl(view):
        torch.manual_seed(1)
        value, actor = loss.value_loss(batch.clone())[0], loss.actor_loss(batch.clone())[0]
        policy = [p for p in loss.actor_network_params.parameters() if p.requires_grad]
        stacked = list(loss.qvalue_network_params.parameters())
        if isinstance(loss, td3.LeanTD3Loss):
            ours = torch.autograd.grad(value, loss.critic_parameters())
            critics = [torch.stack(pair) for pair in zip(ours[:10], ours[10:], strict=True)]
        else:
            critics = torch.autograd.grad(value, stacked)
        seen.append([value, actor, *critics, *torch.autograd.grad(actor, policy)])
    assert len(seen[0]) == 2 + 10 + 10  # two hidden layers with their normalisation, and the last
    for ours, theirs in zip(*seen, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-8)


def test_lean_soft_update_is_that_of_torchrl(env) -> None:
    lean, theirs = lean_and_torchrl(config(env))
    for loss, update in ((lean, td3.LeanSoftUpdate), (theirs, SoftUpdate)):
        made = update(loss, tau=0.25)  # both begin with targets that are the weights
        with torch.no_grad():
            for weight in loss.parameters():
                weight += 1.0 * weight.requires_grad
        made.step()
    before, after = (
        torch.cat([p.flatten() for p in loss.target_qvalue_network_params.values(True, True)])
        for loss in (lean, theirs)
    )
    torch.testing.assert_close(before, after, rtol=0, atol=0)
    source = torch.cat([p.flatten() for p in lean.qvalue_network_params.values(True, True)])
    torch.testing.assert_close(before, source - 0.75)


def test_saturation_penalty_is_the_mean_square_of_the_logits(env) -> None:
    view = config(env)
    actor = td3.make_actor(view)
    loss = td3.make_loss(actor, td3.make_critic(view), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
    batch = transitions(view)
    penalty = td3.saturation_penalty(loss.actor_loss(batch)[1]["logits"])
    torch.testing.assert_close(penalty, actor(batch.select("observation"))["logits"].square().mean())
    penalty.backward()
    assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in loss.actor_network_params.values(True, True))


def test_fresh_actor_is_not_saturated(env) -> None:
    torch.manual_seed(0)
    policy = td3.FieldPolicy(config(env))
    actions = policy.act.normalize("action", env.rollout(4, policy)["action"])
    assert actions.abs().max() < 0.95


def test_evaluation_flies_one_episode_of_each(env) -> None:
    start = torch.tensor([[-2.0, 162.0], [-5.0, 165.0]], dtype=torch.float64)
    target = torch.tensor([[-8.0, 164.0], [-7.0, 168.0]], dtype=torch.float64)
    flight = GeomagneticNavEnv(num_envs=2, tasks=Tasks(start, target), field=env.field, max_steps=7, seed=0)
    rollout = td3.evaluation_rollout(flight, td3.FieldPolicy(config(env)))
    assert rollout.shape == (2, 7)
    assert torch.equal(rollout["start_position"][:, 0], start)
    assert rollout["next", "truncated"][:, -1].all()
    assert not rollout["action"].requires_grad
