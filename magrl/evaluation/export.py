"""Export of episodes as tracks for maps and receivers: GeoJSON, GPX, KML.

The vertices of a track are the way-points of the vehicle, at most 50 km apart, so that straight lines on a map deviate
from the geodesics by some hundred meters at most. Lines are cut at the antimeridian, as RFC 7946 requires in GeoJSON,
and likewise in KML; a GPX track is a sequence of points and needs no cut.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, indent, tostring

from tensordict import TensorDictBase

from magrl.checks import check_number
from magrl.envs.rendering import START, TARGET
from magrl.evaluation.metrics import episode_measures
from magrl.evaluation.navigators import NAVIGATOR_COLORS, parse_navigator
from magrl.files import json_ready

MEASURES = ("success", "steps", "shortest_km", "length_km", "navigation_error_km", "spl")
"""Measures among the properties of each track."""

Position = tuple[float, float]
"""Latitude, longitude [deg]."""


class Track(NamedTuple):
    """The path of an episode.

    Args:
        name: name of the episode.
        positions: latitude, longitude [deg] of each way-point, start first.
        properties: further properties by name, numbers and texts.
        target: latitude, longitude [deg] of the destination, or None.

    Example:
        >>> Track("home", [(-2.0, 162.0), (-2.4, 162.1)], {"steps": 1}).positions[-1]
        (-2.4, 162.1)
    """

    name: str
    positions: Sequence[Position]
    properties: dict[str, Any]
    target: Position | None = None


def tracks(rollout: TensorDictBase, names: Sequence[str], **properties: Any) -> list[Track]:
    """Return the track of the first episode of each vehicle.

    Args:
        rollout: ``(M, T)`` from ``env.rollout``, with the keys of :class:`magrl.envs.GeomagneticNavEnv`.
        names: names of the ``M`` episodes.
        properties: properties of every track, beside its measures.

    Raises:
        ValueError: for another number of names than of episodes.

    Example:
        >>> from magrl import GeomagneticNavEnv
        >>> track, = tracks(GeomagneticNavEnv(seed=0).rollout(3), ["home"], navigator="random")
        >>> len(track.positions), track.properties["navigator"], track.properties["steps"]
        (4, 'random', 3)
    """
    measures = {key: value.tolist() for key, value in episode_measures(rollout).items() if key in MEASURES}
    if len(names) != len(rollout):
        raise ValueError(f"names must hold one name for each of {len(rollout)} episodes, got {len(names)}")
    starts, targets = (rollout[f"{end}_position"][:, 0].tolist() for end in ("start", "target"))
    paths = rollout["next", "position"].tolist()
    return [
        Track(
            name,
            [tuple(position) for position in (start, *path[: measures["steps"][row]])],
            {**properties, **{key: values[row] for key, values in measures.items()}},
            (targets[row][0], targets[row][1]),
        )
        for row, (name, start, path) in enumerate(zip(names, starts, paths, strict=True))
    ]


def to_geojson(tracks: Sequence[Track]) -> str:
    """Return a feature for each track, with its properties (RFC 7946: longitude before latitude, WGS84).

    Raises:
        ValueError: for a track of fewer than two positions, or a position out of range.

    Example:
        >>> feature = json.loads(to_geojson([Track("east", [(0, 179), (0, -179)], {})]))["features"][0]
        >>> feature["geometry"]["coordinates"]
        [[[179.0, 0.0], [180.0, 0.0]], [[-180.0, 0.0], [-179.0, 0.0]]]
    """
    features = []
    for track in tracks:
        properties = {"name": track.name, **json_ready(track.properties)}
        features.append({"type": "Feature", "geometry": _geometry(track), "properties": properties})
    text = json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False)
    return text.replace("<", "\\u003c") + "\n"  # no text can end a script element that holds the data


def _geometry(track: Track) -> dict[str, Any]:
    lines = [[[longitude, latitude] for latitude, longitude in line] for line in cut(track.positions)]
    kind, coordinates = ("LineString", lines[0]) if len(lines) == 1 else ("MultiLineString", lines)
    return {"type": kind, "coordinates": coordinates}


def to_gpx(tracks: Sequence[Track]) -> str:
    """Return a GPX 1.1 document with one track for each episode.

    Raises:
        ValueError: for a track of fewer than two positions, or a position out of range.

    Example:
        >>> print(to_gpx([Track("home", [(-2, 162), (-2.4, 162.1)], {"steps": 1})]).splitlines()[7].strip())
        <trkpt lat="-2.400000000" lon="162.100000000" />
    """
    texts = [(_tag("name", track.name), _tag("desc", _description(track))) for track in tracks]
    segments = (_tag("trkseg", *map(_track_point, _checked(track.positions))) for track in tracks)
    lines = [_tag("trk", *text, segment) for text, segment in zip(texts, segments, strict=True)]
    return _xml(_tag("gpx", *lines, version="1.1", creator="magrl", xmlns="http://www.topografix.com/GPX/1/1"))


def _track_point(position: Position) -> Element:
    """Return a point of a GPX track, whose longitudes are below 180."""
    latitude, longitude = position
    return _tag("trkpt", lat=_number(latitude), lon=_number(-180.0 if longitude == 180 else longitude))


def to_kml(tracks: Sequence[Track]) -> str:
    """Return a KML 2.2 document: a folder for each navigator, and a placemark for each track, clamped to the ground.

    Tracks of one navigator (their properties ``navigator`` and ``run``) have its color. A last folder holds a placemark
    at the start of each task and, where a track has a target, at its destination.

    Raises:
        ValueError: for a track of fewer than two positions, or a position out of range.

    Example:
        >>> text = to_kml([Track("home", [(-2, 162), (-2.5, 162.5)], {"steps": 1})])
        >>> "162.000000000,-2.000000000,0 162.500000000,-2.500000000,0" in text
        True
    """
    groups: dict[tuple[str, int], list[Track]] = {}
    for track in tracks:
        key = str(track.properties.get("navigator", "")), track.properties.get("run", 0)
        groups.setdefault(key, []).append(track)
    names = [name for name, _ in groups]
    styles = [_tag("Style", _tag("IconStyle", _color(color)), id=end) for end, color in _ENDS.items()]
    parts = list[Element]()
    for number, ((name, run), group) in enumerate(groups.items()):
        color = NAVIGATOR_COLORS.get(parse_navigator(name).name, "#000000")
        styles.append(_tag("Style", _tag("LineStyle", _color(color), _tag("width", "2")), id=f"track{number}"))
        lines = [_line_placemark(track, f"#track{number}") for track in group]
        label = f"{name}, run {run}" if names.count(name) > 1 else name
        parts += [_tag("Folder", _tag("name", label), *lines)] if name else lines
    tasks = dict.fromkeys((track.name, track.positions[0], track.target) for track in tracks if track.target)
    if tasks:
        ends = [placemark for task in tasks for placemark in _end_placemarks(*task)]
        parts.append(_tag("Folder", _tag("name", "starts and destinations"), *ends))
    # All styles stand before the first folder.
    return _xml(_tag("kml", _tag("Document", *styles, *parts), xmlns="http://www.opengis.net/kml/2.2"))


_ENDS = {"start": START, "destination": TARGET}
"""Colors of the ends of tasks."""


def _color(color: str) -> Element:
    """Return a color, which KML writes as opacity, blue, green, red."""
    return _tag("color", f"ff{color[5:7]}{color[3:5]}{color[1:3]}".lower())


def _line_placemark(track: Track, style: str) -> Element:
    texts = _tag("name", track.name), _tag("description", _description(track)), _tag("styleUrl", style)
    lines = [_tag("LineString", _tag("tessellate", "1"), _coordinates(line)) for line in cut(track.positions)]
    return _tag("Placemark", *texts, _tag("MultiGeometry", *lines))


def _end_placemarks(name: str, *places: Position) -> list[Element]:
    """Return the placemarks of start and destination of a task."""
    points = [_tag("Point", _coordinates([place])) for place in _checked(places)]
    texts = [(_tag("name", f"{name}: {end}"), _tag("styleUrl", f"#{end}")) for end in _ENDS]
    return [_tag("Placemark", *text, point) for text, point in zip(texts, points, strict=True)]


WRITERS: dict[str, Callable[[Sequence[Track]], str]] = {".geojson": to_geojson, ".gpx": to_gpx, ".kml": to_kml}
"""Writers by the suffix of the file."""


def check_suffix(path: Path | str) -> str:
    """Return the suffix of a file of tracks, in lower case.

    Raises:
        ValueError: for a suffix that is not one of :data:`WRITERS`.

    Example:
        >>> check_suffix("tracks.GPX")
        '.gpx'
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise ValueError(f"a file of tracks must end in one of {', '.join(WRITERS)}, got {str(path)!r}")
    return suffix


def write_tracks(path: Path | str, tracks: Sequence[Track]) -> None:
    """Write tracks in the format given by the suffix of the file; missing folders are created.

    Raises:
        ValueError: for a suffix that is not one of :data:`WRITERS`, or a track that cannot be drawn.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "tracks.geojson"
        >>> write_tracks(path, [Track("home", [(-2, 162), (-2.4, 162.1)], {"steps": 1})])
        >>> json.loads(path.read_text())["features"][0]["properties"]
        {'name': 'home', 'steps': 1}
    """
    text = WRITERS[check_suffix(path)](tracks)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text, encoding="utf-8")


def cut(positions: Sequence[Position]) -> list[list[Position]]:
    """Cut a line into pieces that do not cross the antimeridian; each ends, and the next starts, on it.

    Args:
        positions: latitude, longitude [deg], longitudes from -180 to 180.

    Returns:
        One piece, plus one for each crossing. The latitude of a crossing lies on the straight line on the map.

    Raises:
        ValueError: for fewer than two positions, or a position out of range.

    Example:
        >>> cut([(0.0, 179.5), (1.0, -179.5)])
        [[(0.0, 179.5), (0.5, 180.0)], [(0.5, -180.0), (1.0, -179.5)]]
    """
    points = _checked(positions)
    lines = [[_beside(points[0], points[1])]]
    for point in points[1:]:
        latitude, longitude = lines[-1][-1]
        after = _beside(point, (latitude, longitude))
        if abs(after[1] - longitude) > 180:
            side, left = math.copysign(180.0, longitude), 180 - abs(longitude)
            crossing = latitude + (after[0] - latitude) * left / (left + 180 - abs(after[1]))
            if left:
                lines[-1].append((crossing, side))
            lines.append([(crossing, -side)])
        lines[-1].append(after)
    return lines


def _beside(point: Position, other: Position) -> Position:
    """Return a point on the antimeridian with the sign of another one, so that no cut is made between them."""
    return (point[0], math.copysign(180.0, other[1])) if abs(point[1]) == 180 else point


def _checked(positions: Sequence[Position]) -> list[Position]:
    """Return at least two valid positions as floats."""
    if len(positions) < 2:
        raise ValueError(f"a line must have at least two positions, got {list(positions)}")
    for latitude, longitude in positions:
        check_number(-90, 90, latitude=latitude)
        check_number(-180, 180, longitude=longitude)
    return [(float(latitude), float(longitude)) for latitude, longitude in positions]


def _number(value: float) -> str:
    """Return degrees to a tenth of a millimeter, without the exponent that GPX does not allow."""
    return f"{value:.9f}"


def _description(track: Track) -> str:
    """Return the properties in one line."""
    pairs = ((key, f"{x:.3f}" if isinstance(x, float) else x) for key, x in track.properties.items())
    return ", ".join(f"{key} {value}" for key, value in pairs)


def _coordinates(positions: Sequence[Position]) -> Element:
    places = (f"{_number(longitude)},{_number(latitude)},0" for latitude, longitude in positions)
    return _tag("coordinates", " ".join(places))


def _tag(name: str, *content: Element | str, **attributes: str) -> Element:
    """Return an element; characters that XML does not allow in its text become question marks."""
    element = Element(name, attributes)
    for part in content:
        if isinstance(part, str):
            element.text = re.sub(r"[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "?", part)
        else:
            element.append(part)
    return element


def _xml(root: Element) -> str:
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"
