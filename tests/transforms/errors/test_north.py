"""Error of the north reference: by hand, and its statistics."""

from __future__ import annotations

import math

import pytest
import torch
from support.errors import actions, flown, nav
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from magrl.transforms import NORTH_REFERENCES, NorthReferenceError, north_reference


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


@pytest.mark.parametrize("name", NORTH_REFERENCES)
def test_references_on_the_market(name: str) -> None:
    """The total of the standards' limits, read as two standard deviations; tan(latitude) is tan(I) / 2 of a dipole."""
    error = north_reference(name, speed_km_h=20.0)
    total = {"fiber-optic": 0.1, "marine": math.hypot(0.375, 0.125, 0.25), "low-cost": math.hypot(0.5, 0.75)}
    state = TransformedEnv(nav(), error).reset()
    secant = 1 / torch.cos(torch.atan(torch.tan(torch.deg2rad(state["field"][0, 1])) / 2))
    growth = 1 if name == "low-cost" else secant.item()
    assert math.hypot(state["sensor_std"][0, 0], state["bias_std"][0, 0]) == pytest.approx(growth * total[name])
    assert state["drift_std"][0, 0].item() == pytest.approx(growth * (0.125 if name == "marine" else 0))
    assert ("position" in error.in_keys) == (name != "low-cost")
