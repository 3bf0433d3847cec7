"""The plan of the next move: what it predicts, what it weighs, and what it compares."""

from __future__ import annotations

import pytest
import torch
from support.tracks import F64, STD, f64
from torch import Tensor

from magrl import tracking
from magrl.tracking import FieldTrack, WayPosterior, planning

RANGE_KM = 300.0
NOISE = f64(*STD)
READING = f64(8.0, -16.0, 35000.0)
UNSURE = tracking.start(READING, tracking.dipole_prior(READING), STD)
SLOPES = f64((20.0, 0.3, 0.2), (40.0, -0.2, 0.9), (200.0, 0.5, 0.5))
SURE = FieldTrack(SLOPES, 1e-8 * torch.eye(3, dtype=F64).expand(3, 3, 3))


def predicted(
    track: FieldTrack, moves: Tensor, left: Tensor, bias_std: Tensor | None = None, curvature: Tensor | None = None
) -> Tensor:
    options = NOISE, RANGE_KM, tracking.ELEMENT_SCALES, bias_std, curvature
    nn, ne, ee = planning._covariance_after(track, moves, left, *options)
    return torch.stack((nn, ne, ne, ee), -1).unflatten(-1, (2, 2))


def after(track: FieldTrack, move: Tensor) -> FieldTrack:
    moved = tracking.predict(track, move, (0.0, 0.0, 0.0))
    return tracking.update(moved, tracking.estimated_field(moved), NOISE)


@pytest.mark.parametrize("lasting", [{}, {"bias_std": f64(0.05, 0.01, 4.0), "curvature": f64(0.003, 0.004, 2.0)}])
def test_the_predicted_covariance_is_that_of_the_filter_after_the_move(lasting: dict) -> None:
    """Where the gradients are known, a move teaches nothing, and the formula is that of way_to with the relation."""
    moves, left = f64((20.0, 10.0), (-5.0, 0.0)), f64((150.0, -40.0), (-60.0, 90.0))
    found = predicted(SURE, moves, left, **lasting)
    for index in range(2):
        end = after(SURE, moves[index])
        target = (end.mean[..., 0] + end.mean[..., 1:] @ (left[index] / 100)) * f64(*tracking.ELEMENT_SCALES)
        shared = tracking.related(end, tracking.curl_relation)[1]
        expected = tracking.way_to(end, target, RANGE_KM, shared=shared, **lasting).covariance
        torch.testing.assert_close(found[index], expected, rtol=1e-3, atol=1e-9)


def test_a_crossing_move_is_worth_more_than_one_along_the_way() -> None:
    """After a straight leg, the gradients along it are known and those across it are not."""
    track = after(UNSURE, f64(30.0, 0.0))
    moves = f64((10.0, 0.0), (0.0, 10.0))
    along, across = predicted(track, moves, f64(200.0, 200.0) - moves).diagonal(dim1=-2, dim2=-1).sum(-1)
    assert across < 0.5 * along


def test_the_detour_by_hand() -> None:
    """400 km and 300 km across."""
    way, zero = f64(400.0, 0.0), f64(0.0)[0]
    torch.testing.assert_close(planning._detour(way, (zero, zero, zero + 300.0**2)), f64(100.0)[0])
    torch.testing.assert_close(planning._detour(0 * way, (zero, zero, zero + 300.0**2)), f64(300.0)[0])
    along = 40.0**2 * 2 + zero, zero, zero
    torch.testing.assert_close(planning._detour(way * 30 / 400, along), f64(20.0)[0])  # half of it: 50 - 30


def test_the_moves_that_are_compared_and_the_price_of_a_step() -> None:
    way = f64(0.0, 20.0)
    moves = planning._moves(way, tracking.LENGTHS, 50.0)
    assert moves.shape == ((len(tracking.LENGTHS) + 1) * len(planning.ANGLES_DEG), 2)
    assert (moves - way).norm(dim=-1).min() < 1e-9  # the way itself
    assert moves.norm(dim=-1).min() == pytest.approx(5.0)
    assert moves.norm(dim=-1).max() == pytest.approx(50.0)
    for far, shortest in ((20, 10.0), (500, 50.0)):  # 400 km, 10000 km
        assert planning._moves(far * way, tracking.LENGTHS, 50.0).norm(dim=-1).min() == pytest.approx(shortest)
    steps = torch.tensor([0, 10, 34, 49])
    price = tracking.step_price(0.5, 400.0, 25 * way, steps, (0.0, 0.0, 0.0), max_steps=50, max_move_km=50.0)  # 2 km
    assert price.tolist() == pytest.approx([2 * (50 / 35) ** 4, 2 * 2**4, 2 * 50**4, 2 * 50**4])  # 15 are for the way
    percent, steps = f64(0.25, 4.0, 4.0), torch.tensor([25, 20, 30])
    price = tracking.step_price(percent, 200.0, f64(0.0, 0.0), steps, (0.0, 0.0, 0.0), 50, 50.0)
    assert price.tolist() == pytest.approx([0.5 * 2**4, 8 * (5 / 3) ** 2, 2 * 2.5**4])
    std = f64((0.0, 0.0, 0.0), (1.0, 0.15, 20.0), (1.0, 1.0, 1000.0), (1e4, 1e4, 1e4))  # the last is missing
    price = tracking.step_price(0.5, 400.0, f64(0.0, 0.0), torch.tensor(21), std, 50, 50.0)
    assert price.tolist() == pytest.approx([2 * (50 / 29) ** 4, 2 * 2**4, 2 * (50 / 19) ** 4, 2 * (50 / 29) ** 4])


def test_a_sure_way_is_gone_and_a_batch_is_its_parts() -> None:
    ways, prices = f64((90.0, -120.0), (0.0, 30.0)), f64(1.0, 0.1)
    apart, weights = f64((0.0, 20.0), (0.0, -20.0), (20.0, 0.0), (-20.0, 0.0)), f64(0.4, 0.2, 0.2, 0.2)

    def plan(index: slice | int) -> Tensor:
        track = FieldTrack(*(torch.stack(parts)[index] for parts in zip(SURE, UNSURE, strict=True)))
        aim = ways[index]
        points = aim.unsqueeze(-2) + apart + 100.0  # of which only the shape counts
        posterior = WayPosterior(points, weights.expand(points.shape[:-1]))
        return tracking.planned_move(track, aim, posterior, NOISE, prices[index], 50.0, RANGE_KM)

    torch.testing.assert_close(plan(0), f64(30.0, -40.0))
    torch.testing.assert_close(plan(slice(None)), torch.stack((plan(0), plan(1))))
