"""Figure of one episode on the globe: its track over coastlines and contours of the field.

The coastlines are those of Natural Earth 4.1.0, physical vectors "Land" at 1:50 million, which are in the public domain
(https://www.naturalearthdata.com). They were taken from ``land-50m.json`` of the npm package world-atlas 2.0.2, cut at
the antimeridian, simplified to 0.04 degree (Douglas and Peucker), and rounded to 0.01 degree; islands smaller than 0.2
degree are left out.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number, check_tensor, check_type
from magrl.envs import Region, Regions
from magrl.envs.regions import one_region
from magrl.envs.rendering import PATH, START, TARGET, draw_contours
from magrl.field import FieldModel
from magrl.geodesy import geodesic, move

_LAND = "#8c6d46"
ESTIMATE = "#56B4E9"
"""Color of estimates of the destination."""


@cache
def coastlines() -> np.ndarray:
    """Return the coastlines of the Earth.

    Returns:
        ``(P, 2)`` latitude, longitude [deg], float64: lines that do not cross the antimeridian, with NaN between them.

    Example:
        >>> np.nanmin(coastlines(), axis=0), np.nanmax(coastlines(), axis=0)
        (array([ -85.19, -180.  ]), array([  83.6, 180. ]))
    """
    with np.load(Path(__file__).parent / "coastlines.npz") as file:
        points, lengths = file["points"] / 100, file["lengths"]
    return np.insert(points, np.cumsum(lengths)[:-1], np.nan, axis=0)


def shortest_path(start: Tensor, target: Tensor, points: int = 41) -> Tensor:
    """Return points of the geodesic between two places, both ends included.

    Args:
        start: ``(2,)`` latitude, longitude [deg].
        target: ``(2,)`` latitude, longitude [deg].
        points: number of points.

    Returns:
        ``(points, 2)`` [deg], float64.

    Raises:
        ValueError: for fewer than two points.

    Example:
        >>> shortest_path(torch.tensor([50.0, 0.0]), torch.tensor([50.0, 90.0]), points=3)[1].round(decimals=2)
        tensor([59.3400, 45.0000], dtype=torch.float64)
    """
    check_tensor(2, start=start, target=target)
    check_number(2, whole=True, points=points)
    path, target = [start.double()], target.double()
    for left in range(points - 1, 1, -1):
        distance, bearing = geodesic(*path[-1], *target)
        path.append(torch.stack(move(path[-1][0], path[-1][1], bearing, distance / left)))
    return torch.stack((*path, target))


def frame(positions: Tensor) -> Region:
    """Return the box of a map that shows some positions with room around them, neither very flat nor very narrow.

    Args:
        positions: ``(P, 2)`` latitude, longitude [deg], unwrapped.

    Example:
        >>> frame(torch.tensor([[0.0, 10.0], [0.0, 20.0]]))
        Region(latitude=(-3.5, 3.5), longitude=(8.5, 21.5))
    """
    check_tensor(2, positions=positions)
    low, high = positions.amin(0), positions.amax(0)
    (north, east), (half_north, half_east) = ((high + low) / 2).tolist(), ((high - low) / 2).tolist()
    narrow = math.cos(math.radians(min(abs(north), 80.0)))
    least = 0.5 * max(half_north, half_east * narrow)
    half_north = 1.2 * max(half_north, least) + 0.5
    half_east = min(1.2 * max(half_east, least / narrow) + 0.5, 180.0)
    return Region((max(north - half_north, -88.0), min(north + half_north, 88.0)), (east - half_east, east + half_east))


def flight_figure(rollout: TensorDictBase, field: FieldModel, region: Region | Regions, title: str = "") -> Figure:
    """Return a map of an episode: track, shortest path, contours, coastlines, and where the destination was estimated.

    Args:
        rollout: ``(1, T)`` of one vehicle, until its episode ends; with the key ``way`` ``(..., 2)`` [km] northward and
            eastward (:class:`~magrl.transforms.TrackGradient`), the estimates of the destination are drawn too.
        field: any model of :mod:`magrl.field`.
        region: region of the episode.
        title: title of the figure.

    Raises:
        ValueError: for more than one vehicle.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=1, seed=0)
        >>> flight_figure(env.rollout(3), env.field, env.region).axes[0].get_ylabel()
        'latitude [° N]'
    """
    rollout = rollout.cpu()
    figure, path = flight_map(rollout, field, region, title)
    axes, states = figure.axes[0], rollout[0, 1:]
    if "way" in states.keys():  # noqa: SIM118 - a TensorDict is no mapping
        guesses = one_region(region).unwrapped(estimates(states, 5000.0))
        axes.plot(guesses[:, 1], guesses[:, 0], ".", color=ESTIMATE, ms=4, label="destination, estimated")
    axes.plot(path[:, 1], path[:, 0], "-", color=PATH, lw=2, marker=".", ms=4, label="track")
    draw_legend(figure)
    return figure


def flight_map(
    rollout: TensorDictBase, field: FieldModel, region: Region | Regions, title: str = "", shown: Tensor | None = None
) -> tuple[Figure, Tensor]:
    """Return the map of an episode without its track: contours, coastlines, shortest path, start and destination.

    Args:
        rollout: as in :func:`flight_figure`.
        field: any model of :mod:`magrl.field`.
        region: region of the episode.
        title: title of the figure.
        shown: ``(P, 2)`` positions that the map must hold beside the track and the shortest path [deg].

    Returns:
        The figure, and the positions of the vehicle ``(T + 1, 2)`` latitude, longitude [deg], unwrapped.

    Raises:
        ValueError: for more than one vehicle.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=1, seed=0)
        >>> flight_map(env.rollout(3), env.field, env.region)[1].shape
        torch.Size([4, 2])
    """
    check_type(TensorDictBase, rollout=rollout)
    if rollout.ndim != 2 or len(rollout) != 1:
        raise ValueError(f"a rollout must be of one vehicle, (1, T), got {tuple(rollout.shape)}")
    rollout, region = rollout.cpu(), one_region(region)
    start, target = rollout["start_position"][0, 0], rollout["target_position"][0, 0]
    path = region.unwrapped(torch.cat((start[None], rollout["next", "position"][0])))
    way, ends = region.unwrapped(shortest_path(start, target)), region.unwrapped(torch.stack((start, target)))
    box = frame(torch.cat((path, way, way[:0] if shown is None else region.unwrapped(shown))))
    width = (box.longitude[1] - box.longitude[0]) * math.cos(math.radians(sum(box.latitude) / 2))
    figure = Figure(figsize=(9, 1.6 + 8 * min((box.latitude[1] - box.latitude[0]) / width, 1.3)), layout="constrained")
    axes = figure.subplots()
    draw_contours(axes, field, box)
    for turn in (-360, 0, 360):
        axes.plot(coastlines()[:, 1] + turn, coastlines()[:, 0], color=_LAND, lw=1)
    axes.plot(way[:, 1], way[:, 0], "--", color=PATH, lw=1, label="shortest path")
    axes.plot(ends[0, 1], ends[0, 0], "s", color=START, ms=8, zorder=3, label="start")
    axes.plot(ends[1, 1], ends[1, 0], "^", color=TARGET, ms=9, zorder=3, label="destination")
    axes.set(xlim=box.longitude, ylim=box.latitude, title=title)
    axes.xaxis.set_major_formatter(lambda degrees, _: f"{math.remainder(degrees, 360):g}")
    return figure, path


def draw_legend(figure: Figure) -> None:
    """Draw the legend of a map below it.

    Example:
        >>> figure = Figure(layout="constrained")
        >>> draw_legend(figure.subplots().plot([0, 1], label="track")[0].figure)
        >>> len(figure.legends)
        1
    """
    labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(*labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)


def estimates(states: TensorDictBase, farthest_km: float) -> Tensor:
    """Return where a vehicle estimated its destination to be.

    Args:
        states: ``(T,)`` of one vehicle, with ``position`` and ``way``.
        farthest_km: distance from the vehicle beyond which an estimate is left out [km].

    Returns:
        ``(P, 2)`` latitude, longitude [deg], P at most T.

    Example:
        >>> from tensordict import TensorDict
        >>> ways = torch.tensor([[111.2, 0.0], [9000.0, 0.0]])
        >>> states = TensorDict(position=torch.zeros(2, 2), way=ways, batch_size=[2])
        >>> estimates(states, 5000.0).round(decimals=1)
        tensor([[1., 0.]], dtype=torch.float64)
    """
    (north, east), (latitude, longitude) = (states[key].double().unbind(-1) for key in ("way", "position"))
    distance = torch.hypot(north, east)
    places = torch.stack(move(latitude, longitude, torch.atan2(east, north), distance), -1)
    return places[distance < farthest_km]
