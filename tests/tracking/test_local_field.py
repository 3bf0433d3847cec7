"""The belief of the local potential: moves, prior, readings and destination, each against what it stands for."""

import math

import pytest
import torch
from support.tracks import F64, f64, randn

from magrl.field import FieldBank, SphericalHarmonicField, random_planets
from magrl.field.elements import elements_gradient, measured_elements
from magrl.field.harmonics import basis, field_table
from magrl.geodesy import geodesic, move
from magrl.tracking.destination import destination, log_density, mode, posterior
from magrl.tracking.field_belief import (
    COEFFICIENTS,
    CONSTANT,
    MODEL_NT,
    SLOW,
    Belief,
    before,
    elements,
    innovation,
    known,
    moved,
    read,
    start,
)
from magrl.tracking.harmonics import RADIUS, field_rows, generators, orders, powers, size, turning
from magrl.tracking.prior import latitude_cells

STD = f64(0.05, 0.05, 5.0)


def local_coefficients(gauss: torch.Tensor, latitude: float, degree: int) -> torch.Tensor:
    """Coefficients of planets on the meridian of Greenwich of a sphere: fitted to the field along moves."""
    north, east = torch.meshgrid(*2 * [torch.linspace(-0.08, 0.08, 9, dtype=F64)], indexing="ij")
    way = torch.stack((north, east), -1).reshape(-1, 2)
    rows = torch.tensordot(powers(way, 9), field_rows(degree, 9), 1)
    phi, angle, heading = math.radians(latitude), way.norm(dim=-1) / RADIUS, torch.atan2(way[:, 1], way[:, 0])
    up, ahead = f64(math.cos(phi), 0.0, math.sin(phi)), f64(-math.sin(phi), 0.0, math.cos(phi))
    side = f64(0.0, 1.0, 0.0)
    along = torch.cos(heading)[:, None] * ahead + torch.sin(heading)[:, None] * side
    out = torch.cos(angle)[:, None] * up + torch.sin(angle)[:, None] * along
    forward = torch.cos(angle)[:, None] * along - torch.sin(angle)[:, None] * up
    left = torch.cos(heading)[:, None] * side - torch.sin(heading)[:, None] * ahead
    cos, sin = torch.cos(heading)[:, None], torch.sin(heading)[:, None]
    axes = torch.stack((cos * forward - sin * left, sin * forward + cos * left, -out), -2)  # carried, not turned
    field = field_table(gauss) @ basis(out * RADIUS * 1000, gauss.shape[-1])  # (..., 3, M)
    field = (axes @ field.mT.unsqueeze(-1)).squeeze(-1).flatten(-2)
    return torch.linalg.lstsq(rows.flatten(0, 1), field.mT).solution.mT


def test_generators_are_derivatives_and_turns() -> None:
    """They have the commutators of translations and rotations, and the Laplace equation holds."""
    field, turn = generators(4)
    c = randn(size(4))
    one, two = (turn[i] @ turn[j] - turn[j] @ turn[i] for i, j in ((0, 1), (1, 2)))
    torch.testing.assert_close(one, turn[2])  # rotations
    torch.testing.assert_close(two, turn[0])
    for i in range(3):
        for j in range(3):
            torch.testing.assert_close(field[i] @ field[j], field[j] @ field[i])
    torch.testing.assert_close(sum(field[i] @ field[i] for i in range(3)), torch.zeros(24, 24, dtype=F64))  # Laplace
    angle = f64(0.7)[0]
    torch.testing.assert_close(turning(angle.cos(), angle.sin(), 4) @ c, torch.linalg.matrix_exp(0.7 * turn[2]) @ c)


def test_the_prior_has_the_moments_of_sampled_planets() -> None:
    """Of 8000 planets at 57.5 degrees: each mean and standard deviation, and the correlations."""
    cells, planets = latitude_cells(), random_planets(8_000, seed=1)
    index = int(torch.argmin((cells.latitude - math.radians(57.5)).abs()))
    sample = local_coefficients(planets, 57.5, 8)[:, :COEFFICIENTS]
    gain, rest = cells.gain[index, :-1], cells.covariance[index, :-1, :-1]
    field = cells.field_covariance[index]
    covariance = torch.cat(
        (torch.cat((field, field @ gain.mT), 1), torch.cat((gain @ field, gain @ field @ gain.mT + rest), 1))
    )
    scale = covariance.diagonal().rsqrt()
    apart = (sample - cells.mean[index]) * scale
    assert apart.mean(0).abs().max() < 0.05
    torch.testing.assert_close(apart.mT @ apart / len(sample), covariance * scale * scale[:, None], rtol=0, atol=0.08)


@pytest.mark.parametrize(("latitude", "course"), [(50.0, 1.0), (-20.0, 4.0), (75.0, 2.0)])
def test_a_move_takes_the_field_and_its_gradient_along(latitude: float, course: float) -> None:
    """Six moves of 50 km: 1 nT, the gradients to 0.01 nT/km; and the latitude's column by differences."""
    gauss = random_planets(1, seed=5)[0]
    planet = SphericalHarmonicField(gauss)
    here = f64(latitude)[0], f64(10.0)[0]
    value, _ = planet.value_and_gradient(*here)
    # The coefficients are estimated from exact readings around the place, so that the ellipsoid is in them.
    way = 120 * randn(200, 2, seed=3)
    distance, heading = way.norm(dim=-1), torch.atan2(way[:, 1], way[:, 0])
    there = move(here[0].expand(200), here[1].expand(200), heading, distance)
    wide = torch.diag(f64(*[1e4 ** (1 - (n - 1) / 6) for n, _ in orders(3)])).square()
    belief = Belief(torch.zeros(22, dtype=F64), torch.nn.functional.pad(wide, (0, 7, 0, 7)), here[0])
    spread = belief.covariance[:COEFFICIENTS, :COEFFICIENTS]
    rows = torch.cat([_row(belief, distance[i], heading[i]) for i in range(200)])
    field = planet(*there).flatten()
    inverse = torch.linalg.inv(spread) + rows.mT @ rows
    belief = belief._replace(mean=torch.nn.functional.pad(torch.linalg.solve(inverse, rows.mT @ field), (0, 7)))
    assert (belief.field - value).norm() < 0.5
    km, turn = f64(50.0)[0], f64(course)[0]
    column = f64(*[0.0] * COEFFICIENTS, 1e-4, *[0.0] * 6)
    linear = (moved(belief._replace(mean=belief.mean + column), km, turn).mean - moved(belief, km, turn).mean) / 1e-4
    shifted = [moved(belief._replace(latitude=here[0] + math.degrees(x)), km, turn).mean for x in (1e-4, -1e-4)]
    difference = (shifted[0] - shifted[1])[:3] / 2e-4
    assert (linear[:3] - difference).norm() < 0.02 * difference.norm() + 4
    for step in range(6):
        belief = moved(belief, km, turn)
        here = move(*here, turn, km)
        turn = turn + 0.3 * (-1) ** step
    assert (belief.latitude - here[0]).abs() < 1e-4
    value, gradient = planet.value_and_gradient(*here)
    assert (belief.field - value).norm() < 1.5
    found = elements(belief)
    torch.testing.assert_close(found.value, measured_elements(value), rtol=0, atol=2.0)
    assert ((found.gradient - elements_gradient(value, gradient)).norm(dim=-1) < f64(3e-4, 3e-5, 0.02)).all()


def _row(belief: Belief, distance: torch.Tensor, heading: torch.Tensor) -> torch.Tensor:
    """The field after a move, as a matrix on the coefficients before it."""
    eye = torch.eye(22, dtype=F64)[:COEFFICIENTS]
    many = Belief(eye, belief.covariance.expand(COEFFICIENTS, 22, 22), belief.latitude.expand(COEFFICIENTS))
    return moved(many, distance.expand(COEFFICIENTS), heading.expand(COEFFICIENTS)).field.mT


def test_a_reading_is_the_update_of_a_textbook() -> None:
    """With all errors, iron and a missing element: P and x by the information form."""
    reading, heading = f64(5.0, 60.0, 20000.0), f64(0.8)[0]
    belief = before(reading, f64(0.3, 0.2, 30.0), f64(0.1, 0.1, 10.0), f64(100.0, 80.0, 50.0))
    belief = moved(read(belief, reading, STD, heading), f64(50.0)[0], heading, f64(0.1, 0.1, 10.0))
    new = f64(math.nan, 60.5, 19800.0)
    after, seen = read(belief, new, STD, heading), innovation(belief, new, STD, heading)
    assert not seen.rows[0].any()
    assert seen.residual[0] == 0
    rows, noise = seen.rows[1:], (seen.covariance - seen.rows @ belief.covariance @ seen.rows.mT)[1:, 1:]
    scale = belief.covariance.diagonal().sqrt()
    prior = torch.linalg.inv(belief.covariance / scale / scale[:, None])
    scaled = rows * scale
    covariance = torch.linalg.inv(prior + scaled.mT @ torch.linalg.solve(noise, scaled))
    torch.testing.assert_close(after.covariance / scale / scale[:, None], covariance, rtol=0, atol=1e-6)
    gain = covariance @ scaled.mT @ torch.linalg.solve(noise, seen.residual[1:])
    torch.testing.assert_close((after.mean - belief.mean) / scale, gain, rtol=0, atol=1e-6)


def test_a_known_start_calibrates() -> None:
    true, error = f64(3.0, 65.0, 18000.0), f64(0.8, -0.3, 60.0)
    belief = known(before(true, bias_std=f64(1.0, 0.5, 80.0), drift_std=f64(0.3, 0.1, 10.0)), true, STD / 10)
    belief = read(belief, true + error, STD)
    found = belief.mean[CONSTANT] + belief.mean[SLOW]
    assert ((found - error).abs() < 0.02 * error.abs() + STD).all()
    assert (belief.field - read(belief, true + error, STD).field).norm() < MODEL_NT


@pytest.mark.parametrize("latitude", [45.0, -80.0])
def test_the_destination_is_where_the_field_is(latitude: float) -> None:
    """A belief that is sure knows the displacement from the elements there, to 500 km, also over the ellipsoid."""
    planet = SphericalHarmonicField(random_planets(1, seed=5)[0])
    heading = torch.linspace(0, 6, 12, dtype=F64)
    km = torch.linspace(50, 500, 12, dtype=F64)
    here = torch.full_like(km, latitude), torch.zeros_like(km)
    belief = Belief(torch.zeros(12, 22, dtype=F64), torch.zeros(12, 22, 22, dtype=F64), here[0])
    way = 150 * randn(300, 2, seed=3)
    distance, course = way.norm(dim=-1), torch.atan2(way[:, 1], way[:, 0])
    one = Belief(belief.mean[0], belief.covariance[0], here[0][0])
    rows = torch.cat([_row(one, distance[i], course[i]) for i in range(300)])
    field = planet(*move(here[0][0].expand(300), here[1][0].expand(300), course, distance)).flatten()
    mean = torch.linalg.lstsq(rows, field.unsqueeze(-1)).solution.squeeze(-1)
    belief = belief._replace(mean=torch.nn.functional.pad(mean, (0, 7)).expand(12, 22))
    target = measured_elements(planet(*move(*here, heading, km)))
    found = mode(destination(belief, target, 1e5)).displacement
    wanted = km.unsqueeze(-1) * torch.stack((torch.cos(heading), torch.sin(heading)), -1)
    assert ((found - wanted).norm(dim=-1) < 2.0 + 0.01 * km).all()


def test_the_posterior_is_the_integral_of_its_density() -> None:
    """On a grid of 10 km over 2400 km, for four starts after none to three moves."""
    reading = f64((0.0, 60.0, 20000.0), (20.0, -40.0, 25000.0), (-10.0, 5.0, 35000.0), (5.0, 75.0, 12000.0))
    belief = start(reading, STD.expand(4, 3))
    axis = torch.arange(-1200, 1200, 10, dtype=F64)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), -1).reshape(1, -1, 2).expand(4, -1, -1)
    for step in range(3):
        aside = torch.full((4,), 200.0, dtype=F64), f64(1.0, 4.0, 2.5, 0.2)
        goal = destination(belief, elements(moved(belief, *aside)).value, 300.0)
        weights = torch.softmax(log_density(goal, grid), -1).unsqueeze(-1)
        mean = (weights * grid).sum(-2)
        size = (weights * (grid - mean.unsqueeze(-2)).square()).sum((-2, -1)).sqrt()
        found = posterior(goal, 512)
        way = found.way()
        assert ((way.displacement - mean).norm(dim=-1) < 0.12 * size).all()
        torch.testing.assert_close(
            way.covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().double(), size, rtol=0.12, atol=0
        )
        inside = (weights.squeeze(-1) * (grid.norm(dim=-1) <= 200)).sum(-1)
        torch.testing.assert_close(found.within(200.0).double(), inside, rtol=0, atol=0.06)
        course = torch.full((4,), 0.5 + step, dtype=F64)
        reading = elements(moved(belief, torch.full_like(course, 50.0), course)).value + 0.3 * STD
        belief = read(moved(belief, torch.full_like(course, 50.0), course), reading, STD.expand(4, 3))


def test_it_is_as_sure_as_it_is_right_on_random_planets() -> None:
    """Flights of eight random moves on 256 planets: NEES of the way and of the innovations, 1 where they are right."""
    count = 256
    latitude = torch.rad2deg(
        torch.asin(1.7 * torch.rand(count, generator=torch.Generator().manual_seed(2)).double() - 0.85)
    )
    edges = torch.stack((latitude - 9, latitude + 9), -1), f64((-20.0, 20.0)).expand(count, 2)
    place_of = torch.arange(count)
    bank = FieldBank.build(random_planets(count, seed=11), place_of, *edges, degree=20, tolerance_nt=1.0)
    heading, noise = 6 * torch.rand(count, generator=torch.Generator().manual_seed(3)).double(), randn(9, count, 3)
    here = latitude, torch.zeros_like(latitude)
    place = move(*here, heading, 300 + 20 * randn(count, seed=5))
    target = measured_elements(bank(*place, place_of))
    ratios, squares = [], []
    for step in range(8):
        reading = measured_elements(bank(*here, place_of)) + STD * noise[step]
        if step == 0:
            belief = start(reading, STD.expand(count, 3))
        else:
            seen = innovation(belief, reading, STD.expand(count, 3))
            squares.append(seen.square().mean() / 3)
            belief = read(belief, reading, STD.expand(count, 3))
        distance, bearing = geodesic(*here, *place)
        way = posterior(destination(belief, target, 220.0)).way()
        error = distance.unsqueeze(-1) * torch.stack((torch.cos(bearing), torch.sin(bearing)), -1) - way.displacement
        ratios.append((error * torch.linalg.solve(way.covariance.double(), error)).sum(-1).mean() / 2)
        course, km = heading + 1.2 * math.sin(2 * step), torch.full_like(heading, 45.0)
        here, belief = move(*here, course, km), moved(belief, km, course)
    assert 0.7 < torch.stack(squares).mean() < 1.3
    assert 0.8 < torch.stack(ratios).mean() < 1.3
