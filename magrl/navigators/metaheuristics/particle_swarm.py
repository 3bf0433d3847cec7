"""A particle swarm as a navigator."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number
from magrl.navigators.metaheuristics.base import Evaluate, Metaheuristic, in_disc, take


class ParticleSwarm(Metaheuristic):
    """Particle swarm optimization with an inertia weight.

    Args:
        inertia: share of its velocity that a particle keeps.
        cognitive: pull to the best place of the particle.
        social: pull to the best place of the swarm.
        max_velocity: largest velocity of each coordinate, in longest moves per generation.
        options: options of :class:`Metaheuristic`.

    Source:
        J. Kennedy and R. Eberhart, Particle swarm optimization, ICNN (1995); inertia: Y. Shi and R. Eberhart, A
        modified particle swarm optimizer, ICEC (1998).

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> moved = env.rollout(1, ParticleSwarm(mode="look-ahead", field=env.field))
        >>> (moved["next", "objective"] < moved["objective"]).all()
        tensor(True)
    """

    name, label = "pso", "PSO"
    description = label
    settings: ClassVar = {
        "look-ahead": {"population_size": 16, "generations": 10, "inertia": 0.7, "cognitive": 1.5, "social": 1.5},
        "flown": {"population_size": 8, "spread": 0.2, "inertia": 0.4, "cognitive": 1.5, "social": 1.5},
    }

    def __init__(
        self,
        *,
        inertia: float = 0.7,
        cognitive: float = 1.5,
        social: float = 1.5,
        max_velocity: float = 0.5,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_number(0, 2, inertia=inertia)
        check_number(0, 10, cognitive=cognitive, social=social)
        check_number(1e-6, 10, max_velocity=max_velocity)
        self.inertia, self.cognitive, self.social, self.max_velocity = inertia, cognitive, social, max_velocity

    def begin(self, population: Tensor) -> dict[str, Tensor]:
        lowest = torch.full_like(population[..., 0], math.inf)
        return {"velocity": torch.zeros_like(population), "best": population.clone(), "lowest": lowest}

    def evolve(self, state: TensorDictBase, fitness: Tensor, evaluate: Evaluate | None) -> dict[str, Tensor]:  # noqa: ARG002
        population = state["population"]
        better = fitness < state["lowest"]
        lowest = torch.where(better, fitness, state["lowest"])
        best = torch.where(better.unsqueeze(-1), population, state["best"])
        leader = take(best, lowest.argmin(1, keepdim=True))
        personal, shared = self.uniform(population, 2, *population.shape)
        pull = self.cognitive * personal * (best - population) + self.social * shared * (leader - population)
        velocity = (self.inertia * state["velocity"] + pull).clamp(-self.max_velocity, self.max_velocity)
        return {"population": in_disc(population + velocity), "velocity": velocity, "best": best, "lowest": lowest}
