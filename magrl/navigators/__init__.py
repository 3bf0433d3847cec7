"""Navigators: policies without training, each with its memory of the track."""

from __future__ import annotations

from collections.abc import Callable

from magrl.envs import GeomagneticNavEnv
from magrl.field import Date
from magrl.navigators.base import Navigator
from magrl.navigators.geodesic import Geodesic
from magrl.navigators.kalman import Kalman
from magrl.navigators.map_matching import MapMatching, aged_error, dated_map
from magrl.navigators.mean_jacobian import MeanJacobian
from magrl.navigators.metaheuristics import METAHEURISTICS
from magrl.navigators.parallel import ParallelApproach
from magrl.navigators.quasi_newton import QuasiNewton
from magrl.navigators.run_and_tumble import RunAndTumble
from magrl.navigators.secant import Secant

Noise = tuple[float, float, float]
_PERFECT: Noise = (0.0, 0.0, 0.0)


def _parallel(env: GeomagneticNavEnv, mode: str, seed: int, noise: Noise = _PERFECT) -> ParallelApproach:  # noqa: ARG001
    return ParallelApproach(env.field, env.max_move_km, env.max_turn_rad)


def _secant(env: GeomagneticNavEnv, mode: str, seed: int, noise: Noise = _PERFECT) -> Secant:  # noqa: ARG001
    return Secant(env.max_move_km, env.max_turn_rad, noise=noise)


def _mean_jacobian(env: GeomagneticNavEnv, mode: str, seed: int, noise: Noise = _PERFECT) -> MeanJacobian:  # noqa: ARG001
    if len(env.region) > 1:
        raise ValueError(f"mean_jacobian needs a map of one region, and the scenario has {len(env.region)}")
    places = env.region.grid(21).to(env.device)
    return MeanJacobian(env.field, places, env.max_move_km, env.max_turn_rad, noise=noise)


def _geodesic(env: GeomagneticNavEnv, mode: str, seed: int, noise: Noise = _PERFECT) -> Geodesic:  # noqa: ARG001
    return Geodesic(env.max_move_km, env.max_turn_rad)


def _run_and_tumble(env: GeomagneticNavEnv, mode: str, seed: int, noise: Noise = _PERFECT) -> RunAndTumble:  # noqa: ARG001
    floors = tuple(env.objective_floors.mean(0).tolist())
    return RunAndTumble(env.max_move_km, env.max_turn_rad, objective_floors=floors)


def _kalman(
    env: GeomagneticNavEnv,
    mode: str,  # noqa: ARG001
    seed: int,  # noqa: ARG001
    noise: Noise = _PERFECT,
    bias: Noise = _PERFECT,
) -> Kalman:
    search = env.arrival.rule == "objective"
    return Kalman(env.max_move_km, env.max_turn_rad, noise, env.max_steps, bias=bias, zeta=env.zeta, search=search)


def _map_matching(
    env: GeomagneticNavEnv,
    mode: str,  # noqa: ARG001
    seed: int,  # noqa: ARG001
    noise: Noise = _PERFECT,
    map_date: Date | None = None,
) -> MapMatching:
    if map_date is None:
        return MapMatching(env.field, env.edge, env.max_move_km, env.max_turn_rad, noise)
    field = dated_map(env.scenario, map_date, env.max_move_km).to(env.device)
    error = aged_error(env.scenario, map_date)
    return MapMatching(field, env.edge, env.max_move_km, env.max_turn_rad, noise, error)


NAVIGATORS: dict[str, Callable[..., Navigator]] = {
    "parallel": _parallel,
    "secant": _secant,
    "mean_jacobian": _mean_jacobian,
    "geodesic": _geodesic,
    "run_and_tumble": _run_and_tumble,
    "kalman": _kalman,
    "map_matching": _map_matching,
}
"""Factories by name, called with an environment, a mode and a seed, which these ignore, and perhaps the standard
deviations of the sensors: D [deg], I [deg], B_H [nT]; ``kalman`` also with those of constant and slow errors, and
``map_matching`` with the date of its map."""

NAVIGATOR_CLASSES: dict[str, type[Navigator]] = {
    "parallel": ParallelApproach,
    "secant": Secant,
    "mean_jacobian": MeanJacobian,
    "geodesic": Geodesic,
    "run_and_tumble": RunAndTumble,
    "kalman": Kalman,
    "map_matching": MapMatching,
}
"""Classes by name, for what they say of themselves (:attr:`Navigator.needs`)."""

__all__ = [
    "METAHEURISTICS",
    "NAVIGATORS",
    "NAVIGATOR_CLASSES",
    "Geodesic",
    "Kalman",
    "MapMatching",
    "MeanJacobian",
    "Navigator",
    "ParallelApproach",
    "QuasiNewton",
    "RunAndTumble",
    "Secant",
]
