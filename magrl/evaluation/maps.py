"""Maps of episodes over the field's contours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tensordict import TensorDictBase

from magrl.checks import check_number, check_type
from magrl.envs.regions import Region, Regions, one_region
from magrl.envs.rendering import draw_tracks
from magrl.evaluation.metrics import first_episode_mask
from magrl.field.model import FieldModel


def flights_figure(
    rollouts: Mapping[str, TensorDictBase],
    field: FieldModel,
    region: Region | Regions,
    names: Sequence[str] = (),
    episodes: int = 24,
) -> Figure:
    """Return a map of the first episodes of each navigator, beside each other.

    Args:
        rollouts: by title, ``(M, T)`` from the environment.
        field: any model of :mod:`magrl.field`.
        region: region of the tasks.
        names: names of the tasks, which are written at their destinations.
        episodes: number of episodes to show.

    Raises:
        ValueError: for no rollout.

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> [axes.get_title() for axes in flights_figure({"random": env.rollout(3)}, env.field, env.region).axes]
        ['random']
    """
    check_number(1, whole=True, episodes=episodes)
    if not rollouts:
        raise ValueError("rollouts must hold the flights of at least one navigator, got {}")
    columns = min(len(rollouts), 3)
    rows = math.ceil(len(rollouts) / columns)
    figure = Figure(figsize=(6.4 * columns, 6.9 * rows), layout="constrained")
    places = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes, (title, rollout) in zip(places, rollouts.items(), strict=False):
        draw_episodes(axes, rollout, field, region, episodes, names)
        axes.set_title(title)
    for axes in places[len(rollouts) :]:
        axes.remove()
    return figure


def draw_episodes(
    axes: Axes,
    rollout: TensorDictBase,
    field: FieldModel,
    region: Region | Regions,
    episodes: int,
    names: Sequence[str],
) -> None:
    """Draw the first episodes of a rollout over the field's contours.

    Args:
        axes: axes to draw on.
        rollout: ``(M, T)`` from the environment.
        field: any model of :mod:`magrl.field`.
        region: region of the tasks.
        episodes: number of episodes to draw.
        names: names of the tasks, which are written at their destinations.

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env, axes = GeomagneticNavEnv(num_envs=2, seed=0), Figure().subplots()
        >>> draw_episodes(axes, env.rollout(3), env.field, env.region, 2, ["home", "port"])
        >>> [text.get_text() for text in axes.texts if text.get_text() in ("home", "port")]
        ['home', 'port']
    """
    check_type(TensorDictBase, rollout=rollout)
    region = one_region(region)
    shown = rollout[:episodes].cpu()
    steps = first_episode_mask(shown["next", "done"]).sum(1)
    paths = [
        torch.cat((row["position"][:1], row["next", "position"][:count]))
        for row, count in zip(shown, steps.tolist(), strict=True)
    ]
    targets = shown["target_position"][:, 0]
    draw_tracks(axes, field, region, paths, targets)
    for name, (latitude, longitude) in zip(names, region.unwrapped(targets).tolist(), strict=False):
        east = longitude > sum(region.longitude) / 2  # the text ends at the destination
        side, shift = ("right", -8) if east else ("left", 8)
        text = axes.annotate(name, (longitude, latitude), (shift, 4), textcoords="offset points", parse_math=False)
        text.set(ha=side, fontsize=8, bbox={"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 1})
