"""Transforms of a track: the belief in the TensorDict against the pure functions, by row; search and plan."""

from __future__ import annotations

import math

import pytest
import torch
from support.readings import first_reading, moved
from support.tracks import STD, f64
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from magrl import tracking
from magrl.envs import GeomagneticNavEnv
from magrl.field import elements_gradient_at
from magrl.geodesy import geodesic
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import Belief, DestinationPosterior, NoiseEstimate, Way
from magrl.tracking.belief import CONSTANT, STATES
from magrl.transforms import KnownStart, PlannedMove, SearchAim, SensorErrors, TrackField
from magrl.transforms.track import BELIEF_KEYS, IN_KEYS, NOISE_KEYS, POINTS, POSTERIOR_KEYS, TRACK_KEYS, belief_of

SIZES = SensorStd(STD, (0.5, 0.3, 60.0), (0.3, 0.2, 30.0), (20.0, 20.0, 20.0))
ERRORS = SensorStd(*(f64(*sizes) for sizes in SIZES))
NEXT = [("next", key) for key in TRACK_KEYS]
WORLD = {"range_km": 350.0, "crust_nt": 20.0}


def tracked(num_envs: int = 3, **options: object) -> TransformedEnv:
    return TransformedEnv(GeomagneticNavEnv(num_envs=num_envs, seed=0), TrackField(**options))


def flown(env: TransformedEnv, steps: int = 5) -> TensorDictBase:
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


def stepped(track: TrackField, first: TensorDict, after: TensorDict) -> TensorDictBase:
    """The estimates after a first reading and one move."""
    return track(track(first.clone()).set("next", after.clone()))["next"]


def assert_written(seen: TensorDictBase, belief: Belief) -> None:
    """What is in a TensorDict is that of a belief, in float64, and what follows from it, in the type of readings."""
    assert all(seen[key].dtype == torch.float64 for key in BELIEF_KEYS)
    torch.testing.assert_close(tuple(belief_of(seen)), tuple(belief), rtol=1e-6, atol=1e-6)
    goal = tracking.destination(belief, seen["target_field"], **WORLD)
    local, posterior = tracking.elements(belief), tracking.posterior(goal, POINTS)
    expected = (local.value, local.gradient, *posterior.way(), *posterior)
    for key, value in zip(TRACK_KEYS[3:], expected, strict=True):
        assert seen[key].dtype == seen["field"].dtype
        torch.testing.assert_close(seen[key], value.to(seen[key].dtype), rtol=1e-4, atol=1e-3, msg=key)


def test_the_estimates_are_those_of_the_pure_functions() -> None:
    rollout = flown(tracked(sensor_std=SIZES, **WORLD))
    errors = SensorStd(*(std.expand(3, 3) for std in ERRORS))
    reading, heading = rollout["field"][:, 0], rollout["heading"][:, 0, 0]
    belief = tracking.start(reading, errors, heading, 20.0)
    assert_written(rollout[:, 0], belief)
    for seen in rollout["next"].unbind(1):
        course = seen["heading"].squeeze(-1)
        belief = tracking.moved(belief, seen["move"][:, 0], course, errors)
        belief = tracking.read(belief, seen["field"], errors.noise, course, 20.0)
        assert_written(seen, belief)


def with_std(reading: TensorDict, *factors: float) -> TensorDict:
    """A reading with the standard deviations of its errors, each row its own factor."""
    rows = f64(*factors).unsqueeze(-1)
    return reading.clone().update({key: rows * std for key, std in zip(STD_KEYS, ERRORS, strict=True)})


def test_standard_deviations_may_be_keys() -> None:
    """Each row has its own; and with the first key alone, readings have white noise."""
    first = first_reading(2)
    after = moved(first, 40.0, 0.3, f64(0.3, 0.5, 60.0))
    for keys, stated in ((STD_KEYS, SIZES), (STD_KEYS[:1], SensorStd(STD))):
        found = stepped(TrackField(std_keys=keys), with_std(first, 1.0, 4.0), with_std(after, 1.0, 4.0))
        for row, factor in enumerate((1.0, 4.0)):
            sizes = SensorStd(*(tuple(factor * x for x in std) for std in stated))
            expected = stepped(TrackField(sensor_std=sizes), first, after)
            for key in TRACK_KEYS:
                torch.testing.assert_close(found[key][row], expected[key][row], msg=key)


def test_without_noise_it_finds_gradient_and_target() -> None:
    env = tracked(64, range_km=1000.0)
    after = flown(env, 12)[:, -1]["next"]
    true = elements_gradient_at(env.base_env.field, after["position"]).float()
    error = (after["estimated_gradient"] - true) / torch.tensor((0.004, 0.015, 4.0)).unsqueeze(-1)
    assert error.norm(dim=(-2, -1)).median() < 0.05
    way_km, bearing = geodesic(*after["position"].T, *after["target_position"].T)
    true_way = (way_km * torch.stack((bearing.cos(), bearing.sin()))).T.float()
    assert ((after["way"] - true_way).norm(dim=-1) / way_km).median() < 0.05


def test_partial_reset_restarts_the_chosen_rows_alone() -> None:
    env = tracked(4)
    td = flown(env, 3)[:, -1]["next"]
    chosen = torch.tensor([True, False, False, True])
    after = env.reset(td.clone().set("_reset", chosen.unsqueeze(-1)))
    expected = TrackField()(after.select(*IN_KEYS))
    for key in TRACK_KEYS:
        assert torch.equal(after[key][~chosen], td[key][~chosen]), key
        torch.testing.assert_close(after[key][chosen], expected[key][chosen], msg=key)
        assert not torch.equal(after[key][chosen], td[key][chosen]), key


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_step_depends_on_its_state_and_public_keys_alone(compiled: bool) -> None:
    """As stored data are stepped again, by another transform; compiled as one graph, too."""
    rollout, transform = flown(tracked(sensor_std=STD)), TrackField(sensor_std=STD)
    known = rollout.select(*BELIEF_KEYS, *(("next", key) for key in IN_KEYS))
    if compiled:
        torch.compiler.reset()
        transform = torch.compile(transform, fullgraph=True, backend="eager")
    again = transform(known)
    for key in NEXT:
        torch.testing.assert_close(again[key], rollout[key], rtol=1e-4, atol=1e-4, msg=str(key))
    state = step_mdp(rollout[:, -1].clone()).set("action", torch.tensor([30.0, 0.5]).expand(3, 2))
    one, two = (tracked().step(state.clone()) for _ in range(2))
    assert all(torch.equal(one[key], two[key]) for key in NEXT)
    with pytest.raises(KeyError, match=r"TrackField reads its state \['belief_mean', 'belief_covariance'"):
        tracked().step(state.exclude(*BELIEF_KEYS))


# Errors of the sensors


def test_a_known_start_begins_the_belief_with_its_elements() -> None:
    """The belief reads what was read before the calibration, with the errors of then: it finds those that last."""
    steps = SensorErrors(STD, bias=(0.5, 0.3, 60.0), seed=3), KnownStart(), TrackField(std_keys=STD_KEYS, **WORLD)
    rollout = flown(TransformedEnv(GeomagneticNavEnv(num_envs=40, seed=0), Compose(*steps)), 4)
    first, seen = rollout[:, 0], rollout["next"]
    std, here = SensorStd.read(first), first["start_field"]
    belief = tracking.before(here, std._replace(bias=first["start_bias_std"]))
    belief = tracking.known(belief, here, first["start_std"], 20.0)
    as_read, course = first["field"] + first["start_error"], first["heading"].squeeze(-1)
    belief = tracking.read(belief, as_read, std.noise, course, 20.0)
    assert_written(first, belief)
    as_read, course = (seen["field"] + seen["start_error"])[:, 0], seen["heading"][:, 0, 0]
    belief = tracking.moved(belief, seen["move"][:, 0, 0], course, std)
    assert_written(seen[:, 0], tracking.read(belief, as_read, std.noise, course, 20.0))
    found, true = seen["belief_mean"][:, -1, CONSTANT], rollout["sensor_error"][:, 0, :3]
    assert ((found - true).std(0) < 0.5 * true.std(0)).all()


def test_the_noise_is_scaled_as_the_readings_show() -> None:
    """By the pure function, in place of what is stated; 20 readings at one place show a noise of 4 times that."""
    track = TrackField(std_keys=STD_KEYS, estimate_noise=True)
    first = with_std(first_reading(), *[1.0] * 4).update({key: torch.zeros(4, 3).double() for key in STD_KEYS[1:]})
    after = moved(first, 0.5, 0.3, f64(0.5, 0.4, 50.0)).update(first.select(*STD_KEYS))
    before = track(first.clone())
    seen = track(before.clone().set("next", after.clone()))["next"]
    none, course = torch.zeros(4, 3).double(), after["heading"].squeeze(-1)
    belief = tracking.moved(belief_of(before), after["move"][:, 0], course)
    new = tracking.innovation(belief, after["field"], first["sensor_std"], course)
    estimate = tracking.noise_estimate(NoiseEstimate(none, none), new, first["sensor_std"])
    torch.testing.assert_close(tuple(seen[key] for key in NOISE_KEYS[1:]), tuple(estimate))
    torch.testing.assert_close(seen["sensor_std"], first["sensor_std"] * estimate.factor)
    assert (estimate.factor > 1.2).all()
    belief = tracking.read(belief, after["field"], seen["sensor_std"], course)
    torch.testing.assert_close(tuple(belief_of(seen)), tuple(belief))
    draw = torch.randn(20, 4, 3, generator=torch.Generator().manual_seed(0)).double()
    for reading in first["field"] + 4 * first["sensor_std"] * draw:
        still = moved(first, 0.0, 0.0, f64(0.0, 0.0, 0.0)).update(first.select(*STD_KEYS)).set("field", reading)
        before = track(before.set("next", still))["next"]
    assert (before["sensor_std"].mean(0) > 2 * ERRORS.noise).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"in_keys": ("move", "target_field", "move", "heading")}, r"reads 'move' as .*3\), got \(3, 2\)"),
        ({"in_keys": IN_KEYS[:3]}, "4 or 5 or 8 in_keys"),
        ({"std_keys": ["sensor_std"], "sensor_std": STD}, "give sensor_std or std_keys"),
        ({"in_keys": (*IN_KEYS, "sensor_std")}, "more than 4 keys need names"),
        ({"in_keys": {"reading": "field"}}, "key must be one of 'field', .*'reading'"),
        ({"sensor_std": (0.1, -0.1, 1.0)}, "sensor_std.noise must be a finite number from 0 on, got -0.1"),
        ({"estimate_noise": True}, "estimate_noise .* give std_keys"),
        ({"range_km": 0.0}, r"range_km .*0\.0"),
        ({"crust_nt": -1.0}, r"crust_nt .*-1\.0"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _ = tracked(**options).specs


# Search and plan

PLAN = {"max_move_km": 50.0, "max_steps": 50}


def searching(num_envs: int = 3) -> TransformedEnv:
    errors = SensorErrors((0.02, 0.02, 2.0), bias=(0.3, 0.0, 0.0), seed=1)
    track = TrackField(std_keys=STD_KEYS, estimate_noise=True, **WORLD)
    steps = Compose(errors, track, SearchAim(zeta=0.01), PlannedMove(in_keys={"way": "aim"}, **PLAN, **WORLD))
    return TransformedEnv(GeomagneticNavEnv(num_envs=num_envs, seed=3, start_heading="random"), steps)


def test_specs() -> None:
    """The state is what a step reads of the one before; the points have the number that is promised."""
    env = searching()
    check_env_specs(env, break_when_any_done="both")
    own = {*TRACK_KEYS, *NOISE_KEYS, "aim", "visited", "arrival_weights", "planned_move"}
    assert own & set(env.full_state_spec.keys()) == {*BELIEF_KEYS, *NOISE_KEYS[1:], "visited", "arrival_weights"}
    specs = env.observation_spec
    assert specs["belief_covariance"].shape == (3, STATES, STATES)
    assert [specs[key].shape for key in POSTERIOR_KEYS] == [(3, POINTS, 2), (3, POINTS)]
    assert {key for key in own if specs[key].dtype == torch.float64} == {*BELIEF_KEYS, *NOISE_KEYS[1:]}


def test_aim_and_plan_are_those_of_the_pure_functions() -> None:
    rollout = flown(searching(), 3)
    first = rollout[:, 0]
    weights, visited = tracking.arrival_weights(first["field"], first["target_field"], 0.01), None
    for seen in (first, *rollout["next"].unbind(1)):
        going = seen["move"][:, :1] * torch.cat((seen["heading"].cos(), seen["heading"].sin()), -1)
        visited = tracking.unvisited_yet(weights) if visited is None else tracking.visit(visited, going)
        torch.testing.assert_close(seen["visited"], visited)
        belief, errors = belief_of(seen), SensorStd.read(seen)
        local, way = tracking.elements(belief), Way(seen["way"].double(), seen["way_covariance"].double())
        ellipse = tracking.arrival_ellipse(local.gradient, local.covariance[..., 1:, 1:], weights.double())
        aim = tracking.unvisited(way, visited.double(), ellipse)
        torch.testing.assert_close(seen["aim"], aim.float())
        goal = tracking.destination(belief, seen["target_field"], **WORLD)
        posterior = DestinationPosterior(*(seen[key] for key in POSTERIOR_KEYS))
        step = seen["elapsed_steps"].squeeze(-1)
        price = tracking.step_price(0.5, 300.0, seen["aim"].double(), step, errors.noise, 50, 50.0)
        move = tracking.planned_move(goal, posterior, seen["aim"].double(), errors, price, 50.0)
        torch.testing.assert_close(seen["planned_move"], move.float())


@pytest.mark.parametrize("radius_km", [None, 25.0])
def test_a_place_without_an_arrival_is_left(radius_km: float | None) -> None:
    """A vehicle that is where it expects the destination to be, and has not arrived, aims elsewhere."""
    search = SearchAim(zeta=0.01, radius_km=radius_km)
    seen = TrackField(sensor_std=SIZES)(first_reading()).set("way", f64((0.0, 1.0)).expand(4, 2))
    first = search(seen.clone())
    assert torch.equal(first["aim"], seen["way"])
    after = search(first.clone().set("next", seen.clone().set("move", f64((5.0, 0.0)).expand(4, 2))))["next"]
    local, weights = tracking.elements(belief_of(seen)), first["arrival_weights"]
    ellipse = tracking.arrival_ellipse(local.gradient, local.covariance[..., 1:, 1:], weights, radius_km)
    aim = tracking.unvisited(Way(seen["way"], seen["way_covariance"]), after["visited"], ellipse)
    torch.testing.assert_close(after["aim"], aim)
    assert (aim.norm(dim=-1) > 10).all()
    assert torch.equal(after["arrival_weights"], weights)


def test_each_vehicle_may_have_its_own_price_of_a_step() -> None:
    """With a higher price moves are longer; without caution they are nearer to the way."""
    seen = TrackField(sensor_std=SIZES)(first_reading()).set("elapsed_steps", torch.zeros(4, 1, dtype=torch.int64))
    seen = with_std(seen, *[1.0] * 4).set("step_price", f64(0.1, 0.1, 30.0, 30.0).unsqueeze(-1))
    own = PlannedMove(step_price=None, **PLAN)(seen.clone())["planned_move"]
    cheap, dear, careless = (
        PlannedMove(step_price=price, caution=caution, **PLAN)(seen.clone())["planned_move"]
        for price, caution in ((0.1, 0.3), (30.0, 0.3), (0.1, 0.0))
    )
    torch.testing.assert_close(own, torch.cat((cheap[:2], dear[2:])))
    assert (cheap.norm(dim=-1) < dear.norm(dim=-1) - 10).any()
    ahead, aside = (torch.nn.functional.cosine_similarity(move, seen["way"]) for move in (careless, cheap))
    assert ahead.mean() > aside.mean() + 0.05


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SearchAim(zeta=0.0), r"zeta .*0\.0"),
        (lambda: SearchAim(zeta=0.1, radius_km=0.0), r"radius_km .*0\.0"),
        (lambda: PlannedMove(max_move_km=-1.0, max_steps=5), r"max_move_km .*-1\.0"),
        (lambda: PlannedMove(max_move_km=50.0, max_steps=0), "max_steps .*0"),
        (lambda: PlannedMove(**PLAN, caution=math.nan), "caution .*nan"),
        (lambda: PlannedMove(**PLAN, step_price=0.0), r"step_price .*0\.0"),
    ],
)
def test_bad_options_of_search_and_plan(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
