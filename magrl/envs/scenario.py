"""Scenarios: where tasks lie, the field there, and the tasks themselves, from Python or from a TOML or JSON file."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BeforeValidator, Field, model_validator
from typing_extensions import Self

from magrl import guidance, paper
from magrl.checks import CheckedModel, check_number, check_type, short
from magrl.envs.region import PAPER_REGION, Region
from magrl.envs.specs import field_bounds
from magrl.envs.tasks import (
    TaskEntry,
    Tasks,
    check_distance_range,
    check_tasks,
    numbers_validator,
    task_set,
    without_way,
)
from magrl.field import IGRF, Date, FieldModel, RegionalField, elements_gradient_at, igrf_coefficients, parse_date

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_FILE_BYTES = 10_000_000
"""Largest scenario file: about fifty thousand tasks."""
MAX_ALTITUDE_KM = 600.0
"""Highest altitude of a scenario: IGRF is in use up to there, and distances are those over the ground."""
FLOOR_KM = 25.0
"""Distance of travel whose mean change of each element is the default floor of Eq. 2-6 away from the paper's box."""
_SHORTEST_DEGREE_KM = 110.5  # a degree of arc is nowhere shorter on the ellipsoid


def _tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _region(value: object) -> object:
    if isinstance(value, Region):
        return value
    if not isinstance(value, dict) or value.keys() != {"latitude", "longitude"}:
        raise ValueError(
            f"region must be a Region, or a table of latitude and longitude, each [low, high] in degrees, "
            f"got {short(value)}"
        )
    region = Region(_tuple(value["latitude"]), _tuple(value["longitude"]))  # type: ignore[arg-type]
    if max(map(abs, region.longitude)) > 360:
        raise ValueError(f"region: longitudes must lie between -360 and 360 degrees, got {region.longitude}")
    return region


def _floors(value: object) -> object:
    if value is None:
        return None
    floors = _FLOORS(value)
    if min(floors) <= 0:
        raise ValueError(f"objective_floors must be above 0, got {short(value)}")
    return floors


def _field(value: object) -> object:
    if value is not None and not callable(value):
        raise ValueError(f"field must be called as field(latitude, longitude), got {short(value)}")
    return value


_DISTANCES = numbers_validator("distance_range_km", 2, "shortest and longest in km")
_FLOORS = numbers_validator("objective_floors", 3, "of D [deg], I [deg] and B_H [nT]")


class Scenario(CheckedModel):
    """Where tasks lie, the field there, and how far apart their ends are; by default those of the paper.

    Raises:
        ValueError: naming the value: for distances that the region cannot hold, a date outside the field model, an
            altitude out of range, tasks beyond the region's margin, or another number of names than of tasks.

    Example:
        >>> azores = Scenario(region=Region((35, 45), (-35, -25)), date="2026-07-01", generation=14)
        >>> azores.build_field().latitude
        (29.5, 50.5)
    """

    region: Annotated[Region, BeforeValidator(_region)] = PAPER_REGION
    """Box of starts and destinations."""
    distance_range_km: Annotated[tuple[float, float], BeforeValidator(_DISTANCES)] = paper.DISTANCE_KM
    """Shortest and longest distance from start to destination of random tasks [km]."""
    date: Annotated[Date, BeforeValidator(parse_date)] = parse_date(paper.DATE)
    """Date of the field: ``datetime``, ``date``, ISO text or decimal year; kept as a ``datetime``."""
    generation: Literal[13, 14] = paper.GENERATION  # type: ignore[assignment]
    """Generation of IGRF."""
    altitude_km: Annotated[float, Field(ge=0, le=MAX_ALTITUDE_KM)] = 0.0
    """Altitude over the ellipsoid at which the field is measured [km]; distances are those over the ground."""
    margin_deg: Annotated[float, Field(ge=0)] = 5.0
    """How far beyond the region a vehicle may stray before it is lost [deg]."""
    objective_floors: Annotated[tuple[float, float, float] | None, BeforeValidator(_floors)] = guidance.OBJECTIVE_FLOORS
    """Least differences of D [deg], I [deg], B_H [nT] that Eq. 2-6 divides by, or None for the mean change of each over
    :data:`FLOOR_KM` in the region. Where the field is steep, floors that are too low make every detour very costly."""
    field: Annotated[Any, BeforeValidator(_field)] = None
    """Own field model (:class:`magrl.field.FieldModel`) in place of IGRF."""
    tasks: Tasks | None = None
    """Frozen tasks to fly in place of random ones."""
    names: Annotated[tuple[str, ...], BeforeValidator(_tuple)] = ()
    """Names of the frozen tasks, or none."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.field is None:
            igrf_coefficients(self.date, self.generation)
        if self.tasks is None:
            check_distance_range(self.region, self.distance_range_km)
        else:
            object.__setattr__(self, "tasks", self._checked_tasks(self.tasks))
        count = 0 if self.tasks is None else len(self.tasks.start)
        if self.names and len(self.names) != count:
            raise ValueError(f"names must hold one name for each of {count} tasks, got {short(self.names)}")
        return self

    def _checked_tasks(self, tasks: Tasks) -> Tasks:
        try:
            return check_tasks(tasks, self.edge)
        except ValueError as error:
            raise ValueError(str(error) if str(error).startswith("tasks") else f"tasks: {error}") from error

    @property
    def edge(self) -> Region:
        """Region with its margin: a vehicle beyond it is lost."""
        return self.region.expanded(self.margin_deg)

    def reachable(self, max_move_km: float) -> Region:
        """Return every place that a vehicle can reach: one move beyond the edge, rounded up to half a degree.

        Raises:
            ValueError: for a move that is negative or not finite.

        Example:
            >>> Scenario().reachable(50)
            Region(latitude=(-15.5, 5.5), longitude=(154.5, 175.5))
        """
        check_number(0, max_move_km=max_move_km)
        reach = math.radians(max_move_km / _SHORTEST_DEGREE_KM)
        nearest_pole = math.radians(90 - max(abs(x) for x in self.edge.latitude))
        # The farthest that a great circle of this length leads from its meridian; past a pole it leads anywhere.
        aside = math.degrees(math.asin(math.sin(reach) / math.sin(nearest_pole))) if reach < nearest_pole else 180.0
        south_north, west_east = (math.ceil(2 * x) / 2 for x in (math.degrees(reach), aside))
        return Region(self.edge.expanded(south_north).latitude, self.edge.expanded(west_east).longitude)

    def build_field(self, max_move_km: float = 50.0) -> FieldModel:
        """Return the own field model, or IGRF expanded over every place that a vehicle can reach.

        Args:
            max_move_km: longest move [km].

        Raises:
            ValueError: for a region too large for the expansion, or too near to a pole of the Earth or of the field;
                naming the key, the reason and a change that helps.
        """
        if self.field is not None:
            return self.field
        try:
            return self._expanded_igrf(max_move_km)
        except ValueError as error:
            box = self.reachable(max_move_km)
            reason = f"region.latitude, region.longitude: {str(error).rpartition(': ')[0]}"  # without its advice
            if max(map(abs, box.latitude)) == 90:
                place = f"region.latitude {self.region.latitude}: with margin_deg {self.margin_deg:g}, vehicles reach"
                reason = f"{place} a pole in {box}, where all longitudes meet and the declination takes every value"
            raise ValueError(f"{reason}: {self._remedy(max_move_km)}") from error

    def _expanded_igrf(self, max_move_km: float) -> RegionalField:
        """Return IGRF expanded over every place that a vehicle can reach, with a declination that does not jump."""
        box = self.reachable(max_move_km)
        igrf = IGRF(self.date, self.generation, altitude_km=self.altitude_km)
        field = RegionalField(igrf, box.latitude, box.longitude)
        field_bounds(field, box, torch.device("cpu"))
        return field

    def _remedy(self, max_move_km: float) -> str:
        """Return the smallest changes that give a usable field; each of them was tried."""

        def usable(**changes: Any) -> bool:
            try:
                self.replace(tasks=None, names=(), distance_range_km=(0.0, 1.0), **changes)._expanded_igrf(max_move_km)
            except ValueError:
                return False
            return True

        (south, north), longitude = self.region.latitude, self.region.longitude
        margins = (step / 2 for step in range(min(math.ceil(2 * self.margin_deg), 20) - 1, -1, -1))
        margin = next((margin for margin in margins if usable(margin_deg=margin)), None)
        side = math.copysign(1, south + north)
        shifts = range(1, min(30, int(abs(south + north) / 2)) + 1)
        regions = ((shift, Region((south - side * shift, north - side * shift), longitude)) for shift in shifts)
        shift = next((shift for shift, region in regions if usable(region=region)), None)
        ways = [f"reduce margin_deg to {margin:g}"] if margin is not None else []
        ways += [f"move the region {shift}° toward the equator"] if shift is not None else []
        return ", or ".join(ways) or "choose a smaller region away from the poles"

    def floors(self, field: FieldModel) -> tuple[float, float, float]:
        """Return the floors of Eq. 2-6, D [deg], I [deg], B_H [nT], from ``field`` where none are given.

        Example:
            >>> scenario = Scenario(objective_floors=None)
            >>> [round(x, 2) for x in scenario.floors(scenario.build_field())]
            [0.05, 0.44, 21.11]
        """
        if self.objective_floors is not None:
            return self.objective_floors
        slopes = elements_gradient_at(field, self.region.grid(21)).norm(dim=-1).reshape(-1, 3).mean(0)
        declination, inclination, intensity = (FLOOR_KM * slopes).tolist()
        return declination, inclination, intensity

    def random_tasks(self, num_tasks: int, seed: int) -> Tasks:
        """Return a frozen set of random tasks, see :func:`magrl.envs.tasks.task_set`."""
        return task_set(num_tasks, seed, self.region, self.distance_range_km)

    def with_tasks(self, tasks: Tasks | None) -> Scenario:
        """Return the same scenario with other frozen tasks, or with random ones for None.

        Example:
            >>> len(Scenario().with_tasks(Scenario().random_tasks(5, seed=0)).tasks.start)
            5
        """
        return self.replace(tasks=tasks, names=())


def load_scenario(path: Path | str) -> Scenario:
    """Read a scenario from a TOML or JSON file, whose keys are the fields of :class:`Scenario`.

    ``region`` and ``date`` are required. ``generation`` is 14 and ``objective_floors`` follow the region unless given.
    ``tasks`` is a list of tables with ``start`` and ``target`` (latitude, longitude in degrees) and perhaps ``name``.

    Args:
        path: file that ends in ``.toml`` or ``.json``.

    Raises:
        FileNotFoundError: if it does not exist.
        ValueError: naming the file, the key, the value and what would be right.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "azores.toml"
        >>> lines = "date = 2026-07-01", "region = {latitude = [40, 50], longitude = [-30, -20]}"
        >>> _ = path.write_text(chr(10).join(lines))
        >>> load_scenario(path).region
        Region(latitude=(40.0, 50.0), longitude=(-30.0, -20.0))
    """
    check_type((Path, str), path=path)
    path = Path(path)
    try:
        scenario = _scenario(_content(path))
        scenario.build_field()
        return scenario
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no scenario file at {path}") from None
    except (ValueError, TypeError, OSError, RecursionError, OverflowError) as error:
        raise ValueError(f"{path}: {error or type(error).__name__}") from error


def _scenario(content: Any) -> Scenario:
    if not isinstance(content, dict):
        raise ValueError(f"a scenario file must hold a table, got {short(content)}")
    if "journeys" in content or "field" in content:
        raise ValueError(
            "the tables [field] and [journeys] are of an earlier version: write their keys (date, generation, "
            "altitude_km, distance_range_km, objective_floors) at the top of the file, above [region]"
        )
    known = [name for name in Scenario.model_fields if name not in ("field", "names")]
    if unknown := [key for key in content if key not in known]:
        where = ": write name = ... in each of the tasks" if unknown[0] == "names" else ""
        raise ValueError(f"unknown key {short(unknown[0])}{where or ': choose from ' + ', '.join(known)}")
    if missing := [name for name in ("region", "date") if name not in content]:
        raise ValueError(f"{missing[0]} is missing: a scenario file must hold region and date")
    values: dict[str, Any] = {"generation": 14, "objective_floors": None} | content
    if "tasks" in content:
        values["names"], values["tasks"] = _listed_tasks(content["tasks"])
    return Scenario(**values)


def _listed_tasks(listed: Any) -> tuple[tuple[str, ...], Tasks | None]:
    """Return names and ends of a list of tables."""
    if not isinstance(listed, list):
        raise ValueError(f"tasks must be a list of tables with start and target, got {short(listed)}")
    if not listed:
        return (), None
    entries = [TaskEntry.read(number, entry) for number, entry in enumerate(listed, start=1)]
    start, target = torch.tensor([(e.start, e.target) for e in entries], dtype=torch.float64).unbind(1)
    on_earth = (torch.maximum(start[:, 0].abs(), target[:, 0].abs()) <= 90).nonzero().squeeze(-1)
    if len(nowhere := on_earth[without_way(start[on_earth], target[on_earth])]):
        number = int(nowhere[0])
        raise ValueError(
            f"tasks, entry {number + 1}: start and target are the same place, {list(entries[number].start)}: "
            "move one of them, or remove the entry"
        )
    return tuple(e.name for e in entries), Tasks(start, target)


def _content(path: Path) -> Any:
    """Return the parsed file."""
    parsers: dict[str, Callable[[str], Any]] = {".toml": tomllib.loads, ".json": _json}
    if path.suffix.lower() not in parsers:
        raise ValueError(f"a scenario file must end in .toml or .json, got {path.suffix!r}")
    with path.open("rb") as file:
        content = file.read(MAX_FILE_BYTES + 1)
    if len(content) > MAX_FILE_BYTES:
        raise ValueError(f"the file holds more than {MAX_FILE_BYTES} bytes")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"the file is not UTF-8: {error}") from error
    try:
        return parsers[path.suffix.lower()](text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the file is not valid {path.suffix[1:].upper()}: {error}") from error


def _json(text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            names = [key for key, _ in pairs]
            raise ValueError(f"the key {short(next(key for key in names if names.count(key) > 1))} is repeated")
        return dict(pairs)

    return json.loads(text, object_pairs_hook=unique)
