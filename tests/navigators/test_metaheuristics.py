"""Genetic algorithm, particle swarm and fish swarm as navigators."""

import math

import pytest
import torch
from tensordict import TensorDict

from magrl import guidance
from magrl.envs import GeomagneticNavEnv, Scenario, trip_set
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.field import elements_at
from magrl.geodesy import move
from magrl.navigators import NAVIGATORS
from magrl.navigators.metaheuristics import (
    ArtificialFishSwarm,
    Draws,
    GeneticAlgorithm,
    Metaheuristic,
    ParticleSwarm,
    reachable,
    take,
)
from magrl.random_numbers import counter_stream

FIELD = Scenario().build_field()
every_algorithm = pytest.mark.parametrize("name", ["afsa", "ga", "pso"])


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(trips=trip_set(8, seed=81, distance_range_km=(100, 200))), num_envs=8, seed=0)


def made(kind: type[Metaheuristic], **numbers: float) -> Metaheuristic:
    """An algorithm with other numbers."""
    return type(kind.__name__, (kind,), numbers)(FIELD)


def draws(count: int) -> Draws:
    """Random numbers of some vehicles."""
    return Draws(torch.arange(count))


def bowl(candidate: torch.Tensor) -> torch.Tensor:
    """A fitness with its least value, 0, at (0.5, -0.3)."""
    return (candidate - torch.tensor([0.5, -0.3], dtype=torch.float64)).norm(dim=-1)


def test_reachable_by_hand() -> None:
    candidate = torch.tensor([[0.0, 0.5], [-2.0, 0.0], [0.3, -0.3]])
    distance, turn = reachable(candidate, torch.tensor([0.0, math.pi, math.pi / 2]), math.pi / 2)
    torch.testing.assert_close(distance, torch.tensor([0.5, 1.0, 0.3 * math.sqrt(2)]))
    torch.testing.assert_close(turn, torch.tensor([math.pi / 2, 0.0, -math.pi / 2]), atol=1e-6, rtol=0)


@every_algorithm
def test_first_population_fills_the_disc(name: str) -> None:
    population = made(NAVIGATORS[name], population_size=50).first_state(draws(100))["population"]
    radius = population.norm(dim=-1)
    assert radius.max() <= 1
    assert abs((radius < 0.5).double().mean() - 0.25) < 0.03
    assert population.mean((0, 1)).abs().max() < 0.03


def test_elites_live_on() -> None:
    algorithm = made(GeneticAlgorithm, population_size=6, elites=2)
    state = algorithm.first_state(draws(4))
    fitness = bowl(state["population"])
    after = algorithm.evolve(state, fitness, bowl, draws(len(state)))["population"]
    best = take(state["population"], fitness.argsort(1)[:, :2])
    assert torch.equal(after[:, :2], best)


def test_tournament_of_all_is_won_by_the_best() -> None:
    algorithm = made(GeneticAlgorithm, population_size=3, tournament_size=60, mutation_rate=0.0)
    state = algorithm.first_state(draws(5))
    fitness = torch.tensor([[2.0, 1.0, 3.0]], dtype=torch.float64).expand(5, 3)
    after = algorithm.evolve(state, fitness, bowl, draws(len(state)))["population"]
    torch.testing.assert_close(after, state["population"][:, 1:2].expand(5, 3, 2))


def test_particle_without_pull_coasts() -> None:
    algorithm = made(ParticleSwarm, population_size=3, inertia=0.5, cognitive=0.0, social=0.0)
    state = algorithm.first_state(draws(2))
    state["population"] = state["population"] / 4
    state["velocity"] = torch.full_like(state["velocity"], 0.2)
    after = algorithm.evolve(state, bowl(state["population"]), bowl, draws(len(state)))
    torch.testing.assert_close(after["population"], state["population"] + 0.1)


def test_particles_remember_their_best() -> None:
    algorithm = made(ParticleSwarm, population_size=2)
    state = algorithm.first_state(draws(1))
    first = state["population"].clone()
    state.update(algorithm.evolve(state, torch.tensor([[1.0, 5.0]], dtype=torch.float64), bowl, draws(len(state))))
    second = state["population"].clone()
    state.update(algorithm.evolve(state, torch.tensor([[2.0, 4.0]], dtype=torch.float64), bowl, draws(len(state))))
    assert state["lowest"].tolist() == [[1.0, 4.0]]
    assert torch.equal(state["best"], torch.stack((first[:, 0], second[:, 1]), 1))


def test_fish_follows_its_better_neighbor_and_no_farther_than_its_step() -> None:
    algorithm = made(ArtificialFishSwarm, population_size=3, visual=0.5, step=0.1, crowding=1.0)
    fish = torch.tensor([[[0.0, 0.0], [0.4, 0.0], [0.0, 0.9]]], dtype=torch.float64)
    state = TensorDict({"population": fish}, batch_size=[1])
    after = algorithm.evolve(state, torch.tensor([[2.0, 1.0, 0.5]], dtype=torch.float64), bowl, draws(len(state)))[
        "population"
    ]
    moved = after - fish
    assert 0 < moved[0, 0, 0] <= 0.1  # the first fish sees the second, not the best of all
    assert moved[0, 0, 1] == 0
    assert moved.norm(dim=-1).max() <= 0.1 + 1e-9


@every_algorithm
def test_look_ahead_is_an_oracle_that_arrives(env, name: str) -> None:
    env.set_seed(0)  # back to each vehicle's first trip
    navigator = NAVIGATORS[name].for_env(env, seed=0)
    summary = summarize(episode_measures(evaluation_rollout(env, navigator)))
    assert summary["success_rate"] >= 85
    assert summary["spl"] >= 70
    assert navigator.oracle


@every_algorithm
def test_look_ahead_is_never_worse_than_its_first_guess(env, name: str) -> None:
    env.set_seed(0)
    state = env.reset()
    one, more = (type(name, (NAVIGATORS[name],), {"generations": n}).for_env(env, seed=5) for n in (1, 6))
    other = type(one).for_env(env, seed=6)
    first, last = (env.step(nav(state.clone()))["next", "objective"] for nav in (one, more))
    assert (last <= first + 1e-6).all()
    assert (last < first - 1e-3).any()
    assert not torch.equal(one(state.clone())["action"], other(state.clone())["action"])
    stream = counter_stream(5, torch.cat((state["episode_stream"], state["elapsed_steps"]), -1))
    candidates = NAVIGATORS[name].for_env(env, seed=5).first_state(Draws(stream))["population"]
    distance, turn = reachable(candidates, state["heading"].double(), math.pi / 2)
    start = state["position"].unsqueeze(1)
    ends = move(start[..., 0], start[..., 1], state["heading"] + turn, 50 * distance)
    field = elements_at(env.field, torch.stack(ends, -1))
    value = guidance.objective(field, state["target_field"].unsqueeze(1), state["objective_weights"].unsqueeze(1))
    torch.testing.assert_close(first, value.min(1).values.float(), rtol=1e-3, atol=1e-4)


@every_algorithm
def test_readings_are_counted(env, name: str, monkeypatch) -> None:
    navigator, asked = NAVIGATORS[name].for_env(env), []
    monkeypatch.setattr(Metaheuristic, "_objective_at", lambda *parts: asked.append(parts[2]) or parts[3])
    navigator(env.reset())
    assert sum(part.shape[1] for part in asked) == navigator.readings_per_step


def test_no_leg_follows_the_end_of_an_episode(env) -> None:
    state = env.reset()
    state["done"][3] = True
    assert (NAVIGATORS["ga"].for_env(env)(state)["action"] == 0).all(-1).nonzero().tolist() == [[3]]
