"""Trips (start and destination): random ones from a counter-based generator, and frozen sets of them.

A random trip is a pure function of (seed, vehicle, episode). The trips of a vehicle therefore depend neither on the
batch size nor on when other vehicles are reset, they are the same on every device, and no generator state has to be
saved to repeat them.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import torch
from torch import Tensor

from magrl import paper
from magrl.checks import check_choice, check_number, check_numbers, check_tensor, check_type
from magrl.envs.regions import PAPER_REGION, Region, Regions
from magrl.field.bank import check_index
from magrl.geodesy import MEAN_RADIUS_KM, check_positions, geodesic, move, wrap_angle, wrap_longitude
from magrl.random_numbers import PAPER_SEED, TEST_SEED, counter_uniform

TRIES_PER_ROUND = 8
CHUNK = 16384
"""Trips drawn at a time, which keeps their tries in the cache."""
MAX_ROUNDS = 1000
"""Rounds of rejection sampling after which a region counts as too small for its distances."""
SHORTEST_KM = 0.001
"""Shortest distance from start to destination of a frozen trip [km]."""


class _Columns(NamedTuple):
    start: Tensor
    target: Tensor
    region: Tensor


class Trips(_Columns):
    """Start and destination of episodes, and the index of their region.

    Args:
        start: ``(..., 2)`` latitude, longitude [deg], float64.
        target: ``(..., 2)`` latitude, longitude [deg], float64.
        region: ``(...)`` int64; 0 by default.

    Raises:
        TypeError: for positions that are not tensors.
        ValueError: for positions of another shape.

    Example:
        >>> Trips(torch.tensor([[-2.0, 162.0]]), torch.tensor([[-8.0, 164.0]])).region
        tensor([0])
    """

    __slots__ = ()

    def __new__(cls, start: Tensor, target: Tensor, region: Tensor | None = None) -> Self:
        """Return trips, by default in region 0."""
        check_tensor(2, **{"trips.start": start, "trips.target": target})
        if region is None:
            region = torch.zeros(start.shape[:-1], dtype=torch.int64, device=start.device)
        return super().__new__(cls, start, target, region)


DISTANCE_LAWS = ("area", "log")
"""How random trips draw their distance: ends uniform over the ring about the start, or log-uniform distances."""
# Counters that separate these draws from the attempts at placing a trip, which are counted from 0.
_HEADING_STREAM, _REGION_STREAM, _DISTANCE_STREAM = -1, -2, -3


def check_distance_range(regions: Regions, distance_range_km: tuple[float, float], distance_law: str = "area") -> None:
    """Raise unless distances are a range that each region can hold.

    With the law ``"area"``, distances that do not fit into a region are not drawn there. With ``"log"`` the law of the
    distances is the same in every region, so each must hold the longest.

    Raises:
        ValueError: naming the values, and the smallest region.

    Example:
        >>> check_distance_range(Regions.of(PAPER_REGION), (500, 300))
        Traceback (most recent call last):
            ...
        ValueError: distance_range_km (500, 300) must be two rising numbers from 0 on
    """
    check_numbers(2, distance_range_km=distance_range_km)
    check_choice(DISTANCE_LAWS, distance_law=distance_law)
    shortest, longest = distance_range_km
    if not 0 <= shortest < longest or (distance_law == "log" and shortest == 0):
        start = "above 0 with distance_law 'log'" if distance_law == "log" else "from 0 on"
        raise ValueError(f"distance_range_km {distance_range_km} must be two rising numbers {start}")
    limit_km, smallest = regions.longest_km.min(0)
    if (shortest if distance_law == "area" else longest) >= limit_km:
        raise ValueError(
            f"distance_range_km {distance_range_km}: no two points of {regions[int(smallest)]} are more than "
            f"{limit_km:.0f} km apart"
        )


def sample_trips(
    regions: Regions,
    distance_range_km: tuple[float, float],
    seed: int,
    vehicle: Tensor,
    episode: Tensor,
    distance_law: str = "area",
) -> Trips:
    """Return random trips: start and end uniform over a region, given that their distance is in the range.

    Args:
        regions: boxes, of which each trip draws the one that holds both of its ends.
        distance_range_km: shortest and longest geodesic distance [km].
        seed: seed of the whole family of trips.
        vehicle: ``(P,)`` int64, number of the vehicle.
        episode: ``(P,)`` int64, number of its episode.
        distance_law: ``"log"`` draws the distance first, log-uniform in the range, and then both ends, uniform given
            their distance, which is met to within 30 m up to 2000 km.

    Returns:
        ``P`` trips, each a function of (seed, vehicle, episode) alone.

    Raises:
        ValueError: for an invalid range, one that a region cannot hold, or a seed that is not a whole number.
        RuntimeError: if no trip is found because a region can hardly hold the distances.

    Example:
        >>> number = torch.arange(4)
        >>> trips = sample_trips(Regions.of(PAPER_REGION), (300, 500), 0, number, torch.zeros_like(number))
        >>> d = geodesic(*trips.start.unbind(-1), *trips.target.unbind(-1))[0]
        >>> bool(((d >= 300) & (d <= 500)).all())
        True
    """
    check_distance_range(regions, distance_range_km, distance_law)
    if len(vehicle) > CHUNK:
        rows = zip(vehicle.split(CHUNK), episode.split(CHUNK), strict=True)
        parts = [sample_trips(regions, distance_range_km, seed, *some, distance_law) for some in rows]
        return Trips(*map(torch.cat, zip(*parts, strict=True)))
    counters = torch.stack((vehicle, episode), -1)
    region = (_draw(seed, counters, _REGION_STREAM) * len(regions)).long().squeeze(-1)
    radii_km = torch.tensor(distance_range_km, dtype=torch.float64, device=region.device).expand(len(region), 2)
    if distance_law == "log":
        shortest, longest = distance_range_km
        radii_km = (shortest * (longest / shortest) ** _draw(seed, counters, _DISTANCE_STREAM)).expand_as(radii_km)
    start, target = torch.empty_like(radii_km), torch.empty_like(radii_km)
    waiting = torch.arange(len(region), device=region.device)
    for attempt in range(MAX_ROUNDS):
        uniform = _attempts(seed, counters[waiting], attempt)
        starts, ends = _candidates(regions, region[waiting], radii_km[waiting], uniform)
        fits = regions.contains(ends, region[waiting, None]).squeeze(-1)
        if distance_law == "area":
            distance_km, _ = geodesic(*starts.unbind(-1), *ends.unbind(-1))
            fits = (distance_km >= distance_range_km[0]) & (distance_km <= distance_range_km[1]) & fits
        placed, number = fits.max(-1)
        chosen = (placed.nonzero().squeeze(-1), number[placed])
        start[waiting[placed]], target[waiting[placed]] = starts[chosen], ends[chosen]
        waiting = waiting[~placed]
        if not len(waiting):
            return Trips(start, target, region)
    raise RuntimeError(
        f"no trip was found in {MAX_ROUNDS * TRIES_PER_ROUND} tries: {regions[int(region[waiting[0]])]} can hardly "
        f"hold distances of {distance_range_km} km"
    )


def _draw(seed: int, counters: Tensor, stream: int) -> Tensor:
    """Return one uniform number for each vehicle and episode, ``(P, 1)``."""
    return counter_uniform(seed, torch.nn.functional.pad(counters, (0, 1), value=stream), 1)


def _attempts(seed: int, counters: Tensor, attempt: int) -> Tensor:
    """Return the uniform numbers of the tries ``R`` of a round, ``(P, R, 4)``, for vehicles and episodes ``(P, 2)``."""
    tries = torch.arange(TRIES_PER_ROUND, device=counters.device) + attempt * TRIES_PER_ROUND
    rows = torch.broadcast_tensors(*counters.unsqueeze(1).unbind(-1), tries)
    return counter_uniform(seed, torch.stack(rows, -1), 4)


def _candidates(regions: Regions, region: Tensor, radii_km: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
    """Return starts uniform over boxes, and ends uniform over rings about them, both ``(P, R, 2)`` [deg].

    Args:
        regions: boxes.
        region: ``(P,)`` box of each trip.
        radii_km: ``(P, 2)`` inner and outer radius of the ring.
        uniform: ``(P, R, 4)`` in [0, 1).
    """
    south, north = torch.sin(torch.deg2rad(regions.latitude[region])).unsqueeze(1).unbind(-1)
    west, east = regions.longitude[region].unsqueeze(1).unbind(-1)
    limit_km = 1.01 * regions.longest_km[region]  # beyond, no point of the ring lies in the box
    near, far = torch.cos(radii_km.minimum(limit_km.unsqueeze(-1)) / MEAN_RADIUS_KM).unsqueeze(1).unbind(-1)
    latitude = torch.rad2deg(torch.asin(south + (north - south) * uniform[..., 0]))
    longitude = wrap_longitude(west + (east - west) * uniform[..., 1])
    distance = MEAN_RADIUS_KM * torch.acos(near + (far - near) * uniform[..., 2])
    end = move(latitude, longitude, 2 * math.pi * uniform[..., 3], distance)
    return torch.stack((latitude, longitude), -1), torch.stack(end, -1)


def random_headings(seed: int, vehicle: Tensor, episode: Tensor) -> Tensor:
    """Return uniform start headings, a pure function of (seed, vehicle, episode): ``(P, 1)`` [rad, (-pi, pi]].

    Example:
        >>> random_headings(0, torch.arange(2), torch.zeros(2, dtype=torch.int64)).shape
        torch.Size([2, 1])
    """
    return wrap_angle(2 * math.pi * _draw(seed, torch.stack((vehicle, episode), -1), _HEADING_STREAM))


def trip_set(
    num_trips: int,
    seed: int,
    region: Region | Regions = PAPER_REGION,
    distance_range_km: tuple[float, float] = paper.DISTANCE_KM,
    distance_law: str = "area",
) -> Trips:
    """Return a frozen set of trips: the first episode of each of ``num_trips`` vehicles; see :func:`sample_trips`.

    Raises:
        ValueError: for fewer than one trip, or a range that the region cannot hold.

    Example:
        >>> trip_set(100, seed=1).start.shape
        torch.Size([100, 2])
    """
    check_number(1, whole=True, num_trips=num_trips)
    check_type((Region, Regions), region=region)
    vehicle = torch.arange(num_trips)
    return sample_trips(Regions.of(region), distance_range_km, seed, vehicle, torch.zeros_like(vehicle), distance_law)


def check_trips(trips: Trips, within: Regions) -> Trips:
    """Return a copy of trips in float64 with wrapped longitudes; raise unless all are valid.

    Args:
        trips: ``M`` trips.
        within: boxes; the box of a trip must hold its start and target.

    Raises:
        TypeError: for a region index that is not int64.
        ValueError: for other shapes, an empty set, positions that are not on Earth or outside ``within``, an index
            without a region, or a trip that starts at its destination.

    Example:
        >>> trips = Trips(torch.tensor([[-2.0, 522.0]]), torch.tensor([[-8.0, 164.0]]))
        >>> check_trips(trips, within=Regions.of(PAPER_REGION)).start
        tensor([[ -2., 162.]], dtype=torch.float64)
    """
    start, target, region = trips.start.double(), trips.target.double(), trips.region
    if start.shape != target.shape or start.ndim != 2 or not len(start):
        raise ValueError(
            f"trips must be two (M, 2) tensors with M >= 1, got {tuple(start.shape)} and {tuple(target.shape)}"
        )
    check_index(region, len(within), "trips.region")
    if region.shape != start.shape[:1]:
        raise ValueError(f"trips.region must hold {len(start)} indices, one a trip, got {tuple(region.shape)}")
    for name, position in (("start", start), ("target", target)):
        check_positions(*position.unbind(-1))
        inside = within.contains(position, region).squeeze(-1)
        if not inside.all():
            number = int((~inside).nonzero()[0])
            raise ValueError(
                f"the {name} of trip {number} (the first is trip 0), {position[number].tolist()}, lies outside "
                f"{within[int(region[number])]}"
            )
    distance_km, _ = geodesic(*start.unbind(-1), *target.unbind(-1))
    if (wrong := ~(distance_km >= SHORTEST_KM)).any():  # NaN at the antipode
        number = int(wrong.nonzero()[0])
        raise ValueError(
            f"trip {number} (the first is trip 0) starts at its destination or nearly its antipode, "
            f"{start[number].tolist()}: move one of them, or remove the trip"
        )
    start, target = (torch.stack((x[:, 0], wrap_longitude(x[:, 1])), -1) for x in (start, target))
    return Trips(start, target, region)


TRIP_SETS = ("test-1000", "paper-100", "paper-example")
"""Frozen trip sets: 1000 unseen trips, the paper's 100, and its one trip of Fig. 5."""

RANDOM_SETS = {"test-1000": (1000, TEST_SEED), "paper-100": (100, PAPER_SEED)}
"""Number of trips and seed of each random set."""


def named_trips(name: str) -> Trips:
    """Return a frozen trip set in the paper's region.

    Args:
        name: one of :data:`TRIP_SETS`.

    Raises:
        ValueError: for another name.

    Example:
        >>> named_trips("paper-example").start
        tensor([[ -2., 162.]], dtype=torch.float64)
    """
    check_choice(TRIP_SETS, trips=name)
    if name in RANDOM_SETS:
        return trip_set(*RANDOM_SETS[name])
    return Trips(*(torch.tensor([end], dtype=torch.float64) for end in (paper.EXAMPLE_START, paper.EXAMPLE_TARGET)))
