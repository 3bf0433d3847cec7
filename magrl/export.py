"""Journeys as files that maps and receivers read: GeoJSON, GPX, KML.

A journey is drawn through the places where the vehicle turned, at most 50 km apart: between two of them a straight line
on a map leaves the geodesic by some hundred metres at most. Lines across the antimeridian are cut there, in GeoJSON as
RFC 7946 wants it and in KML alike; a GPX track is a row of points, and needs no cut.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from tensordict import TensorDictBase

from magrl.checks import check_numbers, check_type
from magrl.metrics import episode_measures, flown

MEASURES = ("success", "steps", "shortest_km", "length_km", "navigation_error_km", "spl")
"""What is told of each journey."""
Position = tuple[float, float]
"""Latitude, longitude [deg]."""


class Flight(NamedTuple):
    """A journey: its name, where it led, and what else is to be said of it.

    Example:
        >>> Flight("home", [(-2.0, 162.0), (-2.4, 162.1)], {"steps": 1}).positions[-1]
        (-2.4, 162.1)
    """

    name: str
    positions: Sequence[Position]
    properties: dict[str, Any]


def flights(rollout: TensorDictBase, names: Sequence[str], **properties: Any) -> list[Flight]:
    """The first journey of each vehicle.

    Args:
        rollout: ``(M, T)`` from ``env.rollout``, with the keys of :class:`magrl.env.GeomagneticNavEnv`.
        names: of the ``M`` journeys.
        properties: said of each of them, beside its measures.

    Raises:
        ValueError: for names that are not as many as the journeys.

    Example:
        >>> from magrl import GeomagneticNavEnv
        >>> journey, = flights(GeomagneticNavEnv(seed=0).rollout(3), ["home"], navigator="chance")
        >>> len(journey.positions), journey.properties["navigator"], journey.properties["steps"]
        (4, 'chance', 3)
    """
    measures = {key: value.tolist() for key, value in episode_measures(rollout).items() if key in MEASURES}
    if len(names) != len(rollout):
        raise ValueError(f"there are {len(rollout)} journeys, and {len(names)} names for them")
    starts, ways = rollout["start_position"][:, 0].tolist(), rollout["next", "position"].tolist()
    counts = flown(rollout["next", "done"]).sum(1).tolist()
    return [
        Flight(
            name,
            [tuple(place) for place in (start, *way[:count])],
            {**properties, **{key: values[row] for key, values in measures.items()}},
        )
        for row, (name, start, way, count) in enumerate(zip(names, starts, ways, counts, strict=True))
    ]


def to_geojson(journeys: Sequence[Flight]) -> str:
    """A feature for each journey, with its measures (RFC 7946: longitude before latitude, WGS84).

    Raises:
        ValueError: for a journey of one place, or a place that is not on Earth.

    Example:
        >>> feature = json.loads(to_geojson([Flight("east", [(0, 179), (0, -179)], {})]))["features"][0]
        >>> feature["geometry"]["coordinates"]
        [[[179.0, 0.0], [180.0, 0.0]], [[-180.0, 0.0], [-179.0, 0.0]]]
    """
    features = []
    for journey in journeys:
        lines = [[[longitude, latitude] for latitude, longitude in line] for line in cut(journey.positions)]
        kind, coordinates = ("LineString", lines[0]) if len(lines) == 1 else ("MultiLineString", lines)
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": kind, "coordinates": coordinates},
                "properties": {"name": journey.name, **{key: _plain(x) for key, x in journey.properties.items()}},
            }
        )
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"


def to_gpx(journeys: Sequence[Flight]) -> str:
    """A track for each journey (GPX 1.1).

    Raises:
        ValueError: for a journey of one place, or a place that is not on Earth.

    Example:
        >>> print(to_gpx([Flight("home", [(-2, 162), (-2.4, 162.1)], {"steps": 1})]).splitlines()[7].strip())
        <trkpt lat="-2.400000000" lon="162.100000000" />
    """
    root = ElementTree.Element("gpx", version="1.1", creator="magrl", xmlns="http://www.topografix.com/GPX/1/1")
    for journey in journeys:
        track = ElementTree.SubElement(root, "trk")
        _say(track, "name", journey.name)
        _say(track, "desc", _told(journey))
        segment = ElementTree.SubElement(track, "trkseg")
        for latitude, longitude in _checked(journey.positions):
            west = -180.0 if longitude == 180 else longitude  # GPX has no 180
            ElementTree.SubElement(segment, "trkpt", lat=_number(latitude), lon=_number(west))
    return _xml(root)


def to_kml(journeys: Sequence[Flight]) -> str:
    """A placemark for each journey (KML 2.2), on the ground.

    Raises:
        ValueError: for a journey of one place, or a place that is not on Earth.

    Example:
        >>> text = to_kml([Flight("home", [(-2, 162), (-2.5, 162.5)], {"steps": 1})])
        >>> "162.000000000,-2.000000000,0 162.500000000,-2.500000000,0" in text
        True
    """
    root = ElementTree.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = ElementTree.SubElement(root, "Document")
    for journey in journeys:
        placemark = ElementTree.SubElement(document, "Placemark")
        _say(placemark, "name", journey.name)
        _say(placemark, "description", _told(journey))
        shape = ElementTree.SubElement(placemark, "MultiGeometry")
        for line in cut(journey.positions):
            drawn = ElementTree.SubElement(shape, "LineString")
            _say(drawn, "tessellate", "1")
            _say(drawn, "coordinates", " ".join(f"{_number(lon)},{_number(lat)},0" for lat, lon in line))
    return _xml(root)


WRITERS: dict[str, Callable[[Sequence[Flight]], str]] = {".geojson": to_geojson, ".gpx": to_gpx, ".kml": to_kml}


def check_suffix(path: Path | str) -> str:
    """The suffix of a file of journeys.

    Raises:
        ValueError: for another than those of :data:`WRITERS`.

    Example:
        >>> check_suffix("flights.GPX")
        '.gpx'
    """
    check_type((Path, str), path=path)
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise ValueError(f"journeys are written as {', '.join(WRITERS)}; {str(path)!r} ends in none of them")
    return suffix


def write_flights(path: Path | str, journeys: Sequence[Flight]) -> None:
    """Writes journeys in the format that the file's name ends in; folders on the way are made.

    Raises:
        ValueError: for another suffix than those of :data:`WRITERS`, or a journey that cannot be drawn.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "flights.geojson"
        >>> write_flights(path, [Flight("home", [(-2, 162), (-2.4, 162.1)], {"steps": 1})])
        >>> json.loads(path.read_text())["features"][0]["properties"]
        {'name': 'home', 'steps': 1}
    """
    text = WRITERS[check_suffix(path)](journeys)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text, encoding="utf-8")


def cut(positions: Sequence[Position]) -> list[list[Position]]:
    """A line in pieces that do not cross the antimeridian; each ends, and the next begins, on it.

    Args:
        positions: latitude, longitude [deg], longitudes from -180 to 180.

    Returns:
        One piece, or one more for each crossing. The latitude of a crossing lies on the straight line on the map.

    Raises:
        ValueError: for a line of one place, or a place that is not on Earth.

    Example:
        >>> cut([(0.0, 179.5), (1.0, -179.5)])
        [[(0.0, 179.5), (0.5, 180.0)], [(0.5, -180.0), (1.0, -179.5)]]
    """
    places = _checked(positions)
    lines = [[_beside(places[0], places[1])]]
    for place in places[1:]:
        latitude, longitude = lines[-1][-1]
        there = _beside(place, (latitude, longitude))
        if abs(there[1] - longitude) > 180:
            side, left = math.copysign(180.0, longitude), 180 - abs(longitude)
            crossing = latitude + (there[0] - latitude) * left / (left + 180 - abs(there[1]))
            if left:
                lines[-1].append((crossing, side))
            lines.append([(crossing, -side)])
        lines[-1].append(there)
    return lines


def _beside(place: Position, other: Position) -> Position:
    """A place on the antimeridian with the sign of another, so that nothing is cut between them."""
    return (place[0], math.copysign(180.0, other[1])) if abs(place[1]) == 180 else place


def _checked(positions: Sequence[Position]) -> list[Position]:
    """Places on Earth, two at least."""
    if len(positions) < 2:
        raise ValueError(f"a line needs two places, got {list(positions)}")
    for place in positions:
        check_numbers(2, position=place)
        if not (abs(place[0]) <= 90 and abs(place[1]) <= 180):
            raise ValueError(f"position must be a latitude within 90 and a longitude within 180 degrees, got {place}")
    return [(float(latitude), float(longitude)) for latitude, longitude in positions]


def _number(value: float) -> str:
    """Degrees to a tenth of a millimetre, never in powers of ten, which GPX does not read."""
    return f"{value:.9f}"


def _told(journey: Flight) -> str:
    """The properties in a line."""
    pairs = ((key, f"{x:.3f}" if isinstance(x, float) else x) for key, x in journey.properties.items())
    return ", ".join(f"{key} {value}" for key, value in pairs)


def _say(parent: ElementTree.Element, tag: str, text: str) -> None:
    """An element with a text; characters that XML cannot hold become question marks."""
    ElementTree.SubElement(parent, tag).text = re.sub(r"[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", text)


def _xml(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
