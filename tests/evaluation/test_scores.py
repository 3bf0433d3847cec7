"""Scores of agents of all kinds on the named tasks."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.episodes import episode, point
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import LSTMModule

from magrl import load_policy, save_policy, score
from magrl.envs.gymnasium import GeomagneticNavVectorEnv
from magrl.envs.measures import bootstrap_interval
from magrl.envs.navigation import navigation_env
from magrl.evaluation.scores import SEED, flown, scored
from magrl.named_tasks import NAMED_TASKS
from magrl.navigators import Secant
from magrl.navigators.onnx import with_description


class Toward(nn.Module):
    """Turns to where D and I are those of the destination, taking D for east and I for north: arrives mostly."""

    def forward(self, observation: Tensor) -> Tensor:
        east, north, cosine, sine = observation[..., [8, 9, 11, 12]].unbind(-1)
        turn = torch.atan2(east / 2, north) - torch.atan2(sine, cosine)
        turn = torch.atan2(turn.sin(), turn.cos()) * 2 / math.pi
        return torch.stack((torch.full_like(turn, 0.6), turn.clamp(-1, 1)), -1)


def toward(observations: np.ndarray) -> np.ndarray:
    return Toward()(torch.from_numpy(observations)).numpy()


class Predicting:
    """A model with the interface of stable-baselines3 and a state."""

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False):
        assert deterministic
        assert episode_start.all() if state is None else not episode_start.any()
        return toward(observation), np.zeros((1, len(observation)))


def with_state(observations: np.ndarray, state: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Stands still until it has a state."""
    return toward(observations) * (state is not None) - np.array([state is None, 0]), np.ones(len(observations))


BOX: dict[str, Any] = {"task": "box", "episodes": 8, "max_steps": 12}


@pytest.fixture(scope="module")
def wanted() -> dict[str, float]:
    """The scores of the function."""
    return score(toward, **BOX)


def test_all_kinds_of_an_agent_have_the_same_score(wanted: dict[str, float], tmp_path: Path) -> None:
    save_policy(tmp_path / "policy.onnx", Toward(), navigation_env().view)
    (tmp_path / "network.onnx").write_bytes(with_description((tmp_path / "policy.onnx").read_bytes(), {}))
    for agent in (
        tmp_path / "network.onnx",
        str(tmp_path),
        load_policy(tmp_path / "policy.onnx"),
        TensorDictModule(Toward(), ["observation"], ["action"]),
        Toward(),
        Predicting(),
    ):
        assert score(agent, **BOX) == pytest.approx(wanted, rel=1e-3), agent
    assert 50 < wanted["SR"] < 100
    assert wanted["SPL_low"] < wanted["SPL"] < wanted["SPL_high"]


def test_a_navigator_has_the_score_of_its_name() -> None:
    assert score("secant", "nogo", episodes=4) == score(Secant(), "nogo", episodes=4)


def test_a_task_is_given_by_its_name_or_its_id() -> None:
    name, scores = NAMED_TASKS["nogo"].id, score("secant", "nogo", episodes=2, max_steps=2)
    assert score("secant", name, episodes=2, max_steps=2) == pytest.approx(scores, nan_ok=True)
    assert GeomagneticNavVectorEnv(2, task=name).single_observation_space.shape == (25,)
    with pytest.raises(ValueError, match=r"task must be one of 'box', .*, got 'magrl/GeomagneticNavigationNoGo-v9'"):
        score("secant", name.replace("v1", "v9"))


def test_a_state_is_passed_to_every_function_that_has_one() -> None:
    """Also where it has a default; another argument with a default is none."""

    def default(observations: np.ndarray, state: int | None = None) -> tuple[np.ndarray, int]:
        return with_state(observations, state)

    def scaled(observations: np.ndarray, scale: float = 1.0) -> np.ndarray:
        return scale * toward(observations)

    assert score(default, **BOX) == score(with_state, **BOX)
    assert score(scaled, **BOX) == score(toward, **BOX)


class Unfit(nn.Module):
    """Normalizes, drops out, and writes a value for one vehicle from its third call on."""

    def __init__(self, value: float = 0.0) -> None:
        super().__init__()
        self.norm, self.drop, self.calls, self.value = nn.BatchNorm1d(13), nn.Dropout(), 0, value

    def forward(self, observation: Tensor) -> Tensor:
        action = self.drop(self.norm(observation))[:, :2].tanh().double()
        self.calls += 1
        action[3, 0] = self.value if self.calls > 2 else 0.0
        return action


def test_modules_fly_in_eval_mode_and_keep_theirs() -> None:
    """Also where an evaluation fails: without dropout, with the statistics of the training."""
    module = Unfit()
    module.drop.eval()
    before = copy.deepcopy(module.state_dict())
    scores = [score(module, **BOX) for _ in range(2)]
    assert scores[0] == pytest.approx(scores[1], nan_ok=True)
    assert score(Unfit().eval(), **BOX) == pytest.approx(scores[0], nan_ok=True)
    module.value = math.nan
    with pytest.raises(ValueError, match="is not finite"):
        score(module, **BOX)
    assert [part.training for part in module.modules()] == [True, True, False]
    assert all(torch.equal(value, before[key]) for key, value in module.state_dict().items())


def test_an_action_that_is_not_finite_in_float32_is_refused_with_vehicle_and_step() -> None:
    for value in (math.nan, -math.inf, 1e300):
        message = r"the agent's action is not finite: vehicles \[3\] at step 2 \(the first is step 0\)"
        with pytest.raises(ValueError, match=message):
            score(Unfit(value), **BOX)
    with pytest.raises(ValueError, match="actions must be finite numbers"):
        score(lambda observations: 0 * observations[:, :2].astype(float) + 1e300, **BOX)


def test_a_score_is_of_1000_episodes() -> None:
    assert flown(lambda seen: 0 * seen[:, :2], "box", max_steps=1).shape == (1000, 1)


def test_what_is_no_agent_or_no_evaluation_is_refused() -> None:
    for agent, options, message in (
        (lambda *seen: seen[0], {}, r"act\(observations\) or act\(observations, state\), got .*: name its arguments"),
        (dict, {}, "agent must be an object, got the class dict"),
        (Predicting, {}, "agent must be an object, got the class Predicting"),
        (nn.Linear(13, 2).double(), {}, r"float32 weights, as observations are, got torch.float64: .float\(\)"),
        (nn.Linear(13, 2).bfloat16(), {}, "got torch.bfloat16"),
        ("x" * 5000, {}, "unknown navigator"),
        (Path("x" * 5000) / "y", {}, "there is no policy file"),
        ("secant", {"episodes": 0}, "^episodes must be a whole number from 1 on, got 0"),
        ("secant", {"seed": None}, "^seed must be a whole number from 0 on, got None"),
    ):
        with pytest.raises((TypeError, ValueError, OSError), match=message):
            score(agent, **BOX | options)


def test_the_episodes_are_those_of_the_seed_in_gymnasium(wanted: dict[str, float]) -> None:
    envs, found = GeomagneticNavVectorEnv(8, task="box", max_steps=12), {}
    observations, _ = envs.reset(seed=SEED)
    earned, running = np.zeros(8), np.ones(8, dtype=bool)
    while running.any():
        observations, rewards, terminated, truncated, info = envs.step(toward(observations))
        earned += rewards * running
        for vehicle in np.flatnonzero((terminated | truncated) & running):
            found[vehicle] = [info[name][vehicle] for name in ("success", "spl", "steps")]
        running &= ~(terminated | truncated)
    success, spl, steps = np.mean(list(found.values()), axis=0)
    scores = {"SR": 100 * success, "SPL": 100 * spl, "score": 10 * earned.mean(), "steps": steps}
    assert {key: wanted[key] for key in scores} == pytest.approx(scores, rel=1e-5)


def test_the_state_of_a_function_is_passed_on(wanted: dict[str, float]) -> None:
    """The first step stands still."""
    late = score(with_state, **BOX | {"max_steps": 13})
    assert late["steps"] == wanted["steps"] + 1
    assert late["SPL"] == pytest.approx(wanted["SPL"], rel=1e-3)


def test_a_state_has_the_vehicles_on_the_first_axis() -> None:
    """That of torch's GRU, (layers, N, H), is refused with the line that brings it in order; a model's is known."""
    torch.manual_seed(0)
    gru = nn.GRU(13, 2, num_layers=2)

    def layered(observations: np.ndarray, state: Tensor | None) -> tuple[np.ndarray, Tensor]:
        with torch.no_grad():
            seen, state = gru(torch.from_numpy(observations)[None], state)
        return seen[0].numpy(), state

    def ordered(observations: np.ndarray, state: Tensor | None) -> tuple[np.ndarray, Tensor]:
        actions, state = layered(observations, None if state is None else state.movedim(0, 1).contiguous())
        return actions, state.movedim(1, 0)

    def predict(seen: np.ndarray, state: Any, *_: Any, **__: Any) -> tuple[np.ndarray, np.ndarray]:
        actions, state = layered(seen, None if state is None else torch.tensor(state))
        return actions, state.numpy()

    message = r"vehicles on the first axis, got the shape \(2, 3, 2\): .* return state.movedim\(1, 0\), and take "
    with pytest.raises(ValueError, match=message + r"state.movedim\(0, 1\).contiguous\(\)"):
        score(layered, "box", episodes=3)
    with pytest.raises(ValueError, match="vehicles on the first axis, got 5"):
        score(lambda observations, state: (observations[:, :2], state or 5), "box", episodes=3)
    whole, model = (score(agent, "box", episodes=3) for agent in (ordered, SimpleNamespace(predict=predict)))
    assert whole["score"] == pytest.approx(model["score"])


def test_a_recurrent_policy_of_torchrl_keeps_its_memory() -> None:
    torch.manual_seed(0)
    size = NAMED_TASKS["readings"].make().observation_spec["observation"].shape[-1]
    memory = LSTMModule(size, 8, in_key="observation", out_key="seen")
    head = nn.Sequential(nn.Linear(8, 2), nn.Tanh())
    policy = TensorDictSequential(memory, TensorDictModule(head, ["seen"], ["action"]))

    def act(observations: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        with torch.no_grad():
            before = None if state is None else tuple(part.movedim(0, 1).contiguous() for part in state)
            seen, state = memory.lstm(torch.from_numpy(observations)[:, None], before)
            return head(seen[:, 0]).numpy(), tuple(part.movedim(1, 0) for part in state)

    scores = score(policy, "readings", episodes=4, max_steps=5)
    assert scores["score"] == pytest.approx(score(act, "readings", episodes=4, max_steps=5)["score"], rel=1e-5)


def test_successes_that_end_far_away_are_counted() -> None:
    """Of three successes, one ends 60 km from the destination; a failure ends farther away."""
    ends = [(160.0, True), (110.0, True), (100.0, True), (300.0, False)]
    rollout = torch.cat([episode([(50.0, 0.0), (50.0, 0.0)], point(far, 0.0), good, 2) for far, good in ends])
    rollout["next", "reward"] = torch.tensor([4.0, 3.0, 2.0, 1.0]).expand(2, 4).T.unsqueeze(-1)
    scores = scored(rollout)
    assert scores["beyond_50km"] == pytest.approx(100 / 3)
    assert (scores["SR"], scores["score"], scores["steps"]) == (75.0, 50.0, 2.0)
    assert (scores["score_low"], scores["score_high"]) == bootstrap_interval(torch.tensor([80.0, 60.0, 40.0, 20.0]))
    assert math.isnan(scored(rollout[3:])["beyond_50km"])


def test_what_is_wrong_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for wrong, task, options, message in (
        ("secant", "mars", {}, "task must be one of 'box', .*, got 'mars'"),
        ("sekant", "box", {}, "unknown navigator 'sekant'"),
        (5, "box", {}, "agent must be the name or file of .*, got 5"),
        (SimpleNamespace(), "box", {}, "agent must be"),
        (lambda observations: observations, "box", {}, r"actions must be finite numbers of shape \(2, 2\)"),
        (lambda observations: np.nan * observations[:, :2], "box", {}, "actions must be finite"),
        (
            lambda observations: 0 * observations[:, :2] + 3,
            "box",
            {},
            r"vehicles \[0, 1\] .* \[3.0, 3.0\]\] in \[-1, 1\]: clip them",
        ),
        (toward, "box", {"observation": "dict"}, "observation='dict' leaves out"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            score(wrong, task, episodes=2, **options)
    (tmp_path / "policy.onnx").touch()  # a file in the folder is not taken for a navigator
    monkeypatch.chdir(tmp_path)
    assert score("secant", "box", episodes=2)["SR"] == 100
