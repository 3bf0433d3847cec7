"""Genetic algorithm, particle swarm and artificial fish swarm as navigators: the paper's baselines, in two modes.

The paper does not describe how a candidate move is evaluated. In mode ``"look-ahead"`` the navigator reads the field at
the end of each candidate before it chooses one: an oracle. In mode ``"flown"`` every individual is a move of the
episode, and its fitness is known after the move: no privileged key is read.

An individual is a displacement ``(north, east)`` in units of the longest move, limited to the disc of radius 1, so that
averages and differences of individuals are displacements too. Lower fitness is better.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from tensordict.nn import TensorDictModuleBase

from magrl.checks import check_type
from magrl.envs.geomagnetic import GeomagneticNavEnv
from magrl.navigators.metaheuristics.base import MODES, Metaheuristic
from magrl.navigators.metaheuristics.fish_swarm import ArtificialFishSwarm
from magrl.navigators.metaheuristics.genetic import GeneticAlgorithm
from magrl.navigators.metaheuristics.particle_swarm import ParticleSwarm

__all__ = [
    "ALGORITHMS",
    "METAHEURISTICS",
    "MODES",
    "SETTINGS",
    "ArtificialFishSwarm",
    "GeneticAlgorithm",
    "Metaheuristic",
    "ParticleSwarm",
    "build",
]

ALGORITHMS: dict[str, type[Metaheuristic]] = {
    "ga": GeneticAlgorithm,
    "pso": ParticleSwarm,
    "afsa": ArtificialFishSwarm,
}
SETTINGS: dict[tuple[str, str], dict[str, Any]] = {
    ("ga", "look-ahead"): {
        "population_size": 16,
        "generations": 10,
        "mutation_rate": 0.3,
        "mutation_scale": 0.2,
    },
    ("ga", "flown"): {"population_size": 4, "spread": 0.2, "mutation_rate": 0.3, "mutation_scale": 0.1},
    ("pso", "look-ahead"): {
        "population_size": 16,
        "generations": 10,
        "inertia": 0.7,
        "cognitive": 1.5,
        "social": 1.5,
    },
    ("pso", "flown"): {
        "population_size": 8,
        "spread": 0.2,
        "inertia": 0.4,
        "cognitive": 1.5,
        "social": 1.5,
    },
    ("afsa", "look-ahead"): {"population_size": 8, "generations": 6, "visual": 0.5, "step": 1.0},
    ("afsa", "flown"): {"population_size": 2, "spread": 0.2, "visual": 2.0, "step": 1.0},
}
"""Options by algorithm and mode, from recipes/tables/sweep_metaheuristics.py: those of the highest SPL, or with a third
of the readings for 0.1 % less."""


def build(name: str, env: GeomagneticNavEnv, mode: str, seed: int, **options: Any) -> Metaheuristic:
    """Return an algorithm for an environment, with the options of :data:`SETTINGS` where none are given.

    Raises:
        ValueError: for an unknown algorithm or mode, or an option out of its range.
        TypeError: for another environment, or an option that the algorithm does not have.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> swarm = build("pso", env, "flown", seed=0, population_size=4)
        >>> swarm.oracle, env.rollout(2, swarm)["action"].shape
        (False, torch.Size([2, 2, 2]))
    """
    check_type(GeomagneticNavEnv, env=env)
    if name not in ALGORITHMS:
        raise ValueError(f"unknown metaheuristic {name!r}: choose from {', '.join(ALGORITHMS)}")
    if mode not in MODES:
        raise ValueError(f"mode must be one of {MODES}, got {mode!r}")
    if len(env.region) > 1:
        raise ValueError(f"metaheuristics navigate in one region, and the scenario has {len(env.region)}")
    bounds = {"max_move_km": env.max_move_km, "max_turn_rad": env.max_turn_rad, "seed": seed, "mode": mode}
    bounds["field"] = env.field if mode == "look-ahead" else None
    bounds["objective_floors"] = tuple(env.objective_floors[0].tolist())
    return ALGORITHMS[name](**{**bounds, **SETTINGS[name, mode], **options})


METAHEURISTICS: dict[str, Callable[[GeomagneticNavEnv, str, int], TensorDictModuleBase]] = {
    name: partial(build, name) for name in ALGORITHMS
}
"""Factories by name, called with an environment, a mode and a seed."""
