"""A world of the user's own: where journeys lie, the field there, and journeys that shall be flown, from one file.

The file is TOML or JSON, whatever its suffix says; docs/own_data.md has its keys. Everything in it is checked, and what
is wrong is said with the file, the key, the value, and what would be right.
"""

from __future__ import annotations

import datetime
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from magrl import guidance
from magrl.checks import check_number, check_type
from magrl.env import PAPER_DATE, PAPER_GENERATION, paper_field
from magrl.fields import Date, FieldModel, elements_gradient_at, igrf_coefficients
from magrl.regional import RegionalField
from magrl.tasks import PAPER_DISTANCE_KM, PAPER_REGION, Region, Tasks, check_distance_range, check_tasks, task_set

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_BYTES = 10_000_000
"""Of a file: some fifty thousand tasks."""
HIGHEST_KM = 600.0
"""Up to there IGRF is in use, and vehicles move over the ground below them."""

FLOOR_KM = 25.0


@dataclass(frozen=True)
class World:
    """Where journeys lie, and the field there; the paper's by default.

    Args:
        region: where tasks lie.
        distance_range_km: shortest and longest random journey [km].
        date: of the field, see :data:`magrl.fields.Date`.
        generation: of IGRF, 13 or 14.
        altitude_km: over the ellipsoid, at which the field is read [km]; distances are those over the ground.
        tasks: journeys to fly; random ones where there are none.
        names: of those tasks.
        objective_floors: least differences of D, I, B_H that Eq. 2-6 divides by [deg, deg, nT], the paper's region's by
            default; None for what :data:`FLOOR_KM` of travel change here, as those do there. Where the field is
            steeper, floors that are too low make of every detour an enormous loss.

    Raises:
        ValueError: for distances that the region cannot hold, a date outside the model, an altitude below the ground
            or above :data:`HIGHEST_KM`, tasks outside the region, or names that are not as many.

    Example:
        >>> World(Region((40, 50), (-30, -20)), date="2026-07-01", generation=14).field().latitude
        (34.5, 55.5)
    """

    region: Region = PAPER_REGION
    distance_range_km: tuple[float, float] = PAPER_DISTANCE_KM
    date: Date = PAPER_DATE
    generation: int = PAPER_GENERATION
    altitude_km: float = 0.0
    tasks: Tasks | None = None
    names: tuple[str, ...] = ()
    objective_floors: tuple[float, float, float] | None = guidance.OBJECTIVE_FLOORS

    def __post_init__(self) -> None:
        check_distance_range(self.region, self.distance_range_km)
        check_number(0, HIGHEST_KM, altitude_km=self.altitude_km)
        igrf_coefficients(self.date, self.generation)
        if self.tasks is not None:
            check_tasks(self.tasks, self.region)
        if len(self.names) != (0 if self.tasks is None else len(self.tasks.start)):
            raise ValueError(f"there must be a name for each task, got {self.names}")

    def field(self) -> RegionalField:
        """IGRF over the region and its margin, at the altitude.

        Raises:
            ValueError: for a region too large for the expansion.
        """
        return paper_field(self.region, date=self.date, generation=self.generation, altitude_km=self.altitude_km)

    def random_tasks(self, num_tasks: int, seed: int) -> Tasks:
        """A frozen set of random journeys, see :func:`magrl.tasks.task_set`."""
        return task_set(num_tasks, seed, self.region, self.distance_range_km)

    def options(self) -> dict[str, Any]:
        """What :class:`magrl.env.GeomagneticNavEnv` takes of it."""
        field = self.field()
        floors = self.objective_floors or floors_of(field, self.region)
        place = {"region": self.region, "distance_range_km": self.distance_range_km}
        return {**place, "field": field, "objective_floors": floors}


def floors_of(field: FieldModel, region: Region) -> tuple[float, float, float]:
    """What :data:`FLOOR_KM` of travel along the gradient change, in the mean over a region: D [deg], I [deg], B_H [nT].

    Example:
        >>> [round(x, 2) for x in floors_of(paper_field(), PAPER_REGION)]
        [0.05, 0.44, 21.11]
    """
    check_type(Region, region=region)
    slopes = elements_gradient_at(field, region.grid(21)).norm(dim=-1).reshape(-1, 3).mean(0)
    declination, inclination, intensity = (FLOOR_KM * slopes).tolist()
    return declination, inclination, intensity


def load_world(path: Path | str) -> World:
    """Reads a world from a TOML or JSON file.

    Args:
        path: of a file that ends in ``.toml`` or ``.json``.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: naming the file, the key, the value and what would be right.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "azores.toml"
        >>> lines = "[region]", "latitude = [40, 50]", "longitude = [-30, -20]", "[field]", "date = 2026-07-01"
        >>> _ = path.write_text(chr(10).join(lines))
        >>> load_world(path).region
        Region(latitude=(40.0, 50.0), longitude=(-30.0, -20.0))
    """
    check_type((Path, str), path=path)
    path = Path(path)
    try:
        return _world(_content(path))
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no file of a world at {path}") from None
    except (ValueError, OSError, RecursionError, OverflowError) as error:
        raise ValueError(f"{path}: {error or type(error).__name__}") from error


def _content(path: Path) -> Any:
    """The file as it stands, parsed."""
    parsers: dict[str, Callable[[str], Any]] = {".toml": tomllib.loads, ".json": _json}
    if path.suffix.lower() not in parsers:
        raise ValueError(f"a world is a file that ends in .toml or .json, not in {path.suffix!r}")
    with path.open("rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"it holds more than {MAX_BYTES} bytes")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"it is not UTF-8: {error}") from error
    try:
        return parsers[path.suffix.lower()](text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is not {path.suffix[1:].upper()}: {error}") from error


def _json(text: str) -> Any:
    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        seen: set[str] = set()
        for key, _ in pairs:
            if key in seen:
                raise ValueError(f"the key {_short(key)} is there twice")
            seen.add(key)
        return dict(pairs)

    return json.loads(text, object_pairs_hook=once)


def _world(content: Any) -> World:
    """A world from parsed tables."""
    tables = _table(content, "the file", required=("region", "field"), optional=("journeys", "tasks"))
    region = _table(tables["region"], "region", required=("latitude", "longitude"))
    field = _table(tables["field"], "field", required=("date",), optional=("generation", "altitude_km"))
    journeys = _table(tables.get("journeys", {}), "journeys", optional=("distance_range_km", "objective_floors"))
    box = _region(
        _pair(region["latitude"], "region.latitude", "south and north in degrees, such as [40, 50]"),
        _pair(region["longitude"], "region.longitude", "west and east in degrees, such as [-30, -20]"),
    )
    distance = journeys.get("distance_range_km", list(PAPER_DISTANCE_KM))
    generation, altitude = field.get("generation", 14), field.get("altitude_km", 0.0)
    if isinstance(generation, bool) or not isinstance(generation, int):
        raise ValueError(f"field.generation must be 13 or 14, got {generation!r}")
    check_number(0, HIGHEST_KM, **{"field.altitude_km": altitude})
    names, tasks = _tasks(tables.get("tasks", []), box)
    return World(
        box,
        _pair(distance, "journeys.distance_range_km", "shortest and longest in km, such as [300, 500]"),
        _date(field["date"]),
        generation,
        float(altitude),
        tasks,
        names,
        objective_floors=_floors(journeys.get("objective_floors")),
    )


def _region(latitude: tuple[float, float], longitude: tuple[float, float]) -> Region:
    if not all(abs(x) <= 360 for x in longitude):
        raise ValueError(f"region.longitude must lie between -360 and 360 degrees, got {longitude}")
    try:
        return Region(latitude, longitude)
    except ValueError as error:
        raise ValueError(f"region: {error}") from error


def _tasks(listed: Any, region: Region) -> tuple[tuple[str, ...], Tasks | None]:
    """Names and places of the tasks, each of which lies in the region."""
    if not isinstance(listed, list):
        raise ValueError(f"tasks must be a list of tables with start and target, got {_short(listed)}")
    if not listed:
        return (), None
    names, places = [], []
    for number, entry in enumerate(listed, start=1):
        where = f"tasks, entry {number}"
        task = _table(entry, where, required=("start", "target"), optional=("name",))
        name = task.get("name", f"task {number}")
        if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= 200:
            raise ValueError(f"{where}: name must be a text of 1 to 200 printable characters, got {_short(name)}")
        ends = [_pair(task[end], f"{where}: {end}", "latitude and longitude in degrees") for end in ("start", "target")]
        for end, place in zip(("start", "target"), ends, strict=True):
            if not abs(place[0]) <= 90 or not region.contains(torch.tensor(place, dtype=torch.float64)).item():
                raise ValueError(f"{where}: {end} {list(place)} must lie in the region, {_box(region)}")
        names.append(name)
        places.append(ends)
    start, target = torch.tensor(places, dtype=torch.float64).unbind(1)
    return tuple(names), Tasks(start, target)


def _table(value: Any, where: str, required: tuple[str, ...] = (), optional: tuple[str, ...] = ()) -> Mapping[str, Any]:
    """A table with the keys that it must have and none that it may not."""
    if not isinstance(value, dict):
        raise ValueError(f"{where} must be a table with {', '.join(required + optional)}, got {_short(value)}")
    unknown = [key for key in value if key not in required + optional]
    if unknown:
        raise ValueError(f"{where}: unknown key {_short(unknown[0])}; known are {', '.join(required + optional)}")
    missing = [key for key in required if key not in value]
    if missing:
        raise ValueError(f"{where}: {missing[0]} is missing")
    return value


def _pair(value: Any, where: str, right: str) -> tuple[float, float]:
    """Two finite numbers."""
    first, second = _numbers(value, 2, where, right)
    return first, second


def _numbers(value: Any, count: int, where: str, right: str) -> tuple[float, ...]:
    """A list of so many finite numbers."""
    good = isinstance(value, list) and len(value) == count
    for number in value if good else ():
        good &= isinstance(number, (int, float)) and not isinstance(number, bool) and abs(number) < 1e9
    if not good:
        raise ValueError(f"{where} must be {count} numbers, {right}, got {_short(value)}")
    return tuple(map(float, value))


def _floors(value: Any) -> tuple[float, float, float] | None:
    """Least differences of the elements; None where the file leaves them to the region."""
    if value is None:
        return None
    where, right = "journeys.objective_floors", "above 0, of D, I in degrees and of B_H in nT"
    declination, inclination, intensity = _numbers(value, 3, where, right)
    if min(declination, inclination, intensity) <= 0:
        raise ValueError(f"{where} must be 3 numbers, {right}, got {_short(value)}")
    return declination, inclination, intensity


def _date(value: Any) -> Date:
    """A date as the fields take it; TOML has dates of its own."""
    right = "field.date must be a date such as '2026-07-01' or a year such as 2026.5"
    if isinstance(value, datetime.date) and not isinstance(value, datetime.datetime):
        return value.isoformat()
    if isinstance(value, bool) or not isinstance(value, (datetime.datetime, str, int, float)):
        raise ValueError(f"{right}, got {_short(value)}")
    if isinstance(value, (int, float)) and not 1 <= value < 9999:
        raise ValueError(f"{right}, got {_short(value)}")
    try:
        return datetime.datetime.fromisoformat(value).isoformat() if isinstance(value, str) else value
    except ValueError:
        raise ValueError(f"{right}, got {_short(value)}") from None


def _box(region: Region) -> str:
    (south, north), (west, east) = region.latitude, region.longitude
    return f"latitude {south:g} to {north:g}, longitude {west:g} to {east:g}"


def _short(value: Any) -> str:
    """A value as a message can hold it."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
