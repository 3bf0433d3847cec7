"""Print the table of metaheuristics that keep one population over a trip.

    python docs/tables/populations.py > docs/results/populations.md    # half a minute on one core

At each step, they read the field at the end of each candidate at no cost, fly the best one, and breed a generation.
Populations and longest legs were chosen for results near the paper's.
"""

from __future__ import annotations

from magrl import Scenario, evaluate, summarize
from magrl.evaluation.tables import comparison_table
from magrl.navigators import metaheuristics
from magrl.navigators.metaheuristics import EPISODE_STREAM, Draws, reachable, take
from magrl.random_numbers import counter_stream

import torch
from tensordict import TensorDictBase
from torch import Tensor


class Kept(metaheuristics.Metaheuristic):
    """Mixin: a population that is kept over a trip, with one generation for each step."""

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        """Return the first population."""
        return dict(self.first_state(self.draws(seen, 1)).items())

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the best candidate as distance [km] and turn [rad] ``(N,)``."""
        population, heading = memory["population"], seen["heading"].double()

        def fitness(candidate: Tensor) -> Tensor:
            return self._objective_at(seen, *reachable(candidate, heading, self.max_turn_rad))

        values = fitness(population)
        memory.update(self.evolve(memory, values, fitness, self.draws(seen)))
        distance, turn = reachable(take(population, values.argmin(1, keepdim=True)), heading, self.max_turn_rad)
        return distance.squeeze(-1) * self.max_leg_km, turn.squeeze(-1)

    def draws(self, seen: TensorDictBase, stream: int = 0) -> Draws:
        """Return the random numbers of a step."""
        counters = torch.cat((seen[EPISODE_STREAM], seen["elapsed_steps"]), -1)
        return Draws(counter_stream(2 * self.seed + stream, counters))


class KeptGA(Kept, metaheuristics.GeneticAlgorithm):
    """GA with options that give about the paper's result."""

    population_size, longest_leg_km, description = 5, 25.0, "GA, 5 individuals kept, legs up to 25 km"


class KeptPSO(Kept, metaheuristics.ParticleSwarm):
    """PSO with options that give about the paper's result."""

    population_size, longest_leg_km, description = 5, 22.0, "PSO, 5 particles kept, legs up to 22 km"


class KeptAFSA(Kept, metaheuristics.ArtificialFishSwarm):
    """AFSA with options that give about the paper's result."""

    population_size, tries, longest_leg_km, description = 2, 2, 18.0, "AFSA, 2 fish kept, legs up to 18 km"


def table(trips: str = "test-1000") -> str:
    """Return the table, with the paper's rows."""
    kinds, field = (KeptGA, KeptPSO, KeptAFSA), Scenario().build_field()
    return comparison_table({k: [summarize(evaluate(k(field, max_leg_km=k.longest_leg_km), trips))] for k in kinds})


if __name__ == "__main__":
    print(table(), end="")
