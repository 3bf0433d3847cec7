"""Genetic algorithm, particle swarm and artificial fish swarm as navigators: the paper's baselines.

The paper does not describe how a candidate leg is evaluated. Here the navigator reads the field at the end of each
candidate before it chooses one: an oracle.

An individual is a displacement ``(north, east)`` in units of the longest leg, limited to the disc of radius 1, so that
averages and differences of individuals are displacements too. Lower fitness is better.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from magrl import guidance
from magrl.checks import check_number
from magrl.envs import GeomagneticNavEnv
from magrl.field.model import FieldModel, elements_at
from magrl.geodesy import move, wrap_angle
from magrl.navigators.base import Navigator
from magrl.random_numbers import advanced, counter_stream, normal_of, stream_uniform
from magrl.sensor_std import SensorStd
from magrl.transforms.episode import EPISODE_STREAM

Evaluate = Callable[[Tensor], Tensor]
"""From candidates ``(N, K, 2)`` to their fitness ``(N, K)``."""

CROSSOVER_RATE = 0.9
"""Share of children with two parents."""
BLEND = 0.5
"""How far a child may lie beyond its parents, as a share of their distance (BLX-alpha)."""
MUTATION_SCALE = 0.2
"""Standard deviation of a mutation, in longest legs."""
MAX_VELOCITY = 0.5
"""Largest velocity of each coordinate of a particle, in longest legs per generation."""


def reachable(candidate: Tensor, heading: Tensor, max_turn_rad: float) -> tuple[Tensor, Tensor]:
    """Return the leg nearest to a candidate in heading and length that one turn allows.

    Args:
        candidate: ``(..., 2)`` north, east, in longest legs.
        heading: ``(...)`` present heading [rad].
        max_turn_rad: largest turn [rad].

    Returns:
        Distance in [0, 1] and turn [rad], each ``(...)``.

    Example:
        >>> reachable(torch.tensor([[0.0, 2.0], [-0.3, 0.0]]), torch.zeros(2), 1.0)
        (tensor([1.0000, 0.3000]), tensor([1., 1.]))
    """
    turn = wrap_angle(torch.atan2(candidate[..., 1], candidate[..., 0]) - heading)
    return candidate.norm(dim=-1).clamp_max(1), turn.clamp(-max_turn_rad, max_turn_rad)


def take(values: Tensor, index: Tensor) -> Tensor:
    """Return individuals by number: ``(N, P, ...)`` at ``(N, K)`` is ``(N, K, ...)``.

    Example:
        >>> take(torch.tensor([[10, 11, 12], [20, 21, 22]]), torch.tensor([[2], [0]]))
        tensor([[12],
                [20]])
    """
    return values[torch.arange(len(values), device=values.device).unsqueeze(-1), index]


def in_disc(candidate: Tensor) -> Tensor:
    """Return candidates ``(..., 2)`` shortened to length 1; NaN stays NaN.

    Example:
        >>> in_disc(torch.tensor([[3.0, 4.0], [0.3, 0.4]]))
        tensor([[0.6000, 0.8000],
                [0.3000, 0.4000]])
    """
    return candidate / candidate.norm(dim=-1, keepdim=True).clamp_min(1)


class Draws:
    """Random numbers of vehicles in one step, a pure function of their streams.

    Args:
        stream: ``(N,)`` of :func:`magrl.random_numbers.counter_stream`.

    Example:
        >>> draws = Draws(torch.tensor([5, 5]))
        >>> bool((draws.uniform(3)[0] == draws.uniform(3)[1]).any())
        False
    """

    def __init__(self, stream: Tensor) -> None:
        self.stream = stream

    def uniform(self, *shape: int) -> Tensor:
        """Return the next uniform numbers in [0, 1) of each vehicle, ``(N, *shape)`` float64."""
        count = math.prod(shape)
        numbers, self.stream = stream_uniform(self.stream, count), advanced(self.stream, count)
        return numbers.unflatten(-1, shape)

    def normal(self, *shape: int) -> Tensor:
        """Return the next standard normal numbers of each vehicle, ``(N, *shape)`` float64."""
        return normal_of(self.uniform(*shape))


class Metaheuristic(Navigator):
    """Base class of the metaheuristics: individuals as legs, and the search for the best.

    A subclass initializes its state (:meth:`begin`) and computes the next generation (:meth:`evolve`). Its numbers are
    class attributes, from a sweep: with the highest SPL, or with a third of the readings for 0.1 % less.

    Args:
        field: field model.
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].
        seed: seed of the random numbers, which are those of a vehicle, an episode and a step.

    Raises:
        ValueError: for any option out of its range, naming it and its value.

    Example:
        >>> class RandomSearch(Metaheuristic):
        ...     def evolve(self, state, fitness, evaluate, draws):
        ...         return {"population": self.first_state(draws)["population"]}
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(3, RandomSearch(env.field))["action"].shape
        torch.Size([2, 3, 2])
    """

    oracle, needs = True, "the field at other places"
    options = ("seed",)
    population_size, generations = 16, 10
    """Number of individuals; generations of the search for one leg, the random first one included."""

    def __init__(
        self,
        field: FieldModel,
        *,
        max_leg_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        seed: int = 0,
    ) -> None:
        super().__init__(max_leg_km, max_turn_rad)
        check_number(whole=True, seed=seed)
        self.field, self.seed = field, int(seed)
        self.in_keys = ["target_field", "heading", "elapsed_steps", "position", "objective_weights", "done"]
        self.in_keys += [EPISODE_STREAM]

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: SensorStd) -> dict[str, Any]:  # noqa: ARG004
        if len(env.region) > 1:
            raise ValueError(f"metaheuristics navigate in one region, and the scenario has {len(env.region)}")
        return {"field": env.field}

    # Methods of a subclass

    def begin(self, population: Tensor) -> dict[str, Tensor]:  # noqa: ARG002
        """Return the state of an algorithm beside its first population ``(N, P, 2)``: tensors ``(N, ...)``, or none."""
        return {}

    def evolve(self, state: TensorDictBase, fitness: Tensor, evaluate: Evaluate, draws: Draws) -> dict[str, Tensor]:
        """Return the next generation.

        Args:
            state: ``(N,)`` with ``population`` ``(N, P, 2)`` and the entries of :meth:`begin`.
            fitness: ``(N, P)`` fitness of that population.
            evaluate: fitness of more candidates.
            draws: random numbers.
        """
        raise NotImplementedError

    @property
    def readings_per_step(self) -> int:  # type: ignore[override]
        """Readings of the field at the ends of candidates, in each step."""
        return self.generations * self.population_size

    def first_state(self, draws: Draws) -> TensorDictBase:
        """Return a population uniform over a disc of legs for each of the ``N`` vehicles."""
        radius, angle = draws.uniform(2, self.population_size).unbind(1)
        distance, heading = radius.sqrt(), 2 * math.pi * angle
        population = torch.stack((distance * torch.cos(heading), distance * torch.sin(heading)), -1)
        return TensorDict({"population": population, **self.begin(population)}, batch_size=draws.stream.shape)

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:  # noqa: ARG002
        """Return the best leg; none after the end of an episode, where a rollout steps on for other vehicles."""
        action = torch.zeros(*seen.batch_size, 2, device=seen.device)
        going = ~seen["done"].squeeze(-1)
        action[going] = torch.stack(self._best(seen[going]), -1).float()
        return action

    def _best(self, seen: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return distance [km] and turn [rad] ``(N,)`` of the best of all candidates of some generations."""
        heading, counters = seen["heading"].double(), torch.cat((seen[EPISODE_STREAM], seen["elapsed_steps"]), -1)
        draws = Draws(counter_stream(self.seed, counters))

        def evaluate(candidate: Tensor) -> Tensor:
            return self._objective_at(seen, *reachable(candidate, heading, self.max_turn_rad))

        state = self.first_state(draws)
        best, lowest = state["population"][:, :1], torch.full_like(heading, math.inf)
        for generation in range(self.generations):
            fitness = evaluate(state["population"])
            pool, values = torch.cat((best, state["population"]), 1), torch.cat((lowest, fitness), 1)
            lowest, index = values.min(1, keepdim=True)
            best = take(pool, index)
            if generation + 1 < self.generations:
                state.update(self.evolve(state, fitness, evaluate, draws))
        distance, turn = reachable(best, heading, self.max_turn_rad)
        return distance.squeeze(-1) * self.max_leg_km, turn.squeeze(-1)

    def _objective_at(self, seen: TensorDictBase, distance: Tensor, turn: Tensor) -> Tensor:
        """Return F (Eq. (6)) at the ends of legs ``(N, K)``; infinite beyond the field model."""
        start = seen["position"].unsqueeze(1)
        heading = seen["heading"].double() + turn
        end = torch.stack(move(start[..., 0], start[..., 1], heading, distance * self.max_leg_km), -1)
        there, weights = (seen[key].double().unsqueeze(1) for key in ("target_field", "objective_weights"))
        value = guidance.objective(elements_at(self.field, end), there, weights).squeeze(-1)
        return value.nan_to_num(nan=math.inf)


class GeneticAlgorithm(Metaheuristic):
    """Real-coded genetic algorithm: tournaments, blend crossover, Gaussian mutation, elitism.

    Args:
        field: field model.
        options: options of :class:`Metaheuristic`.

    Source:
        J. H. Holland, Adaptation in Natural and Artificial Systems (1975); blend crossover: L. J. Eshelman and
        J. D. Schaffer, Real-coded genetic algorithms and interval-schemata, FOGA 2 (1993).

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> moved = env.rollout(1, GeneticAlgorithm(env.field))
        >>> (moved["next", "objective"] < moved["objective"]).all()
        tensor(True)
    """

    name, label = "ga", "GA"
    description = "GA, look-ahead (an oracle)"

    tournament_size, mutation_rate, elites = 2, 0.3, 1
    """Individuals that compete to be a parent, share of coordinates that mutate, best individuals that are kept."""

    def evolve(
        self,
        state: TensorDictBase,
        fitness: Tensor,
        evaluate: Evaluate,  # noqa: ARG002
        draws: Draws,
    ) -> dict[str, Tensor]:
        population, size = state["population"], self.population_size
        elite = take(population, fitness.topk(self.elites, dim=1, largest=False).indices)
        first, second = (take(population, self._tournament(fitness, draws)) for _ in range(2))
        weight = (1 + 2 * BLEND) * draws.uniform(size, 2) - BLEND
        crossed = draws.uniform(size, 1) < CROSSOVER_RATE
        children = torch.where(crossed, first + weight * (second - first), first)
        mutated = draws.uniform(size, 2) < self.mutation_rate
        children = children + mutated * MUTATION_SCALE * draws.normal(size, 2)
        return {"population": torch.cat((elite, in_disc(children)[:, self.elites :]), 1)}

    def _tournament(self, fitness: Tensor, draws: Draws) -> Tensor:
        """Return the indices of the winners, one for each place in the next generation, ``(N, P)``."""
        size = fitness.shape[1]
        rivals = (size * draws.uniform(size * self.tournament_size)).long()
        winner = take(fitness, rivals).unflatten(1, (size, -1)).argmin(-1, keepdim=True)
        return rivals.unflatten(1, (size, -1)).gather(-1, winner).squeeze(-1)


class ParticleSwarm(Metaheuristic):
    """Particle swarm optimization with an inertia weight.

    Args:
        field: field model.
        options: options of :class:`Metaheuristic`.

    Source:
        J. Kennedy and R. Eberhart, Particle swarm optimization, ICNN (1995); inertia: Y. Shi and R. Eberhart, A
        modified particle swarm optimizer, ICEC (1998).

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> moved = env.rollout(1, ParticleSwarm(env.field))
        >>> (moved["next", "objective"] < moved["objective"]).all()
        tensor(True)
    """

    name, label = "pso", "PSO"
    description = "PSO, look-ahead (an oracle)"

    inertia, cognitive, social = 0.7, 1.5, 1.5
    """Share of its velocity that a particle keeps, pull to the best place of the particle, and to that of the swarm."""

    def begin(self, population: Tensor) -> dict[str, Tensor]:
        lowest = torch.full_like(population[..., 0], math.inf)
        return {"velocity": torch.zeros_like(population), "best": population.clone(), "lowest": lowest}

    def evolve(
        self,
        state: TensorDictBase,
        fitness: Tensor,
        evaluate: Evaluate,  # noqa: ARG002
        draws: Draws,
    ) -> dict[str, Tensor]:
        population = state["population"]
        better = fitness < state["lowest"]
        lowest = torch.where(better, fitness, state["lowest"])
        best = torch.where(better.unsqueeze(-1), population, state["best"])
        leader = take(best, lowest.argmin(1, keepdim=True))
        personal, shared = draws.uniform(2, *population.shape[1:]).unbind(1)
        pull = self.cognitive * personal * (best - population) + self.social * shared * (leader - population)
        velocity = (self.inertia * state["velocity"] + pull).clamp(-MAX_VELOCITY, MAX_VELOCITY)
        return {"population": in_disc(population + velocity), "velocity": velocity, "best": best, "lowest": lowest}


class ArtificialFishSwarm(Metaheuristic):
    """Artificial fish swarm: each fish follows a better neighbor, swarms to the center, or preys.

    Args:
        field: field model.
        options: options of :class:`Metaheuristic`.

    Source:
        X. Li, Z. Shao and J. Qian, An optimizing method based on autonomous animats: fish-swarm algorithm, Systems
        Engineering: Theory and Practice 22 (2002); as in D. Yazdani et al., Fuzzy adaptive artificial fish swarm
        algorithm, AI (2010).

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> moved = env.rollout(1, ArtificialFishSwarm(env.field))
        >>> (moved["next", "objective"] < moved["objective"]).all()
        tensor(True)
    """

    name, label = "afsa", "AFSA"
    description = "AFSA, look-ahead (an oracle)"

    population_size, generations = 8, 6
    visual, step, crowding, tries = 0.5, 1.0, 0.6, 3
    """Range of sight and longest step of a fish, in longest legs; share of the population near a place above which that
    place is crowded; places that a preying fish evaluates before it steps at random."""

    @property
    def readings_per_step(self) -> int:  # type: ignore[override]
        """Readings at the fish, and between generations at the center of each and where it preys."""
        return self.population_size * (self.generations + (self.generations - 1) * (1 + self.tries))

    def evolve(self, state: TensorDictBase, fitness: Tensor, evaluate: Evaluate, draws: Draws) -> dict[str, Tensor]:
        fish = state["population"]
        near = (fish.unsqueeze(1) - fish.unsqueeze(2)).norm(dim=-1) < self.visual
        near = near & ~torch.eye(fish.shape[1], dtype=torch.bool, device=fish.device)
        count = near.sum(-1)
        leader_fitness, leader = torch.where(near, fitness.unsqueeze(1), math.inf).min(-1)
        weight = near.double() / count.clamp_min(1).unsqueeze(-1)
        center = weight @ fish
        center_fitness = evaluate(center)
        # A fish without neighbors, or in a crowd, preys.
        free = (count > 0) & (count <= self.crowding * fish.shape[1])
        follow = free & (leader_fitness < fitness) & (leader_fitness <= center_fitness)
        swarm = free & (center_fitness < fitness) & ~follow
        goal = torch.where(follow.unsqueeze(-1), take(fish, leader), center)
        goal = torch.where((follow | swarm).unsqueeze(-1), goal, self._prey(fish, fitness, evaluate, draws))
        toward = goal - fish
        length = self.step * draws.uniform(self.population_size, 1)
        return {"population": in_disc(fish + toward * (length / toward.norm(dim=-1, keepdim=True).clamp_min(1e-9)))}

    def _prey(self, fish: Tensor, fitness: Tensor, evaluate: Evaluate, draws: Draws) -> Tensor:
        """Return the first better place in sight, or else the last one evaluated: ``(N, P, 2)``."""
        places = fish.unsqueeze(2) + self.visual * (2 * draws.uniform(*fish.shape[1:2], self.tries, 2) - 1)
        better = evaluate(places.flatten(1, 2)).unflatten(1, (-1, self.tries)) < fitness.unsqueeze(-1)
        better[..., -1] = True
        first = better.long().argmax(-1)
        return places.gather(2, first[..., None, None].expand(*first.shape, 1, 2)).squeeze(2)
