"""Export of episodes as tracks for maps: GeoJSON.

The vertices of a track are the way-points of the vehicle, at most 50 km apart, so that straight lines on a map deviate
from the geodesics by some hundred meters at most. Lines are cut at the antimeridian, as RFC 7946 requires.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tensordict import TensorDictBase

from magrl.checks import check_number
from magrl.evaluation.episodes import episode_measures
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

    Example:
        >>> Track("home", [(-2.0, 162.0), (-2.4, 162.1)], {"steps": 1}).positions[-1]
        (-2.4, 162.1)
    """

    name: str
    positions: Sequence[Position]
    properties: dict[str, Any]


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
    starts = rollout["start_position"][:, 0].tolist()
    paths = rollout["next", "position"].tolist()
    return [
        Track(
            name,
            [tuple(position) for position in (start, *path[: measures["steps"][row]])],
            {**properties, **{key: values[row] for key, values in measures.items()}},
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
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"


def _geometry(track: Track) -> dict[str, Any]:
    lines = [[[longitude, latitude] for latitude, longitude in line] for line in cut(track.positions)]
    kind, coordinates = ("LineString", lines[0]) if len(lines) == 1 else ("MultiLineString", lines)
    return {"type": kind, "coordinates": coordinates}


def check_suffix(path: Path | str) -> None:
    """Raise a ValueError unless the name of a file of tracks ends in ``.geojson``, in any case.

    Example:
        >>> check_suffix("tracks.GeoJSON")
    """
    if Path(path).suffix.lower() != ".geojson":
        raise ValueError(f"a file of tracks must end in .geojson, got {str(path)!r}")


def write_tracks(path: Path | str, tracks: Sequence[Track]) -> None:
    """Write tracks to a GeoJSON file; missing folders are created.

    Raises:
        ValueError: for another suffix than ``.geojson``, or a track that cannot be drawn.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "tracks.geojson"
        >>> write_tracks(path, [Track("home", [(-2, 162), (-2.4, 162.1)], {"steps": 1})])
        >>> json.loads(path.read_text())["features"][0]["properties"]
        {'name': 'home', 'steps': 1}
    """
    check_suffix(path)
    text = to_geojson(tracks)
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
