"""The transform that declares an arrival, and the measures of declared arrivals."""

from __future__ import annotations

import math
import sys
from collections import Counter
from functools import cache, partial

import pytest
import torch
from support.environments import parallel
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from magrl import tracking
from magrl.agents import kalman
from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv, Region, Scenario, Tasks
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.field import FieldModel
from magrl.geodesy import move
from magrl.navigators import Secant
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import DestinationPosterior
from magrl.transforms import DeclareArrival, SensorErrors, TrackField
from magrl.transforms.track import POSTERIOR_KEYS, belief_of

STD, BIAS = (0.05, 0.05, 5.0), (0.1, 0.1, 10.0)


@cache
def field() -> FieldModel:
    return Scenario().build_field()


def nav(num_envs: int = 2, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(field=field()), num_envs=num_envs, **({"seed": 0} | options))


def declared(num_envs: int = 2, radius_km: float = 25.0, **options: object) -> GeomagneticNavEnv:
    return nav(num_envs, arrival="declared", arrival_radius_km=radius_km, **options)


def declaring(num_envs: int = 2, base: GeomagneticNavEnv | None = None) -> TransformedEnv:
    return TransformedEnv(base or declared(num_envs), Compose(TrackField(), DeclareArrival(25.0, max_steps=50)))


def near(*distances_km: float, rule: str = "declared") -> GeomagneticNavEnv:
    """Vehicles whose targets are some distances northward; a radius of 10 km."""
    start = torch.tensor([[-5.0, 165.0]], dtype=torch.float64).expand(len(distances_km), 2)
    reach = torch.tensor(distances_km, dtype=torch.float64)
    target = torch.stack(move(*start.unbind(-1), torch.zeros_like(reach), reach), -1)
    scenario = Scenario(field=field(), tasks=Tasks(start, target))
    return GeomagneticNavEnv(scenario, num_envs=len(reach), arrival=rule, arrival_radius_km=10.0, seed=0)


def test_on_a_long_way_the_distance_tells_what_the_objective_hides() -> None:
    """At 1000 to 1800 km, F < 0.01 holds up to 100 km from the destination: SR is 100 %, and few end within 25 km."""
    region = Region((30.0, 50.0), (-45.0, -20.0))
    scenario = Scenario(region=region, date="2025-01-01", generation=14, distance_range_km=(1000.0, 1800.0))
    frozen = scenario.replace(max_steps=120).with_tasks(scenario.random_tasks(30, seed=1))
    by_objective, by_distance = (
        summarize(episode_measures(evaluation_rollout(env, Secant()), env))
        for env in (GeomagneticNavEnv(frozen, num_envs=30, arrival=rule, seed=0) for rule in ("objective", "distance"))
    )
    assert by_objective["success_rate"] == by_distance["success_rate"] == 100
    assert by_objective["success_rate_within_25km"] < 30
    assert by_objective["final_distance_km_median"] > 35
    assert by_distance["success_rate_within_25km"] == 100
    assert by_distance["final_distance_km_median"] < 25
    assert by_distance["spl_to_arrival"] < by_distance["spl"]


# The transform


@pytest.mark.parametrize(
    "make",
    [declaring, partial(SerialEnv, 2, declaring), lambda: parallel(declaring)],
    ids=["one", "serial", "parallel"],
)
def test_conformance(make) -> None:
    env = make()
    try:
        assert env.action_spec.shape[-1] == 2
        check_env_specs(env)
    finally:
        env.close()


@pytest.mark.parametrize("navigator", [kalman, Secant])
def test_every_navigator_can_be_flown(navigator) -> None:
    env = declaring(40)
    summary = summarize(episode_measures(evaluation_rollout(env, navigator()), env))
    assert summary["success_rate"] >= 97
    assert summary["success_rate"] + summary["false_arrival_rate"] == 100
    assert 80 < summary["spl_to_arrival"] < summary["spl"]
    assert summary["navigation_error_km_declared"] < 20


def test_the_decision_is_that_of_the_pure_function() -> None:
    """With the accuracy that comes with the readings, by the steps that are left."""
    world = {"std_keys": STD_KEYS, "range_km": 350.0, "crust_nt": 20.0}
    declare = DeclareArrival(25.0, max_steps=12, **world)
    steps = Compose(SensorErrors(STD, bias=BIAS, seed=1), TrackField(**world), declare)
    rollout = TransformedEnv(declared(6, max_steps=12), steps).rollout(11, Secant(), break_when_any_done=False)
    for seen in rollout.unbind(1):
        goal = tracking.destination(belief_of(seen), seen["target_field"], 350.0, 20.0)
        posterior = DestinationPosterior(*(seen[key] for key in POSTERIOR_KEYS))
        left = 11 - seen["elapsed_steps"].squeeze(-1)
        decision = tracking.arrival_decision(goal, posterior, SensorStd.read(seen), left, 25.0)
        expected = decision.probability, decision.worth, decision.way, decision.stop_km
        for key, value in zip(declare.default_out_keys, expected, strict=True):
            torch.testing.assert_close(seen[key].flatten(), value.float().flatten(), msg=key)
    assert rollout["arrival_worth"].unique().numel() > 20


def test_declarations_are_as_often_right_as_they_say_and_confidence_prevents_false_ones() -> None:
    """Of vehicles with constant errors, of which readings show only a part."""
    rates = []
    for confidence in (0.0, 0.8):
        declare = DeclareArrival(25.0, max_steps=20, confidence=confidence, std_keys=STD_KEYS)
        steps = Compose(SensorErrors(STD, bias=BIAS, seed=1), TrackField(std_keys=STD_KEYS), declare)
        env = TransformedEnv(declared(60, max_steps=20), steps)
        rollout = evaluation_rollout(env, Secant(sensor_std=STD))
        said = rollout["next", "declared"].squeeze(-1) & ~rollout["declared"].squeeze(-1)
        probability, right = rollout["arrival_probability"][said], rollout["next", "success"][said]
        assert probability.min() >= confidence
        assert confidence or abs(probability.mean() - right.float().mean()) < 0.12
        rates.append(summarize(episode_measures(rollout)))
    bold, careful = rates
    assert bold["success_rate"] + bold["false_arrival_rate"] == 100
    assert 0 < careful["false_arrival_rate"] < bold["false_arrival_rate"] - 5
    assert 20 < careful["success_rate"] < bold["success_rate"]


def test_it_goes_to_the_estimated_place_where_that_is_near() -> None:
    """20 km to the east of a vehicle that heads north, at a probability that is worth no declaration; and 30 km.

    Where it is near enough, 10 km to the west, it turns to read on another heading.
    """
    env = declaring(3)
    state = env.reset().set("action", torch.tensor([[50.0, -1.0]]).expand(3, 2))
    state["arrival_way"] = torch.tensor([[0.0, 20.0], [0.0, 30.0], [0.0, -10.0]])
    state["arrival_probability"], state["arrival_worth"] = torch.zeros(3, 1), torch.ones(3, 1)
    state["arrival_stop"] = torch.full((3, 1), 12.0)
    sent = env.transform.inv(state)["action"]
    quarter = math.pi / 2
    assert sent.tolist() == [
        pytest.approx([20.0 - 12.0, quarter, -1.0]),
        [50.0, -1.0, -1.0],
        pytest.approx([0.0, quarter, -1.0]),
    ]
    state["arrival_probability"] += 1
    assert env.transform.inv(state)["action"].tolist() == [[0.0, 0.0, 1.0]] * 3


def test_nothing_privileged_decides() -> None:
    env = declaring(20)
    state = env.rollout(6, Secant(), break_when_any_done=False)[:, -1].exclude("next")
    sent = env.transform.inv(state)["action"]
    for key in (*PRIVILEGED_KEYS, "declared"):
        state[key] = torch.full_like(state[key], 1)
    assert torch.equal(env.transform.inv(state)["action"], sent)


def test_one_belief_and_one_posterior_are_computed_for_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Estimate, plan, search and declaration share them, in the environment and in the policy that flies it."""
    counts = Counter()

    def counted(name: str) -> None:
        function = getattr(tracking, name)

        def call(*args: object) -> object:
            counts[name] += 1
            return function(*args)

        for module in (tracking, *(sys.modules[f"magrl.tracking.{part}"] for part in ("belief", "destination"))):
            if getattr(module, name, None) is function:
                monkeypatch.setattr(module, name, call)

    for name in ("start", "moved", "updated", "posterior", "mode"):
        counted(name)
    env = declaring(4, declared(4, max_steps=9))
    policy = kalman(max_steps=9, search=False)
    state = policy(env.reset())
    assert counts == {"start": 1, "updated": 1, "posterior": 1, "mode": 1}
    for _ in range(3):
        counts.clear()
        state = policy(env.step_mdp(env.step(state)))
        assert counts == {"moved": 1, "updated": 1, "posterior": 1, "mode": 1}


# Measures


def test_measures_by_hand() -> None:
    """Four vehicles that stay 5, 9, 20 and 30 km from their targets; the third declares falsely, the fourth never."""
    env = near(5.0, 9.0, 20.0, 30.0)
    declare = torch.tensor([1.0, 1.0, 1.0, -1.0]).unsqueeze(-1)

    def act(heading: Tensor) -> Tensor:
        return torch.cat((torch.zeros(4, 2), declare.expand_as(heading)), -1)

    policy = TensorDictModule(act, in_keys=["heading"], out_keys=["action"])
    episodes = episode_measures(evaluation_rollout(env, policy), env)
    assert episodes["success"].tolist() == [True, True, False, False]
    assert episodes["false_arrival"].tolist() == [False, False, True, False]
    assert episodes["spl_to_arrival"].tolist() == [1, 1, 0, 0]
    summary = summarize(episodes)
    assert summary["success_rate"] == 50
    assert summary["false_arrival_rate"] == 25
    assert summary["false_arrival_rate_low"] == pytest.approx(4.56, abs=0.01)
    assert summary["navigation_error_km"] == pytest.approx(7.0, abs=1e-4)
    assert summary["navigation_error_km_declared"] == pytest.approx((5 + 9 + 20) / 3, abs=1e-4)
    plain = episode_measures(evaluation_rollout(nav(), Secant()))
    assert "false_arrival" not in plain
    assert "false_arrival_rate" not in summarize(plain)


# Errors


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: DeclareArrival(-1.0, max_steps=5), "radius_km .*-1.0"),
        (lambda: DeclareArrival(5.0, max_steps=0), "max_steps .*0"),
        (lambda: DeclareArrival(5.0, max_steps=5, confidence=2), "confidence .*2"),
        (
            lambda: TransformedEnv(nav(), Compose(TrackField(), DeclareArrival(5.0, max_steps=5))).specs,
            r"third number .*\(2, 2\)",
        ),
    ],
)
def test_errors(make, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make()


def test_it_needs_a_track() -> None:
    env = TransformedEnv(declared(), DeclareArrival(5.0, max_steps=5))
    with pytest.raises(KeyError, match=r"DeclareArrival reads \['belief_mean', .*'destination_weights'\]"):
        env.reset()
