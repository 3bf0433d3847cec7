"""The filter from reading to reading: the one loop that transforms, navigators and vehicles share, as pure functions.

A track begins with :func:`~magrl.tracking.start`. :func:`read` takes it over a move to the next reading,
:func:`related` adds what is known of the gradients at a place, :func:`~magrl.tracking.way_to` gives the way to the
target, and :func:`aim` the way to where the vehicle has not been.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from magrl.checks import check_tensor
from magrl.tracking.filter import (
    CURVATURE,
    ELEMENT_PERIODS,
    ELEMENT_SCALES,
    FieldTrack,
    GradientRelation,
    PerElement,
    continued,
    estimated_field,
    predict,
    relate,
    update,
)
from magrl.tracking.search import arrival_ellipse, unvisited
from magrl.tracking.way import Way

SLOW_SHARE = 0.25
"""Share of the variance of slow errors that counts as new in each reading; chosen on random planets."""


def reading_std(sensor_std: Tensor, drift_std: Tensor) -> Tensor:
    """Return the standard deviation ``(..., E)`` of a reading in the filter.

    Slow errors vary along the way, which the filter would otherwise take for a gradient. They are correlated from
    reading to reading; :data:`SLOW_SHARE` of their variance as white noise stands for that.

    Args:
        sensor_std: ``(..., E)`` standard deviation of the errors that are new in each reading.
        drift_std: ``(..., E)`` that of slow errors.

    Example:
        >>> reading_std(torch.tensor([3.0]), torch.tensor([8.0]))
        tensor([5.])
    """
    check_tensor(sensor_std=sensor_std, drift_std=drift_std)
    return torch.hypot(sensor_std, SLOW_SHARE**0.5 * drift_std)


def displacement_of(move: Tensor, heading: Tensor) -> Tensor:
    """Return the displacement ``(..., 2)`` [km] of a move ``(..., K)``, distance [km] first, at a heading ``(..., 1)``.

    Example:
        >>> displacement_of(torch.tensor([30.0, 0.5]), torch.tensor([0.0]))
        tensor([30.,  0.])
    """
    check_tensor(1, heading=heading)
    return move[..., :1] * torch.cat((torch.cos(heading), torch.sin(heading)), -1)


def read(
    track: FieldTrack,
    displacement: Tensor,
    reading: Tensor,
    sensor_std: PerElement,
    curvature: PerElement = CURVATURE,
    scales: PerElement = ELEMENT_SCALES,
    periods: PerElement = ELEMENT_PERIODS,
) -> FieldTrack:
    """Return the state after a move and the reading at its end.

    Arguments are those of :func:`~magrl.tracking.predict` and :func:`~magrl.tracking.update`. Angles in the reading are
    taken within half a turn of the estimate, which is continued beyond 180 degrees.

    Example:
        >>> from magrl.tracking import dipole_prior, start
        >>> here = torch.tensor([8.0, -16.0, 35000.0])
        >>> track = start(here, dipole_prior(here), (0.05, 0.05, 5.0))
        >>> track = read(track, torch.tensor([50.0, 0.0]), here + torch.tensor([0.1, 0.5, 90.0]), (0.05, 0.05, 5.0))
        >>> (estimated_field(track) - here).round(decimals=1)
        tensor([ 0.1000,  0.5000, 89.9000])
    """
    moved = predict(track, displacement, curvature, scales)
    return update(moved, continued(reading, moved, scales, periods), sensor_std, scales)


def related(
    track: FieldTrack, relation: Callable[[Tensor], GradientRelation], scales: PerElement = ELEMENT_SCALES
) -> tuple[FieldTrack, Tensor]:
    """Return the state given a relation of its gradients at the estimated field, as :func:`relate` does.

    Args:
        track: state.
        relation: function from the estimated field ``(..., E)`` to a relation.
        scales: those of :func:`start`.

    Example:
        >>> from magrl.tracking import curl_relation
        >>> track = FieldTrack(torch.ones(3, 3), torch.eye(3).expand(3, 3, 3))
        >>> related(track, curl_relation)[1].shape
        torch.Size([3, 3])
    """
    return relate(track, relation(estimated_field(track, scales)), scales)


def aim(
    track: FieldTrack,
    way: Way,
    visited: Tensor,
    weights: Tensor,
    scales: PerElement = ELEMENT_SCALES,
    axes: Tensor | None = None,
) -> Tensor:
    """Return the displacement ``(..., 2)`` [km] to the most probable destination where the vehicle has not been.

    Args:
        track: state, whose gradients give the arrival ellipse.
        way: estimated way.
        visited: ``(..., K, 2)`` from :func:`visit`, northward and eastward [km].
        weights: ``(..., E)`` from :func:`arrival_weights`.
        scales: those of :func:`start`.
        axes: ``(..., 2, 2)`` directions, in rows, of the axes in which the way is given; None for north and east.

    Example:
        >>> from magrl.tracking import unvisited_yet
        >>> track, way = FieldTrack(torch.ones(3, 3), torch.eye(3).expand(3, 3, 3)), Way(torch.ones(2), torch.eye(2))
        >>> aim(track, way, unvisited_yet(torch.zeros(3)), torch.ones(3))
        tensor([1., 1.])
    """
    ellipse = arrival_ellipse(track, weights, scales)
    if axes is not None:
        ellipse, visited = axes @ ellipse @ axes.mT, visited @ axes.mT
    return unvisited(way, visited, ellipse)
