"""Genetic algorithm, particle swarm and artificial fish swarm as navigators: the paper's baselines, in two readings.

The paper does not say how a candidate move is evaluated, so there are two modes. In ``"look-ahead"`` the field at the
end of each candidate is read at no charge before one is flown: an oracle. In ``"flown"`` every individual is a move
of the journey, and its fitness is known once it has been flown: no privileged key is read.

An individual is a displacement ``(north, east)`` in units of the longest move, held to the disc of radius 1: a move
with its heading, on which averages and differences mean what they should. Lower fitness is better.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from tensordict.nn import TensorDictModuleBase

from magrl.checks import check_type
from magrl.env import GeomagneticNavEnv
from magrl.metaheuristics.base import MODES, Metaheuristic
from magrl.metaheuristics.fish_swarm import ArtificialFishSwarm
from magrl.metaheuristics.genetic import GeneticAlgorithm
from magrl.metaheuristics.particle_swarm import ParticleSwarm

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
"""By algorithm and mode, what recipes/sweep_metaheuristics.py found best: the highest SPL, or a third of the readings
for a tenth of a percent less."""


def build(name: str, env: GeomagneticNavEnv, mode: str, seed: int, **options: Any) -> Metaheuristic:
    """An algorithm that fits an environment, with :data:`SETTINGS` unless ``options`` say otherwise.

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
    bounds = {"max_move_km": env.max_move_km, "max_turn_rad": env.max_turn_rad, "seed": seed, "mode": mode}
    bounds["field"] = env.field if mode == "look-ahead" else None
    bounds["objective_floors"] = tuple(env.objective_floors.tolist())
    return ALGORITHMS[name](**{**bounds, **SETTINGS[name, mode], **options})


METAHEURISTICS: dict[str, Callable[[GeomagneticNavEnv, str, int], TensorDictModuleBase]] = {
    name: partial(build, name) for name in ALGORITHMS
}
"""By name: from an environment, a mode and a seed to a navigator that fits it."""
