"""Flights of the tables: random regions of the Earth, and navigators with the data sheets of their sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import ObservationNorm, TransformedEnv

from magrl import paper
from magrl.envs import GeomagneticNavEnv, earth_scenario, planet_scenario
from magrl.evaluation import episode_measures, evaluation_rollout, with_declaration, with_errors
from magrl.evaluation.navigators import label, make_navigator, needs
from magrl.evaluation.runs import NO_NOISE, Noise
from magrl.field.model import elements_gradient_at
from magrl.tracking import common_error
from magrl.transforms import Conditions, conditions_named

FAR_KM = 500.0
"""Longest distance of the paper's tasks; beyond, regions are larger and cells begin with kilometers."""
DRIFT_KM = 40.0
"""How much farther than the longest move errors may carry a vehicle [km], for one environment under all conditions."""
SEED = 3 * paper.FIRST_RESERVED_SEED
"""Seed of regions and tasks, beyond those of trainings and of frozen sets."""
LEVELS: tuple[Noise, ...] = (NO_NOISE, (0.02, 0.02, 2.0), (0.05, 0.05, 5.0), (0.1, 0.1, 10.0), (0.5, 0.1, 20.0))
"""Standard deviations of the noise on D [deg], I [deg], B_H [nT]."""
OPTIONS = {"map_date": "map of", "prior": "prior of a", "step_price": "step [% of SPL]"}
Spec = str | Mapping[str, Any]
"""Navigator: a text, as recipes/evaluate.py takes it, or a ``name`` with options of its own."""


def flown(
    navigator: TensorDictModuleBase | Spec,
    base: GeomagneticNavEnv,
    errors: Noise | Conditions,
    confidence: float = 0.0,
    known_start: Sequence[float] | None = None,
    stated: Sequence[float] = (1.0, 1.0, 1.0),
) -> TensorDictBase:
    """Return the measures of an episode of each vehicle, under noise or under the conditions of a real vehicle.

    Args:
        navigator: navigator.
        base: environment without errors.
        errors: noise of the sensors, or conditions.
        confidence: least probability at which navigators declare arrivals, where they must be declared.
        known_start: standard deviations of the elements at the start, where the vehicle knows them.
        stated: noise on the data sheet over the true noise of D, I and B_H.
    """
    return episode_measures(rollout(navigator, base, errors, confidence, known_start, stated))


def rollout(
    navigator: TensorDictModuleBase | Spec,
    base: GeomagneticNavEnv,
    errors: Noise | Conditions,
    confidence: float = 0.0,
    known_start: Sequence[float] | None = None,
    stated: Sequence[float] = (1.0, 1.0, 1.0),
) -> TensorDictBase:
    """Return an episode of each vehicle, as :func:`flown` measures it."""
    env, sheet = with_errors(base, errors, base.seed, known_start)
    if any(factor != 1 for factor in stated):
        env = TransformedEnv(env, ObservationNorm(0.0, torch.tensor(stated), in_keys=["sensor_std"]), auto_unwrap=True)
        sheet["sensor_std"] = tuple(a * b for a, b in zip(sheet["sensor_std"], stated, strict=True))
    if isinstance(navigator, str):
        navigator = {"name": navigator}
    if isinstance(navigator, Mapping):
        options = {key: value for key, value in navigator.items() if key != "name"}
        navigator = make_navigator(navigator["name"], base, **sheet, **options)
    return evaluation_rollout(with_declaration(env, confidence, navigator), navigator)


def earth_env(
    tasks: int,
    distance_km: Sequence[float] = paper.DISTANCE_KM,
    date: str = "2025-01-01",
    regions: int = 128,
    *,
    num_envs: int | None = None,
    reach_km: float = 0.0,
    crust: bool = False,
    planets: bool = False,
    **options: Any,
) -> GeomagneticNavEnv:
    """Return an environment of frozen tasks in random regions, large enough for the longest distance.

    Args:
        tasks: number of tasks.
        distance_km: shortest and longest distance of a task [km].
        date: date of the field.
        regions: number of regions.
        num_envs: number of vehicles; by default one for each task.
        reach_km: how far errors may carry a vehicle beyond its longest move [km].
        crust: whether the field is WMMHR, with the crust, in place of IGRF.
        planets: whether the regions are those of random planets, on which options are chosen, in place of the Earth.
        options: options of the environment.
    """
    far = distance_km[1] > FAR_KM
    size = {"half_size_deg": 20, "degree": 16, "max_latitude": 75} if far else {"half_size_deg": 10, "max_latitude": 70}
    size |= {"distance_range_km": tuple(distance_km), "max_move_km": 50.0 + reach_km}
    if planets:
        scenario = planet_scenario(regions, SEED, **size)
    else:
        scenario = earth_scenario(regions, SEED, date, crust=crust, **size)
    scenario = scenario.with_tasks(scenario.random_tasks(tasks, SEED))
    return GeomagneticNavEnv(scenario, num_envs=num_envs or tasks, start_heading="random", seed=0, **options)


def estimate_within(
    radius_km: float,
    base: GeomagneticNavEnv,
    errors: Noise | Conditions,
    known_start: Sequence[float] | None = None,
    readings: int = 8,
) -> float:
    """Return the probability that an estimate of the destination is within a radius of it, mean over the tasks [%].

    The estimate is that of weighted least squares from some readings at the destination, with the true gradients and
    the data sheet at the start: the bound of vehicles that do not search.
    """
    env, sheet = with_errors(base, errors, base.seed, known_start)
    jacobian = elements_gradient_at(base.field, base.scenario.tasks.target, base.scenario.tasks.region)
    start = env.reset()
    new, constant = (start.get(key, jacobian.new_tensor(std)).to(jacobian).square() for key, std in sheet.items())
    alike = common_error(start["target_field"].to(jacobian)) * constant.sqrt()
    own = torch.diag_embed((new / readings + constant - alike.square()).clamp_min(1e-12))
    noise = own + alike.unsqueeze(-1) * alike.unsqueeze(-2)
    covariance = torch.linalg.pinv(jacobian.mT @ torch.linalg.solve(noise, jacobian))
    angle = torch.arange(360, dtype=jacobian.dtype).deg2rad()
    spread = torch.linalg.eigvalsh(covariance).clamp_min(0) @ torch.stack((angle.cos(), angle.sin())).square()
    return 100 * (1 - torch.exp(-(radius_km**2) / (2 * spread))).mean().item()


def number(value: float) -> str:
    """Return a measure as text; it has no value where nothing arrives."""
    return "—" if math.isnan(value) else f"{value:.1f}"


def paired_difference(first: Tensor, second: Tensor, region: Tensor) -> str:
    """Return the mean difference of two shares over the same tasks, in percent, with an interval of 95 %.

    Tasks of a region are not independent: the standard error is that of the sums over each region. An interval that
    excludes 0 is bold.

    Args:
        first: share of each task ``(tasks,)``.
        second: the same of the other navigator.
        region: region of each task ``(tasks,)``.
    """
    difference = 100 * (first - second).double().flatten()
    mean, count = difference.mean(), int(region.max()) + 1
    sums = torch.zeros(count, dtype=torch.float64).index_add(0, region.cpu(), difference - mean)
    error = (sums.square().sum() * count / (count - 1)).sqrt().item() / len(difference)
    text = f"{mean.item():+.1f} ({mean.item() - 1.96 * error:+.1f} to {mean.item() + 1.96 * error:+.1f})"
    return f"**{text}**" if abs(mean.item()) > 1.96 * error else text


def columns_of(conditions: Sequence[str]) -> dict[str, Noise | Conditions]:
    """Return some conditions by name, or the levels of noise."""
    columns: dict[str, Noise | Conditions] = {found.name: found for found in map(conditions_named, conditions)}
    return columns or {", ".join(f"{level:g}" for level in noise): noise for noise in LEVELS}


def names(navigator: Spec) -> list[str]:
    """Return the label of a navigator, with the options that are given, and what it needs."""
    name, *options = navigator.items() if isinstance(navigator, Mapping) else [("name", navigator)]
    known = name[1].partition("=")[0]
    return [", ".join([label(known), *(f"{OPTIONS.get(key, key)} {value}" for key, value in options)]), needs(known)]
