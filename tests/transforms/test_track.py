"""TrackGradient: the filter in the TensorDict, against the pure functions, by row, in both frames, and elsewhere."""

from __future__ import annotations

import importlib
import math
import sys
from functools import cache
from pathlib import Path

import pytest
import torch
from support.readings import first_reading, moved
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from magrl import tracking
from magrl.envs import GeomagneticNavEnv, Scenario, earth_scenario
from magrl.field import elements_gradient_at
from magrl.field.regional import RegionalField
from magrl.geodesy import geodesic, wrap_angle
from magrl.guidance import parallel_approach
from magrl.tracking import FieldTrack, GradientPrior, curl_relation
from magrl.transforms import FieldGradient, GradientHeading, SensorNoise, TrackGradient, TrueWay

sys.path.append(str(Path(__file__).parent.parent.parent / "docs" / "examples"))
plume_env = importlib.import_module("plume_env")

STATE = ("track_mean", "track_covariance")
SCALES = torch.tensor(tracking.ELEMENT_SCALES)
ESTIMATES = ("estimated_field", "estimated_gradient", "way", "way_covariance")
NOISE = (0.02, 0.05, 3.0)


@cache
def field() -> RegionalField:
    return Scenario().build_field()


def nav(num_envs: int = 3, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(field=field()), num_envs=num_envs, **({"seed": 0} | options))


def tracked(num_envs: int = 3, *, keys: tuple[str, ...] = (), **options: object) -> TransformedEnv:
    names = ["field", "target_field", "move", "heading", *keys]
    return TransformedEnv(nav(num_envs), TrackGradient(names, **options))


def flown(env: TransformedEnv, steps: int = 6) -> TensorDictBase:
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


def test_the_estimates_are_those_of_the_pure_functions() -> None:
    rollout = flown(tracked(noise_std=NOISE))
    reading = rollout["field"][:, 0]
    prior = tracking.dipole_prior(reading)
    track = tracking.start(reading, prior.gradient, prior.std, NOISE, prior.azimuth)
    for step in rollout["next"].unbind(1):
        heading = step["heading"]
        d = step["move"][:, :1] * torch.cat((heading.cos(), heading.sin()), -1)
        curvature = tracking.field_curvature(track.mean[..., 0] * SCALES)
        track = tracking.update(tracking.predict(track, d, curvature), step["field"], NOISE)
        known, shared = tracking.relate(track, tracking.curl_relation(track.mean[..., 0] * SCALES))
        way = tracking.way_to(known, step["target_field"], 300.0, shared=shared)
        torch.testing.assert_close(FieldTrack(*(step[key] for key in STATE)), track)
        torch.testing.assert_close(step["estimated_field"], known.mean[..., 0] * SCALES)
        torch.testing.assert_close(step["estimated_gradient"], tracking.estimated_gradient(known))
        torch.testing.assert_close((step["way"], step["way_covariance"]), tuple(way), rtol=1e-4, atol=1e-3)


def test_a_constant_error_is_a_key() -> None:
    keys = ("field", "target_field", "move", "heading", "sensor_std", "bias_std")
    first = first_reading()
    first["sensor_std"] = torch.tensor(NOISE, dtype=first["field"].dtype).expand_as(first["field"])
    first["bias_std"] = 10 * first["sensor_std"]
    biased, plain = TrackGradient(keys)(first.clone()), TrackGradient(keys[:5])(first.clone())
    for key in (*STATE, "estimated_gradient"):
        assert torch.equal(biased[key], plain[key])
    known, shared = tracking.relate(FieldTrack(*(plain[key] for key in STATE)), tracking.curl_relation(first["field"]))
    way = tracking.way_to(known, first["target_field"], 300.0, shared=shared, bias_std=first["bias_std"])
    torch.testing.assert_close((biased["way"], biased["way_covariance"]), tuple(way))


def test_the_first_estimate_is_the_reading_and_the_prior() -> None:
    first = TrackGradient(relation=None)(first_reading())
    torch.testing.assert_close(first["estimated_field"], first["field"])
    torch.testing.assert_close(first["estimated_gradient"], tracking.dipole_prior(first["field"]).gradient)


def test_the_estimated_gradient_obeys_the_relation() -> None:
    """The curl is less than that of the prior, and a relation changes the estimates, not the state."""
    first, free = (TrackGradient(**options)(first_reading()) for options in ({}, {"relation": None}))
    weights, value, _ = tracking.curl_relation(first["field"])
    curl, curl_free = (((weights * td["estimated_gradient"]).sum((-2, -1)) - value).abs() for td in (first, free))
    assert (curl < 0.9 * curl_free).all()
    for key in STATE:
        assert torch.equal(first[key], free[key])


def test_without_noise_it_finds_gradient_and_target() -> None:
    env = tracked(64, range_km=1000.0)
    start = flown(env, 12)[:, -1]
    after = start["next"]
    true = elements_gradient_at(field(), after["position"]).float()
    scale = SCALES.unsqueeze(-1) / tracking.DISTANCE_SCALE_KM
    assert ((after["estimated_gradient"] - true) / scale).norm(dim=(-2, -1)).median() < 0.1
    way_km, bearing = geodesic(*after["position"].T, *after["target_position"].T)
    true_way = (way_km * torch.stack((bearing.cos(), bearing.sin()))).T.float()
    assert ((after["way"] - true_way).norm(dim=-1) / way_km).median() < 0.15


def test_partial_reset_restarts_the_chosen_rows_alone() -> None:
    env = tracked(4)
    td = flown(env, 3)[:, -1]["next"]
    chosen = torch.tensor([True, False, False, True])
    after = env.reset(td.clone().set("_reset", chosen.unsqueeze(-1)))
    expected = TrackGradient()(after.select("field", "target_field", "move", "heading"))
    for key in (*STATE, *ESTIMATES):
        assert torch.equal(after[key][~chosen], td[key][~chosen]), key
        torch.testing.assert_close(after[key][chosen], expected[key][chosen], msg=key)
        assert not torch.equal(after[key][chosen], td[key][chosen]), key


def test_a_step_depends_on_its_tensordict_alone() -> None:
    """As stored data are stepped again, by another transform."""
    rollout = flown(tracked(noise_std=NOISE))
    again = TrackGradient(noise_std=NOISE)(rollout.exclude(*(("next", key) for key in (*STATE, *ESTIMATES))))
    for key in (*STATE, *ESTIMATES):
        torch.testing.assert_close(again["next", key], rollout["next", key], msg=key)
    env, other = tracked(), tracked()
    state = step_mdp(flown(env)[:, -1].clone())
    state["action"] = torch.tensor([30.0, 0.5]).expand(3, 2)
    for key in (*STATE, *ESTIMATES):
        assert torch.equal(env.step(state.clone())["next", key], other.step(state.clone())["next", key]), key


def test_nothing_but_its_inputs_is_read() -> None:
    """Privileged keys among them: they may be anything."""
    rollout = flown(tracked(noise_std=NOISE))
    public = [*STATE, *(("next", key) for key in ("field", "target_field", "move", "heading"))]
    again = TrackGradient(noise_std=NOISE)(rollout.select(*public))
    torch.testing.assert_close(again["next", "way"], rollout["next", "way"])


def test_the_frame_of_the_vehicle_by_hand() -> None:
    first = first_reading(1)
    first["heading"] = torch.tensor([[math.pi / 2]], dtype=torch.float64)  # east: north is to the left
    world, vehicle = (TrackGradient(frame=frame)(first.clone()) for frame in ("world", "vehicle"))
    (north, east), ((nn, ne), (_, ee)) = world["way"][0], world["way_covariance"][0]
    torch.testing.assert_close(vehicle["way"][0], torch.stack((east, -north)))
    torch.testing.assert_close(vehicle["way_covariance"][0].flatten(), torch.stack((ee, -ne, -ne, nn)))
    slope = world["estimated_gradient"]
    torch.testing.assert_close(vehicle["estimated_gradient"], torch.stack((slope[..., 1], -slope[..., 0]), -1))


def test_the_frame_of_the_vehicle_turns_nothing_else() -> None:
    world, vehicle = (flown(tracked(frame=frame))["next"] for frame in ("world", "vehicle"))
    for key in (*STATE, "estimated_field"):
        assert torch.equal(world[key], vehicle[key]), key
    torch.testing.assert_close(world["way"].norm(dim=-1), vehicle["way"].norm(dim=-1))
    torch.testing.assert_close(*(torch.linalg.det(td["way_covariance"]) for td in (world, vehicle)))
    assert not torch.allclose(world["way"], vehicle["way"])


@pytest.mark.parametrize("turn", [171.5, -188.0, 360.0])
def test_a_declination_that_crosses_180_degrees_is_continued(turn: float) -> None:
    """The zero of D does not matter: only the prior follows it, which is turned back here."""

    def shifted(td: TensorDict) -> TensorDict:
        td = td.clone()
        for key in ("field", "target_field"):
            td[key][:, 0] = torch.remainder(td[key][:, 0] + turn + 180, 360) - 180
        return td

    def turned_back(reading: Tensor) -> GradientPrior:
        return tracking.dipole_prior(reading - torch.tensor((turn, 0.0, 0.0), dtype=reading.dtype))

    first = first_reading(64)
    after = moved(first, 40.0, 0.3, torch.tensor((-0.8, 0.5, 60.0), dtype=torch.float64))
    one, two = TrackGradient(relation=None), TrackGradient(relation=None, prior=turned_back)
    steps = TensorDict(one(first.clone()), batch_size=64).set("next", after)
    plain, other = one(steps)["next"], two(two(shifted(first)).set("next", shifted(after)))["next"]
    for key in ("estimated_gradient", "way", "way_covariance"):
        torch.testing.assert_close(other[key], plain[key], rtol=1e-8, atol=1e-8, msg=key)
    torch.testing.assert_close(
        other["estimated_field"],
        shifted(plain.select("field", "target_field").set("field", plain["estimated_field"].clone()))["field"],
    )
    if abs(turn) < 360:
        crossed = (shifted(first)["field"] - shifted(after)["field"])[:, 0].abs() > 180
        assert crossed.any()
        assert not crossed.all()


def test_other_elements_are_not_wrapped() -> None:
    plain = TrackGradient(angles=())
    steps = plain(first_reading()).set(
        "next", moved(first_reading(), 1.0, 0.0, torch.tensor((0.0, 400.0, 0.0)).double())
    )
    assert (plain(steps)["next", "estimated_field"][:, 1] > 180).all()


def test_the_data_sheet_may_be_a_key() -> None:
    rows = torch.tensor(NOISE, dtype=torch.float64) * torch.tensor([[1.0], [4.0]], dtype=torch.float64)
    first = first_reading(2).set("sensor_std", rows)
    after = moved(first, 40.0, 0.3, torch.tensor((0.3, 0.5, 60.0), dtype=torch.float64)).set("sensor_std", rows)
    read = TrackGradient(["field", "target_field", "move", "heading", "sensor_std"])
    both = read(read(first.clone()).set("next", after))["next"]
    for row, std in enumerate(rows.tolist()):
        alone = TrackGradient(noise_std=std)
        expected = alone(alone(first.clone()).set("next", after.clone()))["next"]
        for key in (*STATE, *ESTIMATES):
            torch.testing.assert_close(both[key][row], expected[key][row], msg=key)


def test_a_step_is_compiled_whole() -> None:
    torch.compiler.reset()
    transform = TrackGradient(noise_std=NOISE, frame="vehicle")
    rollout = flown(tracked(noise_std=NOISE)).exclude(*(("next", key) for key in (*STATE, *ESTIMATES)))
    expected = transform(rollout.clone())
    found = torch.compile(transform, fullgraph=True, backend="aot_eager")(rollout)
    for key in (*STATE, *ESTIMATES):
        torch.testing.assert_close(found["next", key], expected["next", key], rtol=1e-4, atol=1e-4, msg=key)


def test_a_step_without_its_state_is_refused() -> None:
    first = first_reading()
    with pytest.raises(KeyError, match=r"track_mean.*track_covariance.*reset\(\) or step_mdp\(\)"):
        TrackGradient()(first.set("next", first.clone()))


def test_shapes_that_do_not_match_are_refused() -> None:
    for keys, message in (
        (("move", "target_field", "move", "heading"), r"same shape.*\(3, 2\)"),
        (("field", "target_field", "move", "move"), r"heading \(3, 1\), got \(3, 2\)"),
        (("field", "target_field", "move", "heading", "position"), r"same shape"),
    ):
        with pytest.raises(ValueError, match=message):
            _ = TransformedEnv(nav(), TrackGradient(keys)).specs
    with pytest.raises(ValueError, match=r"an element for each of its scales"):
        _ = TransformedEnv(nav(), TrackGradient(scales=(1.0, 1.0), curvature=(1.0, 1.0))).specs


@pytest.mark.parametrize("frame", ["world", "vehicle"])
def test_specs_in_a_chain(frame: str) -> None:
    env = TransformedEnv(nav(), Compose(TrackGradient(frame=frame)))
    check_env_specs(env, break_when_any_done="both")
    assert set(STATE) <= set(env.full_state_spec.keys())
    assert not set(ESTIMATES) & set(env.full_state_spec.keys())


def tracer_prior(reading: Tensor) -> GradientPrior:
    mean = torch.zeros(*reading.shape, 2)
    return GradientPrior(mean, torch.ones_like(mean), torch.zeros(reading.shape[:-1]))


def test_the_estimated_gradient_of_tracers_leads_to_the_target() -> None:
    """The figures of docs/transforms.md: nothing here is magnetic, and nothing reads the true gradient."""
    options = {"scales": (1.0, 1.0), "curvature": (2000.0, 2000.0), "angles": (), "range_km": 5.0}
    track = TrackGradient(
        ["tracers", "target_tracers", "move", "heading"], prior=tracer_prior, relation=None, **options
    )
    keys = ["estimated_field", "target_tracers", "estimated_gradient"]
    heading = GradientHeading(keys, ["way_heading", "way_valid"], pair=(0, 1))
    env = TransformedEnv(plume_env.PlumeEnv(200), Compose(StepCounter(30), track, heading))

    def sway(td: TensorDictBase) -> TensorDictBase:
        side = math.pi / 6 * (1 - 2 * (td["step_count"] % 2))
        turn = wrap_angle(td["way_heading"] + side - td["heading"]).clamp(-math.pi / 2, math.pi / 2)
        return td.set("action", torch.cat((torch.full_like(turn, 0.6), turn), -1))

    rollout = env.rollout(30, sway, break_when_any_done=False, break_when_all_done=True)
    assert rollout["next", "terminated"].any(1).double().mean() > 0.95
    third = rollout[:, 2]
    gradient = FieldGradient(plume_env.concentration, ["position"], ["gradient"])(third.select("position"))["gradient"]
    true, _ = parallel_approach(third["tracers"], third["target_tracers"], gradient)
    assert wrap_angle(true - third["way_heading"]).abs().median() < math.radians(3)


def test_the_relation_of_the_gradients_replaces_a_second_leg() -> None:
    """Median error of the estimated direction after one leg of 30 km in the direction of the first estimate, on Earth.

    docs/theory.md quotes these numbers.
    """
    scenario = earth_scenario(16, seed=5, max_latitude=70)
    keys = ("field", "target_field", "move", "heading", "sensor_std")
    medians = []
    for std in ((0.0, 0.0, 0.0), (0.05, 0.05, 5.0)):
        for relation in (None, curl_relation):
            base = GeomagneticNavEnv(scenario, num_envs=1000, seed=0, start_heading="random", max_turn_deg=180.0)
            track = TrackGradient(keys, relation=relation, frame="vehicle")
            env = TransformedEnv(base, Compose(SensorNoise(std, seed=1), track, TrueWay()))
            state = env.reset()
            ahead, right = state["way"].unbind(-1)
            action = torch.stack((torch.full_like(ahead, 30.0), torch.atan2(right, ahead)), -1)
            after = env.step(state.set("action", action))["next"]
            angles = [torch.atan2(after[key][:, 1], after[key][:, 0]) for key in ("way", "true_way")]
            medians.append(wrap_angle(angles[0] - angles[1]).abs().rad2deg().median().item())
    assert medians == pytest.approx([48.0, 19.0, 49.0, 33.0], abs=1.0)  # of chance, 90
