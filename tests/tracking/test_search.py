"""The search for a destination where the vehicle has not been."""

from __future__ import annotations

import pytest
import torch

from magrl.tracking import VISITED, Way, arrival_ellipse, unvisited, unvisited_yet, visit

LONG = torch.tensor([[36.0, 200.0], [200.0, 2500.0]])  # [km^2]: 6 km northward, 50 km eastward, correlated
ELLIPSE = torch.diag(torch.tensor([1 / 20.0**2, 1 / 12.0**2]))


def searched(destinations: torch.Tensor, moves: int) -> torch.Tensor:
    """Which of some destinations are found, by vehicles that start at the mean of what is known and go where told."""
    count = len(destinations)
    here, visited = torch.zeros(count, 2), visit(unvisited_yet(torch.zeros(count, 3)), torch.zeros(count, 2))
    found = torch.zeros(count, dtype=torch.bool)
    for _ in range(moves):
        left = destinations - here
        found |= (left.unsqueeze(-2) @ ELLIPSE @ left.unsqueeze(-1)).flatten() <= 1
        step = unvisited(Way(-here, LONG.expand(count, 2, 2)), visited, ELLIPSE.expand(count, 2, 2))
        here, visited = here + step, visit(visited, step)
    return found


def test_a_search_finds_nearly_all_that_the_estimate_allows() -> None:
    normal = torch.randn(2000, 2, generator=torch.Generator().manual_seed(0))
    destinations = normal @ torch.linalg.cholesky(LONG).mT
    found = searched(destinations, 1).float().mean(), searched(destinations, 16).float().mean()
    assert found[0] < 0.3
    assert found[1] > 0.9  # the samples reach to two standard deviations


def test_the_mean_is_the_way_until_the_vehicle_has_been_there() -> None:
    mean = torch.tensor([100.0, -80.0])
    for nearest, expected in ((19.9, False), (20.1, True)):
        visited = unvisited_yet(torch.zeros(3))
        visited[5] = mean + torch.tensor([nearest, 0.0])
        assert torch.equal(unvisited(Way(mean, LONG), visited, ELLIPSE), mean) == expected


@pytest.mark.parametrize("north", [1000.0, -1000.0])
def test_of_places_as_probable_the_nearer_is_searched(north: float) -> None:
    """The mean has been visited, and the estimate is wide along the way to it."""
    mean, visited = torch.tensor([north, 0.0]), unvisited_yet(torch.zeros(3))
    visited[0] = mean
    found = unvisited(Way(mean, torch.diag(torch.tensor([400.0**2, 1.0]))), visited, ELLIPSE)
    assert found.norm() < 1000 - 20


def test_short_moves_do_not_fill_the_memory() -> None:
    visited = visit(unvisited_yet(torch.zeros(3)), torch.tensor([30.0, 0.0]))
    for _ in range(2 * VISITED):
        visited = visit(visited, torch.tensor([0.0, 0.5]))
    assert (visited.norm(dim=-1) < 1e3).sum() == 1
    visited = visit(visited, torch.tensor([0.0, 40.0]))
    assert visited[:2].tolist() == [[0.0, 0.0], [0.0, -40.0]]


def test_the_ellipse_shrinks_with_the_uncertainty_of_the_gradient() -> None:
    """The expected square of g·d is that of the mean plus the variance: here 1 + 3 along the first axis."""
    gradient, covariance = torch.tensor([[1.0, 2.0]]), torch.diag(torch.tensor([3.0, 5.0])).expand(4, 1, 2, 2)
    found = arrival_ellipse(gradient, covariance, torch.tensor([0.5]))
    torch.testing.assert_close(found, 0.5 * torch.tensor([[4.0, 2.0], [2.0, 9.0]]).expand(4, 2, 2))
    circle = arrival_ellipse(gradient, covariance, torch.tensor([0.5]), 25.0)
    torch.testing.assert_close(circle, torch.eye(2).expand(4, 2, 2) / 625)
