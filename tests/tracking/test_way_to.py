"""The way to the target: against exact solutions, normal equations in NumPy, and simulations."""

import numpy as np
import pytest
import torch
from support.tracks import F64, SCALES, f64, randn, random_track

from magrl.tracking import DISTANCE_SCALE_KM, FieldTrack, GradientRelation, relate, way_to


def test_way_in_a_linear_field_is_exact():
    """With small variances the way is where the linear field has the target's values, to 1 m in 400 km."""
    track, way = random_track(50, 3, spread=1e-12), 200 * randn(50, 2, seed=9)
    target = (track.mean[..., 0] + (track.mean[..., 1:] * way[:, None] / DISTANCE_SCALE_KM).sum(-1)) * SCALES
    torch.testing.assert_close(way_to(track, target, 1e5).displacement, way, rtol=0, atol=1e-3)
    turned = target + f64(720.0, 0.0, 0.0)
    found = way_to(track, turned, 1e5, periods=(360.0, 0.0, 0.0)).displacement
    torch.testing.assert_close(found, way, rtol=0, atol=1e-3)


@pytest.mark.parametrize("related", [False, True])
def test_way_satisfies_its_normal_equations(related):
    """The last solve, with the covariance at the way before it, against a least-squares solution in NumPy."""
    (track, shared), target, reach = (random_track(20, 3), None), randn(20, 3, seed=7), 2.5
    if related:
        relation = GradientRelation(100 * randn(20, 3, 2, seed=5), randn(20, seed=6), randn(20, seed=7).abs() + 0.1)
        track, shared = relate(track, relation, scales=(1.0,) * 3)
    found = way_to(track, target, 100 * reach, (1.0,) * 3, shared)
    for n in range(20):
        mean, blocks = track.mean[n].numpy(), track.covariance[n].numpy()
        u = np.zeros((3, 3)) if shared is None else shared[n].numpy()
        covariance = np.diag(blocks[:, 0, 0] + reach**2 * (blocks[:, 1, 1] + blocks[:, 2, 2]))
        for _ in range(3):
            weight = np.linalg.inv(covariance)
            normal = mean[:, 1:].T @ weight @ mean[:, 1:] + np.eye(2) / reach**2
            way = np.linalg.solve(normal, mean[:, 1:].T @ weight @ (target[n].numpy() - mean[:, 0]))
            lever = np.array([1.0, *way])
            covariance = np.diag([lever @ p @ lever for p in blocks]) - np.outer(u @ lever, u @ lever)
        np.testing.assert_allclose(found.displacement[n].numpy(), 100 * way, rtol=1e-7)
        np.testing.assert_allclose(found.covariance[n].numpy(), 1e4 * np.linalg.inv(normal), rtol=1e-7)


def test_a_constant_error_widens_the_way_and_nothing_else():
    """It is as if the value were less certain, but not its relation to the gradients."""
    track, target, bias = random_track(20, 3), SCALES * randn(20, 3, seed=7), f64(0.5, 0.1, 20.0)
    covariance = track.covariance.clone()
    covariance[..., 0, 0] += (bias / SCALES).square()
    expected, found = (
        way_to(FieldTrack(track.mean, covariance), target, 300.0),
        way_to(track, target, 300.0, bias_std=bias),
    )
    torch.testing.assert_close(tuple(found), tuple(expected))


def test_curvature_is_uncertainty_that_grows_with_the_square_of_the_way():
    """Two exact gradients of 1 per 100 km, and a change of 0.1 per (100 km)^2: over 300 km, 0.1 * 3^2 / 2 units."""
    gradients = f64((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    track, scales = FieldTrack(gradients, torch.zeros(2, 3, 3, dtype=F64)), (1.0, 1.0)
    found = way_to(track, f64(3.0, 0.0), 1e6, scales, curvature=(0.1, 0.1))
    torch.testing.assert_close(found.displacement, f64(300.0, 0.0), rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(found.covariance, 45.0**2 * torch.eye(2, dtype=F64), rtol=1e-3, atol=1e-3)


def test_way_is_accurate_in_float32_where_gradients_are_nearly_parallel():
    """At 1e-3 rad between them, a c - b^2 would have no correct digit left."""
    gradients = f64((1.0, 0.0), (2.0, 2e-3), (3.0, 0.0))
    mean = torch.cat((torch.zeros(3, 1, dtype=F64), gradients), -1)
    track = FieldTrack(mean, 1e-8 * torch.eye(3, dtype=F64).expand(3, 3, 3))
    target = gradients @ f64(1.0, -2.0) * SCALES
    exact, low = way_to(track, target, 1e4), way_to(FieldTrack(*(x.float() for x in track)), target.float(), 1e4)
    torch.testing.assert_close(exact.displacement, f64(100.0, -200.0), rtol=1e-3, atol=0)
    torch.testing.assert_close(low.displacement.double(), exact.displacement, rtol=1e-3, atol=0)
    torch.testing.assert_close(low.covariance.double(), exact.covariance, rtol=1e-3, atol=0)


def test_covariance_of_the_way_is_that_of_a_simulation():
    """Over 40 000 fields drawn from the filter's distribution, within 10 % on both principal axes."""
    count, std = 40_000, randn(3, 3, seed=4)
    mean = torch.cat((torch.zeros(3, 1, dtype=F64), f64((0.3, 1.2), (1.0, 0.2), (-0.8, 0.5))), -1)
    covariance = 1e-3 * (std @ std.T + torch.eye(3, dtype=F64)) * torch.ones(3, 1, 1, dtype=F64)
    truth = mean + torch.einsum("ij,nej->nei", torch.linalg.cholesky(covariance[0]), randn(count, 3, 3, seed=1))
    way = f64(150.0, -80.0)
    target = (truth[..., 0] + (truth[..., 1:] * way / DISTANCE_SCALE_KM).sum(-1)) * SCALES
    found = way_to(FieldTrack(mean, covariance), target, 3000.0)
    error = found.displacement - way
    ratio = torch.linalg.eigvals(torch.linalg.solve(found.covariance.mean(0), error.T.cov())).real
    assert (ratio - 1).abs().max() < 0.1
    assert (error.mean(0).abs() < 0.1 * error.std(0)).all()


def test_way_stays_in_range_without_information():
    """With no gradient at all the way is zero, and as uncertain as its prior."""
    way = way_to(FieldTrack(torch.zeros(3, 3), torch.eye(3).expand(3, 3, 3)), torch.ones(3), 250.0)
    torch.testing.assert_close(tuple(way), (torch.zeros(2), 250.0**2 * torch.eye(2)))
