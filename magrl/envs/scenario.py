"""Scenarios: where trips lie, the field there, and the trips themselves, from Python or from a TOML or JSON file."""

from __future__ import annotations

import copy
import datetime
import math
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import torch
from pydantic import BeforeValidator, Field, create_model, model_validator
from torch import Tensor

from magrl import guidance, paper
from magrl.checks import CheckedModel, check_number, check_numbers, check_type, short
from magrl.envs.regions import PAPER_REGION, Region, Regions, check_expansions
from magrl.envs.specs import field_bounds
from magrl.envs.trips import Trips, check_distance_range, check_trips, trip_set
from magrl.field import (
    IGRF,
    Date,
    FieldBank,
    FieldModel,
    RegionalField,
    elements_gradient_at,
    igrf_coefficients,
    parse_date,
)
from magrl.field.elements import elements_gradient
from magrl.files import read_document
from magrl.pilot.records import EpisodeRules

FLOOR_KM = 25.0
"""Distance of travel whose mean change of each element is the default floor of Eq. (6) away from the paper's box."""


def numbers_validator(name: str, count: int) -> BeforeValidator:
    """Return a pydantic validator that turns ``count`` finite numbers into a tuple of floats.

    Example:
        >>> numbers_validator("start", 2).func([40, -30])
        (40.0, -30.0)
    """

    def check(value: Any) -> tuple[float, ...] | None:
        if value is None:
            return None
        check_numbers(count, **{name: value})
        return tuple(float(number) for number in value)

    return BeforeValidator(check)


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _region(value: object) -> object:
    if isinstance(value, Region | Regions):
        return Regions.of(value)
    if not isinstance(value, dict) or value.keys() != {"latitude", "longitude"}:
        raise ValueError(
            f"region must be a Region, or a table of latitude and longitude, each [low, high] in degrees, "
            f"got {short(value)}"
        )
    region = Region(_tuple(value["latitude"]), _tuple(value["longitude"]))
    if max(map(abs, region.longitude)) > 360:
        raise ValueError(f"region: longitudes must lie between -360 and 360 degrees, got {region.longitude}")
    return Regions.of(region)


def _trips(value: object) -> object:
    if isinstance(value, tuple | list) and len(value) == 2:
        try:
            return Trips(*value)
        except TypeError as error:
            raise ValueError(str(error)) from error
    if value is not None and not isinstance(value, Trips):
        form = "Trips(start, target), each (M, 2) latitude and longitude [deg]"
        raise ValueError(f"trips must be {form}, got {short(value)}")
    return value


def _field(value: object) -> object:
    if value is not None and not callable(value):
        raise ValueError(f"field must be called as field(latitude, longitude), got {short(value)}")
    return value


@lru_cache
def _expanded_igrf(box: Region, date: datetime.datetime, generation: int, altitude_km: float) -> RegionalField:
    """Return IGRF on a box where its elements are continuous; kept, as many environments have the same."""
    field = RegionalField(IGRF(date, generation, altitude_km=altitude_km), box.latitude, box.longitude)
    field_bounds(field, Regions.of(box))
    return field


@lru_cache(maxsize=8)
def _mean_changes(field: FieldModel | FieldBank, region: Regions) -> Tensor:
    """Return the mean change of each element over :data:`FLOOR_KM` in each region ``(K, 3)``; kept, as it takes most of
    the time in which an environment over many regions is made."""
    grid = region.grid(21)
    if isinstance(field, FieldBank):
        slopes = elements_gradient(*field.on_grids(grid))
    else:
        slopes = elements_gradient_at(field, grid)
    return FLOOR_KM * slopes.norm(dim=-1).flatten(1, 2).mean(1)


class Scenario(EpisodeRules):
    """Where trips lie, the field there, how far apart their ends are, and the rules of an episode; by default the
    paper's.

    Raises:
        ValueError: naming the value: for distances that the region cannot hold, a date outside the field model, an
            altitude out of range, trips beyond the region's margin, or another number of names than of trips.

    Example:
        >>> azores = Scenario(region=Region((35, 45), (-35, -25)), date="2026-07-01", generation=14)
        >>> azores.build_field().latitude
        (29.5, 50.5)
    """

    region: Annotated[Any, BeforeValidator(_region)] = PAPER_REGION
    """Box of starts and destinations, given as a :class:`Region`, kept as :class:`Regions`; or several boxes, of which
    every random trip draws one, with a bank as ``field``."""
    distance_range_km: Annotated[tuple[float, float], numbers_validator("distance_range_km", 2)] = paper.DISTANCE_KM
    """Shortest and longest distance from start to destination of random trips [km]."""
    distance_law: Literal["area", "log"] = "area"
    """Law of the distances of random trips: both ends uniform over the region given that their distance is in the range
    (``"area"``), or log-uniform distances in the whole range (``"log"``)."""
    date: Annotated[Date, BeforeValidator(parse_date)] = parse_date(paper.DATE)
    """Date of the field: ``datetime``, ``date``, ISO text or decimal year; kept as a ``datetime``."""
    generation: Literal[13, 14] = paper.GENERATION  # type: ignore[assignment]
    """Generation of IGRF."""
    altitude_km: float = 0.0
    """Altitude over the ellipsoid at which the field is measured, negative for a depth [km], -15 to 1000; distances
    are those over the ground."""
    margin_deg: Annotated[float, Field(ge=0)] = 5.0
    """How far beyond the region a vehicle may stray before it is lost [deg]."""
    objective_floors: Annotated[tuple[float, float, float] | None, numbers_validator("objective_floors", 3)] = (
        guidance.OBJECTIVE_FLOORS
    )
    """Least differences of D [deg], I [deg], B_H [nT] that Eq. (6) divides by, or None for the mean change of each over
    :data:`FLOOR_KM` in the region. Where the field is steep, floors that are too low make every detour very costly."""
    field: Annotated[Any, BeforeValidator(_field)] = None
    """Field model (:class:`magrl.field.FieldModel`) instead of IGRF; over many regions a
    :class:`magrl.field.FieldBank` with an expansion for each, of every place that a vehicle can reach."""
    trips: Annotated[Trips | None, BeforeValidator(_trips)] = None
    """Frozen trips to fly instead of random ones; by default in region 0."""
    names: Annotated[tuple[str, ...], BeforeValidator(_tuple)] = ()
    """Names of the frozen trips, or none."""
    start_heading: Literal["north", "random"] = "north"
    """Heading at the start of an episode; ``"random"`` is uniform."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        check_expansions(self.field, self.region)
        check_number(*IGRF.altitude_range_km, altitude_km=self.altitude_km)
        if self.objective_floors is not None:
            check_number(0, above=True, objective_floors=min(self.objective_floors))
        if self.field is None:
            igrf_coefficients(self.date, self.generation)
        if self.trips is None:
            check_distance_range(self.region, self.distance_range_km, self.distance_law)
        else:
            object.__setattr__(self, "trips", self._checked_trips(self.trips))
        count = 0 if self.trips is None else len(self.trips.start)
        if self.names and len(self.names) != count:
            raise ValueError(f"names must hold one name for each of {count} trips, got {short(self.names)}")
        return self

    def _checked_trips(self, trips: Trips) -> Trips:
        try:
            return check_trips(trips, self.edge)
        except ValueError as error:
            text = str(error) if str(error).startswith("trips") else f"trips: {error}"
            if "lies outside" in text and len(self.region) == 1:
                text += f": raise margin_deg from {self.margin_deg:g} to at least {self._margin_to(trips):g}"
            raise ValueError(text) from error

    def _margin_to(self, trips: Trips) -> float:
        """Return the margin that would hold all trips, rounded up to half a degree."""
        ends, region = torch.cat(trips[:2]).double(), self.region[0]
        (low, high) = torch.tensor((region.latitude, region.longitude), dtype=torch.float64).T
        beyond = (region.unwrapped(ends) - (low + high) / 2).abs() - (high - low) / 2
        return math.ceil(2 * beyond.max().item()) / 2

    def given(self, name: str) -> Any:
        """Return a field, or None where it was not given and has its default.

        Example:
            >>> Scenario(zeta=0.1).given("zeta"), Scenario().given("zeta")
            (0.1, None)
        """
        return getattr(self, name) if name in self.model_fields_set else None

    @property
    def edge(self) -> Regions:
        """Regions with their margin: a vehicle beyond it is lost."""
        return self.region.expanded(self.margin_deg)

    def reachable(self, drift_km: float = 0.0) -> Regions:
        """Return every place that a vehicle can reach: one leg beyond the edge, rounded up to half a degree.

        Args:
            drift_km: how much farther than its command an error of motion may carry a vehicle [km].

        Raises:
            ValueError: for a drift that is negative or not finite.

        Example:
            >>> Scenario().reachable()
            Regions(Region(latitude=(-15.5, 5.5), longitude=(154.5, 175.5)))
        """
        check_number(0, drift_km=drift_km)
        return self.edge.reachable(self.max_leg_km + drift_km)

    def build_field(self, drift_km: float = 0.0) -> FieldModel:
        """Return the field model or bank that is given, or IGRF expanded over every place that a vehicle can reach.

        Args:
            drift_km: as in :meth:`reachable`.

        Raises:
            ValueError: for a region too large for the expansion, or too near to a pole of the Earth or of the field;
                naming the key, the reason and a change that helps.
        """
        if self.field is not None:
            return self.field
        boxes, region = self.reachable(drift_km), self.region[0]
        try:
            field = _expanded_igrf(boxes[0], self.date, self.generation, self.altitude_km)
        except ValueError as error:
            reason = f"region.latitude, region.longitude: {str(error).rpartition(': ')[0]}"  # without its advice
            if boxes.latitude.abs().max() == 90:
                place = f"region.latitude {region.latitude}: with margin_deg {self.margin_deg:g}, vehicles reach"
                reason = f"{place} a pole in {boxes[0]}, where the declination takes every value"
            raise ValueError(f"{reason}: reduce margin_deg or the region, or move it toward the equator") from error
        return copy.deepcopy(field, {id(values): values for values in field.buffers()})  # a copy may be moved

    def floors(self, field: FieldModel | FieldBank) -> Tensor:
        """Return the floors of Eq. (6), D [deg], I [deg], B_H [nT], from ``field`` where none are given.

        Returns:
            ``(K, 3)`` float64, for each region.

        Example:
            >>> scenario = Scenario(objective_floors=None)
            >>> scenario.floors(scenario.build_field()).round(decimals=2)
            tensor([[ 0.0500,  0.4400, 21.1300]], dtype=torch.float64)
        """
        count = len(self.region)
        if self.objective_floors is not None:
            return torch.tensor(self.objective_floors, dtype=torch.float64).repeat(count, 1)
        try:
            return _mean_changes(field, self.region).clone()  # type: ignore[arg-type]
        except TypeError:  # a field without a hash
            return _mean_changes.__wrapped__(field, self.region)

    def random_trips(self, num_trips: int, seed: int) -> Trips:
        """Return a frozen set of random trips, see :func:`magrl.envs.trips.trip_set`."""
        return trip_set(num_trips, seed, self.region, self.distance_range_km, self.distance_law)

    def with_trips(self, trips: Trips | None) -> Scenario:
        """Return the same scenario with other frozen trips, or with random ones for None.

        Example:
            >>> len(Scenario().with_trips(Scenario().random_trips(5, seed=0)).trips.start)
            5
        """
        return self.replace(trips=trips, names=())


RULES = (*EpisodeRules.model_fields, "start_heading", "margin_deg")
"""Names of the rules of an episode among the fields of a :class:`Scenario`."""


def rule_settings(*names: str, **defaults: Any) -> Any:
    """Return a model with rules of an episode as :class:`Scenario` declares them, a base of the settings of a program.

    Args:
        names: names of :data:`RULES`.
        **defaults: further rules, with other defaults than a scenario's; None for one that may be left out.

    Example:
        >>> rule_settings("zeta", max_steps=120)()
        Settings(zeta=0.01, max_steps=120)
    """
    fields: dict[str, Any] = {}
    for name in (*names, *defaults):
        rule: Any = Scenario.model_fields[name]
        default = defaults.get(name, rule.default)
        kind = rule.annotation if default is not None else rule.annotation | None
        text = " ".join((rule.description or "").split())  # a command breaks lines by itself
        fields[name] = Annotated[(kind, *rule.metadata, Field(description=text))], default
    return create_model("Settings", __base__=CheckedModel, **fields)


def _name(value: object) -> object:
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= 200:
        raise ValueError(f"name must be a text of 1 to 200 printable characters, got {short(value)}")
    return value


class TripEntry(CheckedModel):
    """A trip in a file."""

    start: Annotated[tuple[float, float], numbers_validator("start", 2)]
    target: Annotated[tuple[float, float], numbers_validator("target", 2)]
    name: Annotated[str | None, BeforeValidator(_name)] = Field(None, validate_default=False)


class TripEntries(CheckedModel):
    """The trips in a file."""

    trips: list[TripEntry]


def load_scenario(path: Path | str, **changes: Any) -> Scenario:
    """Read a scenario from a TOML or JSON file, whose keys are the fields of :class:`Scenario`.

    ``region`` and ``date`` are required. ``generation`` is 14 and ``objective_floors`` follow the region unless given.
    ``trips`` is a list of tables with ``start`` and ``target`` (latitude, longitude in degrees) and perhaps ``name``.

    Args:
        path: file that ends in ``.toml`` or ``.json``.
        **changes: fields of :class:`Scenario` that replace the file's.

    Raises:
        FileNotFoundError: if it does not exist.
        ValueError: naming the file, the key, the value and what would be right.

    Example:
        >>> import tempfile
        >>> lines = "date = 2026-07-01", "region = {latitude = [40, 50], longitude = [-30, -20]}"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "azores.toml").write_text(chr(10).join(lines))
        ...     load_scenario(Path(folder) / "azores.toml").region
        Regions(Region(latitude=(40.0, 50.0), longitude=(-30.0, -20.0)))
    """
    check_type((Path, str), path=path)
    path = Path(path)
    try:
        scenario = _scenario(read_document(path), changes)
        scenario.build_field()
        return scenario
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no scenario file at {path}") from None
    except (ValueError, TypeError, OSError, RecursionError, OverflowError) as error:
        raise ValueError(f"{path}: {error or type(error).__name__}") from error


def _scenario(content: Any, changes: dict[str, Any]) -> Scenario:
    if not isinstance(content, dict):
        raise ValueError(f"a scenario file must hold a table, got {short(content)}")
    keys = [name for name in Scenario.model_fields if name not in ("field", "names")]
    if unknown := [key for key in content if key not in keys]:
        raise ValueError(f"unknown key {short(unknown[0])}: choose from {', '.join(keys)}")
    if missing := [name for name in ("region", "date") if name not in content]:
        raise ValueError(f"{missing[0]} is missing: a scenario file must hold region and date")
    values: dict[str, Any] = {"generation": 14, "objective_floors": None} | content
    if "trips" in content:
        values["names"], values["trips"] = _listed_trips(content["trips"])
    return Scenario(**(values | changes))


def _listed_trips(listed: Any) -> tuple[tuple[str, ...], Trips | None]:
    """Return names and ends of a list of tables."""
    entries = TripEntries(trips=listed).trips
    if not entries:
        return (), None
    start, target = torch.tensor([(e.start, e.target) for e in entries], dtype=torch.float64).unbind(1)
    return tuple(e.name or f"trip {number}" for number, e in enumerate(entries, 1)), Trips(start, target)
