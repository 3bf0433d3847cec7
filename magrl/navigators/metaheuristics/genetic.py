"""A genetic algorithm as a navigator."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number
from magrl.navigators.metaheuristics.base import Evaluate, Metaheuristic, in_disc, take


class GeneticAlgorithm(Metaheuristic):
    """Real-coded genetic algorithm: tournaments, blend crossover, Gaussian mutation, elitism.

    Args:
        tournament_size: individuals that compete to be a parent.
        crossover_rate: share of children with two parents.
        blend: how far a child may lie beyond its parents, as a share of their distance (BLX-alpha).
        mutation_rate: share of coordinates that mutate.
        mutation_scale: standard deviation of a mutation, in longest moves.
        elites: best individuals that are kept.
        options: options of :class:`Metaheuristic`.

    Source:
        J. H. Holland, Adaptation in Natural and Artificial Systems (1975); blend crossover: L. J. Eshelman and
        J. D. Schaffer, Real-coded genetic algorithms and interval-schemata, FOGA 2 (1993).

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> moved = env.rollout(1, GeneticAlgorithm(mode="look-ahead", field=env.field))
        >>> (moved["next", "objective"] < moved["objective"]).all()
        tensor(True)
    """

    name, label = "ga", "GA"
    description = label
    settings: ClassVar = {
        "look-ahead": {"population_size": 16, "generations": 10, "mutation_rate": 0.3, "mutation_scale": 0.2},
        "flown": {"population_size": 4, "spread": 0.2, "mutation_rate": 0.3, "mutation_scale": 0.1},
    }

    def __init__(
        self,
        *,
        tournament_size: int = 2,
        crossover_rate: float = 0.9,
        blend: float = 0.5,
        mutation_rate: float = 0.3,
        mutation_scale: float = 0.2,
        elites: int = 1,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_number(1, 10_000, whole=True, tournament_size=tournament_size)
        check_number(0, 1, crossover_rate=crossover_rate, mutation_rate=mutation_rate)
        check_number(0, 10, blend=blend, mutation_scale=mutation_scale)
        check_number(0, self.population_size - 1, whole=True, elites=elites)
        self.tournament_size, self.elites = tournament_size, elites
        self.crossover_rate, self.blend = crossover_rate, blend
        self.mutation_rate, self.mutation_scale = mutation_rate, mutation_scale

    def evolve(self, state: TensorDictBase, fitness: Tensor, evaluate: Evaluate | None) -> dict[str, Tensor]:  # noqa: ARG002
        population = state["population"]
        elite = take(population, fitness.topk(self.elites, dim=1, largest=False).indices)
        first, second = (take(population, self._tournament(fitness)) for _ in range(2))
        weight = (1 + 2 * self.blend) * self.uniform(population, *population.shape) - self.blend
        crossed = self.uniform(population, *population.shape[:2], 1) < self.crossover_rate
        children = torch.where(crossed, first + weight * (second - first), first)
        mutated = self.uniform(population, *population.shape) < self.mutation_rate
        children = children + mutated * self.mutation_scale * self.normal(children)
        return {"population": torch.cat((elite, in_disc(children)[:, self.elites :]), 1)}

    def _tournament(self, fitness: Tensor) -> Tensor:
        """Return the indices of the winners, one for each place in the next generation, ``(N, P)``."""
        size = fitness.shape[1]
        draws = (size * self.uniform(fitness, len(fitness), size * self.tournament_size)).long()
        winner = take(fitness, draws).unflatten(1, (size, -1)).argmin(-1, keepdim=True)
        return draws.unflatten(1, (size, -1)).gather(-1, winner).squeeze(-1)
