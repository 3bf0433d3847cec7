"""Errors of sensors, north reference and motion: conformance, numbers by hand, statistics, and what depends on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest
import torch
from support.conformance import Conformance
from support.environments import PlaneEnv, nested, parallel
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from magrl.agents import FieldPolicy
from magrl.agents.policy import PolicyConfig
from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv, Scenario
from magrl.field import FieldModel
from magrl.geodesy import move
from magrl.navigators import Kalman, Secant
from magrl.transforms import (
    NORTH_REFERENCES,
    TRUE_KEYS,
    MinMaxNorm,
    MotionError,
    NorthReferenceError,
    RandomSensorNoise,
    SensorErrors,
    SensorNoise,
    VectorErrors,
    north_reference,
)
from magrl.transforms.errors.base import gauss_markov
from magrl.transforms.errors.motion import EDDIES, eddy_velocity, eddy_waves
from magrl.transforms.errors.sensors import OUTAGE_STD

pytestmark = pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped")
F64 = torch.float64


@cache
def field() -> FieldModel:
    return Scenario().build_field(drift_km=30.0)


def nav(num_envs: int = 2, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(field=field()), num_envs=num_envs, **({"seed": 0, "drift_km": 30.0} | options))


def sensor_errors(**options: object) -> SensorErrors:
    sizes = {"bias": (0.1, 0.1, 20.0), "scale": (0.0, 0.0, 1e-3), "drift": (0.05, 0.05, 10.0), "drift_length": 200.0}
    vector = VectorErrors((50.0,) * 3, ((1e-3,) * 3,) * 3, (0.1, 0.1))
    rest = {"resolution": (0.01, 0.01, 1.0), "outage_rate": 0.2, "vector": vector}
    return SensorErrors((0.05, 0.05, 5.0), **(sizes | rest | options))


def north_error(**options: object) -> NorthReferenceError:
    keys = ("heading", "field", "move", "position")
    return NorthReferenceError(0.5, 0.3, 0.2, drift_length_km=100.0, in_keys=keys, **options)


def motion_error(**options: object) -> MotionError:
    errors = {"log_scale": 0.02, "log_noise": 0.01, "compass_deg": 3.0, "heading_noise_deg": 1.0}
    return MotionError(**errors, current_km_h=2.0, eddies_km_h=0.5, speed_km_h=30.0, **options)


def every_error() -> Transform:
    return Compose(motion_error(), sensor_errors(), north_error())


def in_a_chain() -> Transform:
    norm = MinMaxNorm(in_keys_inv=["action"], bounds={"action": ((0.0, -1.57), (50.0, 1.57))})
    return Compose(motion_error(), RandomSensorNoise(), north_error(), norm)


def of_scents() -> Transform:
    keys = {"in_keys": [nested("scent")], "out_keys": [nested("smelled")], "true_key": None}
    return SensorErrors((0.5, 0.0), bias=(1.0, 0.0), drift=(1.0, 1.0), drift_length=3.0, move_key=None, **keys)


CASES: dict[str, tuple[Callable[[], EnvBase], Callable[[], Transform]]] = {
    "sensors": (nav, sensor_errors),
    "sensors without errors": (nav, SensorErrors),
    "north": (nav, north_error),
    "motion": (nav, motion_error),
    "all": (nav, every_error),
    "chain": (nav, in_a_chain),
    "plane": (partial(PlaneEnv, (3,), F64), of_scents),
}
cases = pytest.mark.parametrize(("base", "make"), CASES.values(), ids=CASES.keys())


@cases
class TestConformance(Conformance):
    """Of each case."""


def all_errors(num_envs: int = 2, **options: object) -> TransformedEnv:
    return TransformedEnv(nav(num_envs, **options), every_error())


def actions(steps: int, num_envs: int) -> Tensor:
    draws = torch.rand(steps, num_envs, 2, generator=torch.Generator().manual_seed(0))
    return draws * torch.tensor([50.0, 1.5])


def flown(env: EnvBase, steps: Tensor) -> list[TensorDict]:
    """States of some moves, the first included."""
    states = [env.reset()]
    for action in steps:
        states.append(step_mdp(env.step(states[-1].clone().set("action", action))))
    return states


def assert_same(one: TensorDict, other: TensorDict, rows: Tensor | slice = slice(None)) -> None:
    for key in one.keys(True, True):
        assert torch.equal(one[key][rows], other[key][rows]), key


# Purity


@pytest.mark.parametrize("inside", [True, False])
def test_in_other_processes_everything_is_the_same(inside: bool) -> None:
    env = parallel(all_errors) if inside else TransformedEnv(parallel(nav), every_error())
    try:
        check_env_specs(env)
        if inside:
            state = env.rand_action(env.reset())
            assert_same(env.step(state.clone())["next"], env.step(state.clone())["next"])
    finally:
        env.close()


def test_errors_are_those_of_the_seed_and_of_each_vehicle() -> None:
    """Whatever the batch; another seed, vehicle or episode has others; a restart repeats them."""
    steps, env = actions(4, 3), all_errors(3)
    three = flown(env, steps)
    for one, other in zip(three, flown(all_errors(3), steps), strict=True):
        assert_same(one, other)
    two = flown(all_errors(2), steps[:, :2])
    keys = ("sensor_error", "north_error", "motion_error")
    for key in keys:
        torch.testing.assert_close(two[-1][key], three[-1][key][:2], rtol=1e-4, atol=1e-4)
        assert not torch.isclose(three[0][key][0], three[0][key][1]).any() or key == "sensor_error"
        assert not torch.equal(env.reset()[key], three[0][key])
    env.set_seed(0)
    for part in env.transform:
        part.restart()
    assert_same(env.reset(), three[0])
    other = TransformedEnv(nav(3), Compose(motion_error(seed=1), sensor_errors(seed=1), north_error(seed=1))).reset()
    assert not any(torch.equal(other[key], three[0][key]) for key in keys)


def test_partial_reset_leaves_the_other_vehicles_alone() -> None:
    env = all_errors(4)
    state = flown(env, actions(3, 4))[-1]
    chosen = torch.tensor([False, True, True, False])
    after = env.reset(state.clone().set("_reset", chosen.unsqueeze(-1)))
    assert_same(after, state, ~chosen)
    assert (after["north_error"][chosen] != state["north_error"][chosen]).all()


def test_without_errors_everything_is_the_same_to_the_bit() -> None:
    nothing = Compose(MotionError(), SensorErrors(), NorthReferenceError())
    plain, env = flown(nav(3), actions(5, 3)), flown(TransformedEnv(nav(3), nothing), actions(5, 3))
    for true, measured in zip(plain, env, strict=True):
        assert_same(true, measured.select(*true.keys()))
        assert measured["sensor_std"].eq(0).all()


def test_a_step_without_the_state_is_refused() -> None:
    env = all_errors()
    state = env.rand_action(env.reset())
    for key in ("true_heading", "rated_std", "sensor_error", "north_error", "motion_error", "motion_stream"):
        with pytest.raises(KeyError, match=f"{key}.*which its reset writes: step from what reset"):
            env.step(state.exclude(key))


def policies(env: GeomagneticNavEnv) -> list:
    torch.manual_seed(0)
    return [Secant(), Kalman(), FieldPolicy(PolicyConfig(env.observation_view(), (16,)))]


def test_no_policy_reads_what_is_true() -> None:
    env = all_errors(4)
    states = flown(env, actions(3, 4))
    private = [key for key in (*PRIVILEGED_KEYS, *TRUE_KEYS) if key in states[0].keys()]  # noqa: SIM118
    assert set(private) >= {*TRUE_KEYS} - {"weather_clock"}
    for index in range(3):
        for change in (False, True):
            one, other = policies(nav())[index], policies(nav())[index]
            for state in states:
                seen = state.clone()
                for key in private:
                    seen[key] = torch.rand_like(seen[key].double()).to(seen[key].dtype)
                if change:
                    seen["field"] = seen["field"] * 1.01
                same = torch.equal(one(state.clone())["action"], other(seen)["action"])
            assert same != change


# Sensors


def measured(elements: tuple[float, ...], heading_deg: float, **errors: object) -> list[float]:
    vector = VectorErrors(**errors, fixed=True)
    heading = torch.tensor([math.radians(heading_deg)], dtype=F64)
    return vector.disturb(
        torch.tensor(elements, dtype=F64), heading, vector.constants(torch.zeros(14).double())
    ).tolist()


@pytest.mark.parametrize(
    ("heading", "errors", "expected"),
    [
        (0, {"hard_iron_nt": (100, 0, 0)}, (5, 0, 20100)),  # along magnetic north
        (90, {"hard_iron_nt": (100, 0, 0)}, (5 + math.degrees(math.atan(0.005)), 0, math.hypot(20000, 100))),
        (180, {"hard_iron_nt": (100, 0, 0)}, (5, 0, 19900)),
        (0, {"hard_iron_nt": (0, 0, 200)}, (5, math.degrees(math.atan(0.01)), 20000)),
        (0, {"soft_iron": ((0.01, 0, 0), (0, 0, 0), (0, 0, 0))}, (5, 0, 20200)),
        (90, {"soft_iron": ((0.01, 0, 0), (0, 0, 0), (0, 0, 0))}, (5, 0, 20000)),
    ],
)
def test_iron_by_hand(heading: float, errors: dict, expected: tuple[float, ...]) -> None:
    """D = 5, I = 0, B_H = 20000: the heading is counted from magnetic north."""
    assert measured((5, 0, 20000), heading + 5, **errors) == pytest.approx(expected, abs=1e-9)


def test_attitude_by_hand() -> None:
    """I = 60: roll turns D by tan(I) times the angle on a heading to magnetic north, and I on one across it."""
    turned = math.degrees(math.atan(math.sin(math.radians(1)) * math.tan(math.radians(60))))
    declination, inclination, _ = measured((0, 60, 20000), 0, attitude_deg=(1, 0))
    assert (declination, round(turned, 4)) == (pytest.approx(-turned), 1.7314)
    assert inclination == pytest.approx(60, abs=0.02)
    total = 20000 / math.cos(math.radians(60))
    across = 0, 59, total * math.cos(math.radians(59))
    assert measured((0, 60, 20000), 90, attitude_deg=(1, 0)) == pytest.approx(across)
    assert measured((0, 60, 20000), 0, attitude_deg=(0, 1)) == pytest.approx(across)


def test_variance_of_a_vector_is_that_of_its_errors() -> None:
    vector = VectorErrors((60.0,) * 3, ((2e-3,) * 3,) * 3, (0.1, 0.1))
    draw = torch.Generator().manual_seed(0)
    constants = vector.constants(torch.randn(100_000, 14, generator=draw, dtype=F64))
    elements = torch.tensor([8.0, 50.0, 30000.0], dtype=F64)
    heading = 6.28 * torch.rand(100_000, 1, generator=draw, dtype=F64)
    error = vector.disturb(elements.expand(100_000, 3), heading, constants) - elements
    torch.testing.assert_close(error.var(0), vector.variance(elements), rtol=0.02, atol=0)


def test_constant_errors_by_hand() -> None:
    errors = SensorErrors(bias=(0.1, -0.2, 30.0), scale=(0.0, 0.0, 0.01), resolution=(0.0, 0.5, 0.0), fixed=True)
    for state in flown(TransformedEnv(nav(), errors), actions(2, 2)):
        true = state["true_field"]
        expected = true * torch.tensor([1, 1, 1.01]) + torch.tensor([0.1, -0.2, 30.0])
        expected[:, 1] = (2 * expected[:, 1]).round() / 2
        torch.testing.assert_close(state["field"], expected)
        slow = 0.1, 0.2, math.hypot(30.0, 0.01 * 24000)
        torch.testing.assert_close(state["bias_std"][0], torch.tensor(slow))
        torch.testing.assert_close(state["sensor_std"][0], torch.tensor([0.0, 0.5 / math.sqrt(12), 0.0]))


def test_bias_is_constant_and_of_its_size() -> None:
    env = TransformedEnv(nav(2000), SensorErrors((0.0,) * 3, bias=(0.1, 0.2, 30.0)))
    states = [(s["field"] - s["true_field"]) for s in flown(env, actions(2, 2000))]
    torch.testing.assert_close(states[0], states[2], atol=0.01, rtol=0)
    torch.testing.assert_close(states[0].std(0), torch.tensor([0.1, 0.2, 30.0]), rtol=0.05, atol=0)
    assert torch.corrcoef(states[0].T).triu(1).abs().max() < 4.5 / math.sqrt(2000)


def test_drift_is_stationary_and_forgets_with_the_way() -> None:
    count = 4000
    env = TransformedEnv(nav(count), SensorErrors((0.0,) * 3, drift=(0.1, 0.2, 30.0), drift_length=40.0))
    step = torch.tensor([[[20.0, 0.1]], [[0.0, 0.0]], [[20.0, 1.0]]]).expand(-1, count, -1)
    drift = torch.stack([s["sensor_error"][:, 6:9] / torch.tensor([0.1, 0.2, 30.0]) for s in flown(env, step)])
    torch.testing.assert_close(drift.std(1), torch.ones(4, 3), atol=0.05, rtol=0)
    assert torch.equal(drift[1], drift[2])  # no way, no change
    for later, correlation in ((1, math.exp(-0.5)), (3, math.exp(-1))):
        found = torch.stack([torch.corrcoef(drift[[0, later], :, k])[0, 1] for k in range(3)])
        torch.testing.assert_close(found, torch.full((3,), correlation), atol=0.05, rtol=0)


def test_gauss_markov_does_not_depend_on_the_steps() -> None:
    draw = torch.Generator().manual_seed(0)
    start = torch.full((100_000,), 2.0, dtype=F64)
    once, first, second = torch.randn(3, 100_000, generator=draw, dtype=F64)
    one = gauss_markov(start, 0.5, 30.0, 100.0, once)
    two = gauss_markov(gauss_markov(start, 0.5, 10.0, 100.0, first), 0.5, 20.0, 100.0, second)
    for value in (one, two):
        assert value.mean().item() == pytest.approx(2 * math.exp(-0.3), abs=0.01)
        assert value.std().item() == pytest.approx(0.5 * math.sqrt(1 - math.exp(-0.6)), rel=0.01)


def test_an_outage_repeats_the_last_reading() -> None:
    env = TransformedEnv(nav(2000), SensorErrors((0.05, 0.05, 5.0), outage_rate=0.3))
    states = flown(env, actions(3, 2000))
    missing = [state["sensor_std"].eq(OUTAGE_STD).all(-1) for state in states]
    assert not missing[0].any()
    for before, after, lost in zip(states[:-1], states[1:], missing[1:], strict=True):
        assert lost.double().mean() == pytest.approx(0.3, abs=0.05)
        assert torch.equal(after["field"][lost], before["field"][lost])
        assert (after["field"][~lost] != before["field"][~lost]).all()
        torch.testing.assert_close(
            after["sensor_std"][~lost], torch.tensor((0.05, 0.05, 5.0)).expand(int((~lost).sum()), 3)
        )


# North


def test_an_error_of_two_degrees_turns_the_heading_and_the_declination() -> None:
    """And the vehicle goes where it went without, as a turn is relative; it believes to go 2 degrees less."""
    plain = flown(nav(3), actions(4, 3))
    states = flown(TransformedEnv(nav(3), NorthReferenceError(2.0, fixed=True)), actions(4, 3))
    for true, state in zip(plain, states, strict=True):
        assert torch.equal(state["true_heading"], true["heading"])
        assert torch.equal(state["position"], true["position"])
        assert torch.equal(state["true_field"], true["field"])
        believed = torch.remainder(true["heading"] - math.radians(2) - state["heading"] + 1, 2 * math.pi) - 1
        torch.testing.assert_close(believed, torch.zeros(3, 1), atol=1e-5, rtol=0)
        torch.testing.assert_close(state["field"] - true["field"], torch.tensor([[-2.0, 0.0, 0.0]]).expand(3, 3))
        assert state["bias_std"].tolist() == [[2.0, 0.0, 0.0]] * 3
        assert state["sensor_std"].eq(0).all()


def test_declination_is_wrapped() -> None:
    state = TensorDict(
        heading=torch.tensor([[-3.12]]), field=torch.tensor([[-179.0, 0.0, 1.0]]), move=torch.zeros(1, 2)
    )
    after = NorthReferenceError(3.0, fixed=True)._reset(TensorDict(batch_size=[1]), state.auto_batch_size_(1))
    torch.testing.assert_close(after["field"][0, 0], torch.tensor(178.0))
    torch.testing.assert_close(after["heading"][0, 0], torch.tensor(2 * math.pi - 3.12 - math.radians(3)))


def test_error_grows_with_the_secant_of_the_latitude() -> None:
    keys = ("heading", "field", "move", "position")
    error = NorthReferenceError(0.5, fixed=True, in_keys=keys)
    for state in flown(TransformedEnv(nav(3), error), actions(3, 3)):
        latitude = state["position"][:, 0].deg2rad()
        torch.testing.assert_close(state["north_error"][:, 2].double(), 0.5 / latitude.cos(), atol=1e-6, rtol=0)


def test_parts_of_the_error_have_their_sizes() -> None:
    env = TransformedEnv(nav(4000), NorthReferenceError(0.5, 0.3, 0.2, drift_length_km=20.0))
    states = flown(env, torch.tensor([[[20.0, 0.1]]]).expand(2, 4000, -1))
    parts = torch.stack([state["north_error"] for state in states])
    white = parts[..., 2] - parts[..., 0] - parts[..., 1]
    assert torch.equal(parts[0, :, 0], parts[2, :, 0])
    sizes = torch.stack((parts[..., 0].std(1), parts[..., 1].std(1), white.std(1)), -1)
    torch.testing.assert_close(sizes, torch.tensor([[0.5, 0.3, 0.2]]).expand(3, 3), rtol=0.05, atol=0)
    assert torch.corrcoef(parts[:, :, 1])[0, 2].item() == pytest.approx(math.exp(-2), abs=0.05)
    assert torch.corrcoef(white).triu(1).abs().max() < 0.06


def test_noise_before_the_error_keeps_its_own_size() -> None:
    """The accuracy of D grows once, not at each step, and the noise does not grow with it."""
    north = NorthReferenceError(0.4, random_deg=0.4, fixed=True)
    env = TransformedEnv(nav(2000), Compose(SensorNoise((0.3, 0.1, 5.0)), north))
    states = flown(env, actions(6, 2000))
    noise = [(s["field"] - s["true_field"]) - torch.tensor([-0.4, 0.0, 0.0]) for s in states]
    torch.testing.assert_close(noise[-1].std(0), torch.tensor([0.5, 0.1, 5.0]), rtol=0.06, atol=0)
    torch.testing.assert_close(states[-1]["sensor_std"][0], torch.tensor([0.5, 0.1, 5.0]))
    torch.testing.assert_close(states[-1]["bias_std"][0], torch.tensor([0.4, 0.0, 0.0]))


@pytest.mark.parametrize("name", NORTH_REFERENCES)
def test_references_on_the_market(name: str) -> None:
    """The total of the standards' limits, read as two standard deviations."""
    error = north_reference(name, speed_km_h=20.0)
    total = {"fiber-optic": 0.1, "marine": math.hypot(0.375, 0.125, 0.25), "low-cost": math.hypot(0.5, 0.75)}
    state = TransformedEnv(nav(), error).reset()
    assert math.hypot(state["sensor_std"][0, 0], state["bias_std"][0, 0]) == pytest.approx(total[name])
    assert ("position" in error.in_keys) == (name != "low-cost")


# Motion


def test_a_track_with_errors_is_that_of_a_numpy_integration() -> None:
    errors = MotionError(log_scale=0.1, compass_deg=15.0, current_km_h=9.0, speed_km_h=30.0, fixed=True)
    env, steps = TransformedEnv(nav(3), errors), actions(6, 3)
    states = flown(env, steps)
    drift = 9.0 / 30.0 * np.exp(1j * states[0]["motion_error"][:, 2].double().numpy())  # north + i east, per km
    heading, position = np.zeros(3), states[0]["position"]
    for action, state in zip(steps.double(), states[1:], strict=True):
        distance, turn = action.T.numpy()
        heading = heading + turn
        way = distance * (1.1 * np.exp(1j * (heading + math.radians(15))) + drift)
        ends = move(*position.unbind(-1), torch.tensor(np.angle(way)), torch.tensor(np.abs(way)))
        position = torch.stack(ends, -1)
        torch.testing.assert_close(state["position"], position, atol=2e-6, rtol=0)  # 0.2 m
        torch.testing.assert_close(state["move"], action.float())
        believed = np.angle(np.exp(1j * (state["heading"][:, 0].numpy() - heading)))
        assert np.abs(believed).max() < 1e-5
        torch.testing.assert_close(state["true_move"][:, 0].double(), torch.tensor(np.abs(way)), rtol=1e-5, atol=0)
        assert np.abs(np.angle(np.exp(1j * state["true_course"][:, 0].numpy()) / way)).max() < 1e-5


def test_noise_of_log_and_heading_is_new_in_each_move() -> None:
    env = TransformedEnv(nav(3000), MotionError(log_noise=0.02, heading_noise_deg=2.0))
    states = flown(env, torch.tensor([[[50.0, 0.0]]]).expand(3, 3000, -1))[1:]
    stretch = torch.stack([s["true_move"][:, 0] / 50 - 1 for s in states])
    swing = torch.stack([s["true_course"][:, 0].rad2deg() for s in states])
    torch.testing.assert_close(stretch.std(1), torch.full((3,), 0.02), rtol=0.05, atol=0)
    torch.testing.assert_close(swing.std(1), torch.full((3,), 2.0), rtol=0.05, atol=0)
    assert torch.corrcoef(torch.cat((stretch, swing))).triu(1).abs().max() < 4.5 / math.sqrt(3000)
    assert all(s["heading"].eq(0).all() for s in states)


def test_a_vehicle_at_rest_does_not_drift() -> None:
    before, after = flown(TransformedEnv(nav(), motion_error()), torch.tensor([[[0.0, 0.3], [0.0, -0.3]]]))
    torch.testing.assert_close(before["position"], after["position"])
    torch.testing.assert_close(after["true_course"], torch.tensor([[0.3], [-0.3]]))


def test_eddies_are_free_of_divergence_and_of_unit_size() -> None:
    draw = torch.Generator().manual_seed(0)
    waves = eddy_waves(0, 200.0)
    phases = 2 * math.pi * torch.rand(20_000, EDDIES, generator=draw, dtype=F64)
    place = torch.tensor([60.0, 20.0], dtype=F64).expand(20_000, 2)
    speed = eddy_velocity(place, waves, phases)
    assert speed.square().sum(-1).mean().item() == pytest.approx(1, abs=0.35)  # 8 waves, not in all directions alike
    many = torch.cat([eddy_velocity(place[:50], eddy_waves(seed, 200.0), phases[:50]) for seed in range(400)])
    assert many.square().sum(-1).mean().item() == pytest.approx(1, abs=0.03)
    assert speed.norm(dim=-1).max() < math.sqrt(3 * EDDIES)

    def flux(offset: tuple[float, float], axis: int) -> Tensor:
        at = place[:100] + torch.tensor(offset, dtype=F64)
        return eddy_velocity(at, waves, phases[:100])[:, axis] * (at[:, 0].deg2rad().cos() if axis == 0 else 1)

    h = 1e-4
    divergence = (flux((h, 0), 0) - flux((-h, 0), 0)) + (flux((0, h), 1) - flux((0, -h), 1))
    slope = (flux((h, 0), 0) - flux((-h, 0), 0)).abs().mean()
    assert divergence.abs().max() < 1e-5 * slope


def test_the_environment_must_allow_the_farthest_move() -> None:
    errors = MotionError(log_noise=0.01, current_km_h=3.0, speed_km_h=30.0)
    with pytest.raises(
        ValueError,
        match=r"up to 7 km farther .* allows 5 km: create it with drift_km=7.0",
    ):
        _ = TransformedEnv(nav(drift_km=5.0), errors).specs
    env = TransformedEnv(nav(drift_km=7.01), MotionError(log_noise=0.01, current_km_h=3.0, speed_km_h=30.0))
    assert env.action_spec.space.high[0, 0] == 50
    with pytest.raises(ValueError, match=r"distance \[km\] must be in \[0, 50"):
        nav(drift_km=0.0).step(nav(drift_km=0.0).reset().set("action", torch.tensor([[51.0, 0.0]] * 2)))


# Bad input


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SensorErrors(bias=(0.1, -0.1, 1.0)), r"bias .*not negative, got \(0.1, -0.1, 1.0\)"),
        (lambda: SensorErrors(bias=(0.1, 0.1)), r"bias must be 3 finite numbers, got \(0.1, 0.1\)"),
        (lambda: SensorErrors(drift=(0.1, 0.1, 1.0)), "drift_length .*None"),
        (lambda: SensorErrors(drift=(0.1, 0.1, 1.0), drift_length=0.0), "drift_length .*0.0"),
        (lambda: SensorErrors(resolution=(0.1, math.nan, 1.0)), "resolution .*nan"),
        (lambda: SensorErrors(outage_rate=1), "outage_rate .*1"),
        (lambda: SensorErrors((1.0, 1.0), vector=VectorErrors()), "got 2 elements"),
        (lambda: VectorErrors((1.0, -1.0, 0.0)), r"hard_iron_nt .*\(1.0, -1.0, 0.0\)"),
        (lambda: VectorErrors(soft_iron=((1.0,),)), r"soft_iron .*\(\(1.0,\),\)"),
        (lambda: VectorErrors(attitude_deg=(1.0,)), r"attitude_deg .*\(1.0,\)"),
        (lambda: NorthReferenceError(-1.0), "constant_deg .*-1.0"),
        (lambda: NorthReferenceError(0.0, 1.0), "drift_length_km .*None"),
        (lambda: NorthReferenceError(in_keys=("heading",)), r"3 or 4 in_keys .*\['heading'\]"),
        (lambda: north_reference("sextant", speed_km_h=1.0), "'sextant': choose from fiber-optic, marine, low-cost"),
        (lambda: north_reference("marine", speed_km_h=0.0), "speed_km_h .*0.0"),
        (lambda: MotionError(log_noise=-0.1), "log_noise .*-0.1"),
        (lambda: MotionError(log_scale=0.3), "log_scale 0.3 .*above 0"),
        (lambda: MotionError(current_km_h=1.0), "speed_km_h .*None"),
        (lambda: MotionError(current_km_h=1.0, speed_km_h=0.0), "speed_km_h .*0.0"),
        (lambda: MotionError(eddy_km=0.0), "eddy_km .*0.0"),
        (lambda: nav(drift_km=-1.0), "drift_km .*-1.0"),
    ],
)
def test_bad_options_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
