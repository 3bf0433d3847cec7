"""Anomalies of unknown size: what the readings say of it, and what they leave of a place."""

from __future__ import annotations

import torch
from support.tracks import f64, randn
from torch import Tensor

from magrl.field.elements import measured_elements
from magrl.geodesy import geodesic
from magrl.pilot import anomalies
from magrl.pilot.belief import PLACE, STATES, Belief, Innovation, before, innovation, moved, updated
from magrl.sensor_std import SensorStd

COUNT, LEGS = 400, 8
HERE = f64(3.0, 65.0, 18000.0)


def std_of(drift: Tensor) -> SensorStd:
    """Sensors of 0.02 degrees and 2 nT, whose slow errors are stated."""
    parts = f64(0.02, 0.02, 2.0), drift, drift, torch.zeros(3).double()
    return SensorStd(*(part.expand(COUNT, 3) for part in parts))


def weights(size: Tensor, drift: Tensor) -> Tensor:
    """Weights ``(N, H)`` after some legs of readings that are drawn from the belief with anomalies of true sizes."""
    noise, index = randn(LEGS, COUNT, 3), torch.arange(COUNT)
    beliefs = anomalies.side_by_side(before(HERE.expand(COUNT, 3), std_of(drift)), std_of(drift))
    log_weight, std = anomalies.prior_weights(HERE.expand(COUNT, 3)), std_of(drift).noise.unsqueeze(1)
    errors, legs = SensorStd(*(part.unsqueeze(1) for part in std_of(drift))), torch.full((COUNT, 1), 50.0).double()
    for leg in range(LEGS):
        beliefs = moved(beliefs, legs, 0.4 * leg * legs / 50, errors, crust_nt=anomalies.sizes())
        near = measured_elements(beliefs.field[index, size])
        guess = innovation(beliefs, near.unsqueeze(1), std)
        read = near - guess.residual[index, size]  # what the true belief predicts, and a draw of its own innovation
        read = read + (torch.linalg.cholesky(guess.covariance[index, size]) @ noise[leg].unsqueeze(-1)).squeeze(-1)
        new = innovation(beliefs, read.unsqueeze(1), std)
        log_weight = anomalies.reweighed(log_weight, new)[0]
        beliefs = anomalies.recentered(updated(beliefs, new), log_weight)
    return log_weight.exp()


def test_weights_are_the_probabilities_of_the_sizes() -> None:
    """Over vehicles whose sizes are drawn from the prior, their mean is the share of each; most find the true one."""
    drawn = torch.rand(COUNT, generator=torch.Generator().manual_seed(0)).double()
    size = torch.searchsorted(f64(*anomalies.PRIOR[3]).cumsum(0), drawn).clamp_max(2)
    found = weights(size, torch.zeros(3).double())
    share = torch.bincount(size, minlength=3) / COUNT
    torch.testing.assert_close(found.mean(0), share.double(), rtol=0, atol=0.03)
    assert found[torch.arange(COUNT), size].mean() > 0.8


def test_stated_errors_are_not_taken_for_an_anomaly() -> None:
    """Slow errors of as many nanotesla as the largest anomaly are stated: readings with them leave the prior as is."""
    found = weights(torch.zeros(COUNT, dtype=torch.int64), f64(0.3, 0.12, 90.0))
    torch.testing.assert_close(found.mean(0), f64(*anomalies.PRIOR[3]), rtol=0, atol=0.05)


def test_a_new_reference_place_moves_no_place() -> None:
    place, mean = f64((60.0, 5.0), (-20.0, 179.99)), torch.zeros(2, 3, STATES).double()
    mean[..., PLACE] = 20 * randn(2, 3, 2)
    beliefs = Belief(mean, torch.eye(STATES).double().expand(2, 3, STATES, STATES), place.unsqueeze(1))
    log_weight = f64(*anomalies.PRIOR[3]).log().expand(2, 3)
    after = anomalies.recentered(beliefs, log_weight)
    assert anomalies.mixture(after, log_weight).mean[:, PLACE].abs().max() < 1e-9
    distance, bearing = geodesic(*place.unbind(-1), *after.place.squeeze(1).unbind(-1))
    moved_by = distance.unsqueeze(-1) * torch.stack((bearing.cos(), bearing.sin()), -1)
    torch.testing.assert_close(after.mean[..., PLACE] + moved_by.unsqueeze(1), mean[..., PLACE], rtol=0, atol=0.01)


def test_a_mixture_has_the_moments_of_its_beliefs() -> None:
    mean, weight = randn(3, STATES), f64(0.5, 0.3, 0.2)
    beliefs = Belief(mean, torch.eye(STATES).double().expand(3, STATES, STATES), f64((0.0, 0.0)))
    one, apart = anomalies.mixture(beliefs, weight.log()), mean - weight @ mean
    torch.testing.assert_close(one.covariance, torch.eye(STATES).double() + (apart.T * weight) @ apart)


def test_tails_are_uniform_where_a_belief_is_right() -> None:
    square = randn(5000, 1, 3)
    new = Innovation(square, torch.ones(5000, 1, 3, STATES).double(), torch.eye(3).double().expand(5000, 1, 3, 3))
    found = anomalies.tail(torch.zeros(5000, 1).double(), new, torch.tensor([3]))
    assert all(abs((found < p).double().mean() - p) < 0.02 for p in (0.1, 0.5, 0.9))
    joint = [anomalies.joint_tail(some.tolist()) for some in found[:1000].split(8)]
    assert abs(sum(p < 0.3 for p in joint) / len(joint) - 0.3) < 0.1


def test_the_share_of_the_crust_is_what_errors_leave_of_an_anomaly() -> None:
    """None without a crust, all without other errors, and a quarter of an error that is twice as large."""
    field, none = f64(20000.0, 0.0, 40000.0), SensorStd(*torch.zeros(4, 3).double())
    stated = none._replace(drift=f64(0.0, 0.0, 60.0))
    assert not anomalies.crust_share(field, stated, f64(0.0)[0]).any()
    torch.testing.assert_close(anomalies.crust_share(field, none, f64(30.0)[0]), torch.eye(3).double())
    assert anomalies.crust_share(field, stated, f64(30.0)[0])[0, 0].item() == 0.25


def test_a_vehicle_that_comes_to_another_field_finds_out() -> None:
    """A hundred readings that fit without an anomaly, then one that fits with one."""
    spread = f64(1.0, 9.0, 100.0)[:, None, None] * torch.eye(3).double()
    log_weight = anomalies.prior_weights(HERE)
    for square in (*[0.0] * 100, 36.0):
        residual = f64((square / 3) ** 0.5).expand(3, 3)
        log_weight = anomalies.reweighed(log_weight, Innovation(residual, torch.ones(3, 3, STATES).double(), spread))[0]
        weights = log_weight.exp()
        assert weights[0] > 0.9 if not square else weights[1] > 0.9
