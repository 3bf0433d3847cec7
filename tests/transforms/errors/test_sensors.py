"""Errors of sensors: by hand, and their statistics."""

from __future__ import annotations

import math

import pytest
import torch
from support.errors import actions, flown, nav, under
from torchrl.envs import TransformedEnv

from magrl.sensor_std import OUTAGE_STD
from magrl.transforms import SensorErrors


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
    env = under(SensorErrors(bias=(0.1, 0.2, 30.0)), num_envs=2000)
    states = [(s["field"] - s["true_field"]) for s in flown(env, actions(2, 2000))]
    torch.testing.assert_close(states[0], states[2], atol=0.01, rtol=0)
    torch.testing.assert_close(states[0].std(0), torch.tensor([0.1, 0.2, 30.0]), rtol=0.05, atol=0)
    assert torch.corrcoef(states[0].T).triu(1).abs().max() < 4.5 / math.sqrt(2000)


def test_drift_is_stationary_and_forgets_with_the_way() -> None:
    count = 4000
    env = TransformedEnv(nav(count), SensorErrors((0.0,) * 3, drift=(0.1, 0.2, 30.0), drift_length=40.0))
    step = torch.tensor([[[20.0, 0.1]], [[0.0, 0.0]], [[20.0, 1.0]]]).expand(-1, count, -1)
    drift = torch.stack([s["sensor_error", "drift"] / torch.tensor([0.1, 0.2, 30.0]) for s in flown(env, step)])
    torch.testing.assert_close(drift.std(1), torch.ones(4, 3), atol=0.05, rtol=0)
    assert torch.equal(drift[1], drift[2])  # no way, no change
    for later, correlation in ((1, math.exp(-0.5)), (3, math.exp(-1))):
        found = torch.stack([torch.corrcoef(drift[[0, later], :, k])[0, 1] for k in range(3)])
        torch.testing.assert_close(found, torch.full((3,), correlation), atol=0.05, rtol=0)


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


def test_drift_by_steps_without_a_move() -> None:
    errors = SensorErrors(drift=(1.0, 1.0, 1.0), drift_length=2.0, in_keys=["field"])
    before, after = flown(TransformedEnv(nav(4000), errors), torch.zeros(1, 4000, 2))
    pair = torch.stack([state["sensor_error", "drift"][:, 0] for state in (before, after)])
    assert torch.corrcoef(pair)[0, 1].item() == pytest.approx(math.exp(-0.5), abs=0.05)
