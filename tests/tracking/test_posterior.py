"""The posterior of the way: against an integral in NumPy, and calibrated on fields drawn from the filter's state."""

import numpy as np
import pytest
import torch
from support.tracks import F64, f64, randn, random_track

from magrl.tracking import FieldTrack, GradientRelation, Way, WayPosterior, relate, way_posterior
from magrl.tracking.posterior import _misfit

ONE = (1.0, 1.0, 1.0)


@pytest.mark.parametrize("fine", [True, False])
@pytest.mark.parametrize(("size", "common"), [(0.1, None), (0.4, f64(0.5, 0.0, -0.9))])
@pytest.mark.parametrize("related", [False, True])
def test_it_is_the_integral_of_its_density(related: bool, size: float, common: torch.Tensor | None, fine: bool) -> None:
    """On a grid of 8 km over 2400 km, with errors that are constant and a gradient that changes along the way."""
    (track, shared), target = (random_track(4, 3), None), randn(4, 3, seed=7)
    if related:
        relation = GradientRelation(100 * randn(4, 3, 2, seed=5), randn(4, seed=6), randn(4, seed=7).abs() + 0.1)
        track, shared = relate(track, relation, ONE)
    bias, bend = size * f64(1.0, 0.0, 2.0), f64(0.05, 0.0, 0.1)
    posterior = way_posterior(track, target, 200.0, ONE, shared, bias, curvature=bend, common=common, fine=fine)
    alike = bias.numpy() * (0 if common is None else common.numpy())
    axis = np.arange(-1200, 1200, 8) / 100
    way = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    lever = np.concatenate((np.ones((*way.shape[:2], 1)), way), -1)
    for n in range(4):
        mean, blocks = track.mean[n].numpy(), track.covariance[n].numpy()
        variance = np.einsum("xyi,eij,xyj->xye", lever, blocks, lever)
        variance += bias.numpy() ** 2 - alike**2 + bend.numpy() ** 2 * (way**2).sum(-1, keepdims=True) ** 2 / 4
        covariance = variance[..., None] * np.eye(3) + alike[:, None] * alike
        if shared is not None:
            together = lever @ shared[n].numpy().T
            covariance -= together[..., None] * together[..., None, :]
        left = target[n].numpy() - lever @ mean.T
        square = np.einsum("xye,xyef,xyf->xy", left, np.linalg.inv(covariance), left)
        density = np.exp(-(square + np.linalg.slogdet(covariance)[1] + (way**2).sum(-1) / 4) / 2)
        density /= density.sum()
        expected = (density[..., None] * way).sum((0, 1)) * 100
        within = density[(way**2).sum(-1) <= 0.5**2].sum()
        size = np.sqrt((density * ((100 * way - expected) ** 2).sum(-1)).sum())
        found = posterior.way()
        assert np.linalg.norm(found.displacement[n].numpy() - expected) < 0.1 * size
        assert found.covariance[n].trace().sqrt().item() == pytest.approx(size, rel=0.1)
        assert posterior.within(50.0)[n].item() == pytest.approx(within, abs=0.03)


def test_the_misfit_is_that_of_the_whole_covariance() -> None:
    residual, variance = randn(2, 3, 5, seed=1), randn(2, 3, 5, seed=2).square() + 1
    alike, shares = randn(2, 3, 1, seed=3), 0.4 * randn(2, 3, 5, seed=4)
    one, two, three = (x.expand(2, 3, 5).mT.unsqueeze(-1) for x in (residual, alike, shares))
    whole = torch.diag_embed(variance.mT) + two @ two.mT - three @ three.mT
    square, determinant = _misfit(residual, variance, alike, [shares])
    torch.testing.assert_close(square, (one.mT @ torch.linalg.solve(whole, one)).squeeze((-1, -2)))
    torch.testing.assert_close(determinant, torch.linalg.det(whole))


def test_its_probabilities_are_the_shares_of_fields_drawn_from_the_state() -> None:
    """4000 ways from the prior and fields from the filter, with gradients that are known to a third of their size."""
    count, spread = 4000, 0.3
    mean = torch.cat((torch.zeros(3, 1, dtype=F64), f64((1.0, 0.2), (-0.1, 0.8), (0.5, -0.5))), -1)
    covariance = torch.diag(f64(0.01, spread**2, spread**2)).expand(3, 3, 3)
    way = 0.6 * randn(count, 2, seed=1)
    state = mean + randn(count, 3, 3, seed=2) * f64(0.1, spread, spread)
    target = state[..., 0] + (state[..., 1:] * way[:, None]).sum(-1)
    track = FieldTrack(mean.expand(count, 3, 3), covariance.expand(count, 3, 3, 3))
    posterior = way_posterior(track, target, 60.0, ONE)
    probability, right = posterior.within(40.0), 100 * way.norm(dim=-1) <= 40.0
    for low in torch.arange(0, 1, 0.2):
        bin_ = (probability >= low) & (probability <= low + 0.2)
        assert right[bin_].double().mean().item() == pytest.approx(probability[bin_].mean().item(), abs=0.05)
    held = 100 * way.norm(dim=-1) <= posterior.radius(0.8)
    assert held.double().mean().item() == pytest.approx(0.8, abs=0.03)
    estimate = posterior.way()
    error = 100 * way - estimate.displacement
    squares = (error * torch.linalg.solve(estimate.covariance, error)).sum(-1) / 2
    assert squares.mean().item() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(("long_km", "expected"), [(20.0, 0.7887), (25.0, 0.6827), (40.0, 0.4680)])
def test_a_long_and_narrow_ellipse_around_the_vehicle_is_normal(long_km: float, expected: float) -> None:
    """Constant errors of 0.3 km on one axis and of more on the other, with known gradients: P(|z| < 25 / long_km)."""
    mean = torch.cat((torch.zeros(2, 1, dtype=F64), torch.eye(2, dtype=F64)), -1)
    track = FieldTrack(mean, 1e-12 * torch.eye(3, dtype=F64).expand(2, 3, 3))
    posterior = way_posterior(track, f64(0.0, 0.0), 5000.0, ONE[:2], bias_std=(0.003, long_km / 100))
    assert posterior.within(25.0).item() == pytest.approx(expected, abs=0.015)


def test_both_precisions_agree() -> None:
    track, target = random_track(50, 3), randn(50, 3, seed=7)
    exact = way_posterior(track, target, 200.0, ONE).way()
    low = way_posterior(FieldTrack(*(x.float() for x in track)), target.float(), 200.0, ONE).way()
    torch.testing.assert_close(low.displacement.double(), exact.displacement, rtol=1e-3, atol=0.1)


def test_the_aim_lies_between_the_mean_and_the_likeliest_way() -> None:
    """At the likeliest way where it is certain, at the mean where it is uncertain or leads nowhere; never undefined."""
    posterior = WayPosterior(f64((100.0, 0.0), (0.0, 60.0)), f64(0.5, 0.5))
    ways, sizes = f64((100.0, 0.0), (100.0, 0.0), (100.0, 0.0), (0.0, 0.0), (0.0, 0.0)), f64(0.0, 1e9, 1250.0, 1.0, 0.0)
    aim = posterior.aim(Way(ways, sizes[:, None, None] * torch.eye(2, dtype=F64)))
    expected = f64((100.0, 0.0), (50.0, 30.0), (75.0, 15.0), (50.0, 30.0), (50.0, 30.0))
    torch.testing.assert_close(aim.displacement, expected, rtol=0, atol=1e-3)
    torch.testing.assert_close(aim.covariance, posterior.way().covariance)
