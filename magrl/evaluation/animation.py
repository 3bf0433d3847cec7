"""Animation of one episode on the globe: its track, and where its filter estimates the destination to be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number, check_tensor, check_type
from magrl.envs import Region, Regions
from magrl.envs.regions import one_region
from magrl.envs.rendering import PATH
from magrl.evaluation.flight import ESTIMATE, draw_legend, estimates, flight_map
from magrl.evaluation.replay import PIECES, episode_tracks, save_gif
from magrl.field import FieldModel
from magrl.geodesy import geodesic, move

FRAME_MS, GIF_COLORS = 150, 256
SHOWN = 1.3
"""Distance of an estimate, over that of the task, up to which the map holds it."""
_DRAWN = PIECES // 2  # a frame at every second piece of a move


def way_ellipse(position: Tensor, way: Tensor, covariance: Tensor, deviations: float = 2.0, points: int = 49) -> Tensor:
    """Return the ellipse of the estimated destination of a vehicle, as a closed line on the globe.

    Args:
        position: ``(2,)`` latitude, longitude of the vehicle [deg].
        way: ``(2,)`` estimated way to the destination, northward and eastward [km].
        covariance: ``(2, 2)`` its covariance [km^2].
        deviations: size of the ellipse in standard deviations.
        points: number of points.

    Returns:
        ``(points, 2)`` latitude, longitude [deg], float64.

    Raises:
        ValueError: for a size that is not above 0, or fewer than two points.

    Example:
        >>> pole = torch.zeros(2)  # a degree is 111 km there
        >>> way_ellipse(pole, torch.zeros(2), 111.2**2 * torch.eye(2), deviations=1, points=5).round(decimals=1).abs()
        tensor([[1., 0.],
                [0., 1.],
                [1., 0.],
                [0., 1.],
                [1., 0.]], dtype=torch.float64)
    """
    check_tensor(2, position=position, way=way)
    check_tensor(2, 2, covariance=covariance)
    check_number(0, above=True, deviations=deviations)
    check_number(2, whole=True, points=points)
    angle = torch.linspace(0, 2 * math.pi, points, dtype=torch.float64, device=way.device)
    values, axes = torch.linalg.eigh(covariance.double())
    circle = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    ends = way.double() + deviations * (circle * values.clamp_min(0).sqrt()) @ axes.mT
    return _moved(position, ends)


def write_flight_gif(
    path: Path | str,
    rollout: TensorDictBase,
    field: FieldModel,
    region: Region | Regions,
    title: str = "",
    *,
    width_px: int = 720,
) -> None:
    """Write the flight of a vehicle as an animated GIF: its track and its estimate of the destination.

    Args:
        path: path of the image; an existing file is replaced.
        rollout: ``(1, T)`` of one vehicle, until its episode ends, with the keys ``way`` ``(..., 2)`` [km] northward
            and eastward and ``way_covariance`` ``(..., 2, 2)`` [km^2] (:class:`~magrl.transforms.TrackGradient`).
        field: any model of :mod:`magrl.field`.
        region: region of the episode.
        title: title of the map.
        width_px: width [pixels].

    Raises:
        KeyError: for a rollout without these keys.
        ValueError: for more than one vehicle, or a width below 1.

    Example:
        >>> import tempfile
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import TrackGradient
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=1, seed=0), TrackGradient(range_km=1000.0))
        >>> path = Path(tempfile.mkdtemp()) / "flight.gif"
        >>> write_flight_gif(path, env.rollout(1), env.base_env.field, env.base_env.region, width_px=200)
        >>> path.read_bytes()[:3]
        b'GIF'
    """
    check_type((Path, str), path=path)
    check_type(TensorDictBase, rollout=rollout)
    check_number(1, whole=True, width_px=width_px)
    missing = {"way", "way_covariance"} - set(rollout.keys())
    if missing:
        raise KeyError(f"a flight must be flown with TrackGradient to be animated; the rollout lacks {sorted(missing)}")
    save_gif(path, list(_frames(rollout, field, region, title, width_px)), FRAME_MS, GIF_COLORS)


def _frames(
    rollout: TensorDictBase, field: FieldModel, region: Region | Regions, title: str, width_px: int
) -> Iterator[Image.Image]:
    """Yield the frames; the estimate is that at the last reading."""
    states, region = rollout[0].cpu(), one_region(region)
    distance = geodesic(*states["start_position"][0], *states["target_position"][0])[0].item()
    figure, _ = flight_map(rollout, field, region, title, estimates(states, SHOWN * distance))
    track = episode_tracks(rollout, region)[0].numpy()
    figure.set_dpi((width_px + 0.01) / figure.get_figwidth())
    canvas, axes = FigureCanvasAgg(figure), figure.axes[0]
    ellipse = axes.plot([], [], color=ESTIMATE, lw=1.5, label="destination, estimated: 2 standard deviations")[0]
    guess = axes.plot([], [], "x", color=ESTIMATE, ms=8, mew=2.5)[0]
    line = axes.plot([], [], color=PATH, lw=2.5, marker="o", ms=6, markevery=[-1], label="track")[0]
    draw_legend(figure)
    canvas.draw()
    figure.set_layout_engine("none")  # a fixed layout in all frames
    for piece in range(0, len(track), _DRAWN):
        state = states[piece // PIECES] if piece < len(track) - 1 else states["next"][-1]
        position, way, covariance = (state[key].double() for key in ("position", "way", "way_covariance"))
        line.set_data(*track[: piece + 1].T[::-1])
        guess.set_data(*region.unwrapped(_moved(position, way[None])).T.flip(0).numpy())
        ellipse.set_data(*_unbroken(region.unwrapped(way_ellipse(position, way, covariance)).numpy()).T[::-1])
        canvas.draw()
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def _moved(position: Tensor, ways: Tensor) -> Tensor:
    """Return where ways ``(P, 2)`` northward and eastward [km] lead from a position: ``(P, 2)`` [deg]."""
    latitude, longitude = position.double()
    return torch.stack(move(latitude, longitude, torch.atan2(*ways.double().T.flip(0)), ways.double().norm(dim=-1)), -1)


def _unbroken(line: np.ndarray) -> np.ndarray:
    """Return a line ``(P, 2)`` with a gap where it crosses the edge of the map."""
    jumps = np.flatnonzero(np.abs(np.diff(line[:, 1])) > 180)
    return np.insert(line, jumps + 1, np.nan, axis=0)
