"""From a rollout to the measures of each episode, and from those to a summary.

Every measure comes from positions, moves and flags of the environment, never from a shaped reward. Angles are in
degrees here, because people read them; distances in kilometres.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number, check_tensor, check_type
from magrl.geodesy import geodesic, wrap_angle

WITHIN_KM = (10, 25)
"""Distances at which a second, field-free success rate is reported [km]."""


def flown(done: Tensor) -> Tensor:
    """Which steps belong to the first episode.

    Args:
        done: ``(M, T)`` or ``(M, T, 1)`` bool.

    Returns:
        ``(M, T)`` bool: True up to and including the first done.

    Raises:
        ValueError: for another shape or dtype.

    Example:
        >>> flown(torch.tensor([[False, True, True]]))
        tensor([[ True,  True, False]])
    """
    check_type(Tensor, done=done)
    if done.dtype != torch.bool or done.ndim not in (2, 3) or done.shape[2:].numel() != 1:
        raise ValueError(f"done must be bool of shape (M, T) or (M, T, 1), got {done.dtype} of {tuple(done.shape)}")
    done = done.reshape(done.shape[:2])
    return done.long().cumsum(1) - done.long() == 0


def episode_measures(rollout: TensorDictBase) -> dict[str, Tensor]:
    """The measures of the first episode of each vehicle.

    Args:
        rollout: ``(M, T)`` from ``env.rollout``, with the keys of :class:`magrl.env.GeomagneticNavEnv`.

    Returns:
        Tensors ``(M,)``: ``success`` bool; ``steps``; ``shortest_km``, the geodesic from start to destination;
        ``length_km``, the path flown; ``navigation_error_km``, what was left at the end; ``spl`` in [0, 1];
        ``smoothness_deg``, the mean interior angle at way-points (180 is straight, NaN without way-points);
        ``heading_mae_deg`` and ``heading_rmse_deg``, from the bearing to the destination at each move of some
        length (NaN without any).

    Raises:
        ValueError: for a rollout of other dimensions, or of no vehicle or no step.
        KeyError: for an entry that it lacks.

    Source:
        SPL: Anderson et al., On evaluation of embodied navigation agents (2018).

    Example:
        >>> from magrl.env import GeomagneticNavEnv
        >>> from magrl.navigators import Secant
        >>> rollout = GeomagneticNavEnv(num_envs=2, seed=0).rollout(50, Secant(), break_when_any_done=False)
        >>> episodes = episode_measures(rollout)
        >>> episodes["success"], episodes["steps"]
        (tensor([True, True]), tensor([12, 12]))
    """
    check_type(TensorDictBase, rollout=rollout)
    if rollout.ndim != 2 or 0 in rollout.shape:
        raise ValueError(f"a rollout must be of shape (M, T), each at least 1, got {tuple(rollout.shape)}")
    valid = flown(rollout["next", "done"])
    steps = valid.sum(1)
    last = (steps - 1).unsqueeze(-1)
    success = rollout["next", "success"].squeeze(-1).gather(1, last).squeeze(-1)
    moves = rollout["next", "move"][..., 0].double() * valid
    start, target = rollout["start_position"][:, 0], rollout["target_position"][:, 0]
    end = rollout["next", "position"].gather(1, last.unsqueeze(-1).expand(-1, 1, 2)).squeeze(1)
    shortest, _ = geodesic(*start.unbind(-1), *target.unbind(-1))
    length = moves.sum(1)
    deviation = _heading_deviation(rollout, valid)
    return {
        "success": success,
        "steps": steps,
        "shortest_km": shortest,
        "length_km": length,
        "navigation_error_km": geodesic(*end.unbind(-1), *target.unbind(-1))[0],
        "spl": success * shortest / torch.maximum(length, shortest),
        "smoothness_deg": 180 - _mean(_turns(rollout, valid)),
        "heading_mae_deg": _mean(deviation),
        "heading_rmse_deg": _mean(deviation**2).sqrt(),
    }


def _moving(rollout: TensorDictBase, valid: Tensor) -> Tensor:
    """Moves that have a direction: those of some length, ``(M, T)``."""
    return valid & (rollout["next", "move"][..., 0] > 1e-6)


def _heading_deviation(rollout: TensorDictBase, valid: Tensor) -> Tensor:
    """Angle between each move and the bearing to the destination where it began, ``(M, T)`` [deg], NaN where none."""
    _, bearing = geodesic(*rollout["position"].unbind(-1), *rollout["target_position"].unbind(-1))
    angle = wrap_angle(rollout["next", "heading"].squeeze(-1).double() - bearing).abs()
    return torch.where(_moving(rollout, valid), torch.rad2deg(angle), math.nan)


def _turns(rollout: TensorDictBase, valid: Tensor) -> Tensor:
    """Turn between a move and the last one before it that went anywhere, ``(M, T)`` [deg], NaN where there is none."""
    heading = rollout["next", "heading"].squeeze(-1).double()
    moving = _moving(rollout, valid)
    index = torch.arange(heading.shape[1], device=heading.device).expand_as(heading)
    latest = torch.where(moving, index, -1).cummax(1).values
    previous = torch.cat((torch.full_like(latest[:, :1], -1), latest[:, :-1]), 1)
    turn = wrap_angle(heading - heading.gather(1, previous.clamp_min(0))).abs()
    return torch.where(moving & (previous >= 0), torch.rad2deg(turn), math.nan)


def _mean(values: Tensor) -> Tensor:
    return values.nanmean(1)


def summarise(episodes: dict[str, Tensor]) -> dict[str, float]:
    """A summary of episodes, in the paper's units.

    Args:
        episodes: from :func:`episode_measures`.

    Returns:
        ``success_rate`` [%] with its Wilson 95 % interval ``success_rate_low`` and ``_high``;
        ``success_rate_within_10km`` and ``_25km`` [%], the share that ends so near whatever the field says;
        ``spl`` [%] with its bootstrap 95 % interval ``spl_low`` and ``spl_high``;
        ``trajectory_length_m`` and ``steps`` over successes, as the paper seems to, and ``_all`` over all;
        ``navigation_error_km``, ``smoothness_deg``, ``heading_mae_deg``, ``heading_rmse_deg`` over successes;
        ``num_tasks``. Means over no success at all are NaN.

    Raises:
        ValueError: for no episode, or successes that are not bool.
        KeyError: for a measure that is missing.

    Example:
        >>> flown_km, left_km = torch.tensor([500.0, 480.0]), torch.tensor([8.0, 200.0])
        >>> ends = {"success": torch.tensor([True, False]), "steps": torch.tensor([10, 50])}
        >>> ends["spl"] = torch.tensor([0.8, 0.0])
        >>> angles = dict.fromkeys(("smoothness_deg", "heading_mae_deg", "heading_rmse_deg"), torch.zeros(2))
        >>> summary = summarise({**ends, **angles, "length_km": flown_km, "navigation_error_km": left_km})
        >>> summary["success_rate"], summary["trajectory_length_m"], summary["steps"]
        (50.0, 500000.0, 10.0)
    """
    success = episodes["success"]
    if success.dtype != torch.bool or success.ndim != 1 or not len(success):
        raise ValueError(f"success must be bool of shape (M,) with M >= 1, got {success!r}")
    count = len(success)
    rate = success.double().mean().item()
    low, high = wilson_interval(rate, count)
    error, spl = episodes["navigation_error_km"], episodes["spl"]
    summary = {"success_rate": 100 * rate, "success_rate_low": 100 * low, "success_rate_high": 100 * high}
    summary |= {f"success_rate_within_{d}km": 100 * (error <= d).double().mean().item() for d in WITHIN_KM}
    low, high = bootstrap_interval(spl)
    summary |= {"spl": 100 * spl.mean().item(), "spl_low": 100 * low, "spl_high": 100 * high}
    summary["trajectory_length_m"] = 1000 * episodes["length_km"][success].mean().item()
    summary["trajectory_length_m_all"] = 1000 * episodes["length_km"].mean().item()
    summary["steps"] = episodes["steps"][success].double().mean().item()
    summary["steps_all"] = episodes["steps"].double().mean().item()
    for name in ("navigation_error_km", "smoothness_deg", "heading_mae_deg", "heading_rmse_deg"):
        summary[name] = episodes[name][success].nanmean().item()
    return summary | {"num_tasks": count}


def bootstrap_interval(values: Tensor, resamples: int = 1000, seed: int = 0) -> tuple[float, float]:
    """Percentile bootstrap 95 % interval of a mean.

    Args:
        values: ``(M,)``.
        resamples: how often the values are drawn anew.
        seed: of the draws.

    Returns:
        Low and high end; NaN where a value is.

    Raises:
        ValueError: for no values, another shape, or no resamples.

    Source:
        B. Efron, Bootstrap methods: another look at the jackknife, Annals of Statistics 7 (1979).

    Example:
        >>> bootstrap_interval(torch.ones(10))
        (1.0, 1.0)
    """
    check_tensor(values=values)
    check_number(1, whole=True, resamples=resamples)
    check_number(whole=True, seed=seed)
    if values.ndim != 1 or not len(values):
        raise ValueError(f"values must be of shape (M,) with M >= 1, got {tuple(values.shape)}")
    generator = torch.Generator().manual_seed(seed)
    draws = torch.randint(len(values), (resamples, len(values)), generator=generator)
    low, high = (
        values.cpu().double()[draws].mean(1).quantile(torch.tensor((0.025, 0.975), dtype=torch.float64)).tolist()
    )
    return low, high


def wilson_interval(rate: float, count: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's score interval of a proportion.

    Args:
        rate: observed proportion, in [0, 1].
        count: number of trials.
        z: normal quantile; 1.96 for 95 %.

    Raises:
        ValueError: for a rate outside [0, 1], or no trial.

    Source:
        E. B. Wilson, Probable inference, the law of succession, and statistical inference, JASA 22 (1927).

    Example:
        >>> [round(x, 4) for x in wilson_interval(1.0, 100)]
        [0.963, 1.0]
    """
    check_number(0, 1, rate=rate)
    check_number(1, whole=True, count=count)
    check_number(0, above=True, z=z)
    centre = rate + z**2 / (2 * count)
    half = z * math.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    scale = 1 + z**2 / count
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


class TrainingTally:
    """Counts frames and episodes while they are collected, and averages rewards and the last episodes.

    Args:
        destination_weight: the env's reward at arrival, which is told from the rest of the base reward by it.
        reward_scale: factor that the collected reward carries.
        window: episodes that ``return`` and ``success_rate`` are averaged over, as in Figs. 4-2 and 4-3.

    Example:
        >>> from tensordict import TensorDict
        >>> after = TensorDict(reward=torch.tensor([[1.0], [203.0]]), episode_reward=torch.tensor([[5.0], [230.0]]))
        >>> after["success"] = after["done"] = torch.tensor([[False], [True]])
        >>> tally = TrainingTally(destination_weight=200.0, reward_scale=1.0)
        >>> tally.add(TensorDict(next=after, batch_size=[2]), alignment=None)
        >>> tally.frames, tally.episodes, tally.row()["return"]
        (2, 1, 230.0)
    """

    def __init__(self, destination_weight: float, reward_scale: float, window: int = 200) -> None:
        check_number(0, destination_weight=destination_weight)
        check_number(0, above=True, reward_scale=reward_scale)
        check_number(1, whole=True, window=window)
        self.destination_weight, self.reward_scale = destination_weight, reward_scale
        self.frames = self.episodes = 0
        self._returns: deque[float] = deque(maxlen=window)
        self._successes: deque[float] = deque(maxlen=window)
        self._terms: list[tuple[float, float, float]] = []

    def add(self, batch: TensorDictBase, alignment: Tensor | None) -> None:
        """Counts a batch of transitions.

        Args:
            batch: ``(B,)`` with ``next``: ``reward``, ``episode_reward``, ``success`` and ``done``.
            alignment: ``(B, 1)`` the alignment term in the reward, or None.
        """
        ended, success = batch["next", "done"], batch["next", "success"]
        self.frames += batch.numel()
        self.episodes += int(ended.sum())
        self._returns.extend(batch["next", "episode_reward"][ended].tolist())
        self._successes.extend(success[ended].double().tolist())
        destination = self.destination_weight * success.double().mean().item()
        aligned = 0.0 if alignment is None else alignment.double().mean().item()
        total = batch["next", "reward"].double().mean().item() / self.reward_scale
        self._terms.append((destination, total - destination - aligned, aligned))

    def row(self) -> dict[str, float]:
        """The averages, and a fresh start for those of the reward's terms; NaN where nothing ended yet."""
        terms = torch.tensor(self._terms, dtype=torch.float64).reshape(-1, 3).mean(0).tolist()
        self._terms = []
        names = ("reward_destination", "reward_proximity", "reward_alignment")
        count = len(self._returns)
        return {
            "return": sum(self._returns) / count if count else math.nan,
            "success_rate": 100 * sum(self._successes) / count if count else math.nan,
            **dict(zip(names, terms, strict=True)),
        }

    def state_dict(self) -> dict[str, Any]:
        """The counts, the window and the terms so far."""
        window = {"returns": list(self._returns), "successes": list(self._successes), "terms": list(self._terms)}
        return {"frames": self.frames, "episodes": self.episodes, **window}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Goes on counting from there."""
        self.frames, self.episodes = state_dict["frames"], state_dict["episodes"]
        self._returns.extend(state_dict["returns"])
        self._successes.extend(state_dict["successes"])
        self._terms = [tuple(term) for term in state_dict["terms"]]
