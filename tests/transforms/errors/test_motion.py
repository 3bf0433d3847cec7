"""Errors of motion: a track by numpy, statistics, eddies, and the farthest move."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from support.errors import actions, flown, motion_error, nav
from torch import Tensor
from torchrl.envs import TransformedEnv

from magrl.geodesy import move
from magrl.transforms import MotionError
from magrl.transforms.errors.motion import EDDIES, eddy_velocity, eddy_waves

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
        way = distance * (1.1 * np.exp(1j * (heading + math.radians(15))) + drift)
        ends = move(*position.unbind(-1), torch.tensor(np.angle(way)), torch.tensor(np.abs(way)))
        position = torch.stack(ends, -1)
        torch.testing.assert_close(state["position"], position, atol=2e-6, rtol=0)  # 0.2 m
        torch.testing.assert_close(state["move"], action.float())
        believed = np.angle(np.exp(1j * (state["heading"][:, 0].numpy() - heading)))
        assert np.abs(believed).max() < 1e-5
        torch.testing.assert_close(state["true_move"][:, 0].double(), torch.tensor(np.abs(way)), rtol=1e-5, atol=0)
        assert np.abs(np.angle(np.exp(1j * state["true_course"][:, 0].numpy()) / way)).max() < 1e-5


def test_noise_of_the_log_is_new_in_each_move() -> None:
    env = TransformedEnv(nav(3000), MotionError(log_noise=0.02))
    states = flown(env, torch.tensor([[[50.0, 0.0]]]).expand(3, 3000, -1))[1:]
    stretch = torch.stack([s["true_move"][:, 0] / 50 - 1 for s in states])
    torch.testing.assert_close(stretch.std(1), torch.full((3,), 0.02), rtol=0.05, atol=0)
    assert torch.corrcoef(stretch).triu(1).abs().max() < 4.5 / math.sqrt(3000)
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
    def errors() -> MotionError:
        return MotionError(log_noise=0.01, current_km_h=3.0, speed_km_h=30.0)

    for drift_km in (0.0, 5.0):
        message = f"up to 7 km farther .* allows {drift_km:g} km: create it with drift_km=7.0"
        with pytest.raises(ValueError, match=message):
            _ = TransformedEnv(nav(drift_km=drift_km), errors()).specs
    assert TransformedEnv(nav(drift_km=7.01), errors()).action_spec.space.high[0, 0] == 50
