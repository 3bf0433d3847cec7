"""Map matching: the inversion of a map, its filter, and what an old map costs."""

from __future__ import annotations

import pytest
import torch
from scipy.optimize import least_squares
from tensordict import TensorDict
from torch import Tensor

from magrl import geodesy
from magrl.envs import GeomagneticNavEnv, Region, Scenario, earth_scenario, task_set
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.field import elements_at
from magrl.navigators import MapMatching
from magrl.navigators.map_matching import aged_error, best, dated_map, update
from magrl.transforms import with_sensor_noise

F64 = torch.float64
NOISE = (0.05, 0.05, 5.0)


@pytest.fixture(scope="module")
def box() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(tasks=task_set(100, seed=97)), num_envs=100, seed=0, start_heading="random")


@pytest.fixture(scope="module")
def earth() -> GeomagneticNavEnv:
    scenario = earth_scenario(16, seed=7)
    scenario = scenario.with_tasks(scenario.random_tasks(200, seed=8))
    return GeomagneticNavEnv(scenario, num_envs=200, seed=0, start_heading="random")


def flown(env: GeomagneticNavEnv, navigator: MapMatching, noise: tuple[float, ...] = (0.0, 0.0, 0.0)) -> dict:
    return summarize(episode_measures(evaluation_rollout(with_sensor_noise(env, noise), navigator)))


def away_km(position: Tensor, other: Tensor) -> Tensor:
    return geodesy.geodesic(*position.unbind(-1), *other.unbind(-1))[0]


def scipy_inversion(env: GeomagneticNavEnv, start: Tensor, reading: Tensor, std: Tensor) -> Tensor:
    """Return the position of the least weighted squares of one reading, found from another start by SciPy."""

    def error(position: list[float]) -> list[float]:
        found = elements_at(env.field, torch.tensor(position, dtype=F64))
        return ((found - reading) / std).tolist()

    return torch.tensor(least_squares(error, (start + 0.3).tolist(), xtol=1e-14, ftol=1e-14, gtol=1e-14).x, dtype=F64)


def test_the_first_reading_is_inverted_as_by_scipy(box: GeomagneticNavEnv) -> None:
    """The weighted least squares of a reading with noise, and the destination exactly."""
    navigator = MapMatching(box.field, box.edge, sensor_std=NOISE)
    env = with_sensor_noise(box, NOISE)
    state = env.reset()
    navigator(state)
    here = best(navigator.memory["position"], navigator.memory["misfit"])
    for row in range(5):
        found = scipy_inversion(box, state["position"][row], state["field"][row].double(), navigator.sensor_std[0])
        assert away_km(here[row], found) < 0.02  # the prior of 1000 km pulls by meters
    assert away_km(navigator.memory["target"], state["target_position"]).max() < 0.05


@pytest.mark.parametrize(("scale", "error_km"), [(0.0, 0.0), (0.4, 4.0), (1.0, 10.0), (2.0, 20.0)])
def test_it_finds_its_position_as_well_as_the_noise_allows(box: GeomagneticNavEnv, scale: float, error_km) -> None:
    """At the first reading; the error grows with the noise, and the covariance says how large it is."""
    noise = tuple(scale * std for std in NOISE)
    navigator = MapMatching(box.field, box.edge, sensor_std=noise)
    state = with_sensor_noise(box, noise).reset()
    navigator(state)
    memory = navigator.memory
    error = away_km(best(memory["position"], memory["misfit"]), state["position"])
    assert error.square().mean().sqrt().item() == pytest.approx(error_km, rel=0.2, abs=0.02)
    rows, least = torch.arange(100), memory["misfit"].argmin(-1)
    expected = memory["covariance"][rows, least].diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()
    if scale:
        assert 0.7 < error.square().mean().sqrt() / expected < 1.3


def test_the_update_is_that_of_the_textbook() -> None:
    """Information form: P'^-1 = P^-1 + J^T J, and the displacement P' J^T r."""
    draw = torch.Generator().manual_seed(0)
    root, jacobian = (torch.randn(*shape, dtype=F64, generator=draw) for shape in ((4, 2, 2), (4, 3, 2)))
    residual, covariance = torch.randn(4, 3, dtype=F64, generator=draw), root @ root.mT + torch.eye(2, dtype=F64)
    displacement, after, misfit = update(covariance, jacobian, residual)
    expected = torch.linalg.inv(torch.linalg.inv(covariance) + jacobian.mT @ jacobian)
    torch.testing.assert_close(after, expected)
    torch.testing.assert_close(displacement, (expected @ jacobian.mT @ residual.unsqueeze(-1)).squeeze(-1))
    innovation = jacobian @ covariance @ jacobian.mT + torch.eye(3, dtype=F64)
    whitened = torch.linalg.solve(innovation, residual.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(misfit, (residual * whitened).sum(-1))


def test_a_step_forgets_corrects_and_adds_to_the_misfit(box: GeomagneticNavEnv) -> None:
    """One step against the information form; a map error of 97 km moves the position as much in 30 km."""
    navigator = MapMatching.for_env(box, sensor_std=NOISE, map_date="2012-01-01")
    assert navigator.map_error_km == pytest.approx(97.5, rel=1e-3)
    state = box.step(navigator(box.reset()))["next"]
    before = navigator.memory.clone()
    navigator(state)
    after, region = navigator.memory, torch.zeros(100, dtype=torch.int64)
    length, unit = state["move"][:, :1].double(), torch.eye(2, dtype=F64)
    position = navigator._moved(before["position"], state["heading"].double(), length, region)
    _, jacobian = navigator._residual(position, state["field"].double(), navigator.sensor_std[0], region)
    grown = before["covariance"] + navigator.map_error_km**2 * length[..., None, None] / 30 * unit
    expected = torch.linalg.inv(torch.linalg.inv(grown) + jacobian.mT @ jacobian)
    torch.testing.assert_close(after["covariance"], expected, rtol=1e-5, atol=1e-5)
    assert (after["misfit"] > before["misfit"]).all()


def test_one_hypothesis_is_not_enough(earth: GeomagneticNavEnv) -> None:
    """In some regions, the lowest point of the grid lies in the wrong basin."""
    state, wrong = earth.reset(), []
    for hypotheses in (1, 4):
        navigator = MapMatching(earth.field, earth.edge, hypotheses=hypotheses)
        navigator(state.clone())
        here = best(navigator.memory["position"], navigator.memory["misfit"])
        error = away_km(here, state["position"]) + away_km(navigator.memory["target"], state["target_position"])
        wrong.append(int((error > 10).sum()))
    assert wrong[0] > 0
    assert wrong[1] == 0


def test_the_error_of_an_old_map_partly_cancels(earth: GeomagneticNavEnv) -> None:
    """Both positions on the map are wrong by hundreds of kilometers; the way between them is not."""
    navigator = MapMatching.for_env(earth, map_date="2015-01-01")
    assert (navigator.search, MapMatching.for_env(earth).search) == (False, True)
    state = navigator(earth.reset())
    here = best(navigator.memory["position"], navigator.memory["misfit"])
    there = navigator.memory["target"]
    assert away_km(here, state["position"]).median() > 150
    summary = flown(earth, MapMatching.for_env(earth, map_date="2015-01-01"))
    assert summary["success_rate"] > 85
    exact = MapMatching(dated_map(earth.scenario, "2015-01-01"), earth.edge)
    assert flown(earth, exact)["success_rate"] < summary["success_rate"] - 4  # a map that is taken for exact
    way, error = away_km(here, there), away_km(state["position"], state["target_position"])
    assert (way - error).abs().median() < 0.5 * away_km(here, state["position"]).median()


def test_an_old_map_is_that_of_its_date(box: GeomagneticNavEnv) -> None:
    position = box.region.grid(3)
    again = dated_map(box.scenario, box.scenario.date)
    torch.testing.assert_close(elements_at(again, position), elements_at(box.field, position))
    change = elements_at(dated_map(box.scenario, 2015), position) - elements_at(box.field, position)
    assert change[..., 2].abs().max() > 50
    assert aged_error(box.scenario, box.scenario.date) == (0, 0, 0)
    assert aged_error(box.scenario, "2012-01-01") == pytest.approx((1.0, 1.0, 390.0), rel=1e-3)
    navigator = MapMatching.for_env(box, map_date="2012-01-01")
    assert navigator.target_std.tolist() == pytest.approx([1.0, 1.0, 390.0], rel=1e-3)


def test_it_matches_across_the_antimeridian() -> None:
    scenario = Scenario(region=Region((-10, 0), (175, 185)), objective_floors=None)
    scenario = scenario.with_tasks(scenario.random_tasks(20, seed=1))
    env = GeomagneticNavEnv(scenario, num_envs=20, seed=0)
    assert flown(env, MapMatching.for_env(env))["spl"] > 99.8


def test_a_new_episode_is_located_anew(box: GeomagneticNavEnv) -> None:
    navigator, fresh = (MapMatching.for_env(box) for _ in range(2))
    state = box.reset()
    for _ in range(3):
        state = box.step(navigator(state))["next"]
    keys = navigator.in_keys
    began = torch.arange(100) % 3 == 0
    first = box.reset()
    mixed: TensorDict = torch.where(began, first.select(*keys), state.select(*keys))
    action = navigator(mixed)["action"]
    assert torch.equal(action[began], fresh(first)["action"][began])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"sensor_std": (0.05, -0.05, 5.0)}, "sensor_std.*-0.05"),
        ({"map_error": (-1.0, 1.0, 5.0)}, "map_error.*-1"),
        ({"sensor_std": (0.05, 0.05)}, r"sensor_std.*\(0.05, 0.05\)"),
        ({"hypotheses": 0}, "hypotheses.*0"),
        ({"field": None}, "field.*None"),
        ({"region": Region((0, 20), (150, 160))}, "not defined on all of Region.*larger box"),
    ],
)
def test_bad_options_are_refused_with_their_value(box: GeomagneticNavEnv, options: dict, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        MapMatching(**({"field": box.field, "region": box.edge} | options))


def test_a_map_must_be_given_with_its_regions(box: GeomagneticNavEnv, earth: GeomagneticNavEnv) -> None:
    with pytest.raises(TypeError, match="region"):
        MapMatching(box.field, None)
    with pytest.raises(ValueError, match="1 boxes, and field 16 expansions"):
        MapMatching(earth.field, box.edge)
    with pytest.raises(ValueError, match="16 boxes, and field 1 expansions"):
        MapMatching(box.field, earth.edge)
    with pytest.raises(ValueError, match=r"2040.*outside IGRF"):
        MapMatching.for_env(box, map_date="2040-01-01")
