"""Errors of motion and of the north reference: by hand and by their statistics; magnetic north."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from support.errors import STD, actions, flown, motion_error, nav, sensor_errors
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from magrl import GeomagneticNavEnv
from magrl.envs import Scenario
from magrl.errors import NORTH_REFERENCES, MagneticNorth, MotionError, NorthReferenceError, north_reference
from magrl.errors.base import true_keys
from magrl.errors.motion import EDDIES, eddy_velocity, eddy_waves
from magrl.errors.north import SCHULER_HOURS
from magrl.evaluation import Flight, evaluate
from magrl.geodesy import MEAN_RADIUS_KM, geodesic, move
from magrl.sensor_std import SensorStd
from magrl.transforms import MinMaxNorm

F64 = torch.float64


def test_a_track_with_errors_is_that_of_a_numpy_integration() -> None:
    errors = MotionError(log_scale=0.1, compass_deg=15.0, current_km_h=9.0, speed_km_h=30.0, fixed=True)
    env, steps = TransformedEnv(nav(3), errors), actions(6, 3)
    states = flown(env, steps)
    drift = 9.0 / 30.0 * np.exp(1j * states[0]["motion_error"][:, 2].double().numpy())  # north + i east, per km
    heading, position = np.zeros(3), states[0]["position"]
    for action, state in zip(steps.double(), states[1:], strict=True):
        distance, turn = action.T.numpy()
        heading = heading + turn
        leg = distance * (1.1 * np.exp(1j * (heading + math.radians(15))) + drift)
        ends = move(*position.unbind(-1), torch.tensor(np.angle(leg)), torch.tensor(np.abs(leg)))
        position = torch.stack(ends, -1)
        torch.testing.assert_close(state["position"], position, atol=2e-6, rtol=0)  # 0.2 m
        torch.testing.assert_close(state["leg"], action.float())
        believed = np.angle(np.exp(1j * (state["heading"][:, 0].numpy() - heading)))
        assert np.abs(believed).max() < 1e-5
        torch.testing.assert_close(state["true_leg"][:, 0].double(), torch.tensor(np.abs(leg)), rtol=1e-5, atol=0)
        assert np.abs(np.angle(np.exp(1j * state["true_course"][:, 0].numpy()) / leg)).max() < 1e-5


def test_noise_of_the_log_is_new_in_each_leg() -> None:
    env = TransformedEnv(nav(3000), MotionError(log_noise=0.02))
    states = flown(env, torch.tensor([[[50.0, 0.0]]]).expand(3, 3000, -1))[1:]
    stretch = torch.stack([s["true_leg"][:, 0] / 50 - 1 for s in states])
    torch.testing.assert_close(stretch.std(1), torch.full((3,), 0.02), rtol=0.05, atol=0)
    assert torch.corrcoef(stretch).triu(1).abs().max() < 4.5 / math.sqrt(3000)
    assert all(s["heading"].eq(0).all() for s in states)


def test_a_vehicle_at_rest_does_not_drift() -> None:
    before, after = flown(TransformedEnv(nav(), motion_error()), torch.tensor([[[0.0, 0.3], [0.0, -0.3]]]))
    torch.testing.assert_close(before["position"], after["position"])
    torch.testing.assert_close(after["true_course"], torch.tensor([[0.3], [-0.3]]))


def test_eddies_are_free_of_divergence_and_of_unit_size() -> None:
    draw = torch.Generator().manual_seed(0)
    uniform = torch.rand(20_000, 3 * EDDIES, generator=draw, dtype=F64)
    waves, phases = eddy_waves(uniform[:, EDDIES:], 200.0), 2 * math.pi * uniform[:, :EDDIES]
    place = torch.tensor([60.0, 20.0], dtype=F64).expand(20_000, 2)
    speed = eddy_velocity(place, waves, phases)
    torch.testing.assert_close(speed.square().mean(0), torch.full((2,), 0.5, dtype=F64), atol=0.01, rtol=0)
    one = eddy_velocity(place, waves[0], phases)
    assert one.square().sum(-1).mean().item() == pytest.approx(1, abs=0.35)  # 8 waves, not in all directions alike
    assert speed.norm(dim=-1).max() < math.sqrt(3 * EDDIES)

    def flux(offset: tuple[float, float], axis: int) -> Tensor:
        at = place[:100] + torch.tensor(offset, dtype=F64)
        return eddy_velocity(at, waves[:100], phases[:100])[:, axis] * (at[:, 0].deg2rad().cos() if axis == 0 else 1)

    h = 1e-4
    divergence = (flux((h, 0), 0) - flux((-h, 0), 0)) + (flux((0, h), 1) - flux((0, -h), 1))
    slope = (flux((h, 0), 0) - flux((-h, 0), 0)).abs().mean()
    assert divergence.abs().max() < 1e-5 * slope


def test_each_episode_has_eddies_of_its_own() -> None:
    """In their directions, too, which an agent could learn otherwise; without eddies, none are drawn."""
    env = TransformedEnv(nav(3), MotionError(eddies_km_h=2.0, speed_km_h=20.0, seed=1))
    first, second = env.reset(), env.reset()
    errors = torch.cat((first["motion_error"], second["motion_error"]))
    waves = eddy_waves(errors[:, 3 + EDDIES :], 200.0)
    assert len(waves.flatten(0, 1).unique(dim=0)) == 6 * EDDIES
    velocity = 2.0 * eddy_velocity(second["position"], waves[3:].double(), errors[3:, 3 : 3 + EDDIES].double())
    torch.testing.assert_close(20 * second["true_current"].double(), velocity, atol=1e-4, rtol=0)
    assert MotionError(log_scale=0.1).size == 3 + EDDIES


def test_a_leg_through_eddies_is_that_of_a_fine_integration() -> None:
    """Of 400 parts by Euler's method: within 50 m in 95 % of legs of 25 km, of which eddies move it by 18 km."""
    count, parts = 1000, 400
    errors = MotionError(eddies_km_h=0.9, eddy_km=250.0, speed_km_h=1.0)
    env = TransformedEnv(nav(count, max_leg_km=25.0, drift_km=errors.farthest_km(25.0) - 25.0), errors)
    state = env.reset()
    phases, directions = state["motion_error"].double()[:, 3:].tensor_split([EDDIES], -1)
    waves, place = eddy_waves(directions, 250.0), state["position"]
    for _ in range(parts):
        leg = 25 / parts * (0.9 * eddy_velocity(place, waves, phases) + torch.tensor((1.0, 0.0)))
        place = torch.stack(move(*place.unbind(-1), torch.atan2(leg[:, 1], leg[:, 0]), leg.norm(dim=-1)), -1)
    after = env.step(state.set("action", torch.tensor([[25.0, 0.0]]).expand(count, -1)))["next"]
    off_km, _ = geodesic(*place.unbind(-1), *after["position"].unbind(-1))
    assert off_km.quantile(0.95) < 0.06
    assert off_km.max() < 0.3


def test_the_environment_must_allow_the_farthest_leg() -> None:
    def errors() -> MotionError:
        return MotionError(log_noise=0.01, current_km_h=3.0, speed_km_h=30.0)

    for drift_km in (0.0, 5.0):
        message = f"up to 7 km farther .* allows {drift_km:g} km: create it with drift_km=7.0"
        with pytest.raises(ValueError, match=message):
            _ = TransformedEnv(nav(drift_km=drift_km), errors()).specs
    assert TransformedEnv(nav(drift_km=7.01), errors()).action_spec.space.high[0, 0] == 50
    with pytest.raises(ValueError, match="got scaled ones: put it before their scaling"):
        _ = TransformedEnv(nav(drift_km=7.01), Compose(MinMaxNorm(in_keys_inv=["action"]), errors())).specs


NOISE = (0.02, 0.02, 2.0)


# The north reference


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
    state = TensorDict(heading=torch.tensor([[-3.12]]), field=torch.tensor([[-179.0, 0.0, 1.0]]), leg=torch.zeros(1, 2))
    after = NorthReferenceError(3.0, fixed=True)._reset(TensorDict(batch_size=[1]), state.auto_batch_size_(1))
    torch.testing.assert_close(after["field"][0, 0], torch.tensor(178.0))
    torch.testing.assert_close(after["heading"][0, 0], torch.tensor(2 * math.pi - 3.12 - math.radians(3)))


def test_error_grows_with_the_secant_of_the_latitude() -> None:
    keys = ("heading", "field", "leg", "position")
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


@pytest.mark.parametrize("name", NORTH_REFERENCES)
def test_references_on_the_market(name: str) -> None:
    """The total of the standards' limits, read as two standard deviations; tan(latitude) is tan(I) / 2 of a dipole."""
    pendulum_s = math.tau * math.sqrt(MEAN_RADIUS_KM * 1e3 / 9.80665)  # as long as the radius of the Earth
    assert pendulum_s / 3600 == pytest.approx(SCHULER_HOURS, abs=5e-4)
    error = north_reference(name, speed_km_h=20.0)
    total = {"fiber-optic": 0.1, "marine": math.hypot(0.375, 0.125, 0.25), "low-cost": math.hypot(0.5, 0.75)}
    state = TransformedEnv(nav(), error).reset()
    secant = 1 / torch.cos(torch.atan(torch.tan(torch.deg2rad(state["field"][0, 1])) / 2))
    growth = 1 if name == "low-cost" else secant.item()
    assert math.hypot(state["sensor_std"][0, 0], state["bias_std"][0, 0]) == pytest.approx(growth * total[name])
    assert state["drift_std"][0, 0].item() == pytest.approx(growth * (0.125 if name == "marine" else 0))
    assert ("position" in error.in_keys) == (name != "low-cost")


# Magnetic north


def test_a_leg_starts_at_the_heading_from_magnetic_north() -> None:
    """And the next heading is that which was chosen: it does not tell how D changed along the leg."""
    states = flown(TransformedEnv(nav(3), MagneticNorth()), actions(4, 3))
    for before, state in itertools.pairwise(states):
        chosen = before["heading"] + state["leg"][:, 1:]
        around = torch.remainder(state["heading"] - chosen + 1, 2 * math.pi) - 1
        torch.testing.assert_close(around, torch.zeros(3, 1), atol=1e-5, rtol=0)
        course = geodesic(*before["position"].unbind(-1), *state["position"].unbind(-1))[1]
        true = chosen.squeeze(-1) + torch.deg2rad(before["true_field"][:, 0])
        around = torch.remainder(course - true + 1, 2 * math.pi) - 1
        torch.testing.assert_close(around, torch.zeros(3).double(), atol=1e-4, rtol=0)
        turned = state["true_heading"] - state["heading"] - torch.deg2rad(state["true_field"][:, :1])
        torch.testing.assert_close(torch.remainder(turned + 1, 2 * math.pi) - 1, torch.zeros(3, 1), atol=1e-5, rtol=0)
    plain = flown(nav(3), actions(4, 3))
    assert torch.equal(states[0]["position"], plain[0]["position"])
    for key in ("field", "target_field"):
        assert states[-1][key][:, 0].eq(0).all()
        assert torch.equal(states[0][key][:, 1:], plain[0][key][:, 1:])
    torch.testing.assert_close(states[0]["objective"], plain[0]["objective"])  # that of the true elements
    assert states[-1]["bias_std"].tolist() == [[math.inf, 0.0, 0.0]] * 3


def test_nothing_public_depends_on_declination() -> None:
    """In a field whose D is larger by 30 degrees, a vehicle with the same heading from magnetic north sees the same."""

    def turned(degrees: float) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
        turn = torch.tensor(math.radians(degrees), dtype=torch.float64)

        def field(latitude: torch.Tensor, longitude: torch.Tensor) -> torch.Tensor:
            north, east = 20000 + 10 * latitude, 100 * longitude.sin()
            x, y = north * turn.cos() - east * turn.sin(), north * turn.sin() + east * turn.cos()
            return torch.stack((x, y, 30000 + 100 * latitude), -1)

        return field

    still = torch.zeros(2, 3, 2)
    public = []
    for degrees in (0.0, 30.0):
        base = GeomagneticNavEnv(Scenario(field=turned(degrees)), num_envs=3, seed=0)
        states = flown(TransformedEnv(base, MagneticNorth()), still)
        privileged = {*true_keys(), "objective", "objective_weights", "reward_proximity"}
        public.append(states[-1].exclude(*privileged))
    heading = public[0]["heading"] - public[1]["heading"] - math.radians(30)
    torch.testing.assert_close(heading, torch.zeros(3, 1), atol=1e-5, rtol=0)  # both started northward
    for key in set(public[0].keys()) - {"heading", "reward", "episode_stream"}:
        torch.testing.assert_close(public[0][key], public[1][key], atol=2e-3, rtol=1e-6, msg=key)


def test_the_compass_shows_the_measured_field() -> None:
    """Iron turns the compass: the vehicle believes to be on another heading than it is."""
    env = TransformedEnv(nav(2), Compose(sensor_errors(), MagneticNorth()))
    state = env.reset()
    torch.testing.assert_close(state["true_heading"], torch.zeros(2, 1), atol=1e-6, rtol=0)
    compass = -torch.rad2deg(state["heading"]).squeeze(-1)
    assert (compass - state["true_field"][:, 0]).abs().min() > 1e-3


@pytest.mark.parametrize(("navigator", "noise"), [("kalman", NOISE), ("secant", NOISE), ("anywhere", (0.0,) * 3)])
def test_navigators_fly_by_the_compass(navigator: str, noise: tuple[float, float, float]) -> None:
    scenario = Scenario(arrival="distance", start_heading="random", max_steps=9, distance_range_km=(100, 200))
    scenario = scenario.with_trips(scenario.random_trips(4, 1))
    assert evaluate(navigator, scenario, errors=noise, north="magnetic")["success"].double().mean() > 0.7


def test_only_the_bias_of_declination_may_be_unlimited() -> None:
    assert SensorStd.of(SensorStd(STD, (math.inf, 0.0, 0.0))).magnetic
    with pytest.raises(ValueError, match=r"sensor_std.bias must be 3 finite numbers"):
        SensorStd.of(SensorStd(STD, (math.inf, math.inf, 0.0)))
    with pytest.raises(ValueError, match="north must be"):
        Flight(Scenario(), north="geographic")
