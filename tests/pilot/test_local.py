"""The belief of the local potential: legs, prior, readings and destination, each against what it stands for."""

from __future__ import annotations

import math

import pytest
import torch
from support.tracks import F64, STD, f64, randn, unknown
from torch.nn.functional import pad

from magrl.field import IGRF, FieldBank, SphericalHarmonicField, elements_at, random_planets
from magrl.field.elements import elements_gradient, elements_jacobian, field_vector, measured_elements
from magrl.geodesy import geodesic, move
from magrl.pilot.belief import (
    ANOMALY,
    ANOMALY_KM,
    CONSTANT,
    IRON,
    MODEL_NT,
    STATES,
    Belief,
    before,
    elements,
    innovation,
    known,
    moved,
    read,
    start,
)
from magrl.pilot.destination import destination, log_density, mode, posterior
from magrl.pilot.harmonics import generators, orders, size, turning
from magrl.pilot.local import COEFFICIENTS
from magrl.pilot.prior import lasting_covariances
from magrl.sensor_std import PERFECT, SensorStd

NOISE = f64(*STD)


def sure_belief(planet: SphericalHarmonicField, latitude: float, longitude: float) -> Belief:
    """A belief without uncertainty, from the field along 200 legs, so that the ellipsoid is in it."""
    legs, shape = 120 * randn(200, 1, 2, seed=3), (200, COEFFICIENTS)
    distance, heading = (x.expand(shape) for x in (legs.norm(dim=-1), torch.atan2(legs[..., 1], legs[..., 0])))
    eye, zero = torch.eye(STATES, dtype=F64)[:COEFFICIENTS], torch.zeros(STATES, STATES, dtype=F64)
    each = Belief(eye.expand(*shape, -1), zero.expand(*shape, -1, -1), unknown(f64(latitude).expand(shape)))
    rows = moved(each, distance, heading).field.mT.flatten(0, 1)  # the field after each leg
    here = f64(latitude).expand(200), f64(longitude).expand(200)
    there = planet(*move(*here, heading[:, 0], distance[:, 0])).flatten()
    ridge = torch.diag(f64(*[1e4 ** (1 - (n - 1) / 6) for n, _ in orders(3)])).square().inverse()
    coefficients = torch.linalg.solve(ridge + rows.mT @ rows, rows.mT @ there)
    return Belief(pad(coefficients, (0, STATES - COEFFICIENTS)), zero, unknown(latitude))


def test_generators_are_derivatives_and_turns() -> None:
    """They have the commutators of translations and rotations, and the Laplace equation holds."""
    field, turn = generators(4)
    for i, j, k in ((0, 1, 2), (1, 2, 0)):
        torch.testing.assert_close(turn[i] @ turn[j] - turn[j] @ turn[i], turn[k])
        torch.testing.assert_close(field[i] @ field[j], field[j] @ field[i])
    torch.testing.assert_close(sum(part @ part for part in field), torch.zeros(24, 24, dtype=F64))
    angle = f64(0.7)[0]
    torch.testing.assert_close(turning(angle.cos(), angle.sin(), 4), torch.linalg.matrix_exp(0.7 * turn[2]))
    assert turn.shape[-1] == size(4)


@pytest.mark.parametrize(("latitude", "course"), [(-20.0, 4.0), (75.0, 2.0)])
def test_a_leg_takes_the_field_and_its_gradient_along(latitude: float, course: float) -> None:
    """Six legs of 50 km: 1 nT, the gradients to 0.01 nT/km; and the latitude's column by differences."""
    planet = SphericalHarmonicField(random_planets(1, seed=5)[0])
    here, belief = f64(latitude, 10.0).unbind(), sure_belief(planet, latitude, 10.0)
    assert (belief.field - planet(*here)).norm() < 0.5
    km, turn = f64(50.0)[0], f64(course)[0]
    column = torch.zeros(STATES, dtype=F64)
    column[COEFFICIENTS] = 1e-3
    linear = (moved(belief._replace(mean=belief.mean + column), km, turn).mean - moved(belief, km, turn).mean) / 1e-3
    shifted = [moved(belief._replace(place=unknown(here[0] + x)), km, turn).field for x in (0.01, -0.01)]
    difference = (shifted[0] - shifted[1]) / (0.02 * 111.2)  # by kilometers
    assert (linear[:3] - difference).norm() < 0.02 * difference.norm() + 1e-3
    for step in range(6):
        belief, here = moved(belief, km, turn), move(*here, turn, km)
        turn = turn + 0.3 * (-1) ** step
    assert (belief.latitude - here[0]).abs() < 1e-4
    value, gradient = planet.value_and_gradient(*here)
    assert (belief.field - value).norm() < 1.5
    found = elements(belief)
    torch.testing.assert_close(found.value, measured_elements(value), rtol=0, atol=2.0)
    assert ((found.gradient - elements_gradient(value, gradient)).norm(dim=-1) < f64(3e-4, 3e-5, 0.02)).all()


def test_a_leg_adds_what_the_model_leaves_out_in_proportion_to_the_square_of_its_length() -> None:
    belief = start(f64(5.0, 60.0, 20000.0), SensorStd(NOISE))
    sure = belief._replace(covariance=torch.zeros_like(belief.covariance))
    near, far = (moved(sure, f64(km)[0], f64(0.8)[0]).covariance for km in (50.0, 150.0))
    torch.testing.assert_close(far, 9 * near)
    assert near.diagonal().any()


def test_a_reading_is_the_update_of_a_textbook() -> None:
    """With all errors, iron and a missing element: P and x by the information form."""
    errors = SensorStd(NOISE, f64(0.6, 0.5, 150.0), f64(0.5, 0.4, 130.0), f64(100.0, 80.0, 50.0))
    reading, heading, new = f64(5.0, 60.0, 20000.0), f64(0.8)[0], f64(math.nan, 60.5, 19800.0)
    belief = moved(start(reading, errors, heading), f64(50.0)[0], heading, errors)
    after, seen = read(belief, new, NOISE, heading), innovation(belief, new, NOISE, heading)
    assert not seen.rows[0].any()
    assert seen.residual[0] == 0
    jacobian = elements_jacobian(field_vector(torch.where(new.isnan(), elements(belief).value, new)))[1:]
    torch.testing.assert_close(seen.rows[1:, :3], jacobian, rtol=1e-4, atol=0)
    precision = torch.linalg.inv(torch.diag(NOISE[1:].square()) + MODEL_NT**2 * jacobian @ jacobian.mT)
    own = belief.covariance.diagonal() > 0  # no place, no drift
    scale, before_it = belief.covariance.diagonal()[own].sqrt(), belief.covariance[own][:, own]
    rows, units = seen.rows[1:, own] * scale, scale * scale[:, None]
    covariance = torch.linalg.inv(torch.linalg.inv(before_it / units) + rows.mT @ precision @ rows)
    torch.testing.assert_close(after.covariance[own][:, own] / units, covariance, rtol=0, atol=1e-6)
    gain = covariance @ rows.mT @ precision @ seen.residual[1:]
    torch.testing.assert_close((after.mean - belief.mean)[own] / scale, gain, rtol=0, atol=1e-6)


# Errors of the sensors


def test_readings_on_opposite_headings_tell_the_iron_from_the_field() -> None:
    """At one place: its horizontal part turns with the vehicle, its vertical part and the field do not."""
    iron, field = f64(150.0, -80.0, 60.0), f64(20000.0, 1000.0, 35000.0)
    errors = SensorStd(NOISE, f64(0.5, 0.5, 150.0), f64(0.5, 0.5, 150.0), f64(100.0, 100.0, 100.0))
    belief, variances = before(measured_elements(field), errors), []
    for heading in f64(0.4, 0.4 + math.pi):
        reading = measured_elements(field + turning(heading.cos(), heading.sin(), 1) @ iron)
        belief = read(belief, reading, NOISE, heading)
        variances.append(belief.covariance.diagonal()[IRON])
    assert (variances[0] > 40**2).all()  # of 100^2
    assert (variances[1][:2] < 20**2).all()  # that of the noise of D and I
    assert variances[1][2] > 40**2
    assert (belief.mean[IRON] - iron)[:2].norm() < 40
    assert (belief.field - field)[:2].norm() < 40


def test_constant_and_slow_errors_by_hand() -> None:
    """The part of the stated drift by iron is in the vehicle's axes; the rest is of the field's vector."""
    field = f64(20000.0, 0.0, 20000.0 * 3**0.5)  # I = 60 degrees
    errors = SensorStd(NOISE, f64(0.5, 0.4, 60.0), f64(0.3, 0.3, 50.0), f64(30.0, 40.0, 50.0))
    level, down, per_nt2 = (30.0**2 + 40.0**2) / 2, 50.0**2, math.degrees(1 / 20000) ** 2
    d, i, along = errors.drift.square() - f64(per_nt2 * level, per_nt2 / 16 * (3 * level + down), level)
    tilt = i / math.degrees(1 / 40000) ** 2  # what the error of I is across the field, 3/4 of B_H's and 1/4 of the rest
    anomaly = torch.diag(torch.stack((along, d / per_nt2, (tilt - 0.75 * along) * 4)))
    expected = torch.diag(f64(0.16, 0.07, 1100.0)), anomaly, torch.diag(errors.iron.square())
    torch.testing.assert_close(lasting_covariances(field, errors), expected)
    covariance = before(measured_elements(field), errors).covariance
    for part, variance in zip((CONSTANT, ANOMALY, IRON), expected, strict=True):
        torch.testing.assert_close(covariance[part, part], variance, rtol=1e-5, atol=1e-6)


def test_a_known_start_calibrates_and_slow_errors_are_forgotten() -> None:
    """After three correlation lengths, exp(-3) of the anomaly and all of the constant error is left."""
    true, error = f64(3.0, 65.0, 18000.0), f64(0.8, -0.3, 60.0)
    errors = SensorStd(NOISE, f64(1.0, 0.5, 80.0), f64(0.3, 0.1, 10.0))
    belief = away = read(known(before(true, errors), true, NOISE / 10), true + error, NOISE)
    found = belief.mean[CONSTANT] + elements_jacobian(belief.field) @ belief.mean[ANOMALY]
    assert ((found - error).abs() < 0.02 * error.abs() + NOISE).all()
    assert (belief.field - field_vector(true)).norm() < 4
    for _ in range(3):
        away = moved(away, f64(ANOMALY_KM)[0], f64(1.0)[0], errors)
    assert torch.equal(away.mean[CONSTANT], belief.mean[CONSTANT])
    torch.testing.assert_close(away.mean[ANOMALY], math.exp(-3) * belief.mean[ANOMALY])
    kept, slow = math.exp(-6), lasting_covariances(away.field, errors)[1]
    expected = kept * belief.covariance[ANOMALY, ANOMALY] + (1 - kept) * slow
    torch.testing.assert_close(away.covariance[ANOMALY, ANOMALY].diagonal(), expected.diagonal(), rtol=0.1, atol=0)


# The destination


@pytest.mark.parametrize("latitude", [45.0, -80.0])
def test_the_destination_is_where_the_field_is(latitude: float) -> None:
    """A belief that is sure knows the displacement from the elements there, to 500 km, also over the ellipsoid."""
    planet = SphericalHarmonicField(random_planets(1, seed=5)[0])
    km, heading = torch.linspace(50, 500, 12, dtype=F64), torch.linspace(0, 6, 12, dtype=F64)
    there = planet(*move(torch.full_like(km, latitude), torch.zeros_like(km), heading, km))
    belief = Belief(*(part.expand(12, *part.shape) for part in sure_belief(planet, latitude, 0.0)))
    found = mode(destination(belief, measured_elements(there), 1e5)).mean
    wanted = km.unsqueeze(-1) * torch.stack((torch.cos(heading), torch.sin(heading)), -1)
    assert ((found - wanted).norm(dim=-1) < 0.1 + 0.0015 * km).all()


def test_the_posterior_is_the_integral_of_its_density() -> None:
    """On a grid of 10 km over 1800 km, for four starts after none to two legs."""
    reading = f64((0.0, 60.0, 20000.0), (20.0, -40.0, 25000.0), (-10.0, 5.0, 35000.0), (5.0, 75.0, 12000.0))
    belief = start(reading, SensorStd(NOISE))
    axis = torch.arange(-900, 900, 10, dtype=F64)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).reshape(1, -1, 2).expand(4, -1, -1)
    for step in range(3):
        aside = f64(200.0).expand(4), f64(1.0, 4.0, 2.5, 0.2)
        goal = destination(belief, elements(moved(belief, *aside)).value, 300.0)
        weights = torch.softmax(log_density(goal, grid), -1).unsqueeze(-1)
        mean = (weights * grid).sum(-2)
        wide = (weights * (grid - mean.unsqueeze(-2)).square()).sum((-2, -1)).sqrt()
        found = posterior(goal, 512)
        displacement = found.displacement()
        assert ((displacement.mean - mean).norm(dim=-1) < 0.12 * wide).all()
        spread = displacement.covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().double()
        torch.testing.assert_close(spread, wide, rtol=0.12, atol=0)
        inside = (weights.squeeze(-1) * (grid.norm(dim=-1) <= 200)).sum(-1)
        torch.testing.assert_close(found.within(200.0).double(), inside, rtol=0, atol=0.06)
        leg = f64(50.0).expand(4), f64(0.5 + step).expand(4)
        belief = read(moved(belief, *leg), elements(moved(belief, *leg)).value + 0.3 * NOISE, NOISE.expand(4, 3))


def test_a_destination_beyond_the_reach_of_the_model_is_within_it() -> None:
    """Honolulu to Tokyo, 6200 km: Gauss-Newton steps without a limit end 20 000 km away, where nothing is a number."""
    field, here, std = IGRF("2025-01-01"), (f64(21.3).expand(1), f64(-157.9).expand(1)), torch.zeros(1, 3)
    target, belief = elements_at(field, f64((35.7, 139.7))), start(elements_at(field, torch.stack(here, -1)), PERFECT)
    for course in f64(4.0, 4.8, 5.6):
        there = destination(belief, target, 400.0)
        assert mode(there).mean.norm() < 2001
        places = posterior(there)
        torch.testing.assert_close(places.weights.sum(), torch.tensor(1.0), atol=1e-4, rtol=0)
        assert places.points[places.weights > 0].norm(dim=-1).max() < 2001
        leg = f64(50.0).expand(1), course.expand(1)
        here, belief = move(*here, *leg[::-1]), moved(belief, *leg)
        belief = read(belief, elements_at(field, torch.stack(here, -1)), std)


@pytest.mark.parametrize(("bias", "least"), [(0.0, 0.8), (math.inf, 0.6)], ids=["true north", "magnetic north"])
def test_it_is_as_sure_as_it_is_right_on_random_planets(bias: float, least: float) -> None:
    """Flights of eight random legs on 256 planets: NEES of the displacement and of the innovations, 1 where they are
    right.

    Without true north, headings and the displacement are from magnetic north, and a reading has two elements.
    """
    count, magnetic = 128, math.isinf(bias)
    errors = SensorStd(NOISE, *(f64(*kind).expand(count, 3) for kind in ((bias, 0.0, 0.0), *[(0.0,) * 3] * 2)))
    draw = [torch.rand(count, generator=torch.Generator().manual_seed(seed)).double() for seed in (2, 3)]
    latitude, heading = torch.rad2deg(torch.asin(1.7 * draw[0] - 0.85)), 6 * draw[1]
    edges = torch.stack((latitude - 9, latitude + 9), -1), f64((-20.0, 20.0)).expand(count, 2)
    own = torch.arange(count)
    bank = FieldBank.build(random_planets(count, seed=11), own, *edges, degree=20, tolerance_nt=1.0)
    here = latitude, torch.zeros_like(latitude)
    place = move(*here, heading, 300 + 20 * randn(count, seed=5))
    target = measured_elements(bank(*place, own))
    readings, ratios, squares = NOISE * randn(9, count, 3), [], []
    for step in range(8):
        true = measured_elements(bank(*here, own))
        reading, north = true + readings[step], torch.deg2rad(true[:, 0]) * magnetic
        if step == 0:
            belief = start(reading, errors)
        else:
            square = innovation(belief, reading, NOISE.expand(count, 3)).square()
            squares.append((square / belief.measured.sum(-1)).mean())
            belief = read(belief, reading, NOISE.expand(count, 3))
        assert torch.equal(belief.magnetic, torch.full((count,), magnetic))
        distance, bearing = geodesic(*here, *place)
        displacement = posterior(destination(belief, target, 220.0)).displacement()
        bearing = bearing - north
        error = distance.unsqueeze(-1) * torch.stack((torch.cos(bearing), torch.sin(bearing)), -1) - displacement.mean
        ratios.append((error * torch.linalg.solve(displacement.covariance.double(), error)).sum(-1).mean() / 2)
        course, km = heading + 1.2 * math.sin(2 * step), torch.full_like(heading, 45.0)
        here, belief = move(*here, course + north, km), moved(belief, km, course)
    assert 0.7 < torch.stack(squares).mean() < 1.3
    assert least < torch.stack(ratios).mean() < 1.3
