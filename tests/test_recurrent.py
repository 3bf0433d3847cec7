"""The agent with a memory: what it reads, where its memory starts, how slices are replayed, and its recipe."""

import csv
import dataclasses
import importlib.util
import json
import math
import signal
import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import set_recurrent_mode

from magrl import recurrent, td3
from magrl.checkpoints import save_tensors
from magrl.env import PRIVILEGED_KEYS, GeomagneticNavEnv

RECIPE = Path(__file__).parent.parent / "recipes" / "td3_recurrent.py"
SLICE = 4


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=6, seed=3, max_steps=7)


@pytest.fixture(scope="module")
def view(env) -> td3.PolicyConfig:
    return td3.policy_config(env, (16, 16), layer_norm=True, observe_heading=False)


def training_env(env: GeomagneticNavEnv, view: td3.PolicyConfig, actor) -> TransformedEnv:
    base = GeomagneticNavEnv(num_envs=6, seed=3, max_steps=7, field=env.field)
    return TransformedEnv(base, Compose(*recurrent.training_transforms(view, actor), td3.action_transform(view)))


def make_loss(view: td3.PolicyConfig, actor):
    critic = recurrent.make_critic(view)
    return recurrent.make_loss(actor, critic, gamma=0.9, policy_noise=0.0, noise_clip=0.5)


@pytest.fixture
def collected(env, view):
    """An actor, 24 steps that it took in journeys of at most 7, and slices of those."""
    torch.manual_seed(0)
    actor = recurrent.make_actor(view, 8)
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


def test_last_move() -> None:
    """A turn of 30 degrees, a third of the largest, after a move of three quarters of the longest."""
    seen = torch.zeros(2, 11)
    seen[:, 6:8] = torch.tensor([[0.5, 1 / 3], [-1.0, 0.0]])
    expected = torch.tensor([[0.5, 1 / 3, math.sqrt(3) / 2, 0.5], [-1.0, 0.0, 1.0, 0.0]])
    torch.testing.assert_close(recurrent.LastMove(math.pi / 2)(seen), expected)


def scrambled(state: TensorDict) -> TensorDict:
    """A state with noise in everything that a policy on the eight numbers has no business with."""
    state = state.clone()
    for key in ("heading", *PRIVILEGED_KEYS):
        value = state[key]
        state[key] = ~value if value.dtype == torch.bool else torch.full_like(value, math.nan)
    extra = {"field_gradient": (3, 2), "gradient_heading": (1,), "heading_vector": (2,)}
    return state.update({key: torch.full((6, *shape), math.nan) for key, shape in extra.items()})


def test_policy_reads_neither_heading_nor_privileged_keys(env, view) -> None:
    torch.manual_seed(0)
    actor = recurrent.make_actor(view, 8)
    states = env.rollout(5)
    flown, blind = (recurrent.RecurrentPolicy(view, 8, actor) for _ in range(2))
    for step in range(5):
        action = flown(states[:, step].clone())["action"]
        assert torch.equal(blind(scrambled(states[:, step]))["action"], action)
    assert not {"heading", *PRIVILEGED_KEYS} & set(flown.in_keys)
    assert set(actor.in_keys) == {"observation", "is_init", *recurrent.STATE_KEYS}


def test_observation_in_training_holds_no_heading(env, view) -> None:
    transforms = Compose(*recurrent.observation_transforms(view))
    state = env.rollout(5)["next"][:, -1]
    turned = state.clone().set("heading", state["heading"] + 1)
    seen = transforms(state.clone())["observation"]
    assert seen.shape == (6, 11)
    assert torch.equal(transforms(turned)["observation"], seen)


def test_memory_tells_apart_what_the_eight_numbers_do_not(env, view) -> None:
    """Two vehicles with the same state and other pasts act differently."""
    torch.manual_seed(0)
    policy = recurrent.RecurrentPolicy(view, 8)
    states = env.rollout(3)
    for step in range(2):
        policy(states[:, step].clone())
    last = states[:, 2].clone()
    last.update({key: last[key][:1].expand_as(last[key]).clone() for key in ("field", "target_field", "move")})
    action = policy(last)["action"]
    assert (action[1:] != action[0]).any(-1).all()


def test_memory_starts_anew_with_each_journey(env, view) -> None:
    torch.manual_seed(0)
    actor = recurrent.make_actor(view, 8)
    states = env.rollout(4)
    policy, fresh = (recurrent.RecurrentPolicy(view, 8, actor) for _ in range(2))
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
    for key in recurrent.STATE_KEYS:
        assert (steps[key][begins] == 0).all()
        assert (steps[key][~begins] != 0).any(-1).all()
        inside = ~begins[:, 1:]
        assert torch.equal(steps[key][:, 1:][inside], steps["next", key][:, :-1][inside])


def test_slices_stay_within_journeys(collected) -> None:
    _, _, slices = collected
    begins = slices["is_init"].squeeze(-1)
    assert begins[0]
    assert begins.sum() == 10
    inside = ~begins[1:]
    assert torch.equal(slices["observation"][1:][inside], slices["next", "observation"][:-1][inside])
    assert torch.equal(slices["step_count"][1:][inside], slices["step_count"][:-1][inside] + 1)
    lengths = begins.cumsum(0).bincount()[1:]
    assert lengths.max() <= SLICE
    assert (slices["step_count"][begins] > 0).any(), "no slice begins inside a journey"


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
        state = {key: slices[key][start] for key in recurrent.STATE_KEYS}
        for index, observation in enumerate(observations):
            step = actor(TensorDict({"observation": observation, "is_init": torch.tensor([False]), **state}))
            state = {key: step["next", key] for key in recurrent.STATE_KEYS}
            if index:
                actions.append(step["action"])
    return actions


def test_target_actions_come_from_an_unrolled_memory(view, collected) -> None:
    """Eqs. 3-9 and 3-10 by hand; states that were stored after the first step are of no use, since weights move on."""
    actor, _, slices = collected
    slices["next", "reward"] = torch.randn(len(slices), 1)
    loss = make_loss(view, actor)
    for key in recurrent.STATE_KEYS:
        slices["next", key] = torch.randn_like(slices["next", key])
    value = recurrent.value_loss(loss, slices.clone())
    with torch.no_grad():
        action = torch.stack(by_hand(actor, slices))

        def values(params, at, action):
            data = TensorDict(
                {**{k: at[k] for k in ("observation", "heading_vector")}, "action": action}, [len(slices)]
            )
            with params.to_module(loss.qvalue_network):
                return loss.qvalue_network(data)["state_action_value"]

        targets = loss.target_qvalue_network_params
        smaller = torch.minimum(*(values(targets[i], slices["next"], action) for i in range(2)))
        target = slices["next", "reward"] + 0.9 * ~slices["next", "terminated"] * smaller
        current = [values(loss.qvalue_network_params[i], slices, slices["action"]) for i in range(2)]
    expected = sum(((q - target) ** 2).mean() for q in current)
    torch.testing.assert_close(value, expected)


def test_actor_losses_by_hand(view, collected) -> None:
    actor, _, slices = collected
    loss = make_loss(view, actor)
    losses = recurrent.actor_losses(loss, slices)
    with loss.qvalue_network_params.data[0].to_module(loss.qvalue_network):
        value = loss.qvalue_network(slices.select("observation", "heading_vector", "action"))["state_action_value"]
    torch.testing.assert_close(losses["value"], -value.mean())
    torch.testing.assert_close(losses["saturation"], slices["logits"].square().mean())
    angle = torch.stack((torch.cos(slices["heading"]), torch.sin(slices["heading"])), -1).squeeze(-2)
    torch.testing.assert_close(losses["heading"], ((slices["heading_estimate"] - angle) ** 2).sum(-1).mean())


def test_gradients_go_where_they_should(view, collected) -> None:
    actor, _, slices = collected
    loss = make_loss(view, actor)
    memory, others = recurrent.parameter_groups(loss)
    assert len(memory) + len(others) == len(list(actor.parameters()))
    assert sum(p.numel() for p in memory) == 4 * 8 * (4 + 8 + 2)
    recurrent.actor_losses(loss, slices)["heading"].backward()
    assert all(p.grad.abs().sum() > 0 for p in memory)
    recurrent.actor_losses(loss, slices)["value"].backward()
    assert all(p.grad.abs().sum() > 0 for p in others)
    assert all(p.grad is None for p in loss.qvalue_network_params.values(True, True))
    recurrent.value_loss(loss, slices).backward()
    assert all(p.grad is not None for p in loss.qvalue_network_params.values(True, True))


def test_critics_see_the_heading(view, collected) -> None:
    _, _, slices = collected
    critic = recurrent.make_critic(view)
    turned = slices.clone().set("heading_vector", -slices["heading_vector"])
    assert (critic(slices.clone())["state_action_value"] != critic(turned)["state_action_value"]).all()


def test_training_environment_is_sound(env, view) -> None:
    check_env_specs(training_env(env, view, recurrent.make_actor(view, 8)))


def test_policy_acts_alike_in_the_plain_and_in_the_training_environment(env, view) -> None:
    torch.manual_seed(0)
    policy = recurrent.RecurrentPolicy(view, 8)
    plain = GeomagneticNavEnv(num_envs=6, seed=3, max_steps=7, field=env.field)
    one = plain.rollout(14, policy, break_when_any_done=False)
    other = training_env(env, view, policy.actor).rollout(14, policy.actor, break_when_any_done=False)
    assert one["next", "done"].any()
    torch.testing.assert_close(one["next", "position"], other["next", "position"], rtol=0, atol=1e-7)


def test_save_and_load_give_the_same_journeys(env, view, tmp_path: Path) -> None:
    policy = recurrent.RecurrentPolicy(view, 8)
    recurrent.save_policy(tmp_path / "policy.pt", policy)
    loaded = recurrent.load_policy(tmp_path / "policy.pt")
    assert (loaded.config, loaded.memory_size) == (policy.config, 8)
    states = env.rollout(3)
    for step in range(3):
        assert torch.equal(loaded(states[:, step].clone())["action"], policy(states[:, step].clone())["action"])


def test_damaged_policy_is_refused(view, tmp_path: Path) -> None:
    path = tmp_path / "policy.pt"
    with pytest.raises(FileNotFoundError, match="no policy file"):
        recurrent.load_policy(path)
    td3.save_policy(path, td3.FieldPolicy(view))
    with pytest.raises(ValueError, match="not the file of a recurrent policy"):
        recurrent.load_policy(path)
    recurrent.save_policy(path, recurrent.RecurrentPolicy(view, 8))
    content = torch.load(path, weights_only=True)
    for change in ({"recurrent_format": 99}, {"memory_size": 9}, {"memory_size": 0}):
        save_tensors(content | change, path)
        with pytest.raises(ValueError, match=r"99|size mismatch|memory_size"):
            recurrent.load_policy(path)


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


@pytest.fixture(scope="module")
def recipe():
    sys.path.insert(0, str(RECIPE.parent))  # it reports as the other recipe does
    spec = importlib.util.spec_from_file_location("td3_recurrent", RECIPE)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def settings(recipe, out: Path, **options):
    return dataclasses.replace(recipe.Config(), out=out, **SMALL | options)


def test_run_folder(recipe, tmp_path: Path) -> None:
    out = tmp_path / "run"
    result = recipe.train(settings(recipe, out))
    names = {".lock", "config.json", "train.csv", "policy.pt", "eval.json", "training.png", "trajectories.png"}
    assert {path.name for path in out.iterdir()} == names
    written = json.loads((out / "eval.json").read_text())
    assert (written["num_tasks"], written["seed"], written["frames"], written["updates"]) == (6, 0, 640, 40)
    assert written["spl"] == result["spl"]
    with (out / "train.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frames"]) for row in rows] == [320, 640]
    assert all(math.isfinite(float(row[key])) for row in rows for key in ("loss_critic", "loss_actor", "loss_heading"))
    env = GeomagneticNavEnv(num_envs=3, seed=0)
    assert env.rollout(2, recurrent.load_policy(out / "policy.pt"))["action"].isfinite().all()


def test_same_seed_same_weights(recipe, tmp_path: Path) -> None:
    def trained(name: str, seed: int) -> dict:
        recipe.train(settings(recipe, tmp_path / name, seed=seed))
        return recurrent.load_policy(tmp_path / name / "policy.pt").state_dict()

    one, again, other = trained("a", 1), trained("b", 1), trained("c", 2)
    tensors = [key for key, value in one.items() if isinstance(value, torch.Tensor)]
    assert all(torch.equal(one[key], again[key]) for key in tensors)
    assert not all(torch.equal(one[key], other[key]) for key in tensors)


def outcome(folder: Path) -> tuple[list[dict[str, str]], dict[str, torch.Tensor]]:
    """The curves without their timing, and the weights."""
    with (folder / "train.csv").open() as file:
        rows = [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]
    weights = recurrent.load_policy(folder / "policy.pt").state_dict()
    return rows, {key: value for key, value in weights.items() if isinstance(value, torch.Tensor)}


@pytest.mark.parametrize(
    ("frames", "number"),
    [(448, signal.SIGINT), (192, signal.SIGTERM)],
    ids=["after an evaluation", "before any"],
)
def test_stopped_training_goes_on_as_if_it_had_not(recipe, tmp_path: Path, signalled, capsys, frames, number) -> None:
    """Journeys of 24 moves, 4 a batch: the memory and the journeys under way are those that the checkpoint held."""
    run, whole = tmp_path / "run", tmp_path / "whole"
    with signalled(recipe, frames // 64, number), pytest.raises(SystemExit) as stop:
        recipe.train(settings(recipe, run))
    assert stop.value.code == 128 + number
    assert f"Stopped after {frames} frames" in capsys.readouterr().err
    assert recurrent.load_policy(run / "policy.pt").memory_size == 8
    assert not (run / "eval.json").exists()
    recipe.train(recipe.parse(["--resume", str(run)]))
    recipe.train(settings(recipe, whole))
    (rows, weights), (expected, expected_weights) = outcome(run), outcome(whole)
    assert rows == expected
    assert all(torch.equal(weights[key], expected_weights[key]) for key in expected_weights)
    assert not (run / "checkpoints").exists()


def test_weight_that_is_none_stops_the_training(recipe, tmp_path: Path, monkeypatch) -> None:
    update = recipe.Learner.update

    def poisoned(self, *args):
        update(self, *args)
        if self.updates == 8:  # the last of a batch, so that no loss is computed with it
            with torch.no_grad():
                self.memory[0][0] = float("nan")

    monkeypatch.setattr(recipe.Learner, "update", poisoned)
    with pytest.raises(FloatingPointError, match=r"after update \d+: .*lstm.* is not finite in rows \[0"):
        recipe.train(settings(recipe, tmp_path / "run"))
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_run_of_another_recipe_is_not_resumed(recipe, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"guided": true}')
    with pytest.raises(ValueError, match=r"another recipe: it must have {'recurrent': True}"):
        recipe.parse(["--resume", str(tmp_path)])


@pytest.mark.parametrize(
    "bad",
    [
        {"num_envs": 0},
        {"memory_size": "8"},
        {"wandb_mode": "loud"},
        {"gamma": 1.0},
        {"steps_per_batch": 1},
        {"buffer_size": 63},
        {"shortest_task_km": 0.0},
        {"seed": -1},
    ],
    ids=str,
)
def test_bad_settings_are_refused_by_name(recipe, tmp_path: Path, bad: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        settings(recipe, tmp_path / "run", **bad)


@pytest.mark.slow
def test_the_eight_numbers_suffice_with_a_memory(recipe, tmp_path: Path) -> None:
    """On a seed that nothing was tuned on."""
    result = recipe.train(dataclasses.replace(recipe.Config(), seed=5, out=tmp_path / "run", wandb_mode="disabled"))
    assert result["success_rate"] >= 90
    assert result["num_tasks"] == 1000
