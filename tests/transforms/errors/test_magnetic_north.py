"""Magnetic north: headings by the compass, no declination, and nothing that tells it."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from support.errors import STD, actions, flown, nav, sensor_errors
from torchrl.envs import Compose, TransformedEnv

from magrl import GeomagneticNavEnv
from magrl.envs import Scenario
from magrl.evaluation import Flight, evaluate
from magrl.geodesy import geodesic
from magrl.sensor_std import SensorStd
from magrl.transforms import MagneticNorth
from magrl.transforms.errors.base import true_keys

NOISE = (0.02, 0.02, 2.0)


def test_a_move_starts_at_the_heading_from_magnetic_north() -> None:
    """And the next heading is that which was chosen: it does not tell how D changed along the move."""
    states = flown(TransformedEnv(nav(3), MagneticNorth()), actions(4, 3))
    for before, state in itertools.pairwise(states):
        chosen = before["heading"] + state["move"][:, 1:]
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

    class Turned:
        def __init__(self, degrees: float) -> None:
            self.turn = math.radians(degrees)

        def __call__(self, latitude: torch.Tensor, longitude: torch.Tensor) -> torch.Tensor:
            north, east = 20000 + 10 * latitude, 100 * longitude.sin()
            turn = torch.tensor(self.turn, dtype=torch.float64)
            x, y = north * turn.cos() - east * turn.sin(), north * turn.sin() + east * turn.cos()
            return torch.stack((x, y, 30000 + 100 * latitude), -1)

    still = torch.zeros(2, 3, 2)
    public = []
    for degrees in (0.0, 30.0):
        base = GeomagneticNavEnv(Scenario(field=Turned(degrees)), num_envs=3, seed=0)
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
    scenario = Scenario(arrival="distance", start_heading="random", max_steps=60)
    scenario = scenario.with_tasks(scenario.random_tasks(16, 1))
    assert evaluate(navigator, scenario, errors=noise, north="magnetic")["success"].double().mean() > 0.8


def test_only_the_bias_of_declination_may_be_unlimited() -> None:
    assert SensorStd.of(SensorStd(STD, (math.inf, 0.0, 0.0))).magnetic
    with pytest.raises(ValueError, match=r"sensor_std.bias must be 3 finite numbers"):
        SensorStd.of(SensorStd(STD, (math.inf, math.inf, 0.0)))
    with pytest.raises(ValueError, match="north must be"):
        Flight(Scenario(), north="geographic")
