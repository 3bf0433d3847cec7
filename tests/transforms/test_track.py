"""Transforms of a track: the filter in the TensorDict against the pure functions, by row, in both frames; search."""

from __future__ import annotations

import importlib
import math
import sys
from pathlib import Path

import pytest
import torch
from support.readings import first_reading, moved
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, ObservationNorm, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from magrl import tracking
from magrl.envs import GeomagneticNavEnv, earth_scenario
from magrl.field import elements_gradient_at
from magrl.geodesy import geodesic, wrap_angle
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import FieldTrack, GradientPrior, curl_relation
from magrl.transforms import (
    NoiseScale,
    SearchAim,
    SensorErrors,
    SensorNoise,
    TrackGradient,
    TrueWay,
)
from magrl.transforms.track import IN_KEYS, OUT_KEYS

sys.path.append(str(Path(__file__).parent.parent.parent / "docs" / "examples"))
plume_env = importlib.import_module("plume_env")

STATE = OUT_KEYS[:2]
SCALES = torch.tensor(tracking.ELEMENT_SCALES)
STD = (0.02, 0.05, 3.0)
NEXT = [("next", key) for key in OUT_KEYS]


def tracked(num_envs: int = 3, **options: object) -> TransformedEnv:
    return TransformedEnv(GeomagneticNavEnv(num_envs=num_envs, seed=0), TrackGradient(**options))


def flown(env: TransformedEnv, steps: int = 6) -> TensorDictBase:
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


def stepped(track: TrackGradient, first: TensorDict, after: TensorDict) -> TensorDictBase:
    """The estimates after a first reading and one move."""
    return track(track(first.clone()).set("next", after.clone()))["next"]


def aim(known: FieldTrack, target: Tensor, common: Tensor | None = None, **options: Tensor) -> tuple[Tensor, ...]:
    """The way to aim at and its covariance, by the pure functions."""
    posterior = tracking.way_posterior(known, target, 300.0, **options, common=common, fine=False)
    return tuple(posterior.aim(tracking.way_to(known, target, 300.0, **options)))


def test_the_estimates_are_those_of_the_pure_functions() -> None:
    """In float64, written in the type of the readings but for the state."""
    rollout = flown(tracked(sensor_std=STD))
    reading = rollout["field"][:, 0].double()
    prior = tracking.LearnedPrior.pretrained()(reading, rollout["target_field"][:, 0].double())
    track = tracking.start(reading, prior, STD)
    for written in rollout["next"].unbind(1):
        step = written.double()
        north, east = torch.cos(step["heading"]), torch.sin(step["heading"])
        leg = step["move"][:, :1] * torch.cat((north, east), -1)
        curvature = tracking.field_curvature(track.mean[..., 0] * SCALES)
        track = tracking.update(tracking.predict(track, leg, curvature), step["field"], STD)
        known, shared = tracking.relate(track, tracking.curl_relation(track.mean[..., 0] * SCALES))
        bend = tracking.field_curvature(tracking.estimated_field(known))
        options = {"shared": shared, "curvature": bend}
        way = aim(known, step["target_field"], **options)
        torch.testing.assert_close(FieldTrack(*(written[key] for key in STATE)), track)
        torch.testing.assert_close(written["estimated_field"], (known.mean[..., 0] * SCALES).float())
        torch.testing.assert_close(written["estimated_gradient"], tracking.estimated_gradient(known).float())
        found = step["way"], step["way_covariance"]
        torch.testing.assert_close(found, way, rtol=1e-4, atol=1e-3, check_dtype=False)


@pytest.mark.parametrize("row", [0, 1])
def test_standard_deviations_may_be_keys(row: int) -> None:
    """Each row has its own; a slow error makes readings less certain, and widens the way."""
    rows = torch.tensor(STD, dtype=torch.float64) * torch.tensor([[1.0], [4.0]], dtype=torch.float64)
    std = {"sensor_std": rows, "bias_std": 20 * rows, "drift_std": 10 * rows}
    first = first_reading(2).update(std)
    after = moved(first, 40.0, 0.3, torch.tensor((0.3, 0.5, 60.0), dtype=torch.float64))
    after.update(std)
    plain, biased = (stepped(TrackGradient(std_keys=STD_KEYS[:count]), first, after)[row] for count in (1, 3))
    alone = stepped(TrackGradient(sensor_std=rows[row].tolist()), first, after)[row]
    stated = TrackGradient(sensor_std=SensorStd(*((factor * rows[row]).tolist() for factor in (1, 20, 10))))
    stated = stepped(stated, first, after)[row]
    for key in OUT_KEYS:
        torch.testing.assert_close(plain[key], alone[key], msg=key)
        torch.testing.assert_close(biased[key], stated[key], msg=key)
    noisier = stepped(TrackGradient(sensor_std=(26**0.5 * rows[row]).tolist()), first, after)[row]  # 1 + 10^2 / 4
    for key in (*STATE, "estimated_gradient"):
        torch.testing.assert_close(biased[key], noisier[key], msg=key)
    known, shared = tracking.related(FieldTrack(*(noisier[key] for key in STATE)), curl_relation)
    field = tracking.estimated_field(known)
    options = {"bias_std": 20 * rows[row], "curvature": tracking.field_curvature(field), "shared": shared}
    way = aim(known, after["target_field"][row], tracking.common_error(field), **options)
    for found, expected in zip((biased["way"], biased["way_covariance"]), way, strict=True):
        torch.testing.assert_close(found.float(), expected.float())


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
    true = elements_gradient_at(env.base_env.field, after["position"]).float()
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
    expected = TrackGradient()(after.select(*IN_KEYS))
    for key in OUT_KEYS:
        assert torch.equal(after[key][~chosen], td[key][~chosen]), key
        torch.testing.assert_close(after[key][chosen], expected[key][chosen], msg=key)
        assert not torch.equal(after[key][chosen], td[key][chosen]), key


def test_a_step_depends_on_its_state_and_public_keys_alone() -> None:
    """As stored data are stepped again, by another transform; compiled as one graph, too."""
    rollout, transform = flown(tracked(sensor_std=STD, frame="vehicle")), TrackGradient(sensor_std=STD, frame="vehicle")
    known = rollout.select(*STATE, *(("next", key) for key in IN_KEYS))
    torch.compiler.reset()
    compiled = torch.compile(transform, fullgraph=True, backend="eager")
    for again, tolerance in ((transform(known.clone()), 1e-5), (compiled(known.clone()), 1e-4)):
        for key in NEXT:
            torch.testing.assert_close(again[key], rollout[key], rtol=tolerance, atol=tolerance, msg=str(key))
    state = step_mdp(rollout[:, -1].clone()).set("action", torch.tensor([30.0, 0.5]).expand(3, 2))
    one, two = (tracked(frame="vehicle").step(state.clone()) for _ in range(2))
    assert all(torch.equal(one[key], two[key]) for key in NEXT)


def test_the_frame_of_the_vehicle_by_hand() -> None:
    first = first_reading(1)
    first["heading"] = torch.tensor([[math.pi / 2]], dtype=torch.float64)  # east: north is to the left
    world, vehicle = (TrackGradient(frame=frame)(first.clone()) for frame in ("world", "vehicle"))
    (north, east), ((nn, ne), (_, ee)) = world["way"][0], world["way_covariance"][0]
    torch.testing.assert_close(vehicle["way"][0], torch.stack((east, -north)))
    torch.testing.assert_close(vehicle["way_covariance"][0].flatten(), torch.stack((ee, -ne, -ne, nn)))
    slope = world["estimated_gradient"]
    torch.testing.assert_close(vehicle["estimated_gradient"], torch.stack((slope[..., 1], -slope[..., 0]), -1))


def test_a_declination_that_crosses_180_degrees_is_continued() -> None:
    """The zero of D does not matter: only the prior follows it, which is turned back here."""
    turn = 171.5

    def shifted(td: TensorDict) -> TensorDict:
        td = td.clone()
        for key in ("field", "target_field"):
            td[key][:, 0] = torch.remainder(td[key][:, 0] + turn + 180, 360) - 180
        return td

    def turned_back(reading: Tensor, target: Tensor) -> GradientPrior:  # noqa: ARG001
        return tracking.dipole_prior(reading - torch.tensor((turn, 0.0, 0.0), dtype=reading.dtype))

    first = first_reading(64)
    after = moved(first, 40.0, 0.3, torch.tensor((-0.8, 0.5, 60.0), dtype=torch.float64))
    one, two = (TrackGradient(relation=None, prior=prior) for prior in (tracking.dipole_prior, turned_back))
    plain, other = stepped(one, first, after), stepped(two, shifted(first), shifted(after))
    for key in ("estimated_gradient", "way", "way_covariance"):
        torch.testing.assert_close(other[key], plain[key], rtol=1e-8, atol=1e-8, msg=key)
    torch.testing.assert_close(
        other["estimated_field"],
        shifted(plain.select("field", "target_field").set("field", plain["estimated_field"].clone()))["field"],
    )
    crossed = (shifted(first)["field"] - shifted(after)["field"])[:, 0].abs() > 180
    assert crossed.any()
    assert not crossed.all()


def test_other_elements_are_not_wrapped() -> None:
    after = moved(first_reading(), 1.0, 0.0, torch.tensor((0.0, 400.0, 0.0)).double())
    assert (stepped(TrackGradient(angles=()), first_reading(), after)["estimated_field"][:, 1] > 180).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"in_keys": ("move", "target_field", "move", "heading")}, r"reads 'move' as .*3\), got \(3, 2\)"),
        ({"in_keys": IN_KEYS[:3]}, "4 or 5 or 7 in_keys"),
        ({"std_keys": ["sensor_std"], "sensor_std": STD}, "give sensor_std or std_keys"),
        ({"in_keys": (*IN_KEYS, "sensor_std")}, "more than 4 keys need names"),
        ({"in_keys": {"reading": "field"}}, "key must be one of 'field', .*'reading'"),
        ({"sensor_std": (0.1, -0.1, 1.0)}, "sensor_std.noise must be a finite number from 0 on, got -0.1"),
        ({"angles": (3,)}, r"angles must be indices of the 3 elements, got \(3,\)"),
        ({"relation": 1.0}, "relation one or None"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _ = tracked(**options).specs


def test_the_relation_of_the_gradients_replaces_a_second_leg() -> None:
    """Median error of the estimated direction after one leg of 30 km along the first estimate, on Earth."""
    scenario = earth_scenario(16, seed=5, max_latitude=70)
    medians = []
    for std in ((0.0, 0.0, 0.0), (0.05, 0.05, 5.0)):
        for relation in (None, curl_relation):
            base = GeomagneticNavEnv(scenario, num_envs=4000, seed=0, start_heading="random", max_turn_deg=180.0)
            track = TrackGradient(std_keys=["sensor_std"], relation=relation, frame="vehicle")
            env = TransformedEnv(base, Compose(SensorNoise(std, seed=1), track, TrueWay()))
            state = env.reset()
            ahead, right = state["way"].unbind(-1)
            action = torch.stack((torch.full_like(ahead, 30.0), torch.atan2(right, ahead)), -1)
            after = env.step(state.set("action", action))["next"]
            angles = [torch.atan2(after[key][:, 1], after[key][:, 0]) for key in ("way", "true_way")]
            medians.append(wrap_angle(angles[0] - angles[1]).abs().rad2deg().median().item())
    assert medians == pytest.approx([25.0, 13.1, 28.7, 22.0], abs=1.0)  # of chance, 90


def test_the_scaled_noise_is_that_of_the_pure_function() -> None:
    """Also where slow errors explain the deviation of a reading."""
    first = first_reading().update({key: torch.tensor(STD).double().expand(4, 3) for key in STD_KEYS})
    track, after = TrackGradient(std_keys=STD_KEYS), moved(first, 40.0, 0.3, torch.tensor((0.5, 0.2, 50.0)))
    factors = []
    for slow in (0.0, 50.0):
        std = [first[key] * factor for key, factor in zip(STD_KEYS, (1, 1, slow), strict=True)]
        after.update(dict(zip(STD_KEYS, std, strict=True)))
        before = track(NoiseScale()(first.clone()))
        written = NoiseScale()(before.clone().set("next", after.clone()))["next"]
        way = tracking.displacement_of(after["move"], after["heading"])
        none = tracking.NoiseEstimate(0 * std[0], 0 * std[0])
        state = FieldTrack(*(before[key] for key in STATE))
        estimate = tracking.noise_estimate(none, state, way, after["field"], std[0], std[2])
        torch.testing.assert_close(written["sensor_std"], std[0] * estimate.factor)
        factors.append(written["noise_log_ratio"])
    assert (factors[1].abs() < factors[0].abs() / 2).all()


# The search


def searching(frame: str) -> TransformedEnv:
    base = GeomagneticNavEnv(num_envs=64, seed=3, start_heading="random")
    errors = SensorErrors((0.02, 0.02, 2.0), bias=(0.3, 0.0, 0.0), seed=1)
    track = NoiseScale(), TrackGradient(std_keys=STD_KEYS, frame=frame)
    return TransformedEnv(base, Compose(errors, *track, SearchAim(zeta=0.01, frame=frame)))


def test_specs() -> None:
    env = searching("vehicle")
    check_env_specs(env, break_when_any_done="both")
    state = {*STATE, "visited", "arrival_weights", *NoiseScale.default_out_keys[1:]}
    assert state == {*OUT_KEYS, "aim", *STD_KEYS, *state} & set(env.full_state_spec.keys())


def test_the_filter_weighs_readings_by_the_noise_that_they_show() -> None:
    """A twentieth of the noise is stated to vehicles that stay where they are."""
    base, stay = GeomagneticNavEnv(num_envs=64, seed=3), torch.zeros(64, 2)
    variances = []
    for scaled in ([], [NoiseScale()]):
        noise, stated = SensorNoise((0.1, 0.1, 10.0), seed=1), ObservationNorm(0.0, 0.05, in_keys=["sensor_std"])
        env = TransformedEnv(base, Compose(noise, stated, *scaled, TrackGradient(std_keys=STD_KEYS)))
        state = env.reset()
        for _ in range(12):
            state = env.step_mdp(env.step(state.set("action", stay)))
        variances.append(state[STATE[1]][:, :, 0, 0].mean(0))
    with pytest.raises(ValueError, match=r"NoiseScale stands before the transform that writes \['track_mean'"):
        _ = TransformedEnv(base, Compose(noise.clone(), TrackGradient(), NoiseScale())).specs
    assert (variances[1] > 5 * variances[0]).all()
    assert (state["sensor_std"] > 0.2 * torch.tensor((0.1, 0.1, 10.0))).all()
    with pytest.raises(KeyError, match=r"NoiseScale reads its state \['track_mean'"):
        env.step(state.exclude(*STATE))


def test_both_frames_give_the_same_way() -> None:
    torch.manual_seed(0)
    actions = [searching("world").rand_action()["action"] for _ in range(4)]
    ways = {}
    for frame in ("world", "vehicle"):
        env = searching(frame)
        state = env.reset()
        for action in actions:
            state = env.step_mdp(env.step(state.set("action", action)))
        ways[frame], heading = state["aim"], state["heading"].squeeze(-1)
    cos, sin = torch.cos(heading), torch.sin(heading)
    (north, east), turned = ways["world"].unbind(-1), ways["vehicle"]
    expected = torch.stack((cos * north + sin * east, cos * east - sin * north), -1)
    torch.testing.assert_close(turned, expected, rtol=1e-3, atol=0.1)
