"""Export of episodes as tracks for maps: GeoJSON.

The vertices of a track are the waypoints of the vehicle, at most 50 km apart, so that straight lines on a map deviate
from the geodesics by some hundred meters at most. Lines are cut at the antimeridian, as RFC 7946 requires.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from magrl.evaluation.episodes import episode_measures
from magrl.files import json_ready, write_text

MEASURES = ("success", "steps", "shortest_km", "length_km", "navigation_error_km", "spl")
"""Measures among the properties of each track."""

Position = Sequence[float]
"""Latitude, longitude [deg]."""


Feature = dict[str, Any]
"""Path of an episode as a feature of GeoJSON."""


def tracks(rollout: TensorDictBase, names: Sequence[str], **properties: Any) -> list[Feature]:
    """Return the track of the first episode of each vehicle, with its name and measures among its properties.

    Args:
        rollout: ``(M, T)`` from ``env.rollout``, with the keys of :class:`magrl.envs.GeomagneticNavEnv`.
        names: names of the ``M`` episodes.
        properties: properties of every track, beside its measures.

    Raises:
        ValueError: for another number of names than of episodes.

    Example:
        >>> from magrl import GeomagneticNavEnv
        >>> track, = tracks(GeomagneticNavEnv(seed=0).rollout(3), ["home"], navigator="random")
        >>> len(track["geometry"]["coordinates"]), track["properties"]["navigator"], track["properties"]["steps"]
        (4, 'random', 3)
    """
    measures = {key: value.tolist() for key, value in episode_measures(rollout).items() if key in MEASURES}
    if len(names) != len(rollout):
        raise ValueError(f"names must hold one name for each of {len(rollout)} episodes, got {len(names)}")
    starts = rollout["start_position"][:, 0].tolist()
    paths = rollout["next", "position"].tolist()
    features = []
    for row, (name, start, path) in enumerate(zip(names, starts, paths, strict=True)):
        own = {"name": name, **properties, **{key: values[row] for key, values in measures.items()}}
        features.append(feature([start, *path[: own["steps"]]], own))
    return features


def feature(positions: Sequence[Position], properties: dict[str, Any]) -> Feature:
    """Return a track (RFC 7946: longitude before latitude, WGS84); NaN among its properties is null.

    Args:
        positions: latitude, longitude [deg] of each waypoint, start first.
        properties: numbers and texts by name.

    Example:
        >>> feature([(0, 179), (0, -179)], {})["geometry"]["coordinates"]
        [[[179, 0], [180.0, 0.0]], [[-180.0, 0.0], [-179, 0]]]
    """
    lines = [[[longitude, latitude] for latitude, longitude in line] for line in cut(positions)]
    kind, coordinates = ("LineString", lines[0]) if len(lines) == 1 else ("MultiLineString", lines)
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": json_ready(properties)}


def check_suffix(path: Path | str) -> None:
    """Raise a ValueError unless the name of a file of tracks ends in ``.geojson``, in any case.

    Example:
        >>> check_suffix("tracks.GeoJSON")
    """
    if Path(path).suffix.lower() != ".geojson":
        raise ValueError(f"a file of tracks must end in .geojson, got {str(path)!r}")


def write_tracks(path: Path | str, tracks: Sequence[Feature]) -> None:
    """Write tracks to a GeoJSON file; missing folders are created.

    Raises:
        ValueError: for another suffix than ``.geojson``.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "tracks.geojson"
        >>> write_tracks(path, [feature([(-2, 162), (-2.4, 162.1)], {"name": "home"})])
        >>> json.loads(path.read_text())["features"][0]["properties"]
        {'name': 'home'}
    """
    check_suffix(path)
    text = json.dumps({"type": "FeatureCollection", "features": tracks}, allow_nan=False)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_text(Path(path), text + "\n")


def cut(positions: Sequence[Position]) -> list[list[Position]]:
    """Cut a line into pieces that do not cross the antimeridian; each ends, and the next starts, on it.

    Args:
        positions: latitude, longitude [deg] of at least two places, longitudes from -180 to 180.

    Returns:
        One piece, plus one for each crossing. The latitude of a crossing lies on the straight line on the map.

    Example:
        >>> cut([(0.0, 179.5), (1.0, -179.5)])
        [[(0.0, 179.5), (0.5, 180.0)], [(0.5, -180.0), (1.0, -179.5)]]
    """
    lines = [[_beside(positions[0], positions[1])]]
    for point in positions[1:]:
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
