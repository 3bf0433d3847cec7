"""An artificial fish swarm as a navigator."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number
from magrl.navigators.metaheuristics.base import Evaluate, Metaheuristic, in_disc, take


class ArtificialFishSwarm(Metaheuristic):
    """Artificial fish swarm: each fish follows a better neighbor, swarms to the center, or preys.

    In mode ``"flown"`` the fitness of the center is the mean of the fish around it, and preying is a random step.

    Args:
        visual: range of sight of a fish, in longest moves.
        step: longest step of a fish, in longest moves.
        crowding: share of the population near a place above which that place is crowded.
        tries: places that a preying fish evaluates before it steps at random.
        options: options of :class:`Metaheuristic`.

    Source:
        X. Li, Z. Shao and J. Qian, An optimizing method based on autonomous animats: fish-swarm algorithm, Systems
        Engineering: Theory and Practice 22 (2002); as in D. Yazdani et al., Fuzzy adaptive artificial fish swarm
        algorithm, AI (2010).

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> fish = ArtificialFishSwarm(mode="look-ahead", field=env.field, population_size=4, generations=2)
        >>> moved = env.rollout(1, fish)
        >>> (moved["next", "objective"] < moved["objective"]).all()
        tensor(True)
    """

    name, label = "afsa", "AFSA"
    description = label
    settings: ClassVar = {
        "look-ahead": {"population_size": 8, "generations": 6, "visual": 0.5, "step": 1.0},
        "flown": {"population_size": 2, "spread": 0.2, "visual": 2.0, "step": 1.0},
    }

    def __init__(
        self, *, visual: float = 0.5, step: float = 0.3, crowding: float = 0.6, tries: int = 3, **options: Any
    ) -> None:
        super().__init__(**options)
        check_number(1e-6, 10, visual=visual, step=step)
        check_number(0, 1, crowding=crowding)
        check_number(1, 1000, whole=True, tries=tries)
        self.visual, self.step, self.crowding, self.tries = visual, step, crowding, tries

    def evolve(self, state: TensorDictBase, fitness: Tensor, evaluate: Evaluate | None) -> dict[str, Tensor]:
        fish = state["population"]
        near = (fish.unsqueeze(1) - fish.unsqueeze(2)).norm(dim=-1) < self.visual
        near = near & ~torch.eye(fish.shape[1], dtype=torch.bool, device=fish.device)
        count = near.sum(-1)
        leader_fitness, leader = torch.where(near, fitness.unsqueeze(1), math.inf).min(-1)
        weight = near.double() / count.clamp_min(1).unsqueeze(-1)
        center = weight @ fish
        mean = torch.where(near, fitness.unsqueeze(1), 0.0).sum(-1) / count.clamp_min(1)
        center_fitness = mean if evaluate is None else evaluate(center)
        # A fish without neighbors, or in a crowd, preys.
        free = (count > 0) & (count <= self.crowding * fish.shape[1])
        follow = free & (leader_fitness < fitness) & (leader_fitness <= center_fitness)
        swarm = free & (center_fitness < fitness) & ~follow
        goal = torch.where(follow.unsqueeze(-1), take(fish, leader), center)
        goal = torch.where((follow | swarm).unsqueeze(-1), goal, self._prey(fish, fitness, evaluate))
        way = goal - fish
        length = self.step * self.uniform(fish, *fish.shape[:2], 1)
        return {"population": in_disc(fish + way * (length / way.norm(dim=-1, keepdim=True).clamp_min(1e-9)))}

    def _prey(self, fish: Tensor, fitness: Tensor, evaluate: Evaluate | None) -> Tensor:
        """Return the first better place in sight, or else the last one evaluated: ``(N, P, 2)``."""
        places = fish.unsqueeze(2) + self.visual * (2 * self.uniform(fish, *fish.shape[:2], self.tries, 2) - 1)
        if evaluate is None:
            return places[:, :, -1]
        better = evaluate(places.flatten(1, 2)).unflatten(1, (-1, self.tries)) < fitness.unsqueeze(-1)
        better[..., -1] = True
        first = better.long().argmax(-1)
        return places.gather(2, first[..., None, None].expand(*first.shape, 1, 2)).squeeze(2)
