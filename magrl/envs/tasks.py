"""Tasks (start and destination): random ones from a counter-based generator, and frozen sets of them.

A random task is a pure function of (seed, vehicle, episode). The tasks of a vehicle therefore depend neither on the
batch size nor on when other vehicles are reset, they are the same on every device, and no generator state has to be
saved to repeat them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, overload

import torch
from torch import Tensor

from magrl import paper
from magrl.checks import check_number, check_numbers, check_tensor, check_type
from magrl.counters import counter_uniform
from magrl.envs.region import PAPER_REGION, Region
from magrl.envs.regions import Regions
from magrl.geodesy import MEAN_RADIUS_KM, geodesic, move, wrap_angle, wrap_longitude

TRIES_PER_ROUND = 8
MAX_ROUNDS = 1000
"""Rounds of rejection sampling after which a region counts as too small for its distances."""


class Tasks(NamedTuple):
    """Start and destination of episodes, each ``(..., 2)`` latitude, longitude [deg], float64.

    Example:
        >>> ends = torch.tensor([[-2.0, 162.0]]), torch.tensor([[-8.0, 164.0]])
        >>> Tasks(*ends).target
        tensor([[ -8., 164.]])
    """

    start: Tensor
    target: Tensor


class RegionTasks(NamedTuple):
    """Tasks over many regions: start and destination as in :class:`Tasks`, and the index of their region.

    Example:
        >>> ends = torch.tensor([[-2.0, 162.0]]), torch.tensor([[-8.0, 164.0]])
        >>> RegionTasks(*ends, region=torch.tensor([3])).region
        tensor([3])
    """

    start: Tensor
    target: Tensor
    region: Tensor
    """``(...)`` int64."""


DISTANCE_LAWS = ("area", "log")
"""How random tasks draw their distance: ends uniform over the ring about the start, or log-uniform distances."""
# Counters that separate these draws from the attempts at placing a task, which are counted from 0.
_HEADING_STREAM, _REGION_STREAM, _DISTANCE_STREAM = -1, -2, -3


def check_distance_range(
    region: Region | Regions, distance_range_km: tuple[float, float], distance_law: str = "area"
) -> None:
    """Raise unless distances are a range that the region, or each of many, can hold.

    With the law ``"area"``, distances that do not fit into a region are not drawn there. With ``"log"`` the law of the
    distances is the same in every region, so each must hold the longest.

    Raises:
        ValueError: naming the values, and of many regions the smallest.

    Example:
        >>> check_distance_range(PAPER_REGION, (500, 300))
        Traceback (most recent call last):
            ...
        ValueError: distance_range_km (500, 300) must be two rising numbers from 0 on
    """
    check_type((Region, Regions), region=region)
    check_numbers(2, distance_range_km=distance_range_km)
    if distance_law not in DISTANCE_LAWS:
        raise ValueError(f"distance_law must be one of {', '.join(map(repr, DISTANCE_LAWS))}, got {distance_law!r}")
    shortest, longest = distance_range_km
    if not 0 <= shortest < longest:
        raise ValueError(f"distance_range_km {distance_range_km} must be two rising numbers from 0 on")
    if distance_law == "log" and shortest == 0:
        raise ValueError(f"distance_range_km {distance_range_km} must start above 0 with distance_law 'log'")
    held = float(region.longest_km.min()) if isinstance(region, Regions) else region.longest_km()
    if (shortest if distance_law == "area" else longest) >= held:
        where = region[int(region.longest_km.argmin())] if isinstance(region, Regions) else region
        raise ValueError(
            f"distance_range_km {distance_range_km}: no two points of {where} are more than {held:.0f} km apart"
        )


def sample_tasks(
    region: Region | Regions,
    distance_range_km: tuple[float, float],
    seed: int,
    vehicle: Tensor,
    episode: Tensor,
    distance_law: str = "area",
) -> Tasks | RegionTasks:
    """Return random tasks: start and end uniform over the region, given that their distance is in the range.

    Args:
        region: the box that holds both ends, or many, of which each task draws one.
        distance_range_km: shortest and longest geodesic distance [km].
        seed: seed of the whole family of tasks.
        vehicle: ``(P,)`` int64, number of the vehicle.
        episode: ``(P,)`` int64, number of its episode.
        distance_law: ``"log"`` draws the distance first, log-uniform in the range, and then both ends, uniform given
            their distance, which is met to within 30 m up to 2000 km.

    Returns:
        ``P`` tasks, each a function of (seed, vehicle, episode) alone; with their region where there are many.

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
    check_distance_range(region, distance_range_km, distance_law)
    check_tensor(vehicle=vehicle, episode=episode)
    if vehicle.ndim != 1 or vehicle.shape != episode.shape or {vehicle.dtype, episode.dtype} != {torch.int64}:
        raise ValueError(f"vehicle and episode must be int64 of one shape (P,), got {vehicle!r} and {episode!r}")
    one_each = torch.stack((vehicle, episode), -1)
    index, ring = None, None
    if isinstance(region, Regions):
        index = (_draw(seed, one_each, _REGION_STREAM) * len(region)).long().squeeze(-1)
    if distance_law == "log":
        shortest, longest = distance_range_km
        ring = shortest * (longest / shortest) ** _draw(seed, one_each, _DISTANCE_STREAM)
    start = torch.empty(len(vehicle), 2, dtype=torch.float64, device=vehicle.device)
    target = torch.empty_like(start)
    waiting = torch.arange(len(vehicle), device=vehicle.device)
    for attempt in range(MAX_ROUNDS):
        tries = torch.arange(TRIES_PER_ROUND, device=vehicle.device) + attempt * TRIES_PER_ROUND
        rows = torch.broadcast_tensors(vehicle[waiting].unsqueeze(-1), episode[waiting].unsqueeze(-1), tries)
        uniform = counter_uniform(seed, torch.stack(rows, -1), 4)
        place = () if index is None else (index[waiting].unsqueeze(-1),)
        distances = distance_range_km if ring is None else (ring[waiting], ring[waiting])
        candidate = _candidates(_limits(region, distances, *place), uniform)
        fits = region.contains(candidate.target, *place).squeeze(-1)
        if ring is None:
            distance, _ = geodesic(*candidate.start.unbind(-1), *candidate.target.unbind(-1))
            fits = (distance >= distance_range_km[0]) & (distance <= distance_range_km[1]) & fits
        placed, first = fits.max(-1)
        chosen = (placed.nonzero().squeeze(-1), first[placed])
        start[waiting[placed]], target[waiting[placed]] = candidate.start[chosen], candidate.target[chosen]
        waiting = waiting[~placed]
        if not len(waiting):
            return Tasks(start, target) if index is None else RegionTasks(start, target, index)
    where = region[int(index[waiting[0]])] if isinstance(region, Regions) and index is not None else region
    raise RuntimeError(
        f"no task was found in {MAX_ROUNDS * TRIES_PER_ROUND} tries: {where} can hardly hold distances of "
        f"{distance_range_km} km"
    )


def random_headings(seed: int, vehicle: Tensor, episode: Tensor) -> Tensor:
    """Return uniform start headings, a pure function of (seed, vehicle, episode): ``(P, 1)`` [rad, (-pi, pi]].

    Example:
        >>> random_headings(0, torch.arange(2), torch.zeros(2, dtype=torch.int64)).shape
        torch.Size([2, 1])
    """
    return wrap_angle(2 * math.pi * _draw(seed, torch.stack((vehicle, episode), -1), _HEADING_STREAM))


def _draw(seed: int, counters: Tensor, stream: int) -> Tensor:
    """Return one uniform number for each vehicle and episode, ``(P, 1)``."""
    return counter_uniform(seed, torch.nn.functional.pad(counters, (0, 1), value=stream), 1)


def _limits(region: Region | Regions, distances: Sequence[Any], index: Tensor | None = None) -> tuple[Any, ...]:
    """Return where to draw tasks, as numbers, or as ``(P, 1)`` from the region of each.

    Sines of the southern and northern edge, western and eastern edge [deg], cosines of the shortest and longest
    distance. Beyond 1.01 times the longest distance in a region, no point of the ring lies in it.
    """
    if isinstance(region, Regions):
        sines = torch.sin(torch.deg2rad(region.latitude[index]))
        held = 1.01 * region.longest_km[index]
        cosines = (torch.cos(torch.as_tensor(x).to(held).minimum(held) / MEAN_RADIUS_KM) for x in distances)
        return *sines.unbind(-1), *region.longitude[index].unbind(-1), *cosines
    longest = 1.01 * region.longest_km()
    ring = (
        torch.cos(x / MEAN_RADIUS_KM) if isinstance(x, Tensor) else math.cos(min(x, longest) / MEAN_RADIUS_KM)
        for x in distances
    )
    return *(math.sin(math.radians(x)) for x in region.latitude), *region.longitude, *ring


def _candidates(limits: tuple[Any, ...], uniform: Tensor) -> Tasks:
    """Return starts uniform over the box and ends uniform over the ring about them; ``uniform`` is ``(..., 4)``."""
    south, north, west, east, near, far = limits
    latitude = torch.rad2deg(torch.asin(south + (north - south) * uniform[..., 0]))
    longitude = wrap_longitude(west + (east - west) * uniform[..., 1])
    distance = MEAN_RADIUS_KM * torch.acos(near + (far - near) * uniform[..., 2])
    end = move(latitude, longitude, 2 * math.pi * uniform[..., 3], distance)
    return Tasks(torch.stack((latitude, longitude), -1), torch.stack(end, -1))


@overload
def task_set(
    num_tasks: int,
    seed: int,
    region: Region = PAPER_REGION,
    distance_range_km: tuple[float, float] = paper.DISTANCE_KM,
    distance_law: str = "area",
) -> Tasks: ...


@overload
def task_set(
    num_tasks: int, seed: int, region: Regions, distance_range_km: tuple[float, float], distance_law: str = "area"
) -> RegionTasks: ...


def task_set(
    num_tasks: int,
    seed: int,
    region: Region | Regions = PAPER_REGION,
    distance_range_km: tuple[float, float] = paper.DISTANCE_KM,
    distance_law: str = "area",
) -> Tasks | RegionTasks:
    """Return a frozen set of tasks: the first episode of each of ``num_tasks`` vehicles; see :func:`sample_tasks`.

    Raises:
        ValueError: for fewer than one task, or a range that the region cannot hold.

    Example:
        >>> task_set(100, seed=1).start.shape
        torch.Size([100, 2])
    """
    check_number(1, whole=True, num_tasks=num_tasks)
    vehicle = torch.arange(num_tasks)
    return sample_tasks(region, distance_range_km, seed, vehicle, torch.zeros_like(vehicle), distance_law)


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
