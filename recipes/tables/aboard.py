"""How often a vehicle that declares its arrival is right, all over the Earth.

Each task is flown by :class:`magrl.onboard.Onboard`, which reads plain numbers, with noise of the sensors or under the
conditions of a real vehicle. One flight serves all levels of confidence, as nothing that the vehicle does depends on
them before it stops.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median

import torch
from flights import earth_env
from tqdm import tqdm

from magrl.envs import GeomagneticNavEnv
from magrl.evaluation.navigators import label
from magrl.evaluation.tables import markdown_table
from magrl.geodesy import geodesic
from magrl.onboard import Onboard
from magrl.transforms import Conditions, conditions_named, with_conditions

CONFIDENCE = (0.5, 0.8, 0.95)
"""Levels of confidence."""
NOISE = ((0.02, 0.02, 2.0), (0.05, 0.05, 5.0), (0.1, 0.1, 10.0))
"""Standard deviations of the noise on D [deg], I [deg], B_H [nT]."""
Declared = dict[float, tuple[bool, float]]
"""Of each level that was reached: whether the vehicle had arrived, and its distance to the destination [km]."""


def errors_by_name(names: Sequence[str]) -> dict[str, Conditions]:
    """Return the conditions of some names, or the levels of noise where none are given."""
    if names:
        return {name: conditions_named(name) for name in names}
    noise = {
        f"{d:g}°, {i:g}°, {h:g} nT": Conditions("noise", 100.0, sensors={"sensor_std": (d, i, h)}) for d, i, h in NOISE
    }
    return {"none": conditions_named("laboratory"), **noise}


def flights(name: str, errors: Conditions, tasks: int, arrival_km: float | None, max_steps: int) -> list[Declared]:
    """Return what a navigator on board declared in each task, one after the other."""
    sheet = {"sensor_std": errors.sensor_std, "bias_std": errors.bias_std}
    vehicle = Onboard(name, confidence=max(CONFIDENCE), max_steps=max_steps, arrival_km=arrival_km, **sheet)
    drift_km = errors.drift_km(50.0)
    reach_km = max(drift_km, conditions_named("aircraft").drift_km(50.0))  # the same regions in each row
    options = {"num_envs": 1, "reach_km": reach_km, "drift_km": drift_km, "max_steps": max_steps + 1}
    base = earth_env(tasks, arrival="declared", **options)  # never ends an episode by itself
    env = with_conditions(base, errors, 0)
    return [flight(vehicle, env, base, arrival_km) for _ in range(tasks)]


def flight(vehicle: Onboard, env: GeomagneticNavEnv, base: GeomagneticNavEnv, arrival_km: float | None) -> Declared:
    """Fly the next task and return what was declared."""
    state, declared, over = env.reset(), Declared(), False
    vehicle.start(state["target_field"][0].tolist())
    while not over:
        reading = state["field"][0].tolist()
        order = vehicle.step(*reading, math.degrees(state["heading"].item()), state["move"][0, 0].item())
        left_km = geodesic(*state["position"].unbind(-1), *state["target_position"].unbind(-1))[0].item()
        near = state["objective"].item() < base.zeta if arrival_km is None else left_km <= arrival_km
        for level in CONFIDENCE:
            if order.confidence >= level and order.stop != "lost":
                declared.setdefault(level, (near, left_km))
        over = bool(order.stop) or state["done"].item()
        if not over:
            state["action"] = torch.tensor([[order.distance_km, math.radians(order.turn_deg), -1.0]])
            state = env.step(state)["next"]
    return declared


def onboard(
    navigators: Sequence[str],
    *,
    conditions: Sequence[str] = (),
    tasks: int = 100,
    arrival_km: float | None = None,
    max_steps: int = 50,
) -> str:
    """Return, at each level of confidence, the share of flights that were declared as arrived, the share of these that
    were right, and the median distance to the destination [km] where the vehicle declared."""
    rows = []
    cases = [(name, *case) for name in navigators for case in errors_by_name(conditions).items()]
    for name, errors_name, errors in tqdm(cases, unit="row"):
        flown = flights(name, errors, tasks, arrival_km, max_steps)
        cells = []
        for level in CONFIDENCE:
            found = [declared[level] for declared in flown if level in declared]
            right = f"{100 * sum(near for near, _ in found) / len(found):.1f}" if found else "—"
            distance = f"{median(km for _, km in found):.1f}" if found else "—"
            cells.append(f"{100 * len(found) / len(flown):.1f} / {right} / {distance}")
        rows.append([label(name), errors_name, *cells])
    return markdown_table(["navigator", "errors", *(f"confidence {level:g}" for level in CONFIDENCE)], rows)
