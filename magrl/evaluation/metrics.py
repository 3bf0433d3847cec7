"""Measures of each episode of a rollout, and their summary.

Every measure is computed from positions, moves and flags of the environment, never from a shaped reward. Angles are in
degrees and distances in kilometers.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_type
from magrl.envs.measures import path_measures
from magrl.evaluation.intervals import bootstrap_interval, wilson_interval
from magrl.geodesy import geodesic, wrap_angle

WITHIN_KM = (10, 25)
"""Distances of the additional success rates that do not depend on the field [km]."""


def first_episode_mask(done: Tensor) -> Tensor:
    """Return the mask of the steps that belong to the first episode of each vehicle.

    Args:
        done: ``(M, T)`` or ``(M, T, 1)`` bool.

    Returns:
        ``(M, T)`` bool: True up to and including the first done.

    Example:
        >>> first_episode_mask(torch.tensor([[False, True, True]]))
        tensor([[ True,  True, False]])
    """
    done = done.reshape(done.shape[:2])
    return done.long().cumsum(1) - done.long() == 0


def episode_measures(rollout: TensorDictBase) -> dict[str, Tensor]:
    """Return the measures of the first episode of each vehicle.

    Args:
        rollout: ``(M, T)`` from ``env.rollout``, with the keys of :class:`magrl.envs.GeomagneticNavEnv`.

    Returns:
        Tensors ``(M,)``: ``success`` bool; ``steps``; ``shortest_km``, ``length_km``, ``navigation_error_km``, ``spl``
        and ``path_efficiency`` as in :func:`magrl.envs.measures.path_measures`; ``smoothness_deg``, the mean interior
        angle at way-points (180 is straight, NaN without way-points); ``heading_mae_deg`` and ``heading_rmse_deg``,
        deviations from the bearing to the destination over the legs of nonzero length (NaN without any). Where vehicles
        declare their arrival, also ``false_arrival`` bool: the episode ended with a declaration and no success.

    Raises:
        TypeError: for a rollout of another type.
        ValueError: for a rollout of other dimensions, or without a vehicle or a step.
        KeyError: for a missing key.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.navigators import Secant
        >>> rollout = GeomagneticNavEnv(num_envs=2, seed=0).rollout(50, Secant(), break_when_any_done=False)
        >>> episodes = episode_measures(rollout)
        >>> episodes["success"], episodes["steps"]
        (tensor([True, True]), tensor([12, 12]))
    """
    check_type(TensorDictBase, rollout=rollout)
    if rollout.ndim != 2 or 0 in rollout.shape:
        raise ValueError(f"a rollout must be of shape (M, T), each at least 1, got {tuple(rollout.shape)}")
    valid = first_episode_mask(rollout["next", "done"])
    steps = valid.sum(1)
    last = (steps - 1).unsqueeze(1)
    success = rollout["next", "success"].squeeze(2).gather(1, last).squeeze(1)
    start, target = rollout["start_position"][:, 0], rollout["target_position"][:, 0]
    end = rollout["next", "position"].gather(1, last.unsqueeze(2).expand(-1, 1, 2)).squeeze(1)
    distance, heading = moved(rollout["next"])
    length_km, moving = (distance * valid).sum(1), valid & (distance > 1e-6)
    _, bearing = geodesic(*rollout["position"].unbind(-1), *rollout["target_position"].unbind(-1))
    deviation = torch.where(moving, torch.rad2deg(wrap_angle(heading - bearing).abs()), math.nan)
    measures = {
        "success": success,
        "steps": steps,
        **path_measures(success, start, end, target, length_km),
        "smoothness_deg": 180 - _turns(heading, moving).nanmean(1),
        "heading_mae_deg": deviation.nanmean(1),
        "heading_rmse_deg": (deviation**2).nanmean(1).sqrt(),
    }
    if "declared" in rollout["next"].keys():  # noqa: SIM118 - a TensorDict is no mapping
        declared = rollout["next", "declared"].squeeze(2).gather(1, last).squeeze(1)
        measures["false_arrival"] = declared & ~success
    return measures


def moved(steps: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Return distance [km] and direction [rad] of legs over the ground, ``(...)`` each, in float64.

    They are what the policy commanded (``move``, ``heading``), unless errors of motion or of the north reference keep
    what is true.

    Args:
        steps: what follows the legs, usually ``rollout["next"]``.

    Example:
        >>> from tensordict import TensorDict
        >>> move, heading = torch.tensor([[30.0, 0.1]]), torch.tensor([[0.1]])
        >>> moved(TensorDict(move=move, heading=heading, true_move=1.5 * move))[0]
        tensor([45.], dtype=torch.float64)
    """
    move = steps.get("true_move", steps["move"])
    course = steps.get("true_course", steps.get("true_heading", steps["heading"]))
    return move[..., 0].double(), course.squeeze(-1).double()


def _turns(heading: Tensor, moving: Tensor) -> Tensor:
    """Return the turn between each leg and the last leg of nonzero length before it, ``(M, T)`` [deg] or NaN."""
    index = torch.arange(heading.shape[1], device=heading.device).expand_as(heading)
    latest = torch.where(moving, index, -1).cummax(1).values
    previous = torch.cat((torch.full_like(latest[:, :1], -1), latest[:, :-1]), 1)
    turn = wrap_angle(heading - heading.gather(1, previous.clamp_min(0))).abs()
    return torch.where(moving & (previous >= 0), torch.rad2deg(turn), math.nan)


def summarize(episodes: dict[str, Tensor] | TensorDictBase) -> dict[str, float]:
    """Return the summary of a set of episodes, in the paper's units.

    Args:
        episodes: from :func:`episode_measures` or :func:`magrl.evaluation.evaluate`.

    Returns:
        ``success_rate`` [%] with its Wilson 95 % interval ``success_rate_low`` and ``success_rate_high``;
        ``success_rate_within_10km`` and ``success_rate_within_25km`` [%], the share of episodes that end within that
        distance of the destination, whatever the field there, and ``final_distance_km_median``, the median over all
        episodes of the distance left at the end; ``spl`` [%] with its bootstrap 95 % interval ``spl_low`` and
        ``spl_high``, likewise ``path_efficiency`` over the episodes that moved;
        ``trajectory_length_m``, ``steps``, ``navigation_error_km``, ``smoothness_deg``, ``heading_mae_deg`` and
        ``heading_rmse_deg`` over successes, probably as in the paper; ``num_tasks``. Means over no episode are NaN.
        Where vehicles declare their arrival, also ``false_arrival_rate`` [%] with its Wilson 95 % interval.

    Raises:
        ValueError: for no episode, or ``success`` that is not bool.
        KeyError: for a missing measure.

    Example:
        >>> length_km, error_km = torch.tensor([500.0, 480.0]), torch.tensor([8.0, 200.0])
        >>> ends = {"success": torch.tensor([True, False]), "steps": torch.tensor([10, 50])}
        >>> ends |= {"spl": torch.tensor([0.8, 0.0]), "path_efficiency": torch.tensor([0.8, 0.3])}
        >>> angles = dict.fromkeys(("smoothness_deg", "heading_mae_deg", "heading_rmse_deg"), torch.zeros(2))
        >>> summary = summarize({**ends, **angles, "length_km": length_km, "navigation_error_km": error_km})
        >>> summary["success_rate"], summary["trajectory_length_m"], summary["steps"]
        (50.0, 500000.0, 10.0)
    """
    episodes = dict(episodes.items())
    success = episodes["success"]
    if success.dtype != torch.bool or success.ndim != 1 or not len(success):
        raise ValueError(f"success must be bool of shape (M,) with M >= 1, got {success!r}")
    summary, error = _rate("success_rate", success), episodes["navigation_error_km"]
    summary |= {f"success_rate_within_{d}km": 100 * (error <= d).double().mean().item() for d in WITHIN_KM}
    summary["final_distance_km_median"] = error.double().quantile(0.5).item()
    efficiency = episodes["path_efficiency"]
    summary |= _percent("spl", episodes["spl"]) | _percent("path_efficiency", efficiency[~efficiency.isnan()])
    summary["trajectory_length_m"] = 1000 * episodes["length_km"][success].mean().item()
    summary["steps"] = episodes["steps"][success].double().mean().item()
    for name in ("navigation_error_km", "smoothness_deg", "heading_mae_deg", "heading_rmse_deg"):
        summary[name] = episodes[name][success].nanmean().item()
    if "false_arrival" in episodes:
        summary |= _rate("false_arrival_rate", episodes["false_arrival"])
    return summary | {"num_tasks": len(success)}


def _rate(name: str, mask: Tensor) -> dict[str, float]:
    """Return the share of True [%] and its Wilson 95 % interval."""
    rate = mask.double().mean().item()
    low, high = wilson_interval(rate, len(mask))
    return {name: 100 * rate, f"{name}_low": 100 * low, f"{name}_high": 100 * high}


def _percent(name: str, values: Tensor) -> dict[str, float]:
    """Return a mean [%] and its bootstrap 95 % interval; NaN of no values."""
    low, high = bootstrap_interval(values) if len(values) else (math.nan, math.nan)
    return {name: 100 * values.mean().item(), f"{name}_low": 100 * low, f"{name}_high": 100 * high}
