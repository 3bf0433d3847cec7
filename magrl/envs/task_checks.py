"""Checks of frozen tasks, from Python or from a file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from magrl.checks import check_numbers, check_tensor, check_type, short
from magrl.envs.region import Region
from magrl.envs.regions import Regions
from magrl.envs.tasks import RegionTasks, Tasks
from magrl.field.bank import check_index
from magrl.geodesy import check_positions, geodesic, wrap_longitude

SHORTEST_KM = 0.001
"""Distance from start to destination below which a frozen task counts as without a way to go [km]."""


def without_way(start: Tensor, target: Tensor) -> Tensor:
    """Return which tasks start at their destination, to within 1 m.

    Args:
        start: ``(..., 2)`` latitude, longitude [deg].
        target: ``(..., 2)`` latitude, longitude [deg].

    Returns:
        ``(...)`` bool.

    Raises:
        ValueError: for a latitude beyond 90 degrees.

    Example:
        >>> start = torch.tensor([[-2.0, 162.0], [-3.0, 180.0]])
        >>> without_way(start, torch.tensor([[-8.0, 164.0], [-3.0, -180.0]]))
        tensor([False,  True])
    """
    check_tensor(2, start=start, target=target)
    return geodesic(*start.unbind(-1), *target.unbind(-1))[0] < SHORTEST_KM


def check_tasks(tasks: Tasks | RegionTasks, within: Region | Regions) -> Tasks | RegionTasks:
    """Return a copy of tasks in float64 with wrapped longitudes; raise unless all are valid.

    Args:
        tasks: start and target, each ``(M, 2)`` latitude, longitude [deg]; over many regions also ``(M,)`` indices.
        within: box in which every start and target must lie, or boxes, of which that of the task counts.

    Raises:
        TypeError: for a region index that is not int64.
        ValueError: for other shapes, an empty set, positions that are not on Earth or outside ``within``, an index
            without a region, or a task that starts at its destination.

    Example:
        >>> tasks = Tasks(torch.tensor([[-2.0, 522.0]]), torch.tensor([[-8.0, 164.0]]))
        >>> from magrl.envs.region import PAPER_REGION
        >>> check_tasks(tasks, within=PAPER_REGION).start
        tensor([[ -2., 162.]], dtype=torch.float64)
    """
    check_type((Region, Regions), within=within)
    index = _checked_index(tasks, within)
    if not isinstance(tasks, (tuple, list)) or len(tasks) != 2 + len(index):
        raise ValueError(f"tasks must be two (M, 2) tensors, got {tasks!r}")
    start, target = (torch.as_tensor(x, dtype=torch.float64) for x in tasks[:2])
    if start.shape != target.shape or start.ndim != 2 or start.shape[-1] != 2 or not len(start):
        raise ValueError(
            f"tasks must be two (M, 2) tensors with M >= 1, got {tuple(start.shape)} and {tuple(target.shape)}"
        )
    if index and index[0].shape != start.shape[:1]:
        raise ValueError(f"tasks.region must hold {len(start)} indices, one a task, got {tuple(index[0].shape)}")
    for name, position in (("start", start), ("target", target)):
        check_positions(*position.unbind(-1))
        outside = ~within.contains(position, *index).squeeze(-1)
        if outside.any():
            first = int(outside.nonzero()[0])
            box = within[int(index[0][first])] if isinstance(within, Regions) else within
            raise ValueError(
                f"the {name} of task {first} (the first is task 0), {position[first].tolist()}, lies outside {box}"
            )
    if (nowhere := without_way(start, target)).any():
        first = int(nowhere.nonzero()[0])
        raise ValueError(
            f"task {first} (the first is task 0) starts at its destination, {start[first].tolist()}: move one of them, "
            "or remove the task"
        )
    wrapped = (torch.stack((x[:, 0], wrap_longitude(x[:, 1])), -1) for x in (start, target))
    return RegionTasks(*wrapped, *index) if index else Tasks(*wrapped)


def _checked_index(tasks: object, within: Region | Regions) -> tuple[Tensor, ...]:
    """Return the region of each task, or nothing where there is only one."""
    if not isinstance(within, Regions):
        return ()
    if not isinstance(tasks, RegionTasks):
        raise ValueError(
            f"tasks over {len(within)} regions must be RegionTasks, which hold their region, got {tasks!r}"
        )
    check_index(tasks.region, len(within), "tasks.region")
    return (tasks.region,)


def numbers_validator(name: str, count: int, meaning: str) -> Callable[[Any], tuple[float, ...]]:
    """Return a pydantic validator that turns ``count`` finite numbers into a tuple of floats.

    Args:
        name: name of the value in messages.
        count: how many numbers.
        meaning: what they are, in messages.

    Example:
        >>> numbers_validator("start", 2, "latitude and longitude in degrees")([40, -30])
        (40.0, -30.0)
    """

    def check(value: Any) -> tuple[float, ...]:
        try:
            check_numbers(count, **{name: value})
        except (ValueError, OverflowError):
            raise ValueError(f"{name} must be {count} finite numbers, {meaning}, got {short(value)}") from None
        return tuple(float(number) for number in value)

    return check
