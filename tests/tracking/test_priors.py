"""What is known of gradients in advance: the dipole, its deviations on planets, and a field without curl."""

import math

import pytest
import torch
from support.tracks import F64, f64

from magrl.field import SphericalHarmonicField, elements_at, elements_gradient_at, random_planets
from magrl.field.elements import measured_elements
from magrl.geodesy import REFERENCE_RADIUS_KM, curvature_radii, local_frame, move, to_ecef
from magrl.tracking import common_error, curl_relation, dipole_prior, field_curvature
from magrl.tracking.priors import CURVATURE_NT, DIPOLE_STD_NT
from magrl.transforms import VectorErrors


def places(count, most_latitude):
    draw = torch.rand(count, 2, generator=torch.Generator().manual_seed(0), dtype=F64)
    return (2 * draw - 1) * f64(most_latitude, 180.0)


def test_the_field_has_no_vertical_curl():
    """On planets, B_H dD/dm - dB_H/dc is what the relation says with the true latitude, and mostly in its spread."""
    position, ratios = places(400, 70.0), []
    for gauss in random_planets(8, seed=3):
        planet = SphericalHarmonicField(gauss)
        elements, gradient = elements_at(planet, position), elements_gradient_at(planet, position)
        good, relation = elements[:, 2] > 4000, curl_relation(elements)
        found = (relation.weights * gradient).sum((-2, -1))
        convergence = elements[:, 2] * torch.sin(torch.deg2rad(elements[:, 0])) / curvature_radii(position[:, 0])[1]
        exact = convergence * torch.tan(torch.deg2rad(position[:, 0]))
        torch.testing.assert_close(found[good], exact[good], rtol=0, atol=1e-6)
        ratios.append(((found - relation.value) / relation.std)[good])
    ratio = torch.cat(ratios)
    assert 0.4 < float(ratio.square().mean().sqrt()) < 1.2
    assert (ratio.abs() < 2).double().mean() > 0.9


def elements_on_sphere(field, latitude):
    """Return geocentric latitudes [rad] and D, I, B_H about the normal of the sphere, at points of the reference radius
    above geodetic latitudes [deg]."""
    zero = torch.zeros_like(latitude)
    normal, ground = local_frame(latitude, zero)[:, 2].neg(), to_ecef(latitude, zero)
    lever = (normal * ground).sum(-1)
    altitude = (lever.square() - ground.square().sum(-1) + REFERENCE_RADIUS_KM**2).sqrt() - lever
    place = to_ecef(latitude, zero, altitude)
    geocentric = torch.atan2(place[:, 2], place[:, 0])
    ecef = local_frame(latitude, zero).mT @ field(latitude, zero, altitude).unsqueeze(-1)
    vector = local_frame(torch.rad2deg(geocentric), zero) @ ecef
    return geocentric, measured_elements(vector.squeeze(-1))


def test_dipole_prior_is_the_gradient_of_a_dipole_on_a_sphere():
    """In both hemispheres, to 1e-5, against central differences; declination is zero everywhere."""
    gauss = torch.zeros(2, 2, dtype=torch.complex128)
    gauss[1, 0] = -30000.0
    dipole, latitude = SphericalHarmonicField(gauss), torch.linspace(-80, 80, 40, dtype=F64)
    (south, low), (north, high) = (elements_on_sphere(dipole, latitude + step) for step in (-0.01, 0.01))
    slope = (high - low) / (REFERENCE_RADIUS_KM * (north - south)).unsqueeze(-1)
    found = dipole_prior(elements_on_sphere(dipole, latitude)[1])
    torch.testing.assert_close(found.gradient[:, 1:, 0], slope[:, 1:], rtol=1e-5, atol=0)
    torch.testing.assert_close(found.gradient[:, 0], torch.zeros(40, 2, dtype=F64), rtol=0, atol=0)
    torch.testing.assert_close(found.gradient[..., 1], torch.zeros(40, 3, dtype=F64), rtol=0, atol=1e-12)


def test_errors_of_hard_iron_are_correlated_as_stated():
    """In both hemispheres, over 100 000 vehicles of random iron and headings."""
    normal = torch.randn(100_000, 14, generator=torch.Generator().manual_seed(0), dtype=F64)
    iron = VectorErrors(hard_iron_nt=(10.0,) * 3)
    for elements in f64((20.0, 70.0, 15000.0), (0.0, -35.0, 25000.0)):
        heading = math.pi * normal[:, 13:]
        error = iron.disturb(elements.expand(100_000, 3), heading, iron.constants(normal)) - elements
        common = common_error(elements)
        expected = common[:, None] * common + torch.diag(1 - common.square())
        torch.testing.assert_close(torch.corrcoef(error.mT), expected, rtol=0, atol=0.02)


def test_dipole_prior_points_at_magnetic_north():
    """With D = 90 deg, magnetic north is east; north of the magnetic equator B_H falls towards it and I grows."""
    prior = dipole_prior(f64(90.0, 40.0, 30000.0))
    torch.testing.assert_close(prior.gradient[:, 0], torch.zeros(3, dtype=F64), rtol=0, atol=1e-12)
    assert prior.gradient[1, 1] > 0 > prior.gradient[2, 1]
    assert float(prior.azimuth) == pytest.approx(math.pi / 2)


def test_prior_and_drift_are_those_of_disturbances_of_the_components():
    """At B_H = 30 000 nT and I = 60 deg, F is 60 000 nT: 30 nT turn D by 1 / 1000 rad and I by 1 / 2000 rad."""
    elements = f64(10.0, 60.0, 30000.0)
    unit = f64(math.degrees(1) / 30000, math.degrees(1) / 60000, 1.0)
    torch.testing.assert_close(dipole_prior(elements).std * 100, unit[:, None] * f64(*DIPOLE_STD_NT))
    torch.testing.assert_close(field_curvature(elements), unit * f64(*CURVATURE_NT))


def test_standard_deviations_are_positive_beyond_the_vertical():
    beyond, folded = (dipole_prior(f64(0.0, inclination, 9000.0)).std for inclination in (95.0, 85.0))
    torch.testing.assert_close(beyond, folded)


def test_planets_deviate_from_the_dipole_and_curve_as_assumed():
    """Root mean squares over planets, of the assumed ones."""
    place = places(600, 60.0)
    heading = math.pi * places(600, 1.0)[:, 0]
    later = torch.stack(move(*place.unbind(-1), heading, torch.full_like(heading, 100.0)), -1)
    deviations, changes = [], []
    for gauss in random_planets(12, seed=5):
        planet = SphericalHarmonicField(gauss)
        elements, gradient = elements_at(planet, place), elements_gradient_at(planet, place)
        prior, good = dipole_prior(elements), elements[:, 2] > 10000
        cos, sin = torch.cos(prior.azimuth)[:, None], torch.sin(prior.azimuth)[:, None]
        north, east = (gradient - prior.gradient).unbind(-1)
        turned = torch.stack((cos * north + sin * east, cos * east - sin * north), -1)
        change = elements_gradient_at(planet, later) - gradient
        deviations.append((turned / prior.std)[good])
        changes.append((100 * change / field_curvature(elements).unsqueeze(-1))[good])
    for ratios in (torch.cat(deviations), torch.cat(changes)):
        rms = ratios.square().mean(0).sqrt()
        assert ((rms > 0.75) & (rms < 1.4)).all(), rms
