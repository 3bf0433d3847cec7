"""Genetic algorithm, particle swarm and fish swarm as navigators."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict

from magrl import guidance
from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv, Scenario, task_set
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.field import elements_at
from magrl.geodesy import move
from magrl.navigators.metaheuristics import (
    ALGORITHMS,
    METAHEURISTICS,
    MODES,
    ArtificialFishSwarm,
    GeneticAlgorithm,
    ParticleSwarm,
    build,
)
from magrl.navigators.metaheuristics.base import in_disc, reachable, take

every_algorithm = pytest.mark.parametrize("name", sorted(ALGORITHMS))
either_mode = pytest.mark.parametrize("mode", MODES)


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(tasks=task_set(30, seed=81)), num_envs=30, seed=0)


def flight(env: GeomagneticNavEnv, navigator) -> TensorDict:
    env.set_seed(0)  # back to each vehicle's first task
    return evaluation_rollout(env, navigator)


def bowl(candidate: torch.Tensor) -> torch.Tensor:
    """A fitness with its least value, 0, at (0.5, -0.3)."""
    return (candidate - torch.tensor([0.5, -0.3], dtype=torch.float64)).norm(dim=-1)


def searched(algorithm, generations: int, evaluate) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean over 40 searches of the best fitness in the first and in the last of some generations."""
    state = algorithm.first_state(torch.zeros(40, 1))
    best = []
    for _ in range(generations):
        fitness = bowl(state["population"])
        best.append(fitness.min(1).values.mean())
        state.update(algorithm.evolve(state, fitness, evaluate))
    return best[0], best[-1]


def test_reachable_by_hand() -> None:
    candidate = torch.tensor([[0.0, 0.5], [-2.0, 0.0], [0.3, -0.3]])
    distance, turn = reachable(candidate, torch.tensor([0.0, math.pi, math.pi / 2]), math.pi / 2)
    torch.testing.assert_close(distance, torch.tensor([0.5, 1.0, 0.3 * math.sqrt(2)]))
    torch.testing.assert_close(turn, torch.tensor([math.pi / 2, 0.0, -math.pi / 2]), atol=1e-6, rtol=0)


def test_take_and_disc_by_hand() -> None:
    values = torch.tensor([[10, 11, 12], [20, 21, 22]])
    assert take(values, torch.tensor([[2, 0], [1, 1]])).tolist() == [[12, 10], [21, 21]]
    torch.testing.assert_close(in_disc(torch.tensor([[3.0, 4.0], [0.3, 0.4]])), torch.tensor([[0.6, 0.8], [0.3, 0.4]]))


@every_algorithm
def test_generations_come_nearer_to_the_best(name: str) -> None:
    for evaluate in (bowl, None):
        first, last = searched(ALGORITHMS[name](mode="flown", population_size=10), 25, evaluate)
        assert last < first / 2


@every_algorithm
def test_first_population_fills_the_disc(name: str) -> None:
    population = ALGORITHMS[name](mode="flown", population_size=50).first_state(torch.zeros(100, 1))["population"]
    radius = population.norm(dim=-1)
    assert radius.max() <= 1
    assert abs((radius < 0.5).double().mean() - 0.25) < 0.03
    assert population.mean((0, 1)).abs().max() < 0.03


def test_elites_live_on() -> None:
    algorithm = GeneticAlgorithm(mode="flown", population_size=6, elites=2)
    state = algorithm.first_state(torch.zeros(4, 1))
    fitness = bowl(state["population"])
    after = algorithm.evolve(state, fitness, None)["population"]
    best = take(state["population"], fitness.argsort(1)[:, :2])
    assert torch.equal(after[:, :2], best)


def test_tournament_of_all_is_won_by_the_best() -> None:
    algorithm = GeneticAlgorithm(mode="flown", population_size=3, tournament_size=60, mutation_rate=0.0)
    state = algorithm.first_state(torch.zeros(5, 1))
    fitness = torch.tensor([[2.0, 1.0, 3.0]], dtype=torch.float64).expand(5, 3)
    after = algorithm.evolve(state, fitness, None)["population"]
    torch.testing.assert_close(after, state["population"][:, 1:2].expand(5, 3, 2))


def test_particle_without_pull_coasts() -> None:
    algorithm = ParticleSwarm(mode="flown", population_size=3, inertia=0.5, cognitive=0.0, social=0.0)
    state = algorithm.first_state(torch.zeros(2, 1))
    state["population"] = state["population"] / 4
    state["velocity"] = torch.full_like(state["velocity"], 0.2)
    after = algorithm.evolve(state, bowl(state["population"]), None)
    torch.testing.assert_close(after["population"], state["population"] + 0.1)


def test_particles_remember_their_best() -> None:
    algorithm = ParticleSwarm(mode="flown", population_size=2)
    state = algorithm.first_state(torch.zeros(1, 1))
    first = state["population"].clone()
    state.update(algorithm.evolve(state, torch.tensor([[1.0, 5.0]], dtype=torch.float64), None))
    second = state["population"].clone()
    state.update(algorithm.evolve(state, torch.tensor([[2.0, 4.0]], dtype=torch.float64), None))
    assert state["lowest"].tolist() == [[1.0, 4.0]]
    assert torch.equal(state["best"], torch.stack((first[:, 0], second[:, 1]), 1))


def test_fish_follows_its_better_neighbor_and_no_farther_than_its_step() -> None:
    algorithm = ArtificialFishSwarm(mode="flown", population_size=3, visual=0.5, step=0.1, crowding=1.0)
    fish = torch.tensor([[[0.0, 0.0], [0.4, 0.0], [0.0, 0.9]]], dtype=torch.float64)
    state = TensorDict({"population": fish}, batch_size=[1])
    after = algorithm.evolve(state, torch.tensor([[2.0, 1.0, 0.5]], dtype=torch.float64), None)["population"]
    moved = after - fish
    assert 0 < moved[0, 0, 0] <= 0.1  # the first fish sees the second, not the best of all
    assert moved[0, 0, 1] == 0
    assert moved.norm(dim=-1).max() <= 0.1 + 1e-9


@every_algorithm
def test_look_ahead_is_an_oracle_that_arrives(env, name: str) -> None:
    navigator = METAHEURISTICS[name](env, "look-ahead", 0)
    rollout = flight(env, navigator)
    episodes = episode_measures(rollout)
    summary = summarize(episodes)
    assert summary["success_rate"] >= 85
    assert summary["spl"] >= 70
    assert navigator.oracle
    least = navigator.population_size * navigator.generations
    per_move = navigator.field_readings / episodes["steps"]
    assert (per_move == per_move[0]).all()
    assert per_move[0] == least if name != "afsa" else per_move[0] > least


@every_algorithm
def test_look_ahead_is_never_worse_than_its_first_guess(env, name: str) -> None:
    env.set_seed(0)
    state = env.reset()
    one = build(name, env, "look-ahead", 5, generations=1)
    more = build(name, env, "look-ahead", 5, generations=6)
    first, last = (env.step(nav(state.clone()))["next", "objective"] for nav in (one, more))
    assert (last <= first + 1e-6).all()
    assert (last < first - 1e-3).any()
    candidates = build(name, env, "look-ahead", 5).first_state(state["heading"])["population"]
    distance, turn = reachable(candidates, state["heading"].double(), math.pi / 2)
    start = state["position"].unsqueeze(1)
    ends = move(start[..., 0], start[..., 1], state["heading"] + turn, 50 * distance)
    field = elements_at(env.field, torch.stack(ends, -1))
    value = guidance.objective(field, state["target_field"].unsqueeze(1), state["objective_weights"].unsqueeze(1))
    torch.testing.assert_close(first, value.min(1).values.float(), rtol=1e-3, atol=1e-4)


@every_algorithm
def test_flown_reads_nothing_privileged_and_nothing_unflown(env, name: str) -> None:
    sighted, blind = (METAHEURISTICS[name](env, "flown", 3) for _ in range(2))
    assert not sighted.oracle
    assert set(sighted.in_keys) == {"field", "target_field", "heading", "step_count"}
    env.set_seed(0)
    state = env.reset()
    for _ in range(9):
        hidden = state.clone()
        for key in {*PRIVILEGED_KEYS} - {"region"}:
            hidden[key] = ~hidden[key] if hidden[key].dtype == torch.bool else torch.full_like(hidden[key], math.nan)
        action = sighted(state.clone())["action"]
        assert torch.equal(blind(hidden)["action"], action)
        state = env.step(state.set("action", action))["next"]
    assert (sighted.field_readings == 0).all()


@every_algorithm
def test_flown_fitness_is_what_the_move_took_off_the_objective(env, name: str) -> None:
    navigator = build(name, env, "flown", 0, population_size=4)
    env.set_seed(0)
    state, objectives = env.reset(), []
    for _ in range(4):
        objectives.append(state["objective"])
        state = env.step(navigator(state))["next"]
    population = navigator.memory["state", "population"].clone()
    ratio = torch.cat((*objectives[1:], state["objective"]), -1) / torch.cat(objectives, -1)
    graded = []
    navigator.evolve = lambda now, fitness, _: graded.append(fitness) or {"population": now["population"]}
    navigator(state)
    torch.testing.assert_close(graded[0], ratio.log().double(), atol=1e-3, rtol=1e-3)
    assert torch.equal(navigator.memory["state", "population"][:, 1:], population[:, 1:])


@every_algorithm
@either_mode
def test_same_seed_same_flight(env, name: str, mode: str) -> None:
    flights = []
    for seed in (1, 1, 2):
        env.set_seed(0)  # back to each vehicle's first task
        rollout = env.rollout(6, METAHEURISTICS[name](env, mode, seed), break_when_any_done=False)
        flights.append(rollout["action"])
    assert torch.equal(flights[0], flights[1])
    assert not torch.equal(flights[0], flights[2])


@every_algorithm
@either_mode
def test_actions_stay_in_bounds_that_are_not_the_default(name: str, mode: str) -> None:
    env = GeomagneticNavEnv(num_envs=8, seed=4, max_move_km=8.0, max_turn_deg=40.0, start_heading="random")
    action = env.rollout(12, build(name, env, mode, 0, spread=1.0), break_when_any_done=False)["action"]
    assert ((action[..., 0] >= 0) & (action[..., 0] <= 8.0)).all()
    assert (action[..., 1].abs() <= 0.7 + 1e-6).all()
    assert action[..., 0].max() > 4


@every_algorithm
def test_a_new_episode_begins_a_new_memory_for_its_vehicle_alone(env, name: str) -> None:
    navigator = METAHEURISTICS[name](env, "flown", 0)
    env.set_seed(0)
    state = env.reset()
    for _ in range(3):
        state = env.step(navigator(state))["next"]
    began = torch.arange(30) % 3 == 0
    first = env.reset()
    before = copy.deepcopy(navigator.memory)
    navigator(torch.where(began, first.select(*navigator.in_keys), state.select(*navigator.in_keys)))
    after = navigator.memory
    assert (after["moves"][began] == 1).all()
    assert (after["moves"][~began] == 4).all()
    assert torch.equal(after["weights"][~began], before["weights"][~began])
    torch.testing.assert_close(after["weights"][began].float(), first["objective_weights"][began], rtol=1e-3, atol=0)
    assert (after["fitness"][began] == 0).all()


@every_algorithm
def test_another_batch_begins_anew(env, name: str) -> None:
    navigator = METAHEURISTICS[name](env, "flown", 0)
    navigator(env.reset())
    other = GeomagneticNavEnv(Scenario(field=env.field), num_envs=5, seed=1)
    assert navigator(other.reset())["action"].shape == (5, 2)


def test_bad_options_are_refused_with_their_value() -> None:
    for algorithm, options, message in (
        (GeneticAlgorithm, {"mode": "dreamt"}, "dreamt"),
        (GeneticAlgorithm, {"mode": "look-ahead"}, "look-ahead"),
        (GeneticAlgorithm, {"population_size": 1}, "population_size.*1"),
        (GeneticAlgorithm, {"population_size": 2.5}, "2.5"),
        (GeneticAlgorithm, {"generations": 0}, "generations.*0"),
        (GeneticAlgorithm, {"spread": 1.5}, "spread.*1.5"),
        (GeneticAlgorithm, {"elites": 8, "population_size": 8}, "elites.*8"),
        (GeneticAlgorithm, {"mutation_rate": -0.5}, "-0.5"),
        (GeneticAlgorithm, {"crossover_rate": math.nan}, "nan"),
        (GeneticAlgorithm, {"objective_floors": (1.0, 0.0, 1.0)}, r"\(1.0, 0.0, 1.0\)"),
        (ParticleSwarm, {"inertia": 3.0}, "inertia.*3.0"),
        (ParticleSwarm, {"max_velocity": 0.0}, r"max_velocity.*0\.0"),
        (ArtificialFishSwarm, {"visual": -1.0}, "visual.*-1.0"),
        (ArtificialFishSwarm, {"tries": 0}, "tries.*0"),
        (ArtificialFishSwarm, {"max_turn_rad": 9.0}, "9.0"),
    ):
        with pytest.raises(ValueError, match=message):
            algorithm(**({"mode": "flown"} | options))


def test_field_belongs_to_look_ahead(env) -> None:
    with pytest.raises(ValueError, match="flown"):
        ParticleSwarm(mode="flown", field=env.field)
    with pytest.raises(ValueError, match="ants"):
        build("ants", env, "flown", 0)
    with pytest.raises(ValueError, match="dreamt"):
        build("ga", env, "dreamt", 0)
