"""Scenarios over many random regions: of planets that do not exist, to train on, and of the Earth, to evaluate on."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from magrl.checks import check_number
from magrl.envs.regions import Regions
from magrl.envs.scenario import Scenario
from magrl.envs.specs import region_elements
from magrl.field import Date, FieldBank, igrf_coefficients, parse_date, random_planets, wmmhr_coefficients
from magrl.random_numbers import counter_uniform

REGIONS_PER_PLANET = 2
MAX_TRIES = 100
"""Places drawn for a region before its conditions count as impossible."""


def planet_scenario(count: int, seed: int, **options: Any) -> Scenario:
    """Return a scenario over random regions of random planets, two on each (:func:`magrl.field.random_planets`).

    Args:
        count: number of regions.
        seed: random seed; the result is a pure function of the arguments.
        **options: of :func:`region_scenario`.

    Raises:
        ValueError: for an unknown option, or as :func:`region_scenario`.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(planet_scenario(4, seed=0), num_envs=3, seed=0)
        >>> env.reset()["region"].shape
        torch.Size([3, 1])
    """
    check_number(1, whole=True, count=count)
    planets = random_planets(-(-count // REGIONS_PER_PLANET), seed)
    return region_scenario(planets, count, seed, **options)


def earth_scenario(
    count: int, seed: int, date: Date = "2025-01-01", generation: int = 14, *, crust: bool = False, **options: Any
) -> Scenario:
    """Return a scenario over random regions of the Earth.

    Args:
        count: number of regions.
        seed: random seed; the result is a pure function of the arguments.
        date: date of the field, as in :class:`Scenario`.
        generation: generation of IGRF, 13 or 14.
        crust: whether the field is :class:`~magrl.field.WMMHR` (degree 133, 2025 to 2030) instead of IGRF.
        **options: of :func:`region_scenario`.

    Raises:
        ValueError: for an unknown option, a date outside the field model, or as :func:`region_scenario`.

    Example:
        >>> scenario = earth_scenario(8, seed=0)
        >>> trips = scenario.random_trips(20, seed=1)
        >>> trips.start.shape, trips.region.shape
        (torch.Size([20, 2]), torch.Size([20]))
    """
    earth = wmmhr_coefficients(date) if crust else igrf_coefficients(date, generation)
    scenario = region_scenario(earth.unsqueeze(0), count, seed, **options)
    return scenario.replace(date=parse_date(date), generation=generation)


def region_scenario(
    gauss: Tensor,
    count: int,
    seed: int,
    *,
    half_size_deg: float = 10.0,
    max_latitude: float = 60.0,
    min_intensity_nt: float = 8000.0,
    margin_deg: float = 5.0,
    max_leg_km: float = 50.0,
    degree: int | None = None,
    tolerance_nt: float = 0.1,
    **options: Any,
) -> Scenario:
    """Return a scenario over random regions, each as wide as high at its middle.

    The place of a region is uniform on the sphere, given that B_H is nowhere in it below the limit, and that D is
    continuous everywhere that a vehicle can reach.

    Args:
        gauss: complex ``(P, N + 1, N + 1)`` tables ``g - i h`` [nT].
        count: number of regions, two on each planet, or all on the only one.
        seed: random seed of the places.
        half_size_deg: half of the height of a region [degrees of arc].
        max_latitude: latitude that no region crosses, north or south [deg].
        min_intensity_nt: lowest B_H in a region [nT].
        margin_deg: how far beyond its region a vehicle may stray before it is lost [deg].
        max_leg_km: longest leg of the environment; the field ends one leg beyond the margin.
        degree: degree of the expansions of the field; by default as high as the tolerance requires, from 12 on, or from
            52 on for a field of degree 133.
        tolerance_nt: largest error of the expansions [nT].
        **options: further fields of :class:`Scenario`, such as ``distance_range_km`` and ``distance_law``.

    Returns:
        The scenario, with floors of Eq. (6) from the field of each region.

    Raises:
        ValueError: for a number out of its range, conditions for which no place was found, an expansion that misses the
            field by more than the tolerance, or distances that a region cannot hold; naming it.

    Example:
        >>> far = region_scenario(random_planets(1, seed=0), count=2, seed=0,
        ...                       half_size_deg=20, distance_range_km=(150, 1800), distance_law="log")
        >>> len(far.region)
        2
    """
    check_number(1, whole=True, count=count)
    check_number(0, 2**63 - 1, whole=True, seed=seed)
    check_number(0, 90, above=True, max_latitude=max_latitude)
    check_number(0, max_latitude, above=True, half_size_deg=half_size_deg)
    check_number(0, min_intensity_nt=min_intensity_nt, margin_deg=margin_deg, max_leg_km=max_leg_km)
    planet = torch.arange(count) // REGIONS_PER_PLANET % len(gauss)
    # Regions of the default size need 12 for a field of degree 13 and 52 for one of degree 133.
    lowest = 12 + max(0, gauss.shape[-1] - 14) // 3
    *lower, highest = range(lowest, 3 * lowest, 4) if degree is None else [degree]
    draw = partial(_drawn_regions, seed, half_size_deg, max_latitude)

    def expand(regions: Regions, planet: Tensor, tolerance_nt: float | None = None) -> tuple[Regions, FieldBank]:
        boxes = regions.expanded(margin_deg).reachable(max_leg_km)
        build = partial(FieldBank.build, gauss, planet, boxes.latitude, boxes.longitude)
        if tolerance_nt is None:  # to choose places
            return boxes, build(degree=[*lower, highest][0], tolerance_nt=None)
        for tried in lower:
            bank = build(degree=tried, tolerance_nt=1e9)
            if bank.error_nt.max() <= tolerance_nt:
                return boxes, bank
        return boxes, build(degree=highest, tolerance_nt=tolerance_nt)

    regions = _placed_regions(draw, expand, planet, min_intensity_nt)
    _, bank = expand(regions, planet, tolerance_nt)
    return Scenario(region=regions, field=bank, margin_deg=margin_deg, objective_floors=None, **options)


def _placed_regions(
    draw: Callable[[Tensor, int], Regions],
    expand: Callable[[Regions, Tensor], tuple[Regions, FieldBank]],
    planet: Tensor,
    min_intensity_nt: float,
) -> Regions:
    """Draw a place for each region until it meets the conditions."""
    edges, waiting = torch.empty(len(planet), 4, dtype=torch.float64), torch.arange(len(planet))
    for attempt in range(MAX_TRIES):
        regions = draw(waiting, attempt)
        boxes, bank = expand(regions, planet[waiting])
        declination = region_elements(bank, boxes, points=11)[..., 0]
        strong = region_elements(bank, regions, points=11)[..., 2].amin(1) >= min_intensity_nt
        good = strong & (declination.amax(1) - declination.amin(1) <= 180)
        edges[waiting[good]] = torch.cat((regions.latitude, regions.longitude), -1)[good]
        waiting = waiting[~good]
        if not len(waiting):
            return Regions(edges[:, :2], edges[:, 2:])
    raise ValueError(
        f"no place was found in {MAX_TRIES} tries for region {int(waiting[0])} on planet {int(planet[waiting[0]])} "
        f"with min_intensity_nt {min_intensity_nt:g}: take smaller regions or a lower limit of the intensity"
    )


def _drawn_regions(seed: int, half_size_deg: float, max_latitude: float, number: Tensor, attempt: int) -> Regions:
    """Return boxes whose middles are uniform on the sphere between the latitudes that they may not cross."""
    uniform = counter_uniform(seed, torch.stack((number, torch.full_like(number, attempt)), -1), 2)
    highest = math.sin(math.radians(max_latitude - half_size_deg))
    latitude = torch.rad2deg(torch.asin(highest * (2 * uniform[:, 0] - 1)))
    longitude = 360 * uniform[:, 1] - 180
    aside = (half_size_deg / torch.cos(torch.deg2rad(latitude))).clamp_max(180)
    return Regions(
        torch.stack((latitude - half_size_deg, latitude + half_size_deg), -1),
        torch.stack((longitude - aside, longitude + aside), -1),
    )
