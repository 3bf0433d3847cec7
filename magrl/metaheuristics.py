"""Genetic algorithm, particle swarm and artificial fish swarm as navigators: the paper's baselines, in two readings.

The paper does not say how a candidate move is evaluated, so there are two modes. In ``"look-ahead"`` the field at the
end of each candidate is read at no charge before one is flown: an oracle. In ``"flown"`` every individual is a move
of the journey, and its fitness is known once it has been flown: no privileged key is read.

An individual is a displacement ``(north, east)`` in units of the longest move, held to the disc of radius 1: a move
with its heading, on which averages and differences mean what they should. Lower fitness is better.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from magrl import guidance
from magrl.env import GeomagneticNavEnv
from magrl.fields import FieldModel, elements_at
from magrl.geodesy import move, wrap_angle
from magrl.navigators import Navigator

MODES = ("look-ahead", "flown")
Evaluate = Callable[[Tensor], Tensor]
"""From candidates ``(N, K, 2)`` to their fitness ``(N, K)``."""


def reachable(candidate: Tensor, heading: Tensor, max_turn_rad: float) -> tuple[Tensor, Tensor]:
    """The move nearest in heading and length to a candidate that one turn allows.

    Args:
        candidate: ``(..., 2)`` north, east, in longest moves.
        heading: ``(...)`` now [rad].
        max_turn_rad: largest turn [rad].

    Returns:
        Distance in [0, 1] and turn [rad], each ``(...)``.

    Example:
        >>> reachable(torch.tensor([[0.0, 2.0], [-0.3, 0.0]]), torch.zeros(2), 1.0)
        (tensor([1.0000, 0.3000]), tensor([1., 1.]))
    """
    turn = wrap_angle(torch.atan2(candidate[..., 1], candidate[..., 0]) - heading)
    return candidate.norm(dim=-1).clamp_max(1), turn.clamp(-max_turn_rad, max_turn_rad)


def displacement(distance: Tensor, heading: Tensor) -> Tensor:
    """North and east of a move, ``(..., 2)``."""
    return torch.stack((distance * torch.cos(heading), distance * torch.sin(heading)), -1)


def take(values: Tensor, index: Tensor) -> Tensor:
    """Individuals by their number: ``(N, P, ...)`` at ``(N, K)`` is ``(N, K, ...)``."""
    return values[torch.arange(len(values), device=values.device).unsqueeze(-1), index]


def _check(name: str, value: float, low: float, high: float, whole: bool = False) -> Any:
    if isinstance(value, bool) or not (low <= value <= high) or (whole and int(value) != value):
        kind = "a whole number" if whole else "a number"
        raise ValueError(f"{name} must be {kind} from {low} to {high}, got {value}")
    return int(value) if whole else float(value)


class Metaheuristic(Navigator):
    """What the three share: individuals as moves, both modes of evaluation, a generator of random numbers.

    A subclass says how a population begins (:meth:`begin`) and how one generation leads to the next (:meth:`evolve`).

    Args:
        mode: ``"look-ahead"`` or ``"flown"``.
        field: field model, in look-ahead mode only.
        population_size: individuals. Flown, they are also the moves of one generation.
        generations: of the search for one move in look-ahead mode, the random first one included.
        spread: radius of the first population, in longest moves.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        objective_floors: of Eq. 2-6, for the fitness of flown moves: D [deg], I [deg], B_H [nT].
        seed: of its random numbers.

    Raises:
        ValueError: for any option out of its range, naming it and its value.
    """

    def __init__(
        self,
        *,
        mode: str,
        field: FieldModel | None = None,
        population_size: int = 8,
        generations: int = 6,
        spread: float = 1.0,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        objective_floors: tuple[float, float, float] = guidance.OBJECTIVE_FLOORS,
        seed: int = 0,
    ) -> None:
        super().__init__(max_move_km, max_turn_rad)
        if mode not in MODES:
            raise ValueError(f"mode must be one of {MODES}, got {mode!r}")
        if (field is not None) != (mode == "look-ahead"):
            raise ValueError(f"field must be given in look-ahead mode and in no other, got {field} in mode {mode!r}")
        if len(objective_floors) != 3 or not all(math.isfinite(x) and x > 0 for x in objective_floors):
            raise ValueError(f"objective_floors must be three positive numbers (deg, deg, nT), got {objective_floors}")
        self.mode, self.field, self.oracle = mode, field, mode == "look-ahead"
        self.population_size = _check("population_size", population_size, 2, 10_000, whole=True)
        self.generations = _check("generations", generations, 1, 10_000, whole=True)
        self.spread = _check("spread", spread, 1e-3, 1)
        self.objective_floors = tuple(objective_floors)
        self.generator = torch.Generator().manual_seed(seed)
        private = ["position", "objective_weights", "done"] if self.oracle else ["field"]
        self.in_keys = ["target_field", "heading", "step_count", *private]

    # What a subclass says

    def begin(self, population: Tensor) -> dict[str, Tensor]:
        """What an algorithm holds beside its first population ``(N, P, 2)``: tensors ``(N, ...)``."""
        raise NotImplementedError

    def evolve(self, state: TensorDictBase, fitness: Tensor, evaluate: Evaluate | None) -> dict[str, Tensor]:
        """The next generation.

        Args:
            state: ``(N,)`` with ``population`` ``(N, P, 2)`` and what :meth:`begin` added.
            fitness: ``(N, P)`` of that population.
            evaluate: reads the field at more candidates; None where only flying tells.
        """
        raise NotImplementedError

    # Random numbers, drawn on the CPU so that a seed means the same flight on every device

    def uniform(self, like: Tensor, *shape: int) -> Tensor:
        """Uniform on [0, 1), float64."""
        return torch.rand(shape, generator=self.generator, dtype=torch.float64).to(like.device)

    def normal(self, like: Tensor) -> Tensor:
        """Standard normal, in the shape of ``like``, float64."""
        return torch.randn(like.shape, generator=self.generator, dtype=torch.float64).to(like.device)

    def first_state(self, like: Tensor) -> TensorDictBase:
        """A population spread evenly over a disc of moves, for each of the ``N`` vehicles of ``like``."""
        radius, angle = self.uniform(like, 2, len(like), self.population_size)
        population = displacement(self.spread * radius.sqrt(), 2 * math.pi * angle)
        state = {"population": population, **self.begin(population)}
        return TensorDict(state, batch_size=[len(like)], device=like.device)

    # The two modes

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        if self.oracle:
            return {}
        here, there = seen["field"].double(), seen["target_field"].double()
        weights = guidance.objective_weights(here, there, here.new_tensor(self.objective_floors))
        state = self.first_state(here)
        first = {
            "weights": weights,
            "objective": torch.ones_like(here[:, 0]),
            "fitness": torch.zeros_like(state["population"][..., 0]),
        }
        return {**first, "moves": torch.zeros_like(seen["step_count"].squeeze(-1)), "state": state}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        distance, turn = self._look_ahead(seen, memory) if self.oracle else self._next_individual(seen, memory)
        return distance * self.max_move_km, turn

    def _look_ahead(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The best of all candidates whose end was read, over some generations."""
        heading = seen["heading"].double()
        readings = [0]

        def evaluate(candidate: Tensor) -> Tensor:
            readings[0] += candidate.shape[1]
            return self._objective_at(seen, *reachable(candidate, heading, self.max_turn_rad))

        state = self.first_state(heading)
        best, lowest = state["population"][:, :1], torch.full_like(heading, math.inf)
        for generation in range(self.generations):
            fitness = evaluate(state["population"])
            pool, values = torch.cat((best, state["population"]), 1), torch.cat((lowest, fitness), 1)
            lowest, index = values.min(1, keepdim=True)
            best = take(pool, index)
            if generation + 1 < self.generations:
                state.update(self.evolve(state, fitness, evaluate))
        memory["field_readings"] = memory["field_readings"] + readings[0]
        distance, turn = reachable(best, heading, self.max_turn_rad)
        return distance.squeeze(-1), turn.squeeze(-1)

    def _objective_at(self, seen: TensorDictBase, distance: Tensor, turn: Tensor) -> Tensor:
        """F (Eq. 2-6) where moves ``(N, K)`` would end; infinite beyond the field model."""
        assert self.field is not None
        start = seen["position"].unsqueeze(1)
        heading = seen["heading"].double() + turn
        end = torch.stack(move(start[..., 0], start[..., 1], heading, distance * self.max_move_km), -1)
        there, weights = (seen[key].double().unsqueeze(1) for key in ("target_field", "objective_weights"))
        value = guidance.objective(elements_at(self.field, end), there, weights).squeeze(-1)
        return value.nan_to_num(nan=math.inf)

    def _next_individual(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Grades the individual just flown, evolves where a generation is complete, and flies the next one."""
        size, moves, fitness = self.population_size, memory["moves"], memory["fitness"]
        state: Any = memory["state"]
        here = seen["field"].double()
        value = guidance.objective(here, seen["target_field"].double(), memory["weights"]).squeeze(-1)
        # A ratio, because what a good move takes off F itself shrinks on the way.
        gain = torch.log(value.clamp_min(1e-12) / memory["objective"].clamp_min(1e-12)).unsqueeze(-1)
        last = ((moves - 1) % size).unsqueeze(-1)
        fitness = torch.where(moves.unsqueeze(-1) > 0, fitness.scatter(1, last, gain), fitness)
        complete = (moves > 0) & (moves % size == 0)
        evolved = TensorDict(self.evolve(state, fitness, None), batch_size=state.batch_size, device=state.device)
        state = torch.where(complete, state.clone().update(evolved), state)

        heading, index = seen["heading"].squeeze(-1).double(), (moves % size).unsqueeze(-1)
        distance, turn = reachable(take(state["population"], index).squeeze(1), heading, self.max_turn_rad)
        # What one turn cannot reach becomes what was flown instead, so that fitness belongs to the individual.
        done = displacement(distance, heading + turn).unsqueeze(1)
        state["population"] = state["population"].scatter(1, index.unsqueeze(-1).expand_as(done), done)
        memory.update({"state": state, "fitness": fitness, "objective": value, "moves": moves + 1})
        return distance, turn


class GeneticAlgorithm(Metaheuristic):
    """A real-coded genetic algorithm: tournaments, blend crossover, Gaussian mutation, elitism.

    Args:
        tournament_size: individuals that compete to be a parent.
        crossover_rate: share of children with two parents.
        blend: how far a child may lie beyond its parents, in their distance (BLX-alpha).
        mutation_rate: share of coordinates that mutate.
        mutation_scale: standard deviation of a mutation, in longest moves.
        elites: best individuals that live on.
        options: of :class:`Metaheuristic`.

    Source:
        J. H. Holland, Adaptation in Natural and Artificial Systems (1975); blend crossover: L. J. Eshelman and
        J. D. Schaffer, Real-coded genetic algorithms and interval-schemata, FOGA 2 (1993).
    """

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
        self.tournament_size = _check("tournament_size", tournament_size, 1, 10_000, whole=True)
        self.crossover_rate = _check("crossover_rate", crossover_rate, 0, 1)
        self.blend = _check("blend", blend, 0, 10)
        self.mutation_rate = _check("mutation_rate", mutation_rate, 0, 1)
        self.mutation_scale = _check("mutation_scale", mutation_scale, 0, 10)
        self.elites = _check("elites", elites, 0, self.population_size - 1, whole=True)

    def begin(self, population: Tensor) -> dict[str, Tensor]:  # noqa: ARG002 - a population is all it has
        return {}

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
        """Numbers of the winners, one for each place in the next generation, ``(N, P)``."""
        size = fitness.shape[1]
        draws = (size * self.uniform(fitness, len(fitness), size * self.tournament_size)).long()
        winner = take(fitness, draws).unflatten(1, (size, -1)).argmin(-1, keepdim=True)
        return draws.unflatten(1, (size, -1)).gather(-1, winner).squeeze(-1)


class ParticleSwarm(Metaheuristic):
    """Particle swarm optimisation with an inertia weight.

    Args:
        inertia: what remains of a velocity.
        cognitive: pull to the best place of a particle.
        social: pull to the best place of the swarm.
        max_velocity: in longest moves per generation, for each coordinate.
        options: of :class:`Metaheuristic`.

    Source:
        J. Kennedy and R. Eberhart, Particle swarm optimization, ICNN (1995); inertia: Y. Shi and R. Eberhart, A
        modified particle swarm optimizer, ICEC (1998).
    """

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
        self.inertia = _check("inertia", inertia, 0, 2)
        self.cognitive, self.social = _check("cognitive", cognitive, 0, 10), _check("social", social, 0, 10)
        self.max_velocity = _check("max_velocity", max_velocity, 1e-6, 10)

    def begin(self, population: Tensor) -> dict[str, Tensor]:
        lowest = torch.full_like(population[..., 0], math.inf)
        return {"velocity": torch.zeros_like(population), "best": population.clone(), "lowest": lowest}

    def evolve(self, state: TensorDictBase, fitness: Tensor, evaluate: Evaluate | None) -> dict[str, Tensor]:  # noqa: ARG002
        population = state["population"]
        better = fitness < state["lowest"]
        lowest = torch.where(better, fitness, state["lowest"])
        best = torch.where(better.unsqueeze(-1), population, state["best"])
        leader = take(best, lowest.argmin(1, keepdim=True))
        own, shared = self.uniform(population, 2, *population.shape)
        pull = self.cognitive * own * (best - population) + self.social * shared * (leader - population)
        velocity = (self.inertia * state["velocity"] + pull).clamp(-self.max_velocity, self.max_velocity)
        return {"population": in_disc(population + velocity), "velocity": velocity, "best": best, "lowest": lowest}


class ArtificialFishSwarm(Metaheuristic):
    """The artificial fish swarm: each fish follows a better neighbour, swarms to the centre, or preys.

    Where only flying tells what a place is worth, the centre counts as the mean of those around it, and prey is a
    random step.

    Args:
        visual: how far a fish sees, in longest moves.
        step: its longest step, in longest moves.
        crowding: share of the population about a place above which it is crowded.
        tries: places that a preying fish looks at before it steps at random.
        options: of :class:`Metaheuristic`.

    Source:
        X. Li, Z. Shao and J. Qian, An optimizing method based on autonomous animats: fish-swarm algorithm, Systems
        Engineering: Theory and Practice 22 (2002); as in D. Yazdani et al., Fuzzy adaptive artificial fish swarm
        algorithm, AI (2010).
    """

    def __init__(
        self, *, visual: float = 0.5, step: float = 0.3, crowding: float = 0.6, tries: int = 3, **options: Any
    ) -> None:
        super().__init__(**options)
        self.visual, self.step = _check("visual", visual, 1e-6, 10), _check("step", step, 1e-6, 10)
        self.crowding = _check("crowding", crowding, 0, 1)
        self.tries = _check("tries", tries, 1, 1000, whole=True)

    def begin(self, population: Tensor) -> dict[str, Tensor]:  # noqa: ARG002 - a population is all it has
        return {}

    def evolve(self, state: TensorDictBase, fitness: Tensor, evaluate: Evaluate | None) -> dict[str, Tensor]:
        fish = state["population"]
        near = (fish.unsqueeze(1) - fish.unsqueeze(2)).norm(dim=-1) < self.visual
        near = near & ~torch.eye(fish.shape[1], dtype=torch.bool, device=fish.device)
        count = near.sum(-1)
        leader_fitness, leader = torch.where(near, fitness.unsqueeze(1), math.inf).min(-1)
        weight = near.double() / count.clamp_min(1).unsqueeze(-1)
        centre = weight @ fish
        mean = torch.where(near, fitness.unsqueeze(1), 0.0).sum(-1) / count.clamp_min(1)
        centre_fitness = mean if evaluate is None else evaluate(centre)
        # Alone, a fish has neither leader nor centre; where it is crowded, it goes its own way.
        free = (count > 0) & (count <= self.crowding * fish.shape[1])
        follow = free & (leader_fitness < fitness) & (leader_fitness <= centre_fitness)
        swarm = free & (centre_fitness < fitness) & ~follow
        goal = torch.where(follow.unsqueeze(-1), take(fish, leader), centre)
        goal = torch.where((follow | swarm).unsqueeze(-1), goal, self._prey(fish, fitness, evaluate))
        way = goal - fish
        length = self.step * self.uniform(fish, *fish.shape[:2], 1)
        return {"population": in_disc(fish + way * (length / way.norm(dim=-1, keepdim=True).clamp_min(1e-9)))}

    def _prey(self, fish: Tensor, fitness: Tensor, evaluate: Evaluate | None) -> Tensor:
        """The first better place in sight, or else the last one looked at: ``(N, P, 2)``."""
        places = fish.unsqueeze(2) + self.visual * (2 * self.uniform(fish, *fish.shape[:2], self.tries, 2) - 1)
        if evaluate is None:
            return places[:, :, -1]
        better = evaluate(places.flatten(1, 2)).unflatten(1, (-1, self.tries)) < fitness.unsqueeze(-1)
        better[..., -1] = True
        first = better.long().argmax(-1)
        return places.gather(2, first[..., None, None].expand(*first.shape, 1, 2)).squeeze(2)


def in_disc(candidate: Tensor) -> Tensor:
    """Candidates ``(..., 2)`` with none longer than 1."""
    return candidate / candidate.norm(dim=-1, keepdim=True).clamp_min(1)


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
    """
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
