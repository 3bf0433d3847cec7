"""The filter of quasi-Newton navigators: against a textbook Kalman filter, least squares and Broyden's update."""

from __future__ import annotations

import numpy as np
import torch
from support.tracks import F64, f64, randn

from magrl.navigators.quasi_newton import (
    FieldTrack,
    GradientPrior,
    estimated_displacement,
    first_track,
    next_track,
    wrapped,
)

NONE = torch.zeros(3, dtype=F64)


def random_track(*shape: int, spread: float = 1.0) -> FieldTrack:
    """A state with random means and positive definite covariances."""
    root = randn(*shape, 3, 3, seed=1)
    return FieldTrack(randn(*shape, 3), spread * (root @ root.mT + 0.1 * torch.eye(3, dtype=F64)))


def test_a_track_is_that_of_a_textbook_kalman_filter() -> None:
    """x = F x, P = F P F^T + Q; K = P H^T / S, x = x + K (z - H x), P = (1 - K H) P for each of two elements."""
    std, curvature, prior = f64(0.3, 2.0), f64(0.02, 0.01), GradientPrior(randn(4, 2, 2), randn(4, 2, 2, seed=1).abs())
    readings, legs, h = 10 * randn(6, 4, 2, seed=2), 5 * randn(6, 4, 2, seed=3), np.eye(3)[:1]
    track = first_track(readings[0], prior, std)
    for step in range(1, 6):
        track = next_track(track, legs[step], readings[step], std, curvature, 0 * std)
    for row, element in np.ndindex(4, 2):
        x = np.array([readings[0, row, element], *prior.gradient[row, element]])
        p = np.diag([std[element] ** 2, *(prior.std[row, element] ** 2)])
        for step in range(1, 6):
            f, (n, e) = np.eye(3), legs[step, row].numpy()
            f[0, 1:] = n, e
            drift = np.array([[n / 2, e / 2], [1, 0], [0, 1]])  # of a gradient that changes evenly along the leg
            q = float(curvature[element]) ** 2 * (n * n + e * e) * drift @ drift.T
            x, p = f @ x, f @ p @ f.T + q
            k = p @ h.T / (h @ p @ h.T + float(std[element]) ** 2)
            x, p = x + k @ (readings[step, row, element].numpy() - h @ x), p - k @ h @ p
        np.testing.assert_allclose(track.mean[row, element], x, rtol=1e-8)
        np.testing.assert_allclose(track.covariance[row, element], p, rtol=1e-7, atol=1e-12)


def test_exact_readings_correct_the_gradient_along_the_leg_alone() -> None:
    """Broyden's update, and a declination that crosses 180 degrees."""
    gradient, truth, leg = randn(3, 2), f64((1.0, 0.0), (2.0, -1.0), (0.0, 5.0)), f64(3.0, -4.0)
    track = first_track(f64(179.0, 0.0, 0.0), GradientPrior(gradient, torch.ones(3, 2)), NONE)
    periods = f64(360.0, 0.0, 0.0)
    after = wrapped(f64(179.0, 0.0, 0.0) + truth @ leg, periods)
    found = next_track(track, leg, after, NONE, NONE, periods).mean[:, 1:]
    expected = gradient + ((truth - gradient) @ leg)[:, None] * leg / 25
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_the_displacement_satisfies_its_normal_equations() -> None:
    """The last solve, with the variances at the one before it: of the state, a constant error and the curvature."""
    track, target, reach = random_track(20, 3), randn(20, 3, seed=7), 2.5
    bias, curvature = f64(0.5, 0.1, 0.2), f64(0.2, 0.4, 0.1)
    found = estimated_displacement(track, target, reach, bias, curvature, NONE)
    for n in range(20):
        mean, blocks = track.mean[n].numpy(), track.covariance[n].numpy()
        variance = blocks[:, 0, 0] + reach**2 * (blocks[:, 1, 1] + blocks[:, 2, 2]) + bias.numpy() ** 2
        variance = variance + 8 * (curvature.numpy() * reach**2 / 2) ** 2  # E |d|^4 = 8 reach^4
        for _ in range(3):
            weighted = mean[:, 1:] / variance[:, None]
            normal = weighted.T @ mean[:, 1:] + np.eye(2) / reach**2
            displacement = np.linalg.solve(normal, weighted.T @ (target[n].numpy() - mean[:, 0]))
            lever = np.array([1.0, *displacement])
            variance = np.einsum("i,eij,j->e", lever, blocks, lever) + bias.numpy() ** 2
            variance = variance + (curvature.numpy() * (displacement @ displacement) / 2) ** 2
        np.testing.assert_allclose(found.mean[n].numpy(), displacement, rtol=1e-7)
        np.testing.assert_allclose(found.covariance[n].numpy(), np.linalg.inv(normal), rtol=1e-7)
