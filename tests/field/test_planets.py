"""Random planets have the spectrum, the polarity and the gradients of the Earth's field, and none of its places."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from magrl.field import SphericalHarmonicField, igrf_coefficients, random_planets
from magrl.field.elements import elements_gradient, measured_elements
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


def test_power_of_the_earth() -> None:
    """Most of it is that of the dipole."""
    power = power_spectrum(EARTH)
    g, h = EARTH.real, -EARTH.imag
    assert power[3].item() == pytest.approx(4 * float((g[3] ** 2 + h[3] ** 2).sum()))
    assert float(power[1] / power.sum()) == pytest.approx(0.93, abs=0.005)
    assert power.shape == (14,)
    assert power[0] == 0


def test_the_spectrum_is_the_earth_s(planets: Tensor) -> None:
    """The mean factors are 1 + 0.6²/12 for the dipole and 1.25 for each other degree."""
    ratio = power_spectrum(planets)[:, 1:] / power_spectrum(EARTH)[1:]
    expected = torch.tensor([1 + 0.6**2 / 12] + [1.25] * 12, dtype=torch.float64)
    standard_error = ratio.std(0) / math.sqrt(COUNT)
    assert ((ratio.mean(0) - expected).abs() < 4 * standard_error).all()
    assert (standard_error < 0.02).all()


def test_every_coefficient_of_a_degree_has_the_same_variance(planets: Tensor) -> None:
    for n in range(2, 14):
        square = coefficients(planets, n).square()
        expected = 1.25 * power_spectrum(EARTH)[n] / ((n + 1) * (2 * n + 1))
        error = (square.mean(0) - expected) / (square.std(0) / math.sqrt(COUNT))
        assert error.abs().max() < 4.5, n
        assert coefficients(planets, n).mean(0).abs().max() < 4.5 * math.sqrt(expected / COUNT), n


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


def test_the_ranges_can_be_chosen() -> None:
    moment = dipoles(random_planets(500, seed=1, strength=(2.0, 2.0), tilt_deg=0.0))
    torch.testing.assert_close(moment[:, 2], -2 * dipoles(EARTH.unsqueeze(0)).norm().expand(500))
    assert moment[:, :2].abs().max() < 1e-9
    assert random_planets(3, seed=1, spread=(0.0, 0.0))[:, 2:].abs().max() == 0


def test_tables_hold_nothing_else(planets: Tensor) -> None:
    assert planets.dtype == torch.complex128
    assert planets.shape == (COUNT, 14, 14)
    assert (planets[:, 0] == 0).all()
    assert (planets[..., 0].imag == 0).all()
    assert torch.equal(planets, planets.tril())


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


def test_planets_do_not_resemble_the_earth(planets: Tensor) -> None:
    """The coefficients from degree 2 on, each divided by the deviation of its degree, do not correlate with Earth's."""
    earth, drawn = [], []
    for n in range(2, 14):
        deviation = torch.sqrt(power_spectrum(EARTH)[n] / ((n + 1) * (2 * n + 1)))
        earth.append(coefficients(EARTH.unsqueeze(0), n)[0] / deviation)
        drawn.append(coefficients(planets, n) / deviation)
    mine, theirs = torch.cat(earth), torch.cat(drawn, -1)
    correlation = theirs @ mine / (theirs.norm(dim=-1) * mine.norm())
    assert len(mine) == 192
    assert abs(float(correlation.mean())) < 4 / math.sqrt(192 * COUNT)
    assert correlation.abs().max() < 5 / math.sqrt(192)


@pytest.mark.parametrize("degree", [1, 2, 5])
def test_a_low_degree_has_the_spectrum_up_to_it(degree: int) -> None:
    ratio = power_spectrum(random_planets(COUNT, seed=3, degree=degree)) / power_spectrum(EARTH)[: degree + 1]
    assert ratio.shape == (COUNT, degree + 1)
    assert ratio[:, 1].mean().item() == pytest.approx(1.03, abs=0.02)
    assert ratio[:, 2:].mean(0).tolist() == pytest.approx([1.25] * (degree - 1), rel=0.06)


def test_the_spectrum_continues_above_degree_13() -> None:
    power = power_spectrum(random_planets(COUNT, seed=4, degree=20)).mean(0) / 1.25
    n = torch.arange(2.0, 14, dtype=torch.float64)
    known = torch.log(power_spectrum(EARTH)[2:])
    slope = float(((n - n.mean()) * known).sum() / (n - n.mean()).square().sum())
    expected = [math.exp(float(known.mean()) + slope * (k - 7.5)) for k in range(14, 21)]
    assert power[14:].tolist() == pytest.approx(expected, rel=0.05)
    assert power[2:14].tolist() == pytest.approx(power_spectrum(EARTH)[2:].tolist(), rel=0.06)
    assert -1.5 < slope < -0.9  # the Earth's core: about a factor of 3 a degree


def patches(gauss: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Vectors and gradients on 9 x 9 grids of patches of ±10° up to 60° of latitude, where B_H is 8000 nT or more."""
    center = torch.rand(2, 50, 1, 1, generator=generator, dtype=torch.float64)
    offset = torch.linspace(-10, 10, 9, dtype=torch.float64)
    latitude, longitude = 100 * center[0] - 50 + offset.unsqueeze(-1), 360 * center[1] + offset
    value, gradient = SphericalHarmonicField(gauss).value_and_gradient(latitude, longitude)
    strong = (measured_elements(value)[..., 2] >= 8000).flatten(1).all(1)
    return value[strong].reshape(-1, 3), gradient[strong].reshape(-1, 3, 2)


def rms_gradients(planets: Tensor) -> Tensor:
    """Return root mean squares of the gradients of D, I, B_H per 100 km along and across magnetic north: ``(2, 3)``."""
    generator = torch.Generator().manual_seed(5)
    value, gradient = (torch.cat(x) for x in zip(*(patches(gauss, generator) for gauss in planets), strict=True))
    north, east = (100 * elements_gradient(value, gradient)).unbind(-1)
    cosine, sine = nn.functional.normalize(value[:, :2]).split(1, -1)
    return torch.stack((cosine * north + sine * east, cosine * east - sine * north)).square().mean(1).sqrt()


def test_gradients_are_those_of_the_trials() -> None:
    """Along magnetic north as the Earth's; across it larger, because dipoles are tilted further."""
    expected = torch.tensor([[0.41, 1.31, 314], [0.67, 0.23, 133]], dtype=torch.float64)
    torch.testing.assert_close(rms_gradients(random_planets(100, seed=6)), expected, rtol=0.15, atol=0)
    earth = torch.tensor([[0.40, 1.34, 350], [0.47, 0.16, 119]], dtype=torch.float64)
    torch.testing.assert_close(rms_gradients(EARTH.expand(20, 14, 14)), earth, rtol=0.15, atol=0)
