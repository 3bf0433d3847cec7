"""The track in the TensorDict: that of the pure functions, its specs and its state; declarations from it."""

from collections.abc import Callable
from functools import partial

import pytest
import torch
from support.environments import near, paper_env
from support.tracks import STD
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.utils._pytree import tree_leaves
from torchrl.envs import Transform, TransformedEnv
from torchrl.envs.utils import step_mdp

from magrl.envs import GeomagneticNavEnv
from magrl.errors import KnownPlace, SensorErrors
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.field import elements_gradient_at
from magrl.geodesy import geodesic
from magrl.navigators import Secant, policy_env
from magrl.pilot import Rules, Track, advance, begin, declaring
from magrl.pilot.step import observation
from magrl.transforms import DeclareArrival, TrackField
from magrl.transforms.track import KNOWN_KEYS, READ_KEYS, known_keys, reading_of, track_of

BIAS, SMALL_BIAS = (0.5, 0.3, 60.0), (0.1, 0.1, 10.0)
close = partial(torch.testing.assert_close, equal_nan=True)
RULES = Rules(range_km=350.0, max_steps=5)


def tracked(num_envs: int = 4, *errors, rules: Rules = RULES, **options: object) -> TransformedEnv:
    """The environment with errors of sensors, and with what its rules and errors make known."""
    env = TransformedEnv(GeomagneticNavEnv(num_envs=num_envs, **{"seed": 0, "max_steps": 5} | options))
    for error in errors:
        env.append_transform(error)
    env.append_transform(TrackField(rules, known_keys(env.observation_spec)))
    return env


def erring(num_envs: int = 4, **options: object) -> TransformedEnv:
    return tracked(num_envs, SensorErrors(STD, bias=BIAS, seed=3), KnownPlace(5.0), **options)


def flown(env: TransformedEnv, steps: int = 5) -> TensorDictBase:
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


def assert_equal(found: Track | list[Tensor], expected: Track | list[Tensor]) -> None:
    """Bit for bit; an unknown coordinate of the place is NaN."""
    found, expected = (one._replace(goal=None) if isinstance(one, Track) else one for one in (found, expected))
    close(tree_leaves(found), tree_leaves(expected), rtol=0, atol=0)


def test_the_track_is_that_of_the_pure_functions() -> None:
    """Bit for bit over 5 steps, in which each vehicle begins twice again."""
    rollout, before = flown(erring(start_heading="random", max_steps=2), 5), None
    for row in rollout.unbind(1):
        now, after, found = reading_of(row), reading_of(row["next"]), track_of(row["track"])
        if (now.step == 0).all():
            before = begin(RULES, now)
        assert_equal(found, before)
        before = advance(RULES, found.state, after)
        assert_equal(track_of(row["next", "track"]), before)
        assert torch.equal(row["next", "observation"], observation(RULES, before, after))
    assert (rollout["elapsed_steps"] == 0).sum() == 12


def test_a_step_depends_on_what_is_in_the_tensordict_alone() -> None:
    """As stored data are stepped again, by another environment and by the transform itself."""
    rollout = flown(erring())
    transform = TrackField(RULES, [key for key in KNOWN_KEYS if key in rollout.keys()])  # noqa: SIM118
    known = rollout.select(("track", "state"), *(("next", key) for key in transform.in_keys))
    again = transform(known)["next", "track"]
    close(tree_leaves(track_of(again)), tree_leaves(track_of(rollout["next", "track"])), rtol=1e-6, atol=1e-6)
    state = step_mdp(rollout[:, -2].clone()).set("action", torch.tensor([30.0, 0.5]).expand(4, 2))
    one, two = (tracked().step(state.clone())["next"] for _ in range(2))
    assert_equal(track_of(one["track"]), track_of(two["track"]))
    with pytest.raises(KeyError, match=r"TrackField reads its state .*track.*state.*mean"):
        tracked().step(state.exclude("track"))


def test_without_noise_it_finds_gradient_and_destination() -> None:
    after = flown(tracked(32, rules=Rules(), max_steps=50), 12)[:, -1]["next"]
    env = GeomagneticNavEnv(seed=0)
    true, local = elements_gradient_at(env.field, after["position"]), after["track", "local"]
    error = (local["gradient"] - true) / torch.tensor((0.004, 0.015, 4.0)).unsqueeze(-1)
    assert error.norm(dim=(-2, -1)).median() < 0.05
    distance_km, bearing = geodesic(*after["position"].T, *after["target_position"].T)
    true_displacement = (distance_km * torch.stack((bearing.cos(), bearing.sin()))).T.float()
    assert ((after["track", "displacement", "mean"] - true_displacement).norm(dim=-1) / distance_km).median() < 0.05


# Declarations


def test_the_declaration_is_that_of_the_pure_function() -> None:
    """With the legs of a navigator that does not declare; the environment adds track and declaration by itself."""
    base = GeomagneticNavEnv(num_envs=4, seed=0, arrival="declared", max_steps=8, distance_range_km=(60, 150))
    env = TransformedEnv(base, SensorErrors(STD, bias=BIAS, seed=3))
    rules, found = Rules(**base.limits), policy_env(env, Secant()).rollout(8, Secant())
    again = evaluation_rollout(env, Secant())[:, : found.shape[1]]
    assert torch.equal(found["next", "position"], again["next", "position"])
    for row in found.unbind(1):
        action, decision = declaring(rules, track_of(row["track"]), reading_of(row), row["action"])
        torch.testing.assert_close(row["arrival_probability"].squeeze(-1), decision.probability.float())
        torch.testing.assert_close(row["next", "leg"], action[:, :2])
        assert torch.equal(row["next", "declared"].squeeze(-1), action[:, 2] > 0)
    assert found["next", "declared"].any()


@pytest.mark.slow
def test_declarations_are_as_often_right_as_they_say_and_confidence_prevents_false_ones() -> None:
    """Of vehicles with constant errors, of which readings show only a part."""
    rates = []
    for confidence in (0.0, 0.8):
        base = paper_env(60, arrival="declared", max_steps=20)
        env = TransformedEnv(base, SensorErrors(STD, bias=SMALL_BIAS, seed=1))
        navigator = Secant(sensor_std=STD)
        rollout = evaluation_rollout(policy_env(env, navigator, confidence=confidence), navigator)
        said = rollout["next", "declared"].squeeze(-1) & ~rollout["declared"].squeeze(-1)
        probability, right = rollout["arrival_probability"][said], rollout["next", "success"][said]
        assert probability.min() >= confidence
        assert confidence or abs(probability.mean() - right.float().mean()) < 0.12
        rates.append(summarize(episode_measures(rollout)))
    bold, careful = rates
    assert bold["success_rate"] + bold["false_arrival_rate"] + bold["not_declared_rate"] == 100
    assert 0 < careful["false_arrival_rate"] < bold["false_arrival_rate"] - 5
    assert 10 < careful["success_rate"] < bold["success_rate"]


def test_measures_by_hand() -> None:
    """Four vehicles that stay 5, 9, 20 and 30 km from their targets; the third declares falsely, the fourth never."""
    env = near(5.0, 9.0, 20.0, 30.0)
    declare = torch.tensor([1.0, 1.0, 1.0, -1.0]).unsqueeze(-1)

    def act(heading: Tensor) -> Tensor:
        return torch.cat((torch.zeros(4, 2), declare.expand_as(heading)), -1)

    policy = TensorDictModule(act, in_keys=["heading"], out_keys=["action"])
    episodes = episode_measures(evaluation_rollout(env, policy))
    assert episodes["success"].tolist() == [True, True, False, False]
    assert episodes["false_arrival"].tolist() == [False, False, True, False]
    assert episodes["not_declared"].tolist() == [False, False, False, True]
    summary = summarize(episodes)
    assert summary["success_rate"] == 50
    assert summary["false_arrival_rate"] == summary["not_declared_rate"] == 25
    assert summary["false_arrival_rate_low"] == pytest.approx(4.56, abs=0.01)
    assert summary["navigation_error_km"] == pytest.approx(7.0, abs=1e-4)
    plain = episode_measures(evaluation_rollout(paper_env(), Secant()))
    assert not {"false_arrival", "not_declared"} & set(plain)
    assert "false_arrival_rate" not in summarize(plain)


def under(transform: Transform, **options: object) -> TransformedEnv:
    return TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0, **options), transform)


MISTAKES: dict[str, Callable[[], object]] = {
    r"reads 'leg' as .*3\), got \(2, 2\)": lambda: under(TrackField(in_keys=["leg", *READ_KEYS[1:]])).specs,
    "optional must be one of 'sensor_std', .*'readings'": lambda: TrackField(optional=["readings"]),
    r"third number .*\(2, 2\)": lambda: under(DeclareArrival(Rules(arrival="declared"))).specs,
    r"reads 'track', .*add a TrackField": lambda: (
        under(DeclareArrival(Rules(arrival="declared")), arrival="declared").specs
    ),
}


@pytest.mark.parametrize("message", MISTAKES)
def test_mistakes(message: str) -> None:
    with pytest.raises((ValueError, KeyError), match=message):
        MISTAKES[message]()
