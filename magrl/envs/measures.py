"""The measures of episodes in one table, which rollouts, Gymnasium, summaries, tables and commands read; and intervals.

Every measure is computed from positions, legs and flags of the environment, never from a shaped reward. Angles are in
degrees and distances in kilometers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number
from magrl.geodesy import geodesic, wrap_angle

Statistic = Callable[[Tensor, Tensor], dict[str, float]]
"""Function of a measure ``(M,)`` and the success of the episodes; keys of its values are endings of names."""
DECLARED = ("false_arrival", "not_declared")
"""Measures of vehicles that declare their arrival."""


class Episode(NamedTuple):
    """What the measures of episodes are computed from, ``(...)`` each.

    Args:
        success: bool.
        steps: number of steps.
        start: ``(..., 2)`` latitude, longitude [deg].
        end: ``(..., 2)`` last position [deg].
        target: ``(..., 2)`` destination [deg].
        length_km: length of the path, as commanded: through the water or the air, where there are currents [km].
        declared: bool, whether it ended with a declaration; None where vehicles do not declare.
        truncated: bool, whether it ran out of steps.
        course: ``(..., T)`` directions of the legs [rad], NaN for those of no length; None where only the end is known.
        bearing: ``(..., T)`` bearings to the destination where the legs began [rad].
    """

    success: Tensor
    steps: Tensor
    start: Tensor
    end: Tensor
    target: Tensor
    length_km: Tensor
    declared: Any = None
    truncated: Any = None
    course: Any = None
    bearing: Any = None


def measured(episode: Episode) -> dict[str, Tensor]:
    """Return the measures of episodes by name, ``(...)`` each.

    Returns:
        ``success`` bool; ``steps``; ``length_km``; ``shortest_km``, the geodesic distance from start to destination;
        ``navigation_error_km``, the distance left at the end; :func:`spl` and :func:`path_efficiency`. Where legs are
        known, also ``smoothness_deg``, the mean interior angle at waypoints (180 is straight, NaN without waypoints);
        ``heading_mae_deg`` and ``heading_rmse_deg``, deviations from the bearing to the destination over the legs of
        nonzero length (NaN without any). Where vehicles declare their arrival, also ``false_arrival`` bool: the episode
        ended with a declaration and no success; and ``not_declared`` bool: it ran out of steps without one.

    Example:
        >>> start, end = torch.tensor([[-2.0, 162.0]]).double(), torch.tensor([[-3.0, 162.0]]).double()
        >>> episode = Episode(torch.tensor([True]), torch.tensor([9]), start, end, end, torch.tensor([221.15]).double())
        >>> {name: round(value.item(), 2) for name, value in measured(episode).items() if name != "success"}
        {'steps': 9, 'length_km': 221.15, 'shortest_km': 110.58, 'navigation_error_km': 0.0, 'spl': 0.5, \
'path_efficiency': 0.5}
    """
    success, steps, start, end, target, length_km, declared, truncated, course, bearing = episode
    pairs = ((start, target), (end, target), (start, end))
    shortest_km, error_km, straight_km = (geodesic(*a.unbind(-1), *b.unbind(-1))[0] for a, b in pairs)
    found = {"success": success, "steps": steps, "length_km": length_km, "shortest_km": shortest_km}
    found |= {"navigation_error_km": error_km, "spl": spl(success, shortest_km, length_km)}
    found |= {"path_efficiency": path_efficiency(straight_km, length_km)}
    if declared is not None:
        found |= {"false_arrival": declared & ~success, "not_declared": truncated & ~declared}
    if course is not None:
        deviation = torch.rad2deg(wrap_angle(course - bearing).abs())
        found |= {"smoothness_deg": 180 - _turns(course).nanmean(-1), "heading_mae_deg": deviation.nanmean(-1)}
        found |= {"heading_rmse_deg": (deviation**2).nanmean(-1).sqrt()}
    return found


def _turns(course: Tensor) -> Tensor:
    """Return the turn between each leg and the last leg of nonzero length before it, ``(..., T)`` [deg] or NaN."""
    moving = ~course.isnan()
    index = torch.arange(course.shape[-1], device=course.device).expand_as(course)
    latest = torch.where(moving, index, -1).cummax(-1).values
    previous = torch.cat((torch.full_like(latest[..., :1], -1), latest[..., :-1]), -1)
    turn = wrap_angle(course - course.gather(-1, previous.clamp_min(0))).abs()
    return torch.where(moving & (previous >= 0), torch.rad2deg(turn), math.nan)


def spl(success: Tensor, shortest_km: Tensor, length_km: Tensor) -> Tensor:
    """Return the success of each episode weighted by its path length.

    Args:
        success: ``(...)`` bool.
        shortest_km: ``(...)`` geodesic distance from start to destination [km].
        length_km: ``(...)`` length of the path, as commanded: through the water or the air, where there are currents
            [km].

    Returns:
        ``(...)`` in [0, 1]: 0 for a failure, 1 for a success on a path no longer than the shortest, also where both are
        0.

    Source:
        P. Anderson et al., On evaluation of embodied navigation agents, arXiv 1807.06757 (2018).

    Example:
        >>> spl(torch.tensor([True, True, False]), torch.full((3,), 400.0), torch.tensor([500.0, 390.0, 500.0]))
        tensor([0.8000, 1.0000, 0.0000])
    """
    longer_km = torch.maximum(length_km, shortest_km)
    return success * torch.where(longer_km == 0, 1.0, shortest_km / longer_km)


def path_efficiency(straight_km: Tensor, length_km: Tensor) -> Tensor:
    """Return how straight each path is: the distance from its start to its end over its length.

    Unlike :func:`spl` it does not depend on the destination: it is defined for failures, and an arrival set that is
    large in comparison with the distance hides no detour.

    Args:
        straight_km: ``(...)`` geodesic distance from the start to where the episode ended [km].
        length_km: ``(...)`` length of the path [km].

    Returns:
        ``(...)`` in [0, 1]; NaN where the path has no length.

    Example:
        >>> path_efficiency(torch.tensor([300.0, 0.0]), torch.tensor([400.0, 0.0]))
        tensor([0.7500,    nan])
    """
    efficiency = straight_km / torch.maximum(straight_km, length_km)  # legs are geodesics only within millimeters
    return torch.where(length_km == 0, math.nan, efficiency)


def _share(values: Tensor, _: Tensor) -> dict[str, float]:
    """Return the share of True [%] and its Wilson 95 % interval."""
    rate = values.double().mean().item()
    low, high = wilson_interval(rate, len(values))
    return {"": 100 * rate, "_low": 100 * low, "_high": 100 * high}


def _percent(values: Tensor, _: Tensor) -> dict[str, float]:
    """Return the mean of the values but NaN [%] and its bootstrap 95 % interval; NaN of no values."""
    values = values[~values.isnan()]
    low, high = bootstrap_interval(values) if len(values) else (math.nan, math.nan)
    return {"": 100 * values.mean().item(), "_low": 100 * low, "_high": 100 * high}


def _over_successes(values: Tensor, success: Tensor) -> dict[str, float]:
    """Return the mean over successes, probably as in the paper; NaN of none."""
    values = values[success]
    return {"": (values if values.is_floating_point() else values.double()).nanmean().item()}


def _meters(values: Tensor, success: Tensor) -> dict[str, float]:
    return {"": 1000 * values[success].mean().item()}


def _within(km: float) -> Statistic:
    return lambda values, _: {"": 100 * (values <= km).double().mean().item()}


def _median(values: Tensor, _: Tensor) -> dict[str, float]:
    return {"": values.double().quantile(0.5).item()}


class Measure(NamedTuple):
    """A measure of an episode, and how it is summarized. To add one, compute it in :func:`measured`, and add its row.

    Args:
        name: its key in :func:`measured`.
        summary: its key in summaries.
        of: its statistic.
        label: heading of its column in tables; "" without one.
        form: number format there.
    """

    name: str
    summary: str
    of: Statistic
    label: str = ""
    form: str = ".1f"


MEASURES = (
    Measure("success", "success_rate", _share, "SR %"),
    Measure("length_km", "trajectory_length_m", _meters, "TL m", ".0f"),
    Measure("spl", "spl", _percent, "SPL %", ".2f"),
    Measure("steps", "steps", _over_successes, "TNT steps", ".2f"),
    Measure("path_efficiency", "path_efficiency", _percent, "path efficiency %", ".2f"),
    Measure("navigation_error_km", "navigation_error_km", _over_successes, "NE km"),
    Measure("navigation_error_km", "success_rate_within_10km", _within(10), "within 10 km %"),
    Measure("navigation_error_km", "success_rate_within_25km", _within(25), "within 25 km %"),
    Measure("navigation_error_km", "final_distance_km_median", _median, "final distance, median km"),
    Measure("false_arrival", "false_arrival_rate", _share, "false arrivals %"),
    Measure("not_declared", "not_declared_rate", _share, "not declared %"),
    Measure("smoothness_deg", "smoothness_deg", _over_successes, "smoothness °"),
    Measure("heading_mae_deg", "heading_mae_deg", _over_successes, "MAE °"),
    Measure("heading_rmse_deg", "heading_rmse_deg", _over_successes),
)
"""The summaries of measures; columns of tables are in this order."""


def summarize(episodes: Mapping[str, Tensor] | TensorDictBase) -> dict[str, float]:
    """Return the summary of a set of episodes, in the paper's units.

    Args:
        episodes: from :func:`magrl.evaluation.episode_measures` or :func:`magrl.evaluation.evaluate`.

    Returns:
        The summaries of :data:`MEASURES`: shares [%] with their Wilson 95 % intervals (``success_rate``,
        ``success_rate_low``, ``success_rate_high``), ``spl`` and ``path_efficiency`` [%] with their bootstrap 95 %
        intervals; ``success_rate_within_10km`` and ``success_rate_within_25km`` [%], the share of all episodes that end
        within that distance of the destination, whatever the field there, and ``final_distance_km_median`` of all;
        means over successes for the others, probably as in the paper, NaN without any; and ``num_trips``.

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
    success, summary = episodes["success"], dict[str, float]()
    if success.dtype != torch.bool or success.ndim != 1 or not len(success):
        raise ValueError(f"success must be bool of shape (M,) with M >= 1, got {success!r}")
    for name, key, statistic, *_ in MEASURES:
        if name in episodes.keys() or name not in DECLARED:  # noqa: SIM118 - a TensorDict is no mapping
            summary |= {key + end: value for end, value in statistic(episodes[name], success).items()}
    return summary | {"num_trips": len(success)}


_ENDS = torch.tensor((0.025, 0.975), dtype=torch.float64)
"""Quantiles of a 95 % interval."""


def bootstrap_interval(values: Tensor, resamples: int = 1000, seed: int = 0) -> tuple[float, float]:
    """Return the percentile bootstrap 95 % interval of a mean.

    Args:
        values: ``(M,)``.
        resamples: number of resamples.
        seed: random seed of the resamples.

    Returns:
        Low and high end; NaN if a value is NaN.

    Raises:
        ValueError: for no values, or another shape.

    Source:
        B. Efron, Bootstrap methods: another look at the jackknife, Annals of Statistics 7 (1979).

    Example:
        >>> bootstrap_interval(torch.ones(10))
        (1.0, 1.0)
    """
    if values.ndim != 1 or not len(values):
        raise ValueError(f"values must be of shape (M,) with M >= 1, got {tuple(values.shape)}")
    generator = torch.Generator().manual_seed(seed)
    low, high = _resampled(values, resamples, generator).mean(1).quantile(_ENDS).tolist()
    return low, high


def interquartile_mean(values: Tensor) -> Tensor:
    """Return the mean of the middle half: a quarter of the values, rounded down, is left out at each end.

    It depends less on single outliers than the mean, and varies less between experiments than the median.

    Args:
        values: ``(..., R)``, one for each run.

    Returns:
        ``(...)`` float64; NaN where a value is NaN.

    Raises:
        ValueError: for no values.

    Source:
        R. Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice, NeurIPS (2021).

    Example:
        >>> interquartile_mean(torch.tensor([0.0, 97.0, 98.0, 99.0, 100.0])).item()
        98.0
    """
    if values.ndim < 1 or not values.shape[-1]:
        raise ValueError(f"values must be of shape (..., R) with R >= 1, got {tuple(values.shape)}")
    count = values.shape[-1]
    ordered = values.double().sort(-1).values
    unknown = ordered[..., -1].isnan()  # NaN is sorted to the end, where it would be left out
    return torch.where(unknown, math.nan, ordered[..., count // 4 : count - count // 4].mean(-1))


def stratified_bootstrap(strata: Sequence[Tensor], resamples: int = 10_000, seed: int = 0) -> tuple[float, float]:
    """Return the stratified percentile bootstrap 95 % interval of the interquartile mean over runs.

    Runs are drawn with replacement within each stratum, as many as it has, and taken together. A stratum holds the runs
    of one experiment; several strata are, for example, trainings with different numbers of threads. The score of a run
    is its mean over all trips: all its episodes are of one policy, so that drawing them independently of each other
    would leave out the variation between runs. With fewer than ten runs the interval is too narrow: of five normal
    values it holds the true mean in 90 % of experiments instead of 95 %, of three in 76 %.

    Args:
        strata: ``(R,)`` for each stratum, one score for each run.
        resamples: number of resamples.
        seed: random seed of the resamples.

    Returns:
        Low and high end; NaN if a score is NaN.

    Raises:
        ValueError: for no stratum, or one without runs or of another shape.

    Source:
        R. Agarwal et al., Deep reinforcement learning at the edge of the statistical precipice, NeurIPS (2021), whose
        strata are the trips of a benchmark, each with its own runs.

    Example:
        >>> stratified_bootstrap([torch.full((5,), 99.0), torch.full((3,), 99.0)])
        (99.0, 99.0)
    """
    shapes = [tuple(scores.shape) for scores in strata]
    if not strata or any(len(shape) != 1 or not shape[0] for shape in shapes):
        raise ValueError(f"strata must each be of shape (R,) with R >= 1, got {shapes}")
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.cat([_resampled(scores, resamples, generator) for scores in strata], 1)
    low, high = interquartile_mean(drawn).quantile(_ENDS).tolist()
    return low, high


def _resampled(values: Tensor, resamples: int, generator: torch.Generator) -> Tensor:
    """Return values ``(M,)`` drawn with replacement: ``(resamples, M)`` float64."""
    draws = torch.randint(len(values), (resamples, len(values)), generator=generator)
    return values.cpu().double()[draws]


def wilson_interval(rate: float, count: int) -> tuple[float, float]:
    """Return Wilson's score 95 % interval of a proportion.

    Args:
        rate: observed proportion, in [0, 1].
        count: number of trials.

    Returns:
        Low and high end, in [0, 1].

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
    z = 1.96  # normal quantile
    center = rate + z**2 / (2 * count)
    half = z * math.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    scale = 1 + z**2 / count
    return max(0.0, (center - half) / scale), min(1.0, (center + half) / scale)
