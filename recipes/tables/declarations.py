"""Tables of declared arrivals: how reliable the stated probability is, and the constants of the rule."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any
from unittest import mock

import torch
from flights import DRIFT_KM, Spec, columns_of, earth_env, flown, names, number, rollout
from tqdm import tqdm

from magrl.evaluation import summarize
from magrl.evaluation.metrics import first_episode_mask
from magrl.evaluation.runs import Noise
from magrl.evaluation.tables import markdown_table
from magrl.geodesy import geodesic
from magrl.tracking import belief, decision


def reliability(
    navigators: Sequence[Spec],
    *,
    conditions: Sequence[str],
    tasks: int = 1000,
    regions: int = 128,
    max_steps: int = 80,
    planets: bool = False,
) -> str:
    """Return, for ten bins of the probability of being within 25 km, the share of readings at which that was so [%].

    With the half-width of its 95 % interval: regions are independent, readings of a region are not.
    """
    drift = {"reach_km": DRIFT_KM, "drift_km": DRIFT_KM}
    options: dict[str, Any] = {"planets": planets, "arrival": "declared", "arrival_radius_km": 25.0}
    base = earth_env(tasks, regions=regions, max_steps=max_steps, **options, **drift)
    columns, rows = columns_of(()) | columns_of(conditions), []
    for navigator, (name, errors) in tqdm(list(itertools.product(navigators, columns.items())), unit="row"):
        flight = rollout(navigator, base, errors)
        kept = first_episode_mask(flight["next", "done"]).squeeze(-1)
        probability, places = flight["arrival_probability"][kept].squeeze(-1), flight["position"][kept].unbind(-1)
        distance, _ = geodesic(*places, *flight["target_position"][kept].unbind(-1))
        region = base.scenario.tasks.region.unsqueeze(-1).expand_as(kept)[kept]
        cells = []
        for low in range(0, 100, 10):
            inside = (100 * probability >= low) & (100 * probability < low + 10 + (low == 90))
            right, count = 100.0 * (distance[inside] <= 25), int(inside.sum())
            apart = torch.bincount(region[inside], right - right.mean())
            half = 1.96 * apart.square().sum().sqrt().item() / max(count, 1)
            cells.append(f"{right.mean().item():.0f} ± {half:.0f}" if count >= 100 else "—")
        rows.append([names(navigator)[0], name, *cells])
    return markdown_table(["navigator", "errors", *(f"{low}–{low + 10} %" for low in range(0, 100, 10))], rows)


def decisions(
    navigators: Sequence[Spec],
    *,
    rules: Sequence[Mapping[str, Any]],
    conditions: Sequence[str],
    tasks: int = 1000,
    max_steps: int = 80,
) -> str:
    """Return a row for each change of the constants of :mod:`magrl.tracking.decision`, on random planets.

    Vehicles declare that they are within 25 km.
    """
    drift = {"reach_km": DRIFT_KM, "drift_km": DRIFT_KM}
    base = earth_env(tasks, max_steps=max_steps, planets=True, arrival="declared", arrival_radius_km=25.0, **drift)
    columns, rows = columns_of(()) | columns_of(conditions), []
    for navigator, rule in tqdm(list(itertools.product(navigators, rules)), unit="row"):
        with mock.patch.multiple(decision, **rule):
            found = [summarize(flown(navigator, base, errors)) for errors in columns.values()]
        cells = [" / ".join(number(summary[name]) for name in ("success_rate", "spl", "steps")) for summary in found]
        changed = (f"{key} {value}" for key, value in rule.items())
        rows.append([", ".join([names(navigator)[0], *changed]), *cells])
    return markdown_table(["navigator", *columns], rows)


def data_sheets(
    navigators: Sequence[Spec],
    *,
    noise: Noise,
    stated: Sequence[Sequence[float]],
    rules: Sequence[Mapping[str, Any]],
    confidence: float = 0.9,
    tasks: int = 1000,
    max_steps: int = 80,
    planets: bool = False,
) -> str:
    """Return a row for each change of the constants of :mod:`magrl.tracking.belief`, a column for each data sheet.

    A data sheet states the true noise times the factors of D, I and B_H. Vehicles declare with a least confidence that
    they are within 25 km. An infinite ``DEAD_BAND`` keeps the data sheet.
    """
    base = earth_env(tasks, max_steps=max_steps, planets=planets, arrival="declared", arrival_radius_km=25.0)
    measures, rows = ("success_rate", "spl", "false_arrival_rate", "steps"), []
    for navigator, rule in tqdm(list(itertools.product(navigators, rules)), unit="row"):
        with mock.patch.multiple(belief, **{"DEAD_BAND": belief.DEAD_BAND, **rule}):
            found = [summarize(flown(navigator, base, noise, confidence, stated=factors)) for factors in stated]
        cells = [" / ".join(number(summary[name]) for name in measures) for summary in found]
        changed = ("as stated" if value == math.inf else f"{key} {value}" for key, value in rule.items())
        rows.append([", ".join([names(navigator)[0], *changed]), *cells])
    return markdown_table(["navigator", *(" ".join(f"{x:g}" for x in factors) for factors in stated)], rows)
