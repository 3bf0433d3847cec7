"""Random planets have the spectrum and the polarity of the Earth's field."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from magrl.field import igrf_coefficients, random_planets
from magrl.field.planets import power_spectrum

EARTH = igrf_coefficients("2022-01-01", 13)
COUNT = 4000


@pytest.fixture(scope="module")
def planets() -> Tensor:
    return random_planets(COUNT, seed=0)


def dipoles(planets: Tensor) -> Tensor:
    """Dipole moments as vectors x, y, z, ``(count, 3)`` [nT]."""
    return torch.stack((planets[:, 1, 1].real, -planets[:, 1, 1].imag, planets[:, 1, 0].real), -1)


def coefficients(planets: Tensor, n: int) -> Tensor:
    """The 2n + 1 coefficients g and h of a degree, ``(count, 2n + 1)``."""
    return torch.cat((planets[:, n, : n + 1].real, planets[:, n, 1 : n + 1].imag), -1)


def test_the_spectrum_is_the_earth_s(planets: Tensor) -> None:
    """The mean factors are 1 + 0.6²/12 for the dipole and 1.25 for each other degree."""
    ratio = power_spectrum(planets)[:, 1:] / power_spectrum(EARTH)[1:]
    expected = torch.tensor([1 + 0.6**2 / 12] + [1.25] * 12, dtype=torch.float64)
    standard_error = ratio.std(0) / math.sqrt(COUNT)
    assert ((ratio.mean(0) - expected).abs() < 4 * standard_error).all()
    assert (standard_error < 0.02).all()


def test_the_power_of_a_degree_varies_by_planet_and_degree(planets: Tensor) -> None:
    """At a high degree, the factor of 0.5 to 2 is most of the variance of the power: 0.1875 + 2 (1.75) / (2n + 1)."""
    ratio = power_spectrum(planets)[:, 1:] / power_spectrum(EARTH)[1:]
    for n in (2, 7, 13):
        assert ratio[:, n - 1].var().item() == pytest.approx(0.1875 + 3.5 / (2 * n + 1), rel=0.12), n
    assert torch.corrcoef(ratio[:, 10:].T).fill_diagonal_(0).abs().max() < 0.08


def test_dipoles_are_tilted_and_have_the_earth_s_polarity(planets: Tensor) -> None:
    moment = dipoles(planets)
    strength = moment.norm(dim=-1) / dipoles(EARTH.unsqueeze(0)).norm()
    tilt = torch.rad2deg(torch.acos(-moment[:, 2] / moment.norm(dim=-1)))
    side = torch.rad2deg(torch.atan2(moment[:, 1], moment[:, 0]))
    for values, low, high in ((strength, 0.7, 1.3), (tilt, 0.0, 40.0), (side, -180.0, 180.0)):
        assert ((values >= low) & (values <= high)).all()
        quartiles = torch.quantile((values - low) / (high - low), torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64))
        assert quartiles.tolist() == pytest.approx([0.25, 0.5, 0.75], abs=0.03)
    assert (EARTH[1, 0].real < 0) & (planets[:, 1, 0].real < 0).all()


def test_a_seed_gives_the_same_planets_and_another_gives_others() -> None:
    state = torch.get_rng_state()
    first = random_planets(5, seed=7)
    assert torch.equal(first, random_planets(5, seed=7))
    assert torch.equal(state, torch.get_rng_state())
    other = random_planets(5, seed=8)
    below = torch.ones(14, 14).tril().bool()
    below[0] = False
    assert (first != other)[:, below].all()
    assert (first[:-1] != first[1:])[:, below].all()


def test_the_spectrum_continues_above_degree_13() -> None:
    power = power_spectrum(random_planets(COUNT, seed=4, degree=20)).mean(0) / 1.25
    n = torch.arange(2.0, 14, dtype=torch.float64)
    known = torch.log(power_spectrum(EARTH)[2:])
    slope = float(((n - n.mean()) * known).sum() / (n - n.mean()).square().sum())
    expected = [math.exp(float(known.mean()) + slope * (k - 7.5)) for k in range(14, 21)]
    assert power[14:].tolist() == pytest.approx(expected, rel=0.05)
    assert power[2:14].tolist() == pytest.approx(power_spectrum(EARTH)[2:].tolist(), rel=0.06)
    assert -1.5 < slope < -0.9  # the Earth's core: about a factor of 3 a degree
