"""Spikes, and errors that the vehicle is not told of."""

from __future__ import annotations

import pytest
import torch
from support.errors import actions, flown, sensor_errors, under

from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.transforms import Spikes


def test_spikes_are_rare_large_and_not_told() -> None:
    """They are independent of the reading before, and of each other."""
    states = torch.stack(flown(under(Spikes((2.0, 0.0, 100.0), rate=0.2, seed=1), num_envs=500), actions(9, 500)))
    error = (states["field"] - states["true_field"]).flatten(0, 1)
    hit = (error != 0).any(-1)
    assert hit.double().mean() == pytest.approx(0.2, abs=0.02)
    torch.testing.assert_close(error[hit].std(0), torch.tensor([2.0, 0.0, 100.0]), rtol=0.1, atol=0)
    both = hit.reshape(10, 500).double()
    assert (both[1:] * both[:-1]).mean() == pytest.approx(0.04, abs=0.01)
    assert all(states[key].eq(0).all() for key in STD_KEYS)
    with pytest.raises(ValueError, match=r"rate must be .*got 2"):
        Spikes((1.0,), rate=2)


def test_the_accuracy_that_is_stated_replaces_the_true_one() -> None:
    """And changes nothing else."""
    told = SensorStd((0.05, 0.05, 5.0), drift=(0.0, 0.0, 1.0))
    true, stated = (under(sensor_errors(**options)).reset() for options in ({}, {"stated": told}))
    assert torch.equal(true["field"], stated["field"])
    assert true["bias_std"].ne(0).all()
    for key, std in zip(STD_KEYS, told, strict=True):
        torch.testing.assert_close(stated[key], torch.tensor([std, std]))
