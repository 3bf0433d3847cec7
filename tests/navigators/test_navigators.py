"""Navigators that need no training, and all on another device."""

import itertools
import math
import sys

import pytest
import torch
from support.conformance import check_one_device
from support.tracks import randn
from tensordict import TensorDict
from torchrl.envs import Transform, TransformedEnv
from torchrl.envs.utils import step_mdp

from magrl.envs import PUBLIC_KEYS, GeomagneticNavEnv, Region, Scenario, trip_set
from magrl.envs.navigation import navigation_env
from magrl.errors import Conditions, SensorErrors, with_conditions
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.evaluation.tables import short_table
from magrl.field import elements_gradient_at
from magrl.geodesy import geodesic
from magrl.guidance import displacement_to
from magrl.navigators import NAVIGATORS, MeanJacobian, Navigator, ParallelApproach, Secant, policy_env
from magrl.navigators.metaheuristics import Metaheuristic
from magrl.navigators.names import make_navigator
from magrl.navigators.quasi_newton import probe_length
from magrl.pilot import earth_model
from magrl.sensor_std import STD_KEYS


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(trips=trip_set(30, seed=71)), num_envs=30, seed=0)


NOISE = (0.05, 0.05, 5.0)


def flown(env: GeomagneticNavEnv, navigator) -> dict[str, float]:
    env.set_seed(0)  # back to each vehicle's first trip
    return summarize(episode_measures(evaluation_rollout(env, navigator)))


def test_a_navigator_that_is_told_of_its_arrival_searches() -> None:
    """Under constant errors the destination is not where the readings fit."""
    biased, rates = Conditions("biased", errors={"sensors": {"bias": (0.15, 0.05, 20.0)}}), []
    for search in (False, True):
        base = GeomagneticNavEnv(num_envs=30, seed=0, max_steps=30)
        navigator = make_navigator("secant", base, sensor_std=biased.std)
        assert navigator.search
        navigator.search = search
        rollout = evaluation_rollout(with_conditions(base, biased, seed=0), navigator)
        rates.append(summarize(episode_measures(rollout))["success_rate"])
    assert rates[1] > 90 > 70 > rates[0]
    assert not make_navigator("secant", GeomagneticNavEnv(num_envs=2, seed=0, arrival="declared")).search


def test_dead_reckoning_declares_at_the_reckoned_destination() -> None:
    """Without errors, and so at the destination itself; the start that it reads is left as it was."""
    env = GeomagneticNavEnv(num_envs=20, seed=0, arrival="declared")
    flight = evaluation_rollout(env, make_navigator("dead_reckoning", env))
    assert (flight["start_position"] == flight["position"][:, :1]).all()
    end = flight["next"][:, -1]
    assert end["declared"].all()
    assert geodesic(*end["position"].T, *end["target_position"].T)[0].max() < 0.5


def test_displacement_solves_consistent_equations() -> None:
    """And is finite without a gradient across a line, or any."""
    for elements, shape in (2, ()), (2, (4,)), (3, (2, 3)):
        jacobian, displacement = randn(*shape, elements, 2), randn(*shape, 2, seed=1)
        error = (jacobian @ displacement.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(displacement_to(error, jacobian), displacement, atol=1e-5, rtol=1e-5)
    for dtype, slope in itertools.product((torch.float32, torch.float64), (0, 1)):
        assert (
            displacement_to(torch.tensor([1.0, 2.0], dtype=dtype), torch.full((2, 2), slope, dtype=dtype))
            .isfinite()
            .all()
        )


@pytest.mark.parametrize(("name", "spl", "steps"), [("parallel", 99.8, 9), ("secant", 99.5, 11)])
def test_a_navigator_flies_about_the_shortest_path(env, name: str, spl: float, steps: float) -> None:
    navigator = NAVIGATORS[name].for_env(env)
    summary = flown(env, navigator)
    assert summary["success_rate"] == 100
    assert summary["spl"] > spl
    assert summary["steps"] < steps
    assert navigator.oracle == (name == "parallel")
    assert not navigator.readings_per_step


def test_parallel_and_secant_arrive_where_a_pair_fails() -> None:
    """In the Arabian Sea the gradients of D and I are parallel along a line."""
    scenario = Scenario(region=Region((4, 14), (66, 76)), objective_floors=None)
    scenario = scenario.with_trips(scenario.random_trips(40, seed=1))
    sea = GeomagneticNavEnv(scenario, num_envs=40, seed=0)
    assert flown(sea, Secant(elements=("D", "I")))["success_rate"] < 90
    assert flown(sea, ParallelApproach(sea.field))["success_rate"] == 100
    assert flown(sea, Secant())["success_rate"] == 100


def test_secant_on_two_elements_and_narrow_turns() -> None:
    env = GeomagneticNavEnv(Scenario(trips=trip_set(20, seed=72)), num_envs=20, seed=0, max_turn_deg=math.degrees(1.0))
    assert flown(env, Secant(50.0, 1.0, elements=("D", "I")))["success_rate"] >= 98


def test_probes_are_longer_where_the_sensors_err() -> None:
    """The second most precise element counts: its noise of 0.05 deg is that of 0.05 / 0.015 km."""
    assert Secant().probe_km == probe_length((0.3, 0.0, 0.0)) == 0.5
    assert probe_length(NOISE) == pytest.approx(5 * (0.05 / 0.015) ** (2 / 3), rel=1e-12)
    assert probe_length((9.0, 0.05, 5.0)) == probe_length(NOISE)
    assert Secant(sensor_std=NOISE, probe_km=3.0).probe_km == 3.0
    assert Secant(8.0, sensor_std=NOISE).probe_km == 8.0  # no longer than the longest leg


def test_mean_jacobian_needs_no_probes(env) -> None:
    navigator = MeanJacobian(env.field, env.region.grid(21), sensor_std=NOISE)
    gradient = elements_gradient_at(env.field, env.region.grid(21)).reshape(-1, 3, 2)
    prior = navigator.prior(*torch.zeros(2, 5, 3, dtype=torch.float64))
    torch.testing.assert_close(prior.gradient, gradient.mean(0))
    torch.testing.assert_close(prior.std, gradient.std(0))
    summary = flown(env, NAVIGATORS["mean_jacobian"].for_env(env))
    assert summary["success_rate"] == 100
    assert summary["spl"] > 99.8
    assert summary["steps"] < 8.8
    assert flown(TransformedEnv(env, SensorErrors(NOISE), auto_unwrap=True), navigator)["spl"] > 96


def test_each_navigator_declares_what_it_is() -> None:
    """Names and labels are different; an oracle needs more than its readings."""
    assert len({kind.label for kind in NAVIGATORS.values()}) == len(NAVIGATORS)
    for name, kind in NAVIGATORS.items():
        assert issubclass(kind, Navigator)
        assert kind.name == name
        assert kind.description.startswith(kind.label)
        assert not kind.oracle or kind.needs != Navigator.needs
        assert not kind.oracle or "an oracle" in kind.description


def test_a_navigator_of_ones_own_needs_a_rule_alone(env) -> None:
    """It reads what a vehicle reads, its class is its name, and a column is as good as a vector."""
    vectors = type("Own", (Navigator,), {"decide": lambda _, seen, __: seen["leg"].clamp(1, 1.5).unbind(-1)})
    columns = type("Longer", (Navigator,), {"decide": lambda _, seen, __: seen["leg"].clamp(1, 1.5).split(1, -1)})
    assert (columns.name, columns.label, columns.description) == ("Longer",) * 3
    changed = type("Changed", (type("Named", (columns,), {"name": "named"}),), {"description": "named, changed"})
    assert (changed.name, changed.label, changed.description) == ("named", "named", "named, changed")
    assert short_table({vectors: [flown(env, vectors())]}).splitlines()[-1].startswith("| Own | nothing |")
    assert vectors().in_keys == [*PUBLIC_KEYS, "elapsed_steps"]
    torch.testing.assert_close(*(env.rollout(3, own())["action"] for own in (vectors, columns)))


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"in_keys": ["headin"]}, r"Own reads .*headin.*, its in_keys: .*headin.* not found .*heading"),
        ({"decide": lambda _, seen, __: seen["position"]}, r"Own reads .*leg.*, its in_keys: .*position.* not found"),
        ({"first_memory": lambda *_: {}}, r"memory.* not found.*policy_env\(env, policy\) returns"),
        ({}, r"Own has no method decide\(seen, memory\)"),
    ],
)
def test_what_a_navigator_of_ones_own_lacks_is_named(env, own: dict, message: str) -> None:
    with pytest.raises((KeyError, NotImplementedError), match=message):
        type("Own", (Navigator,), own)()(env.reset())


@pytest.mark.parametrize("name", sorted(NAVIGATORS))
def test_every_navigator_stays_in_bounds_and_reads_what_it_declares(name: str) -> None:
    """Bounds that are not the default; no key is optional."""
    env = GeomagneticNavEnv(num_envs=3, seed=4, max_leg_km=8.0, max_turn_deg=math.degrees(0.7), start_heading="random")
    navigator = NAVIGATORS[name].for_env(env)
    env = policy_env(env, navigator)
    state, longest = env.reset(), torch.zeros(())
    for _ in range(6):
        acted = navigator(state.clone())
        action = acted["action"]
        assert ((action[:, 0] >= 0) & (action[:, 0] <= 8)).all()
        assert (action[:, 1].abs() <= 0.7 + 1e-6).all()
        longest = torch.maximum(longest, action[:, 0].max())
        state = step_mdp(env.step(acted))
    assert longest > 3.9
    for key in navigator.in_keys:
        with pytest.raises(KeyError):
            navigator(state.exclude(key))


@pytest.mark.parametrize("name", ["secant", "kalman", "parallel"])
def test_declination_continues_across_half_a_turn(env, name: str) -> None:
    """D from -180 to 180 gives the legs of D without that jump."""

    class Rotated(Transform):
        """Add 171 degrees to D, which is 8 to 10 degrees there."""

        def __init__(self, wrapped: bool) -> None:
            super().__init__(["field"], ["field"])
            self.wrapped = wrapped

        def _apply_transform(self, field: torch.Tensor) -> torch.Tensor:
            turned = field.double() + torch.tensor([171.0, 0.0, 0.0]).double()
            return turned - 360 * self.wrapped * (turned > 180) * torch.tensor([1, 0, 0])

        def _reset(self, _: TensorDict, seen: TensorDict) -> TensorDict:
            return self._call(seen.set("target_field", self._apply_transform(seen["target_field"])))

    actions = []
    for wrapped in (False, True):
        few = GeomagneticNavEnv(env.scenario, num_envs=8, seed=0, max_steps=4)
        actions.append(evaluation_rollout(TransformedEnv(few, Rotated(wrapped)), make_navigator(name, few))["action"])
    torch.testing.assert_close(actions[0], actions[1], rtol=1e-3, atol=1e-3)


def test_a_new_episode_begins_a_new_memory_for_its_vehicle_alone(env) -> None:
    navigator = Secant()
    env.set_seed(0)
    state = policy_env(env, navigator).rollout(5, navigator)[:, -1]
    began = torch.arange(30) % 3 == 0
    mixed = torch.where(began, env.reset().set("memory", state["memory"]), state.select(*env.reset().keys(), "memory"))
    going, acted = navigator(state.clone()), navigator(mixed)
    torch.testing.assert_close(acted["action"][began], torch.tensor([0.5, 0.0]).expand(int(began.sum()), 2))
    assert torch.equal(acted["action"][~began], going["action"][~began])
    slopes = acted["next", "memory", "mean"][..., 1:]
    assert (slopes[began] == 0).all()
    assert (slopes[~began] != 0).all()


def test_secant_stands_a_field_without_change() -> None:
    navigator = Secant()
    state = policy_env(GeomagneticNavEnv(num_envs=2, seed=0), navigator).reset()
    for step in range(5):
        state["elapsed_steps"] = torch.full((2, 1), step)
        state["leg"] = torch.tensor([[10.0, 0.0]]).expand(2, 2) * (step > 0)
        acted = navigator(state)
        assert torch.isfinite(acted["action"]).all()
        state["memory"] = acted["next", "memory"]


def test_bad_options_are_refused_with_their_value() -> None:
    for make, message in (
        (lambda: Secant(max_turn_rad=4.5), "4.5"),
        (lambda: Secant(probe_km=60.0), "60.0"),
        (lambda: Secant(elements=("D",)), "'D'"),
        (lambda: Secant(elements=("D", "D")), "'D', 'D'"),
        (lambda: Secant(elements=("D", "X")), "'X'"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


def test_a_navigator_needs_physical_actions() -> None:
    env = navigation_env(2, seed=0)
    with pytest.raises(ValueError, match="secant acts in km and rad: take an environment with scale_actions=False"):
        policy_env(env, Secant())


def test_the_larger_bias_of_readings_and_of_what_is_stated_counts() -> None:
    """A navigator that is told nothing flies by what comes with the readings."""
    bias = (0.5, 0.1, 20.0)
    env = GeomagneticNavEnv(num_envs=4, seed=0, start_heading="random", max_steps=6)
    own = Conditions("own", errors={"sensors": {"noise": (0.02, 0.02, 2.0), "bias": bias}})
    told, full = (
        evaluation_rollout(with_conditions(env, own), Secant(sensor_std=std))["next", "position"]
        for std in (own.std.noise, own.std)
    )
    assert torch.equal(told, full)


def test_a_reading_that_is_nan_is_not_flown(env) -> None:
    """A NaN action, which the environment refuses, and not a leg by a guess; other vehicles go on."""
    env.set_seed(0)
    navigator = Secant()
    state = policy_env(env, navigator).rollout(4, navigator)[:, -1]
    state["field"][3] = torch.nan
    action = navigator(state)["action"]
    assert action[3, 1].isnan()
    assert action[:3].isfinite().all()


@pytest.mark.parametrize("name", sorted({*NAVIGATORS} - {"kalman"}))  # which is in anywhere
def test_a_navigator_stays_on_the_device_of_what_it_sees(name: str, monkeypatch) -> None:
    monkeypatch.setattr(sys.modules["magrl.pilot.destination"], "_STEPS", 1)
    arrival = "declared" if name in ("anywhere", "dead_reckoning") else "objective"
    env = GeomagneticNavEnv(num_envs=2, seed=0, arrival=arrival)
    monkeypatch.setattr(Metaheuristic, "generations", 2)
    navigator = NAVIGATORS[name].for_env(env)
    if name == "dead_reckoning":
        navigator = navigator.fitted(env, {"model": earth_model("IGRF-13", "2022-01-01")})
    seen = policy_env(env, navigator).reset().update({key: torch.zeros(2, 3) for key in STD_KEYS})
    act = getattr(navigator, "_best", navigator)  # without the choice of rows, whose number depends on values
    check_one_device(monkeypatch, navigator, lambda moved: act(moved(seen)))
