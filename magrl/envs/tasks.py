"""Tasks (start and destination): random ones from a counter-based generator, and frozen sets of them.

A random task is a pure function of (seed, vehicle, episode). The tasks of a vehicle therefore depend neither on the
batch size nor on when other vehicles are reset, they are the same on every device, and no generator state has to be
saved to repeat them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import BeforeValidator
from torch import Tensor
from typing_extensions import Self

from magrl import paper
from magrl.checks import CheckedModel, check_number, check_numbers, check_tensor, check_type, short
from magrl.envs.region import MEAN_RADIUS_KM, PAPER_REGION, Region
from magrl.geodesy import check_positions, geodesic, move, wrap_longitude
from magrl.transforms.counters import counter_uniform

TRIES_PER_ROUND = 8
MAX_ROUNDS = 1000
"""Rounds of rejection sampling after which a region counts as too small for its distances."""
SHORTEST_KM = 0.001
"""Distance from start to destination below which a frozen task counts as without a way to go [km]."""


class Tasks(NamedTuple):
    """Start and destination of episodes, each ``(..., 2)`` latitude, longitude [deg], float64.

    Example:
        >>> ends = torch.tensor([[-2.0, 162.0]]), torch.tensor([[-8.0, 164.0]])
        >>> Tasks(*ends).target
        tensor([[ -8., 164.]])
    """

    start: Tensor
    target: Tensor


def check_distance_range(region: Region, distance_range_km: tuple[float, float]) -> None:
    """Raise unless distances are a range that the region can hold.

    Raises:
        ValueError: naming the values.

    Example:
        >>> check_distance_range(PAPER_REGION, (500, 300))
        Traceback (most recent call last):
            ...
        ValueError: distance_range_km (500, 300) must be two rising numbers from 0 on
    """
    check_type(Region, region=region)
    check_numbers(2, distance_range_km=distance_range_km)
    shortest, longest = distance_range_km
    if not 0 <= shortest < longest:
        raise ValueError(f"distance_range_km {distance_range_km} must be two rising numbers from 0 on")
    held = region.longest_km()
    if shortest >= held:
        raise ValueError(
            f"distance_range_km {distance_range_km}: no two points of {region} are more than {held:.0f} km apart"
        )


def sample_tasks(
    region: Region, distance_range_km: tuple[float, float], seed: int, vehicle: Tensor, episode: Tensor
) -> Tasks:
    """Return random tasks: start and end uniform over the region, given that their distance is in the range.

    Args:
        region: the box that holds both ends.
        distance_range_km: shortest and longest geodesic distance [km].
        seed: seed of the whole family of tasks.
        vehicle: ``(P,)`` int64, number of the vehicle.
        episode: ``(P,)`` int64, number of its episode.

    Returns:
        ``P`` tasks, each a function of (seed, vehicle, episode) alone.

    Raises:
        ValueError: for an invalid range, one that the region cannot hold, a seed that is not a whole number, or
            vehicles and episodes of different shapes.
        RuntimeError: if no task is found because the region can hardly hold the distances.

    Example:
        >>> tasks = sample_tasks(PAPER_REGION, (300, 500), 0, torch.arange(4), torch.zeros(4, dtype=torch.int64))
        >>> d = geodesic(*tasks.start.unbind(-1), *tasks.target.unbind(-1))[0]
        >>> bool(((d >= 300) & (d <= 500)).all())
        True
    """
    check_distance_range(region, distance_range_km)
    check_tensor(vehicle=vehicle, episode=episode)
    if vehicle.ndim != 1 or vehicle.shape != episode.shape or {vehicle.dtype, episode.dtype} != {torch.int64}:
        raise ValueError(f"vehicle and episode must be int64 of one shape (P,), got {vehicle!r} and {episode!r}")
    start = torch.empty(len(vehicle), 2, dtype=torch.float64, device=vehicle.device)
    target = torch.empty_like(start)
    waiting = torch.arange(len(vehicle), device=vehicle.device)
    for attempt in range(MAX_ROUNDS):
        tries = torch.arange(TRIES_PER_ROUND, device=vehicle.device) + attempt * TRIES_PER_ROUND
        rows = torch.broadcast_tensors(vehicle[waiting].unsqueeze(-1), episode[waiting].unsqueeze(-1), tries)
        candidate = _candidates(region, distance_range_km, counter_uniform(seed, torch.stack(rows, -1), 4))
        distance, _ = geodesic(*candidate.start.unbind(-1), *candidate.target.unbind(-1))
        in_range = (distance >= distance_range_km[0]) & (distance <= distance_range_km[1])
        fits = in_range & region.contains(candidate.target).squeeze(-1)
        placed, first = fits.max(-1)
        chosen = (placed.nonzero().squeeze(-1), first[placed])
        start[waiting[placed]], target[waiting[placed]] = candidate.start[chosen], candidate.target[chosen]
        waiting = waiting[~placed]
        if not len(waiting):
            return Tasks(start, target)
    raise RuntimeError(
        f"no task was found in {MAX_ROUNDS * TRIES_PER_ROUND} tries: {region} can hardly hold distances of "
        f"{distance_range_km} km"
    )


def _candidates(region: Region, distance_range_km: tuple[float, float], uniform: Tensor) -> Tasks:
    """Return starts uniform over the box and ends uniform over the ring about them; ``uniform`` is ``(..., 4)``."""
    south, north = (math.sin(math.radians(x)) for x in region.latitude)
    held = 1.01 * region.longest_km()  # beyond this, no point of the ring lies in the box
    near, far = (math.cos(min(x, held) / MEAN_RADIUS_KM) for x in distance_range_km)
    west, east = region.longitude
    latitude = torch.rad2deg(torch.asin(south + (north - south) * uniform[..., 0]))
    longitude = wrap_longitude(west + (east - west) * uniform[..., 1])
    distance = MEAN_RADIUS_KM * torch.acos(near + (far - near) * uniform[..., 2])
    end = move(latitude, longitude, 2 * math.pi * uniform[..., 3], distance)
    return Tasks(torch.stack((latitude, longitude), -1), torch.stack(end, -1))


def task_set(
    num_tasks: int,
    seed: int,
    region: Region = PAPER_REGION,
    distance_range_km: tuple[float, float] = paper.DISTANCE_KM,
) -> Tasks:
    """Return a frozen set of tasks: the first episode of each of ``num_tasks`` vehicles.

    Raises:
        ValueError: for fewer than one task, or a range that the region cannot hold.

    Example:
        >>> task_set(100, seed=1).start.shape
        torch.Size([100, 2])
    """
    check_number(1, whole=True, num_tasks=num_tasks)
    vehicle = torch.arange(num_tasks)
    return sample_tasks(region, distance_range_km, seed, vehicle, torch.zeros_like(vehicle))


TASK_SETS = ("test-1000", "paper-100", "figure-4-1")
"""Frozen task sets: 1000 unseen tasks, the paper's 100, and its one task of Fig. 4-1."""

RANDOM_SETS = {"test-1000": (1000, paper.TEST_SEED), "paper-100": (100, paper.PAPER_SEED)}
"""Number of tasks and seed of each random set."""


def named_tasks(name: str) -> Tasks:
    """Return a frozen task set in the paper's region.

    Args:
        name: one of :data:`TASK_SETS`.

    Raises:
        ValueError: for another name.

    Example:
        >>> named_tasks("figure-4-1").start
        tensor([[ -2., 162.]], dtype=torch.float64)
    """
    if name in RANDOM_SETS:
        return task_set(*RANDOM_SETS[name])
    if name == "figure-4-1":
        return Tasks(*(torch.tensor([end], dtype=torch.float64) for end in (paper.EXAMPLE_START, paper.EXAMPLE_TARGET)))
    raise ValueError(f"unknown task set {name!r}: choose from {', '.join(TASK_SETS)}")


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


def check_tasks(tasks: Tasks, within: Region) -> Tasks:
    """Return a copy of tasks in float64 with wrapped longitudes; raise unless all are valid.

    Args:
        tasks: start and target, each ``(M, 2)`` latitude, longitude [deg].
        within: box in which every start and target must lie.

    Raises:
        ValueError: for other shapes, an empty set, positions that are not on Earth or outside ``within``, or a task
            that starts at its destination.

    Example:
        >>> tasks = Tasks(torch.tensor([[-2.0, 522.0]]), torch.tensor([[-8.0, 164.0]]))
        >>> check_tasks(tasks, within=PAPER_REGION).start
        tensor([[ -2., 162.]], dtype=torch.float64)
    """
    check_type(Region, within=within)
    if not isinstance(tasks, (tuple, list)) or len(tasks) != 2:
        raise ValueError(f"tasks must be two (M, 2) tensors, got {tasks!r}")
    start, target = (torch.as_tensor(x, dtype=torch.float64) for x in tasks)
    if start.shape != target.shape or start.ndim != 2 or start.shape[-1] != 2 or not len(start):
        raise ValueError(
            f"tasks must be two (M, 2) tensors with M >= 1, got {tuple(start.shape)} and {tuple(target.shape)}"
        )
    for name, position in (("start", start), ("target", target)):
        check_positions(*position.unbind(-1))
        outside = ~within.contains(position).squeeze(-1)
        if outside.any():
            index = int(outside.nonzero()[0])
            raise ValueError(
                f"the {name} of task {index} (the first is task 0), {position[index].tolist()}, lies outside {within}"
            )
    if (nowhere := without_way(start, target)).any():
        index = int(nowhere.nonzero()[0])
        raise ValueError(
            f"task {index} (the first is task 0) starts at its destination, {start[index].tolist()}: move one of them, "
            "or remove the task"
        )
    return Tasks(*(torch.stack((x[:, 0], wrap_longitude(x[:, 1])), -1) for x in (start, target)))


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


_DEGREES = "latitude and longitude in degrees"


def _name(value: object) -> object:
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= 200:
        raise ValueError(f"name must be a text of 1 to 200 printable characters, got {short(value)}")
    return value


class TaskEntry(CheckedModel):
    """A task in a file."""

    start: Annotated[
        tuple[float, float], BeforeValidator(numbers_validator("start", 2, "latitude and longitude in degrees"))
    ]
    target: Annotated[
        tuple[float, float], BeforeValidator(numbers_validator("target", 2, "latitude and longitude in degrees"))
    ]
    name: Annotated[str, BeforeValidator(_name)]

    @classmethod
    def read(cls, number: int, entry: Any) -> Self:
        """Return an entry of a file, counted from 1."""
        if not isinstance(entry, dict):
            raise ValueError(f"tasks, entry {number}, must be a table with start and target, got {short(entry)}")
        values: dict[str, Any] = {"name": f"task {number}"} | entry
        try:
            return cls(**values)
        except ValueError as error:
            raise ValueError(f"tasks, entry {number}: {error}") from error
