"""Base class of the metaheuristics: individuals as moves, two modes of evaluation, memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from magrl import guidance
from magrl.checks import check_choice, check_number, check_numbers
from magrl.envs import GeomagneticNavEnv
from magrl.field.model import FieldModel, elements_at
from magrl.geodesy import move, wrap_angle
from magrl.navigators.base import Navigator

MODES = ("look-ahead", "flown")
Evaluate = Callable[[Tensor], Tensor]
"""From candidates ``(N, K, 2)`` to their fitness ``(N, K)``."""


def reachable(candidate: Tensor, heading: Tensor, max_turn_rad: float) -> tuple[Tensor, Tensor]:
    """Return the move nearest to a candidate in heading and length that one turn allows.

    Args:
        candidate: ``(..., 2)`` north, east, in longest moves.
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


def displacement(distance: Tensor, heading: Tensor) -> Tensor:
    """Return north and east of a move, ``(..., 2)``.

    Example:
        >>> displacement(torch.tensor([1.0, 2.0]), torch.tensor([0.0, math.pi / 2])).round(decimals=3).abs()
        tensor([[1., 0.],
                [0., 2.]])
    """
    return torch.stack((distance * torch.cos(heading), distance * torch.sin(heading)), -1)


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


class Metaheuristic(Navigator):
    """Base class of the metaheuristics: individuals as moves, both modes of evaluation, random numbers.

    A subclass initializes its state (:meth:`begin`) and computes the next generation (:meth:`evolve`).

    Args:
        mode: ``"look-ahead"`` or ``"flown"``.
        field: field model, in look-ahead mode only.
        population_size: number of individuals; in mode ``"flown"`` also the moves of one generation.
        generations: generations of the search for one move in look-ahead mode, the random first one included.
        spread: radius of the first population, in longest moves.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        objective_floors: floors of Eq. 2-6 for the fitness of flown moves: D [deg], I [deg], B_H [nT].
        seed: seed of the random numbers.

    Raises:
        ValueError: for any option out of its range, naming it and its value.

    Example:
        >>> class RandomSearch(Metaheuristic):
        ...     def evolve(self, state, fitness, evaluate):
        ...         return {"population": self.first_state(fitness)["population"]}
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> GeomagneticNavEnv(num_envs=2, seed=0).rollout(3, RandomSearch(mode="flown"))["action"].shape
        torch.Size([2, 3, 2])
    """

    oracle, needs = True, "the field at other places"  # in mode "flown", an instance has False and "nothing"
    options = ("mode", "seed")
    settings: ClassVar[Mapping[str, Mapping[str, float]]]
    """Options by mode, from a sweep: those of the highest SPL, or with a third of the readings for 0.1 % less."""

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
        check_choice(MODES, mode=mode)
        if (field is not None) != (mode == "look-ahead"):
            raise ValueError(f"field must be given in mode 'look-ahead' and in no other, got {field} in mode {mode!r}")
        check_numbers(3, objective_floors=objective_floors)
        check_number(0, above=True, objective_floors=min(objective_floors))
        check_number(2, 10_000, whole=True, population_size=population_size)
        check_number(1, 10_000, whole=True, generations=generations)
        check_number(1e-3, 1, spread=spread)
        check_number(whole=True, seed=seed)
        self.field, self.oracle = field, mode == "look-ahead"
        self.needs = Metaheuristic.needs if self.oracle else Navigator.needs
        self.population_size, self.generations, self.spread = population_size, generations, spread
        self.objective_floors = tuple(objective_floors)
        self.generator = torch.Generator().manual_seed(seed)
        private = ["position", "objective_weights", "done"] if self.oracle else ["field"]
        self.in_keys = ["target_field", "heading", "elapsed_steps", *private]

    @classmethod
    def for_env(cls, env: GeomagneticNavEnv, *, mode: str = "look-ahead", **options: Any) -> Self:
        """Return the navigator of an environment, with its :attr:`settings` where no options are given."""
        if len(env.region) > 1:
            raise ValueError(f"metaheuristics navigate in one region, and the scenario has {len(env.region)}")
        defaults = {"field": env.field if mode == "look-ahead" else None, "mode": mode}
        defaults["objective_floors"] = tuple(env.objective_floors[0].tolist())
        return super().for_env(env, **{**defaults, **cls.settings.get(mode, {}), **options})

    # Methods of a subclass

    def begin(self, population: Tensor) -> dict[str, Tensor]:  # noqa: ARG002
        """Return the state of an algorithm beside its first population ``(N, P, 2)``: tensors ``(N, ...)``, or none."""
        return {}

    def evolve(self, state: TensorDictBase, fitness: Tensor, evaluate: Evaluate | None) -> dict[str, Tensor]:
        """Return the next generation.

        Args:
            state: ``(N,)`` with ``population`` ``(N, P, 2)`` and the entries of :meth:`begin`.
            fitness: ``(N, P)`` fitness of that population.
            evaluate: fitness of more candidates; None in mode ``"flown"``.
        """
        raise NotImplementedError

    # Random numbers, drawn on the CPU so that a seed gives the same episodes on every device

    def uniform(self, like: Tensor, *shape: int) -> Tensor:
        """Return uniform numbers in [0, 1), float64."""
        return torch.rand(shape, generator=self.generator, dtype=torch.float64).to(like.device)

    def normal(self, like: Tensor) -> Tensor:
        """Return standard normal numbers in the shape of ``like``, float64."""
        return torch.randn(like.shape, generator=self.generator, dtype=torch.float64).to(like.device)

    def first_state(self, like: Tensor) -> TensorDictBase:
        """Return a population uniform over a disc of moves, for each of the ``N`` vehicles of ``like``."""
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
        fitness, moves = torch.zeros_like(state["population"][..., 0]), torch.zeros_like(seen["elapsed_steps"][:, 0])
        objective = torch.ones_like(here[:, 0])
        return {"weights": weights, "objective": objective, "fitness": fitness, "moves": moves, "state": state}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        distance, turn = self._look_ahead(seen, memory) if self.oracle else self._next_individual(seen, memory)
        return distance * self.max_move_km, turn

    def _look_ahead(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the best of all candidates of some generations."""
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
        """Return F (Eq. 2-6) at the ends of moves ``(N, K)``; infinite beyond the field model."""
        assert self.field is not None
        start = seen["position"].unsqueeze(1)
        heading = seen["heading"].double() + turn
        end = torch.stack(move(start[..., 0], start[..., 1], heading, distance * self.max_move_km), -1)
        there, weights = (seen[key].double().unsqueeze(1) for key in ("target_field", "objective_weights"))
        value = guidance.objective(elements_at(self.field, end), there, weights).squeeze(-1)
        return value.nan_to_num(nan=math.inf)

    def _next_individual(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the next individual, after grading the last one and evolving where a generation is complete."""
        size, moves, fitness = self.population_size, memory["moves"], memory["fitness"]
        state: Any = memory["state"]
        here = seen["field"].double()
        value = guidance.objective(here, seen["target_field"].double(), memory["weights"]).squeeze(-1)
        # The ratio of F, because the decrease of F by a good move shrinks along the way.
        gain = torch.log(value.clamp_min(1e-12) / memory["objective"].clamp_min(1e-12)).unsqueeze(-1)
        last = ((moves - 1) % size).unsqueeze(-1)
        fitness = torch.where(moves.unsqueeze(-1) > 0, fitness.scatter(1, last, gain), fitness)
        complete = (moves > 0) & (moves % size == 0)
        evolved = TensorDict(self.evolve(state, fitness, None), batch_size=state.batch_size, device=state.device)
        state = torch.where(complete, state.clone().update(evolved), state)

        heading, index = seen["heading"].squeeze(-1).double(), (moves % size).unsqueeze(-1)
        distance, turn = reachable(take(state["population"], index).squeeze(1), heading, self.max_turn_rad)
        # The individual becomes the move that is made, so that the fitness belongs to it.
        done = displacement(distance, heading + turn).unsqueeze(1)
        state["population"] = state["population"].scatter(1, index.unsqueeze(-1).expand_as(done), done)
        memory.update({"state": state, "fitness": fitness, "objective": value, "moves": moves + 1})
        return distance, turn
