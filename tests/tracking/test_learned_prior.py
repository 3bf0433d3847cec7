"""The prior of the gradients that is learned from random planets."""

import math

import pytest
import torch
from support.tracks import F64, f64

from magrl.envs import planet_scenario
from magrl.field import elements_at
from magrl.field.model import elements_gradient_at
from magrl.tracking import LearnedPrior, dipole_prior
from magrl.tracking.learned_prior import features
from magrl.tracking.priors import DIPOLE_STD_NT

HERE, THERE = f64(20.0, 60.0, 25_000.0), f64(25.0, 58.0, 26_500.0)


def test_features_by_hand() -> None:
    """At I = 60 deg, the total intensity is twice B_H, and 1 deg of I is 50 000 nT * pi / 180."""
    degree = math.radians(1) * 25_000 / 1500
    angles = [math.sin(math.radians(a)) for a in (60, 30, 20, 70)]
    differences = [5 * degree, -2 * degree * 2, 1.0]
    expected = [*angles, 0.0, 1 / 3, *differences, *map(abs, differences)]
    assert features(HERE, THERE).tolist() == pytest.approx(expected, abs=1e-6)


def test_before_it_is_fitted_it_is_the_prior_of_a_dipole() -> None:
    torch.testing.assert_close(tuple(LearnedPrior(8)(HERE, THERE)), tuple(dipole_prior(HERE)))


def test_it_corrects_the_dipole_along_and_across_magnetic_north() -> None:
    """The network writes a deviation of 1 along, for D, and doubles the standard deviation across, for B_H."""
    prior, dipole = LearnedPrior(8), dipole_prior(HERE)
    with torch.no_grad():
        prior.network[-1].bias.copy_(torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, math.log(2)]))
        found = prior(HERE, THERE)
    north = f64(math.cos(math.radians(20)), math.sin(math.radians(20)))
    per_km = DIPOLE_STD_NT[0][0] / 100 * math.degrees(1) / 25_000
    torch.testing.assert_close(found.gradient - dipole.gradient, torch.stack((per_km * north, 0 * north, 0 * north)))
    assert (found.std / dipole.std).flatten().tolist() == pytest.approx([1, 1, 1, 1, 1, 2])


def test_the_loss_is_that_of_normal_deviations() -> None:
    """A gradient that is off by one standard deviation of D along magnetic north costs a half."""
    prior, dipole = LearnedPrior(8), dipole_prior(HERE)
    off = dipole.std[0, 0] * torch.stack((torch.cos(dipole.azimuth), torch.sin(dipole.azimuth)))
    gradient = dipole.gradient + torch.stack((off, 0 * off, 0 * off))
    prior.requires_grad_(False)
    assert float(prior.loss(HERE, THERE, gradient)) == pytest.approx(0.5, abs=1e-5)
    prior.network[-1].bias[6] = 1.0
    assert float(prior.loss(HERE, THERE, gradient)) == pytest.approx(0.5 / math.e**2 + 1.0, abs=1e-5)


def test_the_prior_of_the_library_knows_other_planets() -> None:
    """On planets that no fit has seen, it is surer than a dipole and its deviations have the size that it states."""
    scenario = planet_scenario(16, seed=4242, distance_range_km=(150.0, 1800.0), half_size_deg=20, max_latitude=75)
    tasks = scenario.random_tasks(500, 0)
    here, there = (elements_at(scenario.field, place, tasks.region) for place in (tasks.start, tasks.target))
    gradient = elements_gradient_at(scenario.field, tasks.start, tasks.region)
    prior = LearnedPrior.pretrained()
    assert not any(parameter.requires_grad for parameter in prior.parameters())
    assert prior.loss(here, there, gradient).mean() < LearnedPrior().loss(here, there, gradient).mean() - 1.0
    found = prior(here, there)
    north, east = torch.cos(found.azimuth)[:, None], torch.sin(found.azimuth)[:, None]
    off = gradient - found.gradient
    along = (off[..., 0] * north + off[..., 1] * east) / found.std[..., 0]
    across = (off[..., 1] * north - off[..., 0] * east) / found.std[..., 1]
    assert torch.stack((along, across)).square().mean().sqrt() == pytest.approx(1.0, abs=0.25)
    assert found.gradient.dtype == F64
