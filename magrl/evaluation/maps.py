"""Maps of episodes over contours of the field.

The coastlines are from Natural Earth 4.1.0, physical vectors "Land" at 1:50 million, which are in the public domain
(https://www.naturalearthdata.com). They were taken from ``land-50m.json`` of the npm package world-atlas 2.0.2, cut at
the antimeridian, simplified to 0.04 degree (Douglas and Peucker), and rounded to 0.01 degree; islands smaller than 0.2
degree are left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number, library
from magrl.envs import Region, Regions
from magrl.envs.regions import one_region
from magrl.envs.rendering import PATH, START, TARGET, draw_contours
from magrl.evaluation.episodes import episode_measures
from magrl.field import FieldModel
from magrl.geodesy import geodesic, move, polar

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LAND, ESTIMATE = "#8c6d46", "#56B4E9"
"""Colors of coastlines, and of estimates of the destination."""
DISPLACEMENT = ("track", "displacement")
"""Key of the estimated displacement of a :class:`~magrl.transforms.TrackField`."""


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
    """Return points of geodesics, both ends included.

    Args:
        start: ``(..., 2)`` latitude, longitude [deg].
        target: ``(..., 2)`` latitude, longitude [deg].
        points: number of points.

    Returns:
        ``(..., points, 2)`` [deg], float64.

    Raises:
        ValueError: for fewer than two points.

    Example:
        >>> shortest_path(torch.tensor([50.0, 0.0]), torch.tensor([50.0, 90.0]), points=3)[1].round(decimals=2)
        tensor([59.3400, 45.0000], dtype=torch.float64)
    """
    check_number(2, whole=True, points=points)
    path, target = [start.double()], target.double()
    for left in range(points - 1, 1, -1):
        latitude, longitude = path[-1].unbind(-1)
        distance, bearing = geodesic(latitude, longitude, *target.unbind(-1))
        path.append(torch.stack(move(latitude, longitude, bearing, distance / left), -1))
    return torch.stack((*path, target), -2)


def frame(positions: Tensor) -> Region:
    """Return the box of a map that shows some positions with room around them, neither very flat nor very narrow.

    Args:
        positions: ``(P, 2)`` latitude, longitude [deg], unwrapped.

    Example:
        >>> frame(torch.tensor([[0.0, 10.0], [0.0, 20.0]]))
        Region(latitude=(-3.5, 3.5), longitude=(8.5, 21.5))
    """
    low, high = positions.amin(0), positions.amax(0)
    (north, east), (half_north, half_east) = ((high + low) / 2).tolist(), ((high - low) / 2).tolist()
    narrow = math.cos(math.radians(min(abs(north), 80.0)))
    least = 0.5 * max(half_north, half_east * narrow)
    half_north = 1.2 * max(half_north, least) + 0.5
    half_east = min(1.2 * max(half_east, least / narrow) + 0.5, 180.0)
    return Region((max(north - half_north, -88.0), min(north + half_north, 88.0)), (east - half_east, east + half_east))


def episode_tracks(rollout: TensorDictBase, region: Region | Regions) -> list[Tensor]:
    """Return the track of the first episode of each vehicle.

    Args:
        rollout: ``(M, T)`` in one region.
        region: region that gives the branch of the longitudes.

    Returns:
        ``M`` tensors ``(steps + 1, 2)``, latitude and unwrapped longitude [deg].

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(seed=0, max_steps=3)
        >>> (track,) = episode_tracks(env.rollout(3), env.region)
        >>> len(track)
        4
    """
    rollout, region = rollout.cpu(), one_region(region)
    steps = episode_measures(rollout)["steps"].tolist()
    rows = zip(rollout["position"], rollout["next", "position"], steps, strict=True)
    return [region.unwrapped(torch.cat((before[:1], after[:count]))) for before, after, count in rows]


def trajectories_figure(
    rollouts: TensorDictBase | Mapping[str, TensorDictBase],
    field: FieldModel,
    region: Region | Regions,
    episodes: int = 24,
    names: Sequence[str] = (),
) -> Figure:
    """Return maps of the first episodes of one or several navigators, beside each other.

    A map has the tracks, the shortest paths, contours of the field and coastlines; for an episode with a track
    (:class:`~magrl.transforms.TrackField`) also where its destination was estimated.

    Args:
        rollouts: ``(M, T)`` from the environment, or several of them by title.
        field: any model of :mod:`magrl.field`.
        region: region of the trips.
        episodes: number of episodes to show.
        names: names of the trips, which are written at their destinations.

    Raises:
        ValueError: for no rollout or no episode.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> [axes.get_title() for axes in trajectories_figure({"random": env.rollout(3)}, env.field, env.region).axes]
        ['random']
    """
    check_number(1, whole=True, episodes=episodes)
    region = one_region(region)
    titled = {"": rollouts} if isinstance(rollouts, TensorDictBase) else rollouts
    if not titled:
        raise ValueError("rollouts must hold the episodes of at least one navigator, got {}")
    columns, rows = min(len(titled), 3), math.ceil(len(titled) / 3)
    figure = library("matplotlib.figure", "plots").Figure(layout="constrained")
    for place, (title, rollout) in enumerate(titled.items(), 1):
        axes, shown = figure.add_subplot(rows, columns, place, title=title), rollout[:episodes].cpu()
        tracks, height = _draw_map(axes, shown, field, region)
        figure.set_size_inches(8 * columns, max(figure.get_figheight(), height * rows))
        for track in tracks:
            axes.plot(track[:, 1], track[:, 0], "-", color=PATH, lw=1.5, marker=".", ms=4)
        axes.lines[-1].set_label("track")
        if shown.get(DISPLACEMENT, None) is not None:
            guesses = region.unwrapped(estimates(shown["next"].reshape(-1), 5000.0))
            axes.plot(guesses[:, 1], guesses[:, 0], ".", color=ESTIMATE, ms=4, label="destination, estimated")
        _write_names(axes, names, region.unwrapped(shown["target_position"][:, 0]))
    _draw_legend(figure)
    return figure


def _draw_map(axes: Axes, rollout: TensorDictBase, field: FieldModel, region: Region) -> tuple[list[Tensor], float]:
    """Draw a map of episodes without their tracks.

    Args:
        axes: axes to draw on.
        rollout: ``(M, T)`` from the environment.
        field: any model of :mod:`magrl.field`.
        region: region of the trips.

    Returns:
        The tracks (:func:`episode_tracks`), and the height of a figure of 8 inches.
    """
    tracks, ends = episode_tracks(rollout, region), [rollout[f"{end}_position"][:, 0] for end in ("start", "target")]
    shortest = region.unwrapped(shortest_path(*ends))
    box = frame(torch.cat([*tracks, *shortest]))
    draw_contours(axes, field, box)
    for turn in (-360, 0, 360):
        axes.plot(coastlines()[:, 1] + turn, coastlines()[:, 0], color=LAND, lw=1)
    for path in shortest:
        axes.plot(path[:, 1], path[:, 0], "--", color=PATH, lw=1)
    axes.lines[-1].set_label("shortest path")
    (south, west), (north, east) = (region.unwrapped(end).T for end in ends)
    axes.plot(west, south, "s", color=START, ms=7, zorder=3, label="start")
    axes.plot(east, north, "^", color=TARGET, ms=8, zorder=3, label="destination")
    axes.set(xlim=box.longitude, ylim=box.latitude)
    axes.xaxis.set_major_formatter(lambda degrees, _: f"{math.remainder(degrees, 360):g}")
    width = (box.longitude[1] - box.longitude[0]) * math.cos(math.radians(sum(box.latitude) / 2))
    return tracks, 1.6 + 7 * min((box.latitude[1] - box.latitude[0]) / width, 1.3)


def _draw_legend(figure: Figure) -> None:
    labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(*labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)


def _write_names(axes: Axes, names: Sequence[str], places: Tensor) -> None:
    """Write names beside places ``(M, 2)``, toward the middle of a map."""
    for name, (latitude, longitude) in zip(names, places.tolist(), strict=False):
        east = longitude > sum(axes.get_xlim()) / 2
        side, shift = ("right", -8) if east else ("left", 8)
        text = axes.annotate(name, (longitude, latitude), (shift, 4), textcoords="offset points", parse_math=False)
        text.set(ha=side, fontsize=8, bbox={"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 1})


def estimates(states: TensorDictBase, farthest_km: float) -> Tensor:
    """Return where a vehicle estimated its destination to be.

    Args:
        states: ``(T,)`` of one vehicle, with ``position`` and a track.
        farthest_km: distance from the vehicle beyond which an estimate is left out [km].

    Returns:
        ``(P, 2)`` latitude, longitude [deg], P at most T.

    Example:
        >>> from tensordict import TensorDict
        >>> states = TensorDict(position=torch.zeros(2, 2), batch_size=[2])
        >>> states["track", "displacement", "mean"] = torch.tensor([[111.2, 0.0], [9000.0, 0.0]])
        >>> estimates(states, 5000.0).round(decimals=1)
        tensor([[1., 0.]], dtype=torch.float64)
    """
    displacement = states[DISPLACEMENT]["mean"]
    return _ends(states["position"], displacement)[displacement.norm(dim=-1) < farthest_km]


def _ends(position: Tensor, displacement: Tensor) -> Tensor:
    """Return where displacements ``(..., 2)`` northward and eastward [km] lead from positions ``(..., 2)`` [deg]."""
    distance, heading = polar(displacement.double())
    latitude, longitude = position.double().expand_as(displacement).unbind(-1)
    return torch.stack(move(latitude, longitude, heading, distance), -1)


def displacement_ellipse(
    position: Tensor, displacement: Tensor, covariance: Tensor, deviations: float = 2.0, points: int = 49
) -> Tensor:
    """Return the ellipse of the estimated destination of a vehicle, as a closed line on the globe.

    Args:
        position: ``(2,)`` latitude, longitude of the vehicle [deg].
        displacement: ``(2,)`` estimated displacement to the destination, northward and eastward [km].
        covariance: ``(2, 2)`` its covariance [km^2].
        deviations: size of the ellipse in standard deviations.
        points: number of points.

    Returns:
        ``(points, 2)`` latitude, longitude [deg], float64.

    Example:
        >>> pole = torch.zeros(2)  # a degree is 111 km there
        >>> points = displacement_ellipse(pole, torch.zeros(2), 111.2**2 * torch.eye(2), deviations=1, points=5)
        >>> points.round(decimals=1).abs()
        tensor([[1., 0.],
                [0., 1.],
                [1., 0.],
                [0., 1.],
                [1., 0.]], dtype=torch.float64)
    """
    angle = torch.linspace(0, 2 * math.pi, points, dtype=torch.float64)
    values, axes = torch.linalg.eigh(covariance.double())
    circle = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    return _ends(position, displacement.double() + deviations * (circle * values.clamp_min(0).sqrt()) @ axes.mT)
