"""A known start: what the first reading tells of constant errors, in theory and in an environment."""

from __future__ import annotations

import math

import pytest
import torch
from support.errors import nav
from torchrl.envs import Compose, TransformedEnv

from magrl.sensor_std import SensorStd
from magrl.transforms import CONDITIONS, Conditions, KnownStart, SensorErrors, calibration, with_conditions
from magrl.transforms.errors.known import START_KEYS

STD = (0.02, 0.02, 2.0), (0.5, 0.1, 20.0), (0.3, 0.05, 10.0), (0.1, 0.0, 0.0)  # noise, bias, drift, known


def test_calibration_is_the_best_linear_estimate_of_the_constant_error() -> None:
    """Of many errors that are drawn, it is unbiased, and what is left has the variance that it states."""
    draw = torch.Generator().manual_seed(0)
    noise, bias, drift, known = torch.tensor(STD, dtype=torch.float64)
    normal = torch.randn(5, 200_000, 3, generator=draw, dtype=torch.float64)
    constant, slow = (bias.square() - drift.square()).sqrt() * normal[0], drift * normal[1]
    reading = constant + slow + noise * normal[2] + torch.tensor([179.0, 60.0, 20000.0])
    here = torch.tensor([-181.0, 60.0, 20000.0]) + known * normal[3]  # the same place, on the other side of 180
    error, left = calibration(reading, here, SensorStd(noise, bias, drift), known)
    rest = constant + drift * normal[4] - error  # later, the slow error is another
    torch.testing.assert_close(rest.square().mean(0).sqrt(), left.bias, rtol=0.01, atol=0)
    assert ((rest * error).mean(0) / (bias * bias)).abs().max() < 0.01  # nothing more to subtract


@pytest.mark.parametrize(("bias", "expected"), [(0.0, 0.0), (0.5, 0.7)])
def test_without_other_errors_the_whole_difference_is_constant(bias: float, expected: float) -> None:
    none, std = torch.zeros(3), SensorStd(torch.zeros(3), torch.full((3,), bias), torch.zeros(3))
    error, left = calibration(torch.full((3,), 0.7), none, std, none)
    assert error.tolist() == pytest.approx([expected] * 3)
    assert left.bias.tolist() == [0] * 3


def test_the_error_of_the_start_is_subtracted_from_all_readings_of_an_episode() -> None:
    errors = SensorErrors((0.01, 0.01, 1.0), bias=(0.5, 0.2, 50.0), seed=3)
    env = TransformedEnv(nav(3, max_steps=4), Compose(errors, KnownStart(known_std=(0.02, 0.01, 3.0))))
    rollout = env.rollout(9, break_when_any_done=False)
    error, first = rollout["next", "start_error"], rollout[:, 0]
    assert torch.equal(first["start_field"], first["true_field"])
    assert torch.equal(first["start_bias_std"], torch.tensor([0.5, 0.2, 50.0]).expand(3, 3))
    assert torch.equal(first["start_std"], torch.tensor([0.02, 0.01, 3.0]).expand(3, 3))
    for key in START_KEYS[1:]:  # what was known then is kept
        assert torch.equal(rollout["next", key][:, :4], first[key].unsqueeze(1).expand(-1, 4, -1))
    assert torch.equal(error[:, :4], rollout["start_error"][:, :1].expand(-1, 4, -1))
    assert not torch.equal(error[:, 4], error[:, 3])  # another episode, other errors
    bias = rollout["next", "sensor_error", "bias"]
    torch.testing.assert_close(error, bias, rtol=0, atol=5.0)
    left = (rollout["next", "field"] - rollout["next", "true_field"])[..., :2]
    assert left.abs().max() < 0.1 < bias[..., 0].abs().max()
    expected = [math.hypot(*pair) for pair in ((0.01, 0.02), (0.01, 0.01), (1.0, 3.0))]  # noise, known
    assert rollout["next", "bias_std"].amax((0, 1)).tolist() == pytest.approx(expected, rel=0.01)


def test_conditions_state_what_is_left_where_the_start_is_known() -> None:
    """Of the constant error of the north reference little, of slow errors all, of the model's error some."""
    own = Conditions("own", sensors={"noise": (0.0, 0.0, 2.0)}, north={"constant_deg": 0.5})
    assert own.std_at((0, 0, 0)).bias == (0, 0, 0)
    assert own.std_at((0.5, 0, 0)).bias[0] == pytest.approx(0.5 / 2**0.5, abs=1e-6)
    aircraft = CONDITIONS["aircraft"]
    std, left = aircraft.std, aircraft.std_at((0, 0, 0))
    assert std.bias[0] > 2 * left.bias[0] > 2 * std.drift[0] > 0
    assert left.bias[1:] == std.drift[1:] == std.bias[1:]
    assert left._replace(bias=std.bias) == std
    base = nav(4)
    env = with_conditions(base, aircraft, known_start=(0.0, 0.0, 0.0))
    state, none = env.reset(), torch.zeros(3)
    latitude = math.atan(
        math.tan(math.radians(state["field"][0, 1])) / 2
    )  # of a dipole: a gyrocompass errs by its secant
    std = std._replace(bias=(math.hypot(0.1 / math.cos(latitude), std.drift[0]), *std.bias[1:]))
    left = calibration(none, none, SensorStd(*map(torch.tensor, std)), none)[1]
    assert state["bias_std"][0].tolist() == pytest.approx(left.bias.tolist(), abs=1e-6)


def test_a_bad_known_start_is_named() -> None:
    with pytest.raises(ValueError, match=r"^known_start must be 3 finite numbers"):
        CONDITIONS["ship"].std_at((1.0,))
