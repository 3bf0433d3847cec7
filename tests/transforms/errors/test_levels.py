"""Noise of sensors: its distribution, its levels, and what it leaves alone."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from scipy import stats
from support.errors import actions, flown, nav, under
from tensordict import TensorDict
from torch import Tensor

from magrl.navigators import Secant
from magrl.transforms import SensorErrors, sensor_levels
from magrl.transforms.errors.sensors import DRIFT_KM

F64 = torch.float64


def test_noise_is_white_and_normal() -> None:
    """Along vehicles, episodes and readings."""
    noise = SensorErrors((1.0, 1.0, 1.0), in_keys=["field"])
    data = TensorDict(field=torch.zeros(50_000, 3, dtype=F64), batch_size=[50_000])
    first, second = noise(data.clone()), noise(data.clone())["field"]
    third = noise(first.clone().set("next", data.clone()))["next", "field"]
    drawn = first["field"]
    torch.testing.assert_close(drawn.std(0), torch.ones(3, dtype=F64), atol=0.014, rtol=0)
    for element in drawn.unbind(-1):
        assert stats.kstest(element, "norm").pvalue > 1e-3
    joint = torch.cat((drawn[1:], drawn[:-1], second[1:], third[1:]), -1)
    assert torch.corrcoef(joint.T).triu(1).abs().max() < 4.5 / math.sqrt(50_000)


def test_without_noise_the_reading_is_the_value_to_the_bit() -> None:
    td = under(SensorErrors()).rollout(3, Secant())
    expected = nav().rollout(3, Secant())
    assert torch.equal(td["next", "field"], expected["next", "field"])
    assert torch.equal(td["action"], expected["action"])


def test_levels_by_hand() -> None:
    #    none  common  own factors  D poor  by, then of the bias: none  common  own factors
    uniform = torch.tensor(
        [
            [0.1499, 0.0, 0.5, 0.5, 0.5, 0.0, 0.5, 0.5, 0.0, 0.5, 0.5, 0.5],  # perfect sensors, bias
            [0.15, 0.5 ** (2 / 3), 0.5, 0.5, 0.5, 0.3, 0.5, 0.5, 0.625, 0.0, 1.0, 0.5],  # a tenth of the largest
            [0.99, 1.0, 0.0, 1.0, 0.5, 0.9, 0.5, 0.49, 0.0, 0.5, 0.5, 0.5],  # a hundredth, factors 0.398, 2.512, 1
            [0.99, 0.0, 0.5, 0.5, 0.5, 0.29, 0.5, 0.0, 0.0, 0.5, 0.5, 0.5],  # a poor north reference: 1 + 6 / 2
        ],
        dtype=F64,
    )
    factor = 10**0.4
    expected = [
        [0, 0, 0, 0.35, 0.05, 45.0],
        [0.02, 0.02, 2.0, 0.035 / factor, 0.005 * factor, 4.5],
        [0.002 / factor, 0.002 * factor, 0.2, 0, 0, 0],
        [0.8, 0.2, 20, 0, 0, 0],
    ]
    torch.testing.assert_close(sensor_levels(uniform), torch.tensor(expected, dtype=F64))
    uniform[1, 1] = 0.5
    torch.testing.assert_close(sensor_levels(uniform, 1.0), torch.tensor(expected, dtype=F64))


def noisy(bias: float) -> Callable[[Tensor], Tensor]:
    """Levels of random noise in silence, or with one bias."""

    def levels(uniform: Tensor) -> Tensor:
        return torch.cat((sensor_levels(uniform)[..., :3], torch.full_like(uniform[..., :3], bias)), -1)

    return levels


def test_random_noise_has_the_level_of_its_episode() -> None:
    env = under(SensorErrors(levels=noisy(0.0), seed=3), num_envs=2000)
    td = torch.stack([s.select("field", "true_field", "sensor_std") for s in flown(env, actions(6, 2000))])
    std = td["sensor_std"]
    assert torch.equal(std, std[:1].expand_as(std))
    silent = (std == 0).all(-1)
    assert silent[0].double().mean() == pytest.approx(0.15, abs=0.03)
    assert torch.equal(td["field"][silent], td["true_field"][silent])
    loud = std[..., 2] > 0.05  # above the rounding of float32
    z = ((td["field"] - td["true_field"])[..., 2] / std[..., 2])[loud]
    assert stats.kstest(z.double(), "norm").pvalue > 1e-3
    again = env.reset()["sensor_std"]
    assert ((again != std[0]).any(-1) | (again == 0).all(-1)).double().mean() > 0.95


def test_the_bias_is_partly_constant_and_as_large_as_told() -> None:
    """Their correlation along the way is that of a half that is constant and a half that drifts."""
    env = under(SensorErrors(levels=noisy(30.0), seed=3), num_envs=4000)
    keys = ("field", "true_field", "bias_std", "sensor_std", "move")
    td = torch.stack([state.select(*keys) for state in flown(env, actions(9, 4000))])
    assert (td["bias_std"] == 30).all()
    silent = (td["sensor_std"][0] == 0).all(-1)
    error, moved = (td["field"] - td["true_field"])[:, silent, 2] / 30, td["move"][:, silent, 0].cumsum(0)
    assert error.std() == pytest.approx(1.0, rel=0.06)
    expected = 0.5 + 0.5 * torch.exp(-moved / DRIFT_KM)  # shares are uniform
    torch.testing.assert_close((error * error[0]).mean(-1), expected.mean(-1), rtol=0, atol=0.15)


def test_own_levels_add_to_the_sizes() -> None:
    """By numbers which are not those of the readings."""

    def levels(uniform: Tensor) -> Tensor:
        first = uniform[..., :1]
        return torch.cat((first, first + 1, 0 * first, 4 * first, *[0 * first] * 2), -1)

    state = under(SensorErrors((0.0, 0.0, 3.0), bias=(3.0, 0.0, 0.0), levels=levels), num_envs=1000).reset()
    std = state["sensor_std"]
    torch.testing.assert_close(std[:, 1] - std[:, 0], torch.ones(1000))
    assert std[:, 2].eq(3).all()
    torch.testing.assert_close(state["bias_std"][:, 0], torch.hypot(torch.tensor(3.0), 4 * std[:, 0]))
    std = torch.hypot(std, state["bias_std"])
    z = (state["field"] - state["true_field"])[:, :2] / std[:, :2]
    assert torch.corrcoef(torch.cat((z, std[:, :1]), -1).T).triu(1).abs().max() < 4.5 / math.sqrt(1000)
