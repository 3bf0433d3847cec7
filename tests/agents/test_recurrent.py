"""The recurrent agent: its observations, its state, the replay of slices, its loss, and its recipe."""

import csv
import json
import math
import signal
from pathlib import Path

import pytest
import td3_recurrent as recipe
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import Bounded, LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import TD3Loss as StockTD3Loss

from magrl.agents import (
    FieldPolicy,
    PolicyConfig,
    RecurrentTD3Loss,
    load_policy,
    make_critic,
    make_recurrent_actor,
    recurrent_transforms,
    saturation_penalty,
    save_policy,
)
from magrl.agents.recurrent import STATE_KEYS, LastMove
from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv, Scenario
from magrl.training import Run, UsageError, parse_config
from magrl.transforms import ObservationView

SLICE, CELLS = 4, (16, 16)


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=6, seed=3, max_steps=7)


@pytest.fixture(scope="module")
def view(env) -> ObservationView:
    return env.observation_view(observe_heading=False)


@pytest.fixture
def actor(view) -> TensorDictSequential:
    torch.manual_seed(0)
    return make_recurrent_actor(view, CELLS, 8)


def make_policy(view: ObservationView, actor: TensorDictSequential | None = None) -> FieldPolicy:
    return FieldPolicy(PolicyConfig(view, CELLS, memory_size=8), actor)


def training_env(env: GeomagneticNavEnv, view: ObservationView, actor) -> TransformedEnv:
    base = GeomagneticNavEnv(Scenario(field=env.field), num_envs=6, seed=3, max_steps=7)
    return TransformedEnv(base, Compose(*recurrent_transforms(view, actor), view.action_transform()))


def make_heading_critic(view: ObservationView):
    return make_critic(view.size + 2, CELLS, observation_keys=("observation", "heading_vector"))


def make_loss(view: ObservationView, actor, policy_noise: float = 0.0) -> RecurrentTD3Loss:
    critic = make_heading_critic(view)
    return RecurrentTD3Loss(actor, critic, gamma=0.9, policy_noise=policy_noise, noise_clip=0.5)


@pytest.fixture
def collected(env, view, actor):
    """Return an actor, 24 steps that it took in episodes of at most 7, and slices of those."""
    collector = Collector(
        training_env(env, view, actor),
        actor,
        frames_per_batch=6 * 24,
        total_frames=6 * 24,
        auto_register_policy_transforms=False,
    )
    (steps,) = list(collector)
    collector.shutdown()
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(1000, ndim=2),
        sampler=SliceSampler(slice_len=SLICE, end_key=("next", "done"), strict_length=False),
        batch_size=40,
    )
    buffer.extend(steps.clone())
    return actor, steps, buffer.sample()


# Observation and state


def test_last_move() -> None:
    """A turn of 30 degrees, a third of the largest, after a move of three quarters of the longest."""
    moves = torch.tensor([[0.5, 1 / 3], [-1.0, 0.0]])
    expected = torch.tensor([[0.5, 1 / 3, math.sqrt(3) / 2, 0.5], [-1.0, 0.0, 1.0, 0.0]])
    torch.testing.assert_close(LastMove(math.pi / 2)(moves), expected)


def test_last_move_is_that_of_the_environment(env, view) -> None:
    """``move_scaled`` holds distance and turn, in this order, whatever the columns of the observation."""
    moves = env.rollout(5)["next"][:, -1]
    observed = Compose(*view.observation_transforms())(moves.clone())
    distance, turn = (view.max_move_km / 2 * (observed["move_scaled"][:, 0] + 1), observed["move_scaled"][:, 1])
    torch.testing.assert_close(distance, moves["move"][:, 0])
    torch.testing.assert_close(turn * view.max_turn_rad, moves["move"][:, 1])


def scrambled(state: TensorDict) -> TensorDict:
    """Return a state with noise in everything that a policy on the eight numbers must not read."""
    state = state.clone()
    for key in {"heading", *PRIVILEGED_KEYS} - {"region"}:
        value = state[key]
        state[key] = ~value if value.dtype == torch.bool else torch.full_like(value, math.nan)
    extra = {"field_gradient": (3, 2), "gradient_heading": (1,), "heading_vector": (2,)}
    return state.update({key: torch.full((6, *shape), math.nan) for key, shape in extra.items()})


def test_policy_reads_neither_heading_nor_privileged_keys(env, view, actor) -> None:
    states = env.rollout(5)
    plain, blind = (make_policy(view, actor) for _ in range(2))
    for step in range(5):
        action = plain(states[:, step].clone())["action"]
        assert torch.equal(blind(scrambled(states[:, step]))["action"], action)
    assert not {"heading", *PRIVILEGED_KEYS} & set(plain.in_keys)
    assert set(actor.in_keys) == {"observation", "move_scaled", "is_init", *STATE_KEYS}


def test_observation_in_training_holds_no_heading(env, view) -> None:
    transforms = Compose(*view.observation_transforms())
    state = env.rollout(5)["next"][:, -1]
    turned = state.clone().set("heading", state["heading"] + 1)
    observed = transforms(state.clone())["observation"]
    assert observed.shape == (6, 11)
    assert torch.equal(transforms(turned)["observation"], observed)


def test_memory_tells_apart_what_the_eight_numbers_do_not(env, view, actor) -> None:
    """Vehicles with equal observations and different pasts act differently."""
    policy = make_policy(view, actor)
    states = env.rollout(3)
    for step in range(2):
        policy(states[:, step].clone())
    last = states[:, 2].clone()
    last.update({key: last[key][:1].expand_as(last[key]).clone() for key in ("field", "target_field", "move")})
    action = policy(last)["action"]
    assert (action[1:] != action[0]).any(-1).all()


def test_memory_is_reset_at_the_start_of_an_episode(env, view, actor) -> None:
    states = env.rollout(4)
    policy, fresh = (make_policy(view, actor) for _ in range(2))
    for step in range(3):
        policy(states[:, step].clone())
    restarted = torch.tensor([True, False, True, False, False, True])
    now = states[:, 3].clone()
    now["step_count"] = torch.where(restarted.unsqueeze(-1), 0, now["step_count"])
    action = policy(now.clone())["action"]
    anew = fresh(now.clone())["action"]
    assert torch.equal(action[restarted], anew[restarted])
    assert (action[~restarted] != anew[~restarted]).any(-1).all()


def test_memory_is_reset_in_collected_steps(collected) -> None:
    _, steps, _ = collected
    begins = steps["is_init"].squeeze(-1)
    assert torch.equal(begins, steps["step_count"].squeeze(-1) == 0)
    assert begins.sum() > 6, "no vehicle was reset on the way"
    for key in STATE_KEYS:
        assert (steps[key][begins] == 0).all()
        assert (steps[key][~begins] != 0).any(-1).all()
        inside = ~begins[:, 1:]
        assert torch.equal(steps[key][:, 1:][inside], steps["next", key][:, :-1][inside])


def test_slices_stay_within_episodes(collected) -> None:
    _, _, slices = collected
    begins = slices["is_init"].squeeze(-1)
    assert begins[0]
    assert begins.sum() == 10
    inside = ~begins[1:]
    assert torch.equal(slices["observation"][1:][inside], slices["next", "observation"][:-1][inside])
    assert torch.equal(slices["step_count"][1:][inside], slices["step_count"][:-1][inside] + 1)
    lengths = begins.cumsum(0).bincount()[1:]
    assert lengths.max() <= SLICE
    assert (slices["step_count"][begins] > 0).any(), "no slice begins inside an episode"


def test_unrolled_slices_give_what_was_collected(collected) -> None:
    actor, _, slices = collected
    with torch.no_grad(), set_recurrent_mode(True):
        again = actor(slices.select(*actor.in_keys))
    for key in ("memory", "heading_estimate", "action"):
        torch.testing.assert_close(again[key], slices[key], rtol=0, atol=1e-6)


def by_hand(actor, slices: TensorDict) -> list[torch.Tensor]:
    """Actions at the next observations: each slice flown step by step from its stored state."""
    starts = slices["is_init"].squeeze(-1).nonzero().squeeze(-1).tolist()
    actions = []
    for start, stop in zip(starts, [*starts[1:], len(slices)], strict=True):
        observations = torch.cat((slices["observation"][start : start + 1], slices["next", "observation"][start:stop]))
        state = {key: slices[key][start] for key in STATE_KEYS}
        for index, observation in enumerate(observations):
            step = actor(TensorDict({"observation": observation, "is_init": torch.tensor([False]), **state}))
            state = {key: step["next", key] for key in STATE_KEYS}
            if index:
                actions.append(step["action"])
    return actions


# Loss


def states_at_next_observations(actor, slices: TensorDict) -> list[TensorDict]:
    """Return what the actor writes at the next observations: each slice unrolled step by step from its stored state."""
    starts = slices["is_init"].squeeze(-1).nonzero().squeeze(-1).tolist()
    written = []
    for start, stop in zip(starts, [*starts[1:], len(slices)], strict=True):
        inputs = {
            key: torch.cat((slices[key][start : start + 1], slices["next", key][start:stop]))
            for key in ("observation", "move_scaled")
        }
        state = {key: slices[key][start] for key in STATE_KEYS}
        for index in range(stop - start + 1):
            inputs_now = {key: value[index] for key, value in inputs.items()}
            step = actor(TensorDict({**inputs_now, "is_init": torch.tensor([False]), **state}))
            if index:
                written.append(TensorDict({"action": step["action"], **state}))
            state = {key: step["next", key] for key in STATE_KEYS}
    return written


def critic_values(loss, params, at, action) -> torch.Tensor:
    data = TensorDict({**{k: at[k] for k in ("observation", "heading_vector")}, "action": action}, [len(action)])
    with params.to_module(loss.qvalue_network):
        return loss.qvalue_network(data)["state_action_value"]


def test_target_actions_come_from_an_unrolled_memory(view, collected) -> None:
    """Eqs. 3-9 and 3-10 by hand. Stored states after the first step are not read, since they are of older weights."""
    actor, _, slices = collected
    slices["next", "reward"] = torch.randn(len(slices), 1)
    loss = make_loss(view, actor)
    for key in STATE_KEYS:
        slices["next", key] = torch.randn_like(slices["next", key])
    value, _ = loss.value_loss(slices.clone())
    with torch.no_grad():
        action = torch.stack([step["action"] for step in states_at_next_observations(actor, slices)])
        targets = loss.target_qvalue_network_params
        smaller = torch.minimum(*(critic_values(loss, targets[i], slices["next"], action) for i in range(2)))
        target = slices["next", "reward"] + 0.9 * ~slices["next", "terminated"] * smaller
        current = [critic_values(loss, loss.qvalue_network_params[i], slices, slices["action"]) for i in range(2)]
    expected = sum(((q - target) ** 2).mean() for q in current)
    torch.testing.assert_close(value, expected)


def test_actor_loss_by_hand(view, collected) -> None:
    actor, _, slices = collected
    loss = make_loss(view, actor)
    value, outputs = loss.actor_loss(slices)
    with torch.no_grad():
        expected = -critic_values(loss, loss.qvalue_network_params[0], slices, slices["action"]).mean()
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(saturation_penalty(outputs["logits"]), slices["logits"].square().mean())
    torch.testing.assert_close(outputs["heading_estimate"], slices["heading_estimate"])
    angle = torch.stack((torch.cos(slices["heading"]), torch.sin(slices["heading"])), -1).squeeze(-2)
    torch.testing.assert_close(slices["heading_vector"], angle)


def stock_loss(view: ObservationView, actor) -> StockTD3Loss:
    """Return TorchRL's loss on a recurrent actor; it gives critics what the actor writes, so the heading passes by."""
    beside = TensorDictModule(torch.nn.Identity(), ["heading_vector"], ["heading_vector"])
    spec = {"action_spec": Bounded(-1.0, 1.0, (2,)), "loss_function": "l2", "policy_noise": 0.1, "noise_clip": 0.5}
    stock = StockTD3Loss(TensorDictSequential(actor, beside), make_heading_critic(view), deactivate_vmap=True, **spec)
    stock.make_value_estimator(gamma=0.9)
    return stock


def test_loss_is_that_of_torchrl(view, collected) -> None:
    """Values and gradients, to rounding; the stock loss gets the recurrent state with which each slice continues."""
    actor, _, slices = collected
    ours = make_loss(view, actor, policy_noise=0.1)
    stock = stock_loss(view, actor)
    for name in ("qvalue_network_params", "target_qvalue_network_params"):
        getattr(stock, name).data.update_(getattr(ours, name).data)
    prepared = slices.clone()
    with torch.no_grad():
        unrolled = states_at_next_observations(actor, slices)
    prepared["next", "is_init"] = prepared["is_init"]
    begins = prepared["is_init"].squeeze(-1)
    for key in STATE_KEYS:
        states = torch.stack([step[key] for step in unrolled])
        prepared["next", key] = torch.where(begins[:, None, None], states, prepared["next", key])

    torch.manual_seed(1)
    value, _ = ours.value_loss(slices.clone())
    actor_value, _ = ours.actor_loss(slices.clone())
    torch.manual_seed(1)
    with set_recurrent_mode(True):
        stock_value, _ = stock.value_loss(prepared.clone())
        stock_actor_value, _ = stock.actor_loss(prepared.clone())
    torch.testing.assert_close(value, stock_value)
    torch.testing.assert_close(actor_value, stock_actor_value)

    gradients = torch.autograd.grad(value, ours.critic_parameters())
    half = len(gradients) // 2
    critics = [torch.stack(pair) for pair in zip(gradients[:half], gradients[half:], strict=True)]
    expected = torch.autograd.grad(stock_value, list(stock.qvalue_network_params.parameters()))
    for one, other in zip(critics, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-7)
    one, other = (
        torch.autograd.grad(loss_value, [p for p in loss.actor_network_params.parameters() if p.requires_grad])
        for loss_value, loss in ((actor_value, ours), (stock_actor_value, stock))
    )
    assert sum(gradient.abs().sum() > 0 for gradient in one) == len(one)
    for mine, theirs in zip(one, other, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-7)


def test_gradients_reach_their_parameters_only(view, collected) -> None:
    actor, _, slices = collected
    loss = make_loss(view, actor)
    memory, others = loss.memory_parameters(), loss.actor_parameters()
    assert len(memory) + len(others) == len(list(actor.parameters()))
    assert sum(p.numel() for p in memory) == 4 * 8 * (4 + 8 + 2)
    _, outputs = loss.actor_loss(slices)
    (outputs["heading_estimate"] - slices["heading_vector"]).square().mean().backward()
    assert all(p.grad.abs().sum() > 0 for p in memory)
    loss.actor_loss(slices)[0].backward()
    assert all(p.grad.abs().sum() > 0 for p in others)
    assert all(p.grad is None for p in loss.critic_parameters())
    before = [p.grad.clone() for p in (*memory, *others)]
    loss.value_loss(slices)[0].backward()
    assert all(p.grad is not None for p in loss.critic_parameters())
    assert all(torch.equal(p.grad, old) for p, old in zip((*memory, *others), before, strict=True))


def test_critics_read_the_heading(view, collected) -> None:
    _, _, slices = collected
    critic = make_heading_critic(view)
    turned = slices.clone().set("heading_vector", -slices["heading_vector"])
    assert (critic(slices.clone())["state_action_value"] != critic(turned)["state_action_value"]).all()


# Environment and policy


def test_training_environment_is_sound(env, view, actor) -> None:
    check_env_specs(training_env(env, view, actor))


def test_policy_acts_alike_in_the_plain_and_in_the_training_environment(env, view, actor) -> None:
    plain = GeomagneticNavEnv(Scenario(field=env.field), num_envs=6, seed=3, max_steps=7)
    one = plain.rollout(14, make_policy(view, actor), break_when_any_done=False)
    other = training_env(env, view, actor).rollout(14, actor, break_when_any_done=False)
    assert one["next", "done"].any()
    torch.testing.assert_close(one["next", "position"], other["next", "position"], rtol=0, atol=1e-7)


def test_save_and_load_give_the_same_episodes(env, view, tmp_path: Path) -> None:
    policy = make_policy(view)
    save_policy(tmp_path / "policy.pt", policy)
    loaded = load_policy(tmp_path / "policy.pt")
    assert loaded.config == policy.config
    assert loaded.config.memory_size == 8
    states = env.rollout(3)
    for step in range(3):
        assert torch.equal(loaded(states[:, step].clone())["action"], policy(states[:, step].clone())["action"])


# The recipe

SMALL = {
    "num_envs": 16,
    "total_frames": 640,
    "num_cells": (16, 16),
    "memory_size": 8,
    "num_slices": 4,
    "updates_per_step": 1,
    "eval_every": 5,
    "eval_tasks_small": 4,
    "eval_tasks": 6,
    "wandb_mode": "disabled",
}


def settings(out: Path, **options) -> recipe.Config:
    return recipe.Config(out=out, **SMALL | options)


def resume(folder: Path) -> recipe.Config:
    return parse_config(recipe.Config, {"default": recipe.Config()}, recipe.RECIPE, "", ["--resume", str(folder)])


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, dict[str, float]]:
    """Return the folder and the result of a training that was left alone."""
    out = tmp_path_factory.mktemp("recurrent") / "run"
    return out, recipe.train(settings(out))


def test_run_folder(trained) -> None:
    out, result = trained
    names = {".lock", "config.json", "train.csv", "policy.pt", "eval.json", "training.png", "trajectories.png"}
    assert {path.name for path in out.iterdir()} == names
    written = json.loads((out / "eval.json").read_text())
    assert (written["num_tasks"], written["seed"], written["frames"], written["updates"]) == (6, 0, 640, 40)
    assert written["spl"] == result["spl"]
    assert json.loads((out / "config.json").read_text())["recipe"] == "td3_recurrent.py"
    with (out / "train.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frames"]) for row in rows] == [320, 640]
    assert all(math.isfinite(float(row[key])) for row in rows for key in ("loss_critic", "loss_actor", "loss_heading"))
    env = GeomagneticNavEnv(num_envs=3, seed=0)
    assert env.rollout(2, load_policy(out / "policy.pt"))["action"].isfinite().all()


@pytest.mark.usefixtures("without_figures")
def test_interrupted_training_resumes_exactly(trained, tmp_path: Path, signalled, same_outcome, capsys) -> None:
    """Episodes of 24 moves, 4 per batch: recurrent states and running episodes are those of the checkpoint."""
    run = tmp_path / "run"
    with signalled(7, signal.SIGINT), pytest.raises(SystemExit) as stop:
        recipe.train(settings(run))
    assert stop.value.code == 130
    assert "Stopped after 448 frames" in capsys.readouterr().err
    assert load_policy(run / "policy.pt").config.memory_size == 8
    assert not (run / "eval.json").exists()
    recipe.train(resume(run))
    assert same_outcome(run, trained[0])
    assert not (run / "checkpoints").exists()


def test_non_finite_weight_stops_the_training(tmp_path: Path, monkeypatch) -> None:
    """After the last update of a batch, so that no loss is computed with it."""

    class Poisoned(recipe.SoftUpdate):
        def __init__(self, loss: RecurrentTD3Loss, *, tau: float) -> None:
            super().__init__(loss, tau=tau)
            self.weight, self.steps = loss.memory_parameters()[0], 0

        def step(self) -> None:
            super().step()
            self.steps += 1
            if self.steps == 4:  # two updates of the targets a batch
                with torch.no_grad():
                    self.weight[0] = float("nan")

    monkeypatch.setattr(recipe, "SoftUpdate", Poisoned)
    with pytest.raises(FloatingPointError, match=r"after update 8: .*lstm.* is not finite in rows \[0"):
        recipe.train(settings(tmp_path / "run"))
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_run_of_another_recipe_is_not_resumed(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"recipe": "td3_gradient_guided.py"}')
    with pytest.raises(UsageError, match=r"the run was started by td3_gradient_guided\.py: resume it with that recipe"):
        resume(tmp_path)


@pytest.mark.parametrize(
    "bad",
    [
        {"num_envs": 0},
        {"num_envs": 1},
        {"memory_size": "8"},
        {"memory_size": 0},
        {"wandb_mode": "loud"},
        {"gamma": 1.0},
        {"steps_per_batch": 1},
        {"buffer_size": 63},
        {"shortest_task_km": 0.0},
        {"shortest_task_km": 500.0},
        {"num_cells": ()},
        {"noise_share": 0.0},
        {"random_share": 1.5},
        {"seed": -1},
    ],
    ids=str,
)
def test_bad_settings_are_refused_by_name(tmp_path: Path, bad: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        settings(tmp_path / "run", **bad)


def test_shortest_task_is_below_the_longest_of_the_scenario(tmp_path: Path) -> None:
    content = {"region": {"latitude": [40, 50], "longitude": [-30, -20]}, "date": "2026-07-01"}
    path = tmp_path / "near.json"
    path.write_text(json.dumps(content | {"distance_range_km": [50, 90]}))
    with pytest.raises(ValueError, match="shortest_task_km must be below 90, got 100"):
        settings(tmp_path / "run", scenario=path)


def test_the_step_limit_of_a_scenario_is_that_of_the_evaluations(tmp_path: Path) -> None:
    content = {"region": {"latitude": [40, 50], "longitude": [-30, -20]}, "date": "2026-07-01", "max_steps": 80}
    path = tmp_path / "long.json"
    path.write_text(json.dumps(content))
    config = settings(tmp_path / "run", scenario=path)
    with Run(config, recipe="mine.py", name="mine") as run:
        assert recipe.make_base(run, config).max_steps == config.train_steps != 80
        assert [env.max_steps for env in run.evaluation_envs()] == [80, 80]


@pytest.mark.slow
def test_the_eight_numbers_suffice_with_a_memory(tmp_path: Path) -> None:
    """On a seed that was not used for tuning."""
    result = recipe.train(recipe.Config(seed=5, out=tmp_path / "run", wandb_mode="disabled"))
    assert result["success_rate"] >= 90
    assert result["num_tasks"] == 1000
