"""The measured elements of a destination whose place is known."""

from __future__ import annotations

import math

import pytest
import torch
from support.tracks import f64, randn
from torch import Tensor

from magrl.field import IGRF
from magrl.field.elements import measured_elements
from magrl.geodesy import geodesic, move_place
from magrl.sensor_std import SensorStd
from magrl.tracking import Motion, earth_model
from magrl.tracking.belief import PLACE, Belief, at_place, moved
from magrl.tracking.survey import surveyed

MODEL, TRUE = earth_model("IGRF-2005", "2025-01-01"), IGRF("2025-01-01")
COUNT, NONE, EXACT = 60, torch.zeros(3).double(), f64(0.01, 0.01, 1.0)
ERRORS = SensorStd(*torch.zeros(4, COUNT, 3).double())
PLACES = torch.stack((60 * randn(COUNT).tanh(), 180 * randn(COUNT, seed=1).tanh()), -1)
TARGETS = move_place(PLACES, 3 * randn(COUNT, seed=2), 400 * torch.ones(COUNT).double())


def at_start(start_km: float = 0.01) -> Belief:
    return at_place(PLACES, start_km, ERRORS, Motion(MODEL))


def told(belief: Belief, std: Tensor = EXACT, crust_nt: float = 0.0, errors: SensorStd = ERRORS) -> Belief:
    """The belief with the true elements of the destination."""
    given = measured_elements(TRUE(*TARGETS.unbind(-1)))
    return surveyed(belief, given, std, TARGETS, MODEL, torch.full((COUNT,), crust_nt).double(), errors)


def field_error(belief: Belief) -> Tensor:
    return (belief.field - TRUE(*PLACES.unbind(-1))).norm(dim=-1)


def test_they_show_how_far_the_model_is_off() -> None:
    """A model of 2005 is off by hundreds of nanotesla here; with what is measured 400 km away, by half as much."""
    before, after = at_start(), told(at_start())
    assert field_error(after).square().mean() < 0.25 * field_error(before).square().mean()
    square = (after.field - TRUE(*PLACES.unbind(-1))).unsqueeze(-1)
    square = (square.mT @ torch.linalg.inv(after.covariance[:, :3, :3]) @ square).mean()
    assert 1.5 < square < 4.5  # chi-square of three


@pytest.mark.parametrize("errors", [{"std": 1e6 * EXACT}, {"crust_nt": 1e6}], ids=str)
def test_they_count_by_their_accuracy(errors: dict) -> None:
    before, after = at_start(), told(at_start(), **errors)
    torch.testing.assert_close(after.field, before.field, rtol=1e-4, atol=1.0)


def test_declination_counts_neither_by_a_compass_nor_where_it_is_missing() -> None:
    compass = ERRORS._replace(bias=torch.full_like(ERRORS.bias, math.inf))
    given = measured_elements(TRUE(*TARGETS.unbind(-1))).index_fill(-1, torch.tensor([0]), math.nan)
    missing = surveyed(at_start(), given, EXACT, TARGETS, MODEL, torch.zeros(COUNT).double(), ERRORS)
    masked = told(at_start(), errors=compass._replace(bias=f64(math.inf, 0.0, 0.0).expand(COUNT, 3)))
    torch.testing.assert_close(masked.mean, missing.mean)
    torch.testing.assert_close(masked.covariance, missing.covariance)
    assert (missing.field - told(at_start()).field).norm(dim=-1).max() > 1


def test_they_say_nothing_of_the_place() -> None:
    """The error of a coarse start is in the predicted difference, which does not depend on it where the model is
    right."""
    belief = moved(
        at_start(20.0), torch.full((COUNT,), 30.0).double(), torch.ones(COUNT).double(), ERRORS, Motion(MODEL)
    )
    off = geodesic(*told(belief).place.unbind(-1), *belief.place.unbind(-1))[0]
    assert off.max() < 1.0
    scale = belief.covariance[:, PLACE, PLACE].diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(
        told(belief).covariance[:, PLACE, PLACE].diagonal(dim1=-2, dim2=-1), scale, rtol=0.1, atol=0
    )
