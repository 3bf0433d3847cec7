"""Navigators: policies without training, each with its memory of the track."""

from __future__ import annotations

from collections.abc import Callable

from tensordict.nn import TensorDictModuleBase

from magrl.envs import GeomagneticNavEnv
from magrl.navigators.base import Navigator
from magrl.navigators.metaheuristics import METAHEURISTICS
from magrl.navigators.parallel import ParallelApproach
from magrl.navigators.secant import Secant


def _parallel(env: GeomagneticNavEnv, mode: str, seed: int) -> TensorDictModuleBase:  # noqa: ARG001
    return ParallelApproach(env.field, env.max_move_km, env.max_turn_rad)


def _secant(env: GeomagneticNavEnv, mode: str, seed: int) -> TensorDictModuleBase:  # noqa: ARG001
    return Secant(env.max_move_km, env.max_turn_rad, min(10.0, env.max_move_km))


NAVIGATORS: dict[str, Callable[[GeomagneticNavEnv, str, int], TensorDictModuleBase]] = {
    "parallel": _parallel,
    "secant": _secant,
}
"""Factories by name, called with an environment, a mode and a seed; these two ignore mode and seed."""

__all__ = ["METAHEURISTICS", "NAVIGATORS", "Navigator", "ParallelApproach", "Secant"]
