"""Replay of episodes: a web page in a single file without dependencies.

The page is ``templates/replay.html`` with the data embedded as JSON, escaped so that no name can inject markup.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number
from magrl.envs.regions import Region, Regions, one_region
from magrl.envs.rendering import contour_lines
from magrl.evaluation.metrics import episode_measures, moved
from magrl.field.model import FieldModel
from magrl.geodesy import geodesic, move

PIECES = 4
"""Pieces in which a move is drawn, since a geodesic is not a straight line on the map."""

PLACEHOLDER = "{{replay-data}}"
_SEEN = ("position", "field", "objective", "heading", "move")


def replay_data(
    rollouts: Mapping[str, TensorDictBase],
    field: FieldModel,
    region: Region | Regions,
    *,
    zeta: float,
    title: str = "",
    names: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the data of the page, as lists and numbers.

    Args:
        rollouts: by label of the navigator, ``(M, T)`` from the environment, each over the same tasks.
        field: field model of the environment.
        region: region of the tasks; the map is extended to hold all tracks.
        zeta: arrival threshold on the objective.
        title: title of the page.
        names: names of the tasks; numbers without any.

    Returns:
        ``title``, ``zeta``, ``pieces``, ``region``, ``contours`` of each element, ``tasks`` and ``navigators``. Each
        navigator has an episode for each task: its values at every step, start first, and its measures. Latitudes,
        unwrapped longitudes and all angles in degrees, lengths in km, intensities in nT.

    Raises:
        ValueError: for no rollout, a rollout of other tasks than the first, another number of names than of tasks, or a
            threshold out of its range.

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> data = replay_data({"random": env.rollout(3)}, env.field, env.region, zeta=env.zeta)
        >>> len(data["navigators"][0]["episodes"])
        2
    """
    check_number(0, above=True, zeta=zeta)
    if not rollouts:
        raise ValueError("rollouts must hold at least one rollout, got {}")
    region, first = one_region(region), next(iter(rollouts.values()))
    names = [*names] or [str(number) for number in range(1, len(first) + 1)]
    if len(names) != len(first):
        raise ValueError(f"names must hold one name for each of {len(first)} tasks, got {names}")
    for name, rollout in rollouts.items():
        if any(not torch.equal(rollout[key][:, 0], first[key][:, 0]) for key in ("start_position", "target_position")):
            raise ValueError(f"the rollout {name!r} is of other tasks than {next(iter(rollouts))!r}")
    tracks = {name: episode_tracks(rollout, region) for name, rollout in rollouts.items()}
    target = region.unwrapped(first["target_position"][:, 0])
    shown = region.holding(torch.cat([target.cpu(), *(track for group in tracks.values() for track in group)]))
    return {
        "title": title,
        "zeta": zeta,
        "pieces": PIECES,
        "region": {"latitude": shown.latitude, "longitude": shown.longitude},
        "contours": _contours(field, shown),
        "tasks": [{"name": name, **task} for name, task in zip(names, _tasks(first, region), strict=True)],
        "navigators": [
            {"label": name, "episodes": _episodes(rollout, tracks[name])} for name, rollout in rollouts.items()
        ],
    }


def episode_tracks(rollout: TensorDictBase, region: Region | Regions) -> list[Tensor]:
    """Return the track of the first episode of each vehicle, each move in :data:`PIECES` pieces of its geodesic.

    Args:
        rollout: ``(M, T)`` from the environment.
        region: region of the tasks.

    Returns:
        ``M`` tensors ``(PIECES * steps + 1, 2)``, latitude and unwrapped longitude [deg]; every ``PIECES``-th is a
        way-point.

    Raises:
        ValueError: for a rollout of other dimensions.

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(seed=0)
        >>> track, = episode_tracks(env.rollout(3), env.region)
        >>> len(track) == 3 * PIECES + 1
        True
    """
    rollout, region = rollout.cpu(), one_region(region)
    steps = episode_measures(rollout)["steps"].tolist()
    latitude, longitude = rollout["position"].unsqueeze(-2).unbind(-1)
    share = torch.arange(PIECES, dtype=torch.float64) / PIECES
    distance, heading = (part.unsqueeze(-1) for part in moved(rollout["next"]))
    legs = torch.stack(move(latitude, longitude, heading, distance * share), -1)
    legs[..., 0, :] = rollout["position"]
    rows = zip(legs, rollout["next", "position"], steps, strict=True)
    return [
        region.unwrapped(torch.cat((leg[:count].flatten(0, 1), after[count - 1 : count]))) for leg, after, count in rows
    ]


def _rounded(values: Tensor, digits: int) -> Any:
    return np.round(values.double().cpu().numpy(), digits).tolist()


def _contours(field: FieldModel, region: Region) -> dict[str, list[dict[str, Any]]]:
    """Return the lines of each element: their level and their points, longitude first [deg]."""
    return {
        name: [
            {"level": round(float(level), 6), "line": np.round(line, 3).tolist()}
            for level, lines in zip(contours.levels, contours.allsegs, strict=True)
            for line in lines
            if len(line) > 1
        ]
        for name, contours in contour_lines(Figure().subplots(), field, region).items()
    }


def _tasks(rollout: TensorDictBase, region: Region) -> list[dict[str, Any]]:
    """Return start, target and the elements at the target of each task."""
    start, target = (region.unwrapped(rollout[f"{end}_position"][:, 0]) for end in ("start", "target"))
    columns = (_rounded(start, 5), _rounded(target, 5), _rounded(rollout["target_field"][:, 0], 4))
    return [dict(zip(("start", "target", "field"), row, strict=True)) for row in zip(*columns, strict=True)]


def _episodes(rollout: TensorDictBase, tracks: list[Tensor]) -> list[dict[str, Any]]:
    """Return the data of the episodes of a navigator."""
    measures = episode_measures(rollout)
    rows = [dict(zip(measures, row, strict=True)) for row in zip(*(m.tolist() for m in measures.values()), strict=True)]
    return [_episode(*parts) for parts in zip(rollout.cpu(), tracks, rows, strict=True)]


def _episode(row: TensorDictBase, track: Tensor, measures: dict[str, Any]) -> dict[str, Any]:
    """Return the data of an episode ``(T,)``: its values at each step, start first, and its measures."""
    count = measures["steps"]
    seen = {key: torch.cat((row[key][:1], row["next", key][:count])) for key in _SEEN}
    left, _ = geodesic(*seen["position"].unbind(-1), *row["target_position"][0])
    end = row["next"][count - 1]
    declared = bool(end.get("declared", torch.tensor(False)))
    failure = "false arrival" if declared else "lost" if end["terminated"] else "out of steps"
    return {
        "track": _rounded(track, 5),
        "field": _rounded(seen["field"], 4),
        "objective": [float(f"{value:.4g}") for value in seen["objective"].flatten().tolist()],
        "heading_deg": _rounded(seen["heading"].squeeze(-1).rad2deg() % 360, 2),
        "move_km": _rounded(seen["move"][:, 0], 4),
        "turn_deg": _rounded(seen["move"][:, 1].rad2deg(), 2),
        "path_km": _rounded(seen["move"][:, 0].double().cumsum(0), 4),
        "distance_km": _rounded(left, 4),
        "outcome": "arrived" if measures["success"] else failure,
        "steps": count,
        **{key: round(measures[key], 4) for key in ("shortest_km", "length_km", "navigation_error_km", "spl")},
    }


def write_replay(path: Path | str, data: Mapping[str, Any]) -> None:
    """Write the page: one file that opens from disk and makes no network requests.

    Args:
        path: path of the page; an existing file is replaced.
        data: from :func:`replay_data`.

    Raises:
        KeyError: for missing keys, naming them.
        ValueError: for non-finite values.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "replay.html"
        >>> write_replay(path, {"title": "none", "contours": {}, "tasks": [], "navigators": []})
        >>> path.read_text()[:15]
        '<!doctype html>'
    """
    missing = {"title", "contours", "tasks", "navigators"} - data.keys()
    if missing:
        raise KeyError(f"data must come from replay_data; it lacks {', '.join(sorted(missing))}")
    template = files("magrl.evaluation").joinpath("templates/replay.html").read_text(encoding="utf-8")
    # Without "<", no text can end the script element that holds the data.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    Path(path).write_text(template.replace(PLACEHOLDER, text), encoding="utf-8")
