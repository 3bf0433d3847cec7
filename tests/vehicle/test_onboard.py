"""On board: the commands of the environment from plain numbers, refusals, stops, saved states, the exported step."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnxruntime import InferenceSession
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, ObservationNorm, TransformedEnv

from magrl.agents import FieldPolicy, PolicyConfig, load_pretrained
from magrl.envs import GeomagneticNavEnv
from magrl.evaluation.navigators import make_navigator
from magrl.evaluation.rollout import restart
from magrl.evaluation.scenarios import with_declaration
from magrl.field import IGRF, elements_at
from magrl.geodesy import geodesic, move
from magrl.navigators import Geodesic, Secant
from magrl.navigators.base import displacement_to
from magrl.sensor_std import PERFECT, SensorStd
from magrl.transforms import Conditions, MagneticNorth, SensorErrors, with_conditions, with_sensor_noise
from magrl.vehicle.onboard import Onboard, VehicleStep, check_earth_jump, check_earth_reading, first_state, write_step
from magrl.vehicle.onboard.step import ONNX_INPUTS

TARGET, HERE = (-11.6, 75.4, 13240.0), (3.5, 73.0, 15000.0)
NOISE = (0.02, 0.02, 2.0)
NONE = (0.0, 0.0, 0.0)
Known = tuple[float, ...]


def environment(noise: tuple[float, float, float] = NONE, **options: str) -> EnvBase:
    return with_sensor_noise(GeomagneticNavEnv(num_envs=1, seed=3, start_heading="random", **options), noise, seed=1)


def numbers(state) -> tuple[float, ...]:
    """What a vehicle knows of a state of the environment: reading, heading [deg] and distance [km]."""
    heading = math.degrees(state["heading"].item())
    return (*state["field"][0].tolist(), heading, state["move"][0, 0].item())


def episode(policy: TensorDictModuleBase, env: EnvBase, limit: int = 50) -> tuple[list[float], list[Known], list]:
    """An episode: the target, what the vehicle knows in each state, and the actions of the policy."""
    restart(env)
    state, known, actions = env.reset(), [], []
    target = state["target_field"][0].tolist()
    while True:
        known.append(numbers(state))
        if state["done"].item() or len(actions) == limit:
            return target, known, actions
        with torch.no_grad():
            actions.append(policy(state)["action"][0].tolist())
        state = env.step(state)["next"]


def region_policy() -> FieldPolicy:
    torch.manual_seed(0)
    return FieldPolicy(PolicyConfig(environment().observation_view(), (8,)))


# The same commands as in the environment


@pytest.mark.parametrize(
    ("name", "noise", "stated", "north"),
    [
        ("anywhere", NONE, 1.0, "true"),
        ("secant", NOISE, 1.0, "true"),
        ("anywhere", (0.1, 0.1, 10.0), 2.5, "true"),
        ("kalman", (0.05, 0.05, 5.0), 0.4, "true"),
        ("kalman", NOISE, 1.0, "magnetic"),
        ("secant", NOISE, 1.0, "magnetic"),
    ],
)
def test_commands_are_those_of_the_environment(name: str, noise: Known, stated: float, north: str) -> None:
    """Over a whole episode, with the declaration at its end; also where other noise is stated, and without D."""
    env, sensor_std = environment(noise, arrival="declared"), tuple(stated * std for std in noise)
    magnetic = north == "magnetic"
    known = SensorStd(sensor_std, (math.inf, 0.0, 0.0)) if magnetic else sensor_std
    policy = make_navigator(name, getattr(env, "base_env", env), sensor_std=known)
    if stated != 1:
        env = TransformedEnv(env, ObservationNorm(0.0, stated, in_keys=["sensor_std"]), auto_unwrap=True)
    env = with_declaration(TransformedEnv(env, MagneticNorth(), auto_unwrap=True) if magnetic else env)
    vehicle = Onboard(name, north=north, sensor_std=sensor_std, max_steps=50, confidence=0.0)
    restart(env)
    state, over, steps = env.reset(), False, 0
    vehicle.start((None, *state["target_field"][0, 1:].tolist()) if magnetic else state["target_field"][0].tolist())
    while not over:
        declination, *others = numbers(state)
        command = vehicle.step(None if magnetic else declination, *others)
        with torch.no_grad():
            after = env.step(policy(state))["next"]
        over = after["done"].item()
        assert command.confidence == pytest.approx(state["arrival_probability"].item(), abs=1e-4)
        assert (command.stop == "arrived") == over == after["declared"].item()
        distance, turn = after["move"][0].tolist()
        assert command.distance_km == pytest.approx(distance, abs=1e-4)
        assert math.radians(command.turn_deg) == pytest.approx(turn, abs=1e-4)
        assert math.remainder(command.heading_deg - math.degrees(after["heading"].item()), 360) == pytest.approx(
            0, abs=0.01
        )
        state, steps = after, steps + 1
    assert steps > 5
    assert after["success"].item() or stated != 1


@pytest.mark.parametrize("name", ["anywhere", "kalman", "secant"])
def test_commands_from_a_known_start_are_those_of_the_environment(name: str, tmp_path: Path) -> None:
    """The constant errors of sensors that the first reading shows; also for a vehicle that is restored."""
    own = Conditions(
        "own", sensors={"noise": NOISE, "bias": (0.4, 0.1, 30.0), "drift": (0.2, 0.1, 20.0), "drift_length": 50}
    )
    known, options = (0.1, 0.1, 10.0), {"max_steps": 50, "confidence": 0.0}
    base = GeomagneticNavEnv(num_envs=1, seed=3, start_heading="random", arrival="declared")
    policy = make_navigator(name, base, sensor_std=own.std_at(known))
    env = with_conditions(base, own, seed=1)
    here = env.reset()["true_field"][0].tolist()
    bare, env = env, with_declaration(with_conditions(base, own, seed=1, known_start=known))
    restart(bare)
    restart(env)
    state = env.reset()
    vehicle = Onboard(name, sensor_std=own.std, **options)
    vehicle.start(state["target_field"][0].tolist(), here, here_std=known)
    for step in range(6):
        if step in (0, 3):
            vehicle.save(tmp_path / "state")
            vehicle = Onboard(name, sensor_std=own.std, **options)
            vehicle.restore(tmp_path / "state")
        reading = (state["field"] + state["start_error"])[0].tolist()
        command = vehicle.step(*reading, *numbers(state)[3:])
        assert command.way_km == pytest.approx(state["arrival_way"][0].tolist(), rel=1e-3, abs=0.01)
        with torch.no_grad():
            state = env.step(policy(state))["next"]
        distance, turn = state["move"][0].tolist()
        assert (command.distance_km, math.radians(command.turn_deg)) == pytest.approx((distance, turn), abs=1e-3)


@pytest.mark.parametrize(
    ("reading", "intensity_nt", "cause"),
    [
        ((8.0, -65.0), 20000.0, "the vertical axis points up"),
        ((-8.0, 65.0), 20000.0, "D is positive where magnetic north is east"),
        ((-8.0, -65.0), 20000.0, "the axes point left and up"),
        ((math.radians(8.0), math.radians(65.0)), 30000.0, "it fits in radians"),
        ((8.0, math.radians(65.0)), 30000.0, "I fits in radians"),
        ((math.radians(8.0), 65.0), 20000.0, "D fits in radians"),
        ((65.0, 8.0), 30000.0, "D and I are swapped"),
        ((-172.0, 65.0), 20000.0, "the horizontal axes point backward"),
        ((82.0, 65.0), 20000.0, "the horizontal axes are swapped"),
        ((8.0, 65.0, 14000.0 / math.cos(math.radians(65.0))), 14000.0, "B_H is the total intensity"),
        ((0.0, 65.0), 20000.0, "the heading is from magnetic north"),
        ((8.0, 60.0), 20000.0, "check sensors, calibration"),
    ],
)
def test_a_first_reading_that_does_not_fit_the_start_is_refused(
    reading: Known, intensity_nt: float, cause: str
) -> None:
    """Where a mistake explains it, that is named; the right reading is then taken."""
    here = (8.0, 65.0, intensity_nt)
    vehicle = Onboard("kalman", sensor_std=SensorStd(NOISE, (0.1, 0.1, 10.0)))
    vehicle.start((5.0, 67.0, intensity_nt), here)
    with pytest.raises(ValueError, match=rf"^the first reading, .* does not fit the start, .*: .*{cause}"):
        vehicle.step(*(*reading, intensity_nt)[:3], heading=0.0)
    assert vehicle.step(*here, heading=0.0).stop is None


def test_a_place_near_the_start_checks_the_first_reading_and_nothing_else(tmp_path: Path) -> None:
    """An uncalibrated reading in Norway is refused; one 150 km away is taken, with the command without a place."""
    vehicle, other = (Onboard("secant", sensor_std=NOISE) for _ in range(2))
    vehicle.start(TARGET, near=(60.4, 5.3), date="2026-06-30")
    vehicle.save(tmp_path / "state")
    vehicle.restore(tmp_path / "state")
    with pytest.raises(ValueError, match=r"\(I deviates by 80.75, where 3.46 is likely\): check sensors, calibration"):
        vehicle.step(-8.0, -7.7, 35603.0, heading=0.0)
    other.start(TARGET)
    reading = elements_at(IGRF("2026-06-30"), torch.tensor([59.1, 5.3], dtype=torch.float64)).tolist()
    assert vehicle.step(*reading, heading=0.0) == replace(other.step(*reading, heading=0.0), reason="")
    with pytest.raises(ValueError, match="need a date"):
        vehicle.start(TARGET, near=(60.4, 5.3))
    with pytest.raises(ValueError, match="from the target"):
        Onboard("secant", max_steps=20).start(TARGET, near=(-37.0, 5.3), date="2026-06-30")


def test_a_position_at_the_start_gives_the_elements_of_the_model() -> None:
    """With the accuracy of the model, to which a compass that is off by half a degree is corrected in part."""
    vehicle = Onboard("secant", sensor_std=SensorStd(bias=(0.5, 0.0, 0.0)))
    vehicle.start(TARGET, (60.4, 5.3), date="2026-06-30")
    elements = elements_at(IGRF("2026-06-30"), torch.tensor([60.4, 5.3], dtype=torch.float64)).tolist()
    with pytest.raises(ValueError, match=r"D deviates by 4\.3.*: check sensors, calibration"):
        vehicle.step(elements[0] - 4.3, elements[1] + 0.6, elements[2] - 500, heading=0.0)  # iron, or nearly -D
    vehicle.step(elements[0] + 0.5, *elements[1:], heading=0.0)
    share = 0.25 / (0.25 + 0.26**2 + (5417 / elements[2]) ** 2)
    assert vehicle._last[0] == pytest.approx(elements[0] + 0.5 - 0.5 * share)
    for here, options, message in (
        ((60.4, 5.3), {}, "need a date"),
        (HERE, {"date": "2026-06-30"}, "elements need no date"),
        ((60.4,), {}, "latitude and longitude, got"),
        ((95.0, 5.3), {"date": "2026-06-30"}, "latitude must be .* from -90 up to 90, got 95.0"),
        (HERE, {"here_std": (0.1, -1.0, 5.0)}, "here_std must be a finite number from 0 on, got -1.0"),
        ((3.5, 73.0, 15.0), {}, "here: horizontal_intensity 15 at"),
    ):
        with pytest.raises(ValueError, match=message):
            vehicle.start(TARGET, here, **options)


def test_commands_of_own_policies() -> None:
    """One that reads the turn and the field of a region."""
    policy, vehicle = region_policy(), Onboard(region_policy())
    target, known, actions = episode(policy, environment(), limit=6)
    vehicle.start(target)
    for step, action in zip(known, actions, strict=False):
        command = vehicle.step(*step)
        assert (command.distance_km, math.radians(command.turn_deg)) == pytest.approx(tuple(action), abs=1e-5)


@pytest.mark.parametrize("navigator", ["anywhere", "secant"])
def test_the_estimated_way_is_northward_and_eastward(navigator: str) -> None:
    """Whatever the heading, which a move of 0 km changes; and it is about the true one."""
    env = environment()
    target, known, _ = episode(Secant(), env)
    vehicle = Onboard(navigator)
    vehicle.start(target)
    *_, before, _, first = [vehicle.step(*step) for step in known[:8]]
    other = copy.deepcopy(vehicle)
    again, turned = (v.step(*known[7][:3], known[7][3] + turn, 0.0) for v, turn in ((vehicle, 0.0), (other, 77.0)))
    assert turned.way_km == pytest.approx(again.way_km, abs=0.01)
    assert turned.way_covariance_km2[0] == pytest.approx(again.way_covariance_km2[0], rel=1e-3, abs=0.01)
    restart(env)
    state = env.reset()
    ways = []
    for step in known[1:8]:
        action = [step[4], math.remainder(math.radians(step[3]) - state["heading"].item(), 2 * math.pi)]
        state = env.step(state.set("action", torch.tensor([action])))["next"]
        distance, bearing = geodesic(*state["position"][0], *state["target_position"][0])
        ways.append(((distance * torch.cos(bearing)).item(), (distance * torch.sin(bearing)).item()))
    assert math.dist(before.way_km, ways[4]) < before.error_km
    assert math.dist(first.way_km, ways[6]) < 0.3 * distance.item()


# Missed readings, useless elements, repeated messages


@pytest.mark.parametrize("name", ["anywhere", "secant"])
def test_missed_readings_are_the_outages_of_the_environment(name: str) -> None:
    """The vehicle gets None, the policy in the environment the last reading with a large standard deviation."""
    base = GeomagneticNavEnv(num_envs=1, seed=3, start_heading="random", arrival="declared")
    env = with_declaration(TransformedEnv(base, SensorErrors(NOISE, outage_rate=0.5, seed=2)))
    policy = make_navigator(name, base, sensor_std=NOISE)
    vehicle, missed = Onboard(name, sensor_std=NOISE, max_steps=50, confidence=0.0), 0
    restart(env)
    state = env.reset()
    vehicle.start(state["target_field"][0].tolist())
    for _ in range(8):
        missing = state["sensor_std"].max().item() > 100
        missed += missing
        command = vehicle.step(*([None] * 3 if missing else numbers(state)[:3]), *numbers(state)[3:])
        assert command.way_km == pytest.approx(state["arrival_way"][0].tolist(), rel=1e-3, abs=0.01)
        with torch.no_grad():
            state = env.step(policy(state))["next"]
        distance, turn = state["move"][0].tolist()
        assert (command.distance_km, math.radians(command.turn_deg)) == pytest.approx((distance, turn), abs=1e-3)
    assert 0 < missed < 8


def test_a_way_that_is_longer_than_a_move_is_reported_in_parts() -> None:
    """The path of all parts explains the change of I and B_H; that D is the same at both ends is no stuck sensor."""
    after, vehicle = (3.5, 79.0, 9000.0), Onboard("secant", sensor_std=NOISE)
    vehicle.start(TARGET)
    with pytest.raises(ValueError, match=r"inclination \[deg\] must be a finite number .*, got None"):
        vehicle.step(3.5, None, 15000.0, 0.0)
    before = vehicle.step(*HERE, 0.0)
    with pytest.raises(ValueError, match="report a longer way in parts"):
        vehicle.step(*after, 0.0, 700.0)
    for _ in range(13):
        command = vehicle.step(None, None, None, 0.0, 50.0)
        assert command.stop is None
    assert command.error_km > before.error_km
    assert vehicle.step(*after, 0.0, 50.0).stop is None
    with pytest.raises(ValueError, match="over 50 km"):
        vehicle.step(*HERE, 0.0, 50.0)


def test_the_same_message_twice_is_no_second_move() -> None:
    """By its time; a message without a time is always new."""
    vehicle, once = Onboard("secant", sensor_std=NOISE), Onboard("secant", sensor_std=NOISE)
    messages = [(*HERE, 290.0, 0.0, 5.0), (3.49, 73.001, 14999.0, 290.0, 0.5, 6.5), (None, None, None, 290.0, 0.5, 9.0)]
    for each in (vehicle, once):
        each.start(TARGET)
    for message in messages:
        command = once.step(*message)
        assert [vehicle.step(*message) for _ in range(3)] == [command] * 3
    for late in (messages[1], (*HERE, 290.0, 0.5, 9.0)):
        with pytest.raises(ValueError, match=r"time must be later than 9.0, that of the last step, got"):
            vehicle.step(*late)
    assert vehicle.step(*HERE, 290.0, 0.5) == once.step(*HERE, 290.0, 0.5)
    assert vehicle.step(*HERE, 290.0, 0.5) != once.step(*HERE, 290.0, 0.0)


def test_the_altitude_of_the_target_moves_the_estimate() -> None:
    """B_H at Reykjavik is 53 nT less at 10 km of altitude, as 14 km away at sea level: the numbers of the page."""
    places = torch.tensor([[64.1, -21.9], [64.2, -21.9], [64.1, -21.7]]).double()
    here, north, east = elements_at(IGRF("2026-06-30"), places)
    change = elements_at(IGRF("2026-06-30", altitude_km=10.0), places[0]) - here
    kilometers = torch.tensor([0.1, 0.2 * math.cos(math.radians(64.1))]) * 111.2
    slopes = torch.stack((north - here, east - here), -1) / kilometers
    noise = torch.tensor(NOISE)
    assert change[2].item() == pytest.approx(-53, abs=1)
    assert displacement_to(change / noise, slopes / noise[:, None]).norm().item() == pytest.approx(14, abs=0.5)


# State


@pytest.mark.parametrize("navigator", ["anywhere", "kalman"])
def test_a_restored_vehicle_goes_on_bit_for_bit(navigator: str, tmp_path: Path) -> None:
    """From each step on, also after a missed reading and a repeated message, whatever kind of number was given."""
    first, path = Onboard(navigator, sensor_std=np.float32(NOISE), max_steps=np.int64(50)), tmp_path / "state"
    target, known, _ = episode(Secant(), environment(), limit=6)
    first.start(torch.tensor(target))
    kinds = (np.float64, np.float32, torch.tensor, np.array, float)
    for number, step in enumerate((*known[:4], (None, None, None, *known[4][3:]), *known[5:])):
        if number in (0, 1, 5):
            first.save(path)
            second = Onboard(navigator, sensor_std=np.float32(NOISE), max_steps=50)
            second.restore(path)
        values = [None if value is None else kinds[number % 5](value) for value in step]
        command = first.step(*values, time=np.int32(number))
        assert command == second.step(*(value and float(value) for value in values), time=number)
        assert first.step(*values, time=number) == command
    first.save(path)
    second.save(tmp_path / "again")
    assert path.read_bytes() == (tmp_path / "again").read_bytes()


def test_a_state_of_another_vehicle_is_refused(tmp_path: Path) -> None:
    path, vehicle = tmp_path / "state", Onboard("secant", sensor_std=NOISE)
    with pytest.raises(RuntimeError, match=r"call start\(target\) first"):
        vehicle.save(path)
    vehicle.start(TARGET)
    vehicle.save(path)
    with pytest.raises(ValueError, match=r"another sensor_std, SensorStd\(noise=\(0\.02, 0\.02, 2\.0\)"):
        Onboard("secant").restore(path)
    with pytest.raises(ValueError, match="another navigator, 'Secant'"):
        Onboard("kalman", sensor_std=NOISE).restore(path)
    region = Onboard(region_policy())
    region.start((9.0, -25.0, 34500.0))
    region.save(tmp_path / "region")
    with pytest.raises(ValueError, match="another weights"):
        Onboard(FieldPolicy(region_policy().config)).restore(tmp_path / "region")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match="it is damaged"):
        vehicle.restore(path)


def changed(content: Any) -> Iterator[Any]:
    """The content of a state with one part replaced by what no vehicle writes, or left out, or with another part."""
    yield from ("x", math.nan, True, [[]], {})
    if isinstance(content, dict):
        yield content | {"forward": 5.0}
        yield from ({key: value for key, value in content.items() if key != name} for name in content)
    for key in content if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ():
        for part in changed(content[key]):
            copied = copy.copy(content)
            copied[key] = part
            yield copied


def test_a_changed_state_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    """With a right checksum, whichever part is changed."""
    path, vehicle, other = tmp_path / "state", *(Onboard(Secant(), sensor_std=NOISE) for _ in range(2))
    for each in (vehicle, other):
        each.start(TARGET, here=HERE, here_std=NOISE)
        each.step(*HERE, 290.0, time=1.0)
        each.step(3.49, 73.001, 14999.0, 290.0, 0.5)
    vehicle.save(path)
    state = json.loads(path.read_bytes().splitlines()[0])
    jump = copy.deepcopy(state)
    jump["steps"][1]["inclination"] = -73.0
    states = [*changed(state), jump, "[" * 100_000, 1]
    for content in states:
        body = (content if isinstance(content, str) else json.dumps(content, separators=(",", ":"))).encode()
        path.write_bytes(body + b"\n" + hashlib.sha256(body).hexdigest().encode())
        with pytest.raises(ValueError, match=r"state|date|inclination changed"):
            vehicle.restore(path)
    assert len(states) > 200
    after = (3.49, 73.002, 14998.0, 290.0, 0.5)
    assert vehicle.step(*after) == other.step(*after)


def test_a_refused_call_changes_nothing() -> None:
    first, second = Onboard("secant"), Onboard("secant")
    for vehicle in (first, second):
        vehicle.start(TARGET)
        vehicle.step(*HERE, 290.0)
    with pytest.raises(ValueError, match="inclination changed"):
        first.step(3.5, -73.0, 15000.0, 290.0, 0.5)
    after = (3.49, 73.001, 14999.0, 290.0, 0.5)
    assert first.step(*after) == second.step(*after)


# Refusals


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((math.nan, 73.0, 15000.0, 0.0), "declination must be a finite number, got nan"),
        ((3.5, "73", 15000.0, 0.0), "inclination must be a valid number, got '73'"),
        ((3.5, 73.0, np.bool_(True), 0.0), "horizontal_intensity must be a valid number, got True"),
        ((3.5, 73.0, torch.tensor([15000.0]), 0.0), r"horizontal_intensity must be a valid number, got \[15000.0\]"),
        ((3.5, 73.0, 15000.0, None), "heading must be a valid number, got None"),
        ((3.5, 73.0, 15000.0, 361), "heading must be less than or equal to 360, got 361"),
        ((3.5, 73.0, 15000.0, 0.0, 1.0), "distance must be 0"),
        ((3.5, 73.0, 15.0, 0.0), "looks like microtesla, and nanotesla are expected"),
        ((3.5, 73.0, 0.15, 0.0), "looks like gauss"),
        ((350.5, 73.0, 15000.0, 0.0), r"declination \[deg\] must be from -180 up to 180, got 350.5: give -9.5"),
        ((0.061, 1.274, 15000.0, 0.0), "the inclination looks like radians, and degrees are expected"),
        ((3.3, -7.7, 44600.0, 0.0), "44600 at an inclination of -7.7 deg is not possible on the Earth"),
        ((3.3, -7.7, 40000.0, 0.0), "at least 3676 km from the target, and the longest way is 2500 km: check"),
        ((3.5, 88.5, 1500.0, 0.0), "B_H 1500 nT is out of the range of the policy, 2000 to inf nT"),
    ],
)
def test_first_readings_that_are_refused(values: tuple, message: str) -> None:
    vehicle = Onboard("anywhere")
    vehicle.start(TARGET)
    with pytest.raises(ValueError, match=message):
        vehicle.step(*values)
    vehicle.step(*HERE, 0.0)  # a right one is taken


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((*HERE, 290.0, 30000.0), "distance 30000 km is longer than the longest move of this vehicle, 50 km"),
        ((*HERE, 290.0, -1.0), "distance must be greater than or equal to 0, got -1"),
        ((3.5, 73.0, 21000.0, 290.0, 40.0), r"B_H changed from 15000 to 21000 nT over 40 km.*at most 4400 nT"),
        ((40.0, 73.0, 15000.0, 290.0, 20.0), "declination changed from 3.5 to 40 deg over 20 km"),
    ],
)
def test_later_readings_that_are_refused(values: tuple, message: str) -> None:
    vehicle = Onboard("secant")  # its first move is straight on
    vehicle.start(TARGET)
    vehicle.step(*HERE, 290.0)
    with pytest.raises(ValueError, match=message):
        vehicle.step(*values)


@pytest.mark.parametrize("unit", [1.0, math.pi / 180], ids=["degrees", "radians"])
def test_headings_in_radians_are_noticed_by_two_moves_and_not_by_one(unit: float) -> None:
    """One may be that of a vehicle which did not follow the command, as one that goes on northward."""
    for steer in range(0, 360, 20):
        vehicle = Onboard("secant", sensor_std=NOISE)  # its first move is straight on
        vehicle.start(TARGET)
        vehicle.step(*HERE, steer)
        assert vehicle.step(*HERE, unit * steer, 1.0).stop is None
    vehicle.start(TARGET)
    stops, place = [vehicle.step(*HERE, 90.0)], torch.zeros(2)
    while stops[-1].stop is None and len(stops) < 6:
        distance, heading = stops[-1].distance_km, math.radians(stops[-1].heading_deg)
        place = place + distance * torch.tensor([math.cos(heading), math.sin(heading)])
        reading = torch.tensor(HERE) + torch.tensor([[-0.002, 0.012], [0.008, -0.001], [-6.0, 0.5]]) @ place
        stops.append(vehicle.step(*reading.tolist(), unit * stops[-1].heading_deg, distance))
    lost = ("lost", True) if unit < 1 else (None, False)
    assert (stops[-1].stop, "radians: degrees are expected" in stops[-1].reason) == lost, stops


def test_step_before_start_and_bad_targets() -> None:
    vehicle = Onboard("anywhere")
    with pytest.raises(RuntimeError, match=r"call start\(target\) first"):
        vehicle.step(*HERE, 0.0)
    for target, message in (
        ((-11.6, 75.4, 13.24), r"the target: .*microtesla"),
        ((-0.2, 1.316, 13240.0), r"the target: .*radians"),
        ((-11.6, 75.4), r"target.2 is missing"),
        ((-11.6, 88.5, 1500.0), "the target: B_H 1500 nT is out of the range"),
    ):
        with pytest.raises(ValueError, match=message):
            vehicle.start(target)
    region = Onboard(region_policy())
    with pytest.raises(ValueError, match=r"the target: D -11\.6 deg is out of the range of the policy"):
        region.start(TARGET)
    region.start((9.0, -25.0, 34500.0))
    with pytest.raises(ValueError, match=r"the reading at the start: D 3\.5 deg is out of the range"):
        region.step(*HERE, 0.0)


def test_readings_all_over_the_earth_are_taken() -> None:
    """Of IGRF, 1900 and 2030; moves of 50 km eastward and northward up to 85 degrees of latitude."""
    for date in ("1900-01-01", "2030-01-01"):
        latitude = torch.arange(-85.0, 85.1, 5.0, dtype=torch.float64)
        place = torch.cartesian_prod(latitude, torch.arange(-180.0, 180.0, 15.0, dtype=torch.float64))
        north = place + torch.tensor([0.45, 0.0])
        east = torch.stack((place[:, 0], place[:, 1] + 0.45 / torch.cos(torch.deg2rad(place[:, 0]))), -1)
        here, *there = (elements_at(IGRF(date), places).tolist() for places in (place, north, east))
        for before, *after in zip(here, *there, strict=True):
            check_earth_reading(*before)
            for reading in after:
                check_earth_jump(before, reading, 50.0)


@pytest.mark.parametrize("navigator", ["anywhere", "secant"])
def test_a_log_in_radians_at_middle_latitudes_is_never_an_arrival(navigator: str) -> None:
    """A reading of 0.66 is possible at the magnetic equator; that it hardly changes along the way is not."""
    field, vehicle, place, heading = IGRF("2025-01-01"), Onboard(navigator), [26.0, 30.0], 0.0

    def reading(place: list[float]) -> list[float]:
        d, i, h = elements_at(field, torch.tensor(place, dtype=torch.float64)).tolist()
        return [math.radians(d), math.radians(i), h]

    vehicle.start(reading([28.5, 32.0]))
    command = vehicle.step(*reading(place), heading)
    for _ in range(13):
        distance, heading = command.distance_km or 20.0, math.radians(command.heading_deg)
        place[0] += distance / 111.2 * math.cos(heading)
        place[1] += distance / 111.2 * math.sin(heading) / math.cos(math.radians(place[0]))
        command = vehicle.step(*reading(place), command.heading_deg, distance)
        if command.stop:
            break
    assert command.stop == "lost"
    assert "looks like radians" in command.reason


def test_the_magnetic_equator_is_no_log_in_radians() -> None:
    field, vehicle = IGRF("2025-01-01"), Onboard("secant")
    latitudes = torch.arange(8.0, 11.0, 0.1, dtype=torch.float64)
    dips = elements_at(field, torch.stack((latitudes, torch.full_like(latitudes, 33.0)), -1))[:, 1]
    equator = latitudes[dips.abs().argmin()].item()
    vehicle.start(elements_at(field, torch.tensor([8.0, 40.0]).double()).tolist())
    for number, longitude in enumerate(torch.arange(31.5, 34.5, 0.3)):
        here = elements_at(field, torch.tensor([equator, longitude]).double()).tolist()
        assert abs(here[1]) < 1.57
        assert vehicle.step(*here, 90.0, 32.9 if number else 0.0).stop is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"navigator": "dowsing"}, "unknown navigator 'dowsing': choose from anywhere"),
        ({"navigator": Geodesic()}, "Geodesic reads position, target_position, which a vehicle does not know"),
        ({"max_move_km": 20.0}, "max_move_km must be at least 50, which the policy commands, got 20.0"),
        ({"max_turn_deg": 45.0}, "max_turn_deg must be at least 90"),
        ({"sensor_std": (0.1, -0.1, 1.0)}, "sensor_std.noise must be a finite number from 0 on, got -0.1"),
        (
            {"sensor_std": (0.02, 0.02, 0.002)},
            r"sensor_std.noise: 0.002 nT .*: it looks like microtesla",
        ),
        ({"sensor_std": SensorStd(bias=(0.1, 0.1, 0.02))}, "sensor_std.bias: 0.02 nT .* give 0 for a perfect sensor"),
        ({"sensor_std": (1e5, 0.1, 1.0)}, "sensor_std.noise must be at most 10000, that of an outage, got 100000"),
        ({"max_move_km": True}, "max_move_km must be a valid number, got True"),
        ({"arrival_km": -1.0}, "arrival_km must be"),
        ({"confidence": 1.5}, "confidence must be"),
        ({"max_steps": 0}, "max_steps must be"),
    ],
)
def test_options_that_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Onboard(**options)


# Stops


def test_the_last_step_stops_and_says_how_near() -> None:
    vehicle = Onboard("secant", max_steps=3)
    vehicle.start(TARGET)
    stops = [vehicle.step(*HERE, 290.0, distance) for distance in (0.0, 0.5, 0.5)]
    assert [command.stop for command in stops] == [None, None, "nearest"]
    assert (
        stops[-1].reason == f"out of steps: within {stops[-1].radius_km:.0f} km with an estimated probability of 0.80"
    )
    assert (stops[-1].distance_km, stops[-1].turn_deg) == (0.0, 0.0)


def test_readings_that_scatter_more_than_is_stated_are_no_track() -> None:
    """Noise of 0.5 degrees and 50 nT of sensors that are stated as perfect, and with this noise."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(30, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.5, 0.5, 50.0])
    stops = []
    for sensor_std in (PERFECT, SensorStd((0.5, 0.5, 50.0))):
        vehicle = Onboard("secant", sensor_std=sensor_std)
        vehicle.start(TARGET)
        readings = (torch.tensor(HERE) + noise).tolist()
        stops.append({vehicle.step(*r, 290.0, 1.0 if k else 0.0).stop for k, r in enumerate(readings)})
    assert stops == [{None, "lost"}, {None}]
    assert sum(vehicle._surprises) / len(vehicle._surprises) < 2
    before = vehicle._surprises
    vehicle.step(None, None, None, 290.0, 1.0)
    assert vehicle._surprises == before


@pytest.mark.parametrize(
    ("sign", "zero", "lost"),
    [(1.0, 0.0, False), (-1.0, 0.0, True), (-1.0, 90.0, True)],
    ids=["right", "-I", "vertical"],
)
def test_readings_of_no_field_are_noticed(sign: float, zero: float, lost: bool) -> None:
    """Inclinations with another sign, or from the vertical, have a curl and a divergence after two moves."""
    vehicle, field = Onboard("kalman", sensor_std=NOISE), IGRF("2026-06-30")
    latitude, longitude, heading = (torch.tensor([x], dtype=torch.float64) for x in (30.0, 30.0, 1.0))
    stops = []
    for step in range(6):
        d, i, b_h = elements_at(field, torch.stack((latitude, longitude), -1))[0].tolist()
        if not step:
            vehicle.start((d + 2.0, sign * i + zero + 2.0, b_h - 800.0))
        reading, course = (d, sign * i + zero, b_h), math.degrees(heading.item())
        stops.append(vehicle.step(*reading, course, 50.0 if step else 0.0).stop)
        heading = heading + 0.6
        latitude, longitude = move(latitude, longitude, heading, torch.full_like(heading, 50.0))
    assert ("lost" in stops[2:4]) == lost
    assert "lost" in stops or not lost


def test_out_of_range_on_the_way() -> None:
    weak = Onboard("anywhere")
    weak.start((0.0, 88.0, 2100.0))
    weak.step(0.0, 87.9, 2100.0, 0.0)
    command = weak.step(0.0, 88.1, 1990.0, 0.0, 20.0)
    assert (command.stop, command.distance_km) == ("out of range", 0.0)
    assert "B_H 1990 nT is out of the range of the policy" in command.reason
    region = Onboard(region_policy())
    region.start((9.0, -25.0, 34500.0))
    region.step(9.0, -36.5, 35000.0, 180.0)
    command = region.step(9.0, -37.4, 34900.0, 180.0, 50.0)
    assert (command.stop, command.distance_km) == ("out of range", 0.0)


@pytest.mark.parametrize(
    ("held", "moves", "reason"),
    [
        ((0, 1, 2), 4, "no change of D, I, B_H over 100 km: a sensor is stuck"),
        ((1,), 14, "no change of I over 400 km: a sensor is stuck"),
        ((), None, ""),
    ],
)
def test_a_stuck_sensor(held: tuple[int, ...], moves: int | None, reason: str) -> None:
    """Moves of 30 km on a straight track where readings change."""
    vehicle = Onboard("secant", max_move_km=50.0, sensor_std=(0.5, 0.5, 50.0))
    vehicle.start(TARGET)
    for step in range(15):
        reading = [value + 1e-3 * step * (index not in held) for index, value in enumerate(HERE)]
        command = vehicle.step(*reading, 290.0, 30.0 if step else 0.0)
        assert (command.reason if step == moves else command.stop) == (reason if step == moves else None)
        if step == moves:
            assert command.stop == "lost"
            break


@pytest.mark.parametrize("useless", [0, 1, 2])
@pytest.mark.parametrize("std", [(5.0, 20.0, 5000.0), (1e4, 1e4, 1e4)])
def test_an_element_that_is_stated_as_useless_never_ends_a_way(useless: int, std: Known) -> None:
    """Its sensor always shows the same, even an inclination that looks like radians."""
    here = [3.5, 1.3, 30000.0] if useless == 1 else list(HERE)
    vehicle = Onboard("secant", sensor_std=[std[i] if i == useless else NOISE[i] for i in range(3)])
    vehicle.start([-1.0, 4.0, 30500.0] if useless == 1 else TARGET)
    for step in range(20):
        reading = [value + (0.01, 0.02, 2.0)[i] * step * (i != useless) for i, value in enumerate(here)]
        command = vehicle.step(*reading, 0.0, 30.0 if step else 0.0)
        assert command.stop != "lost"
        assert math.isfinite(command.turn_deg + command.error_km)


# Confidence


@pytest.mark.parametrize("known", [{}, {"near": (73.0, 0.0)}, {"here": (3.5, 73.0, 15000.0)}], ids=str)
def test_the_first_command_says_what_was_not_checked(known: dict[str, Any]) -> None:
    vehicle = Onboard("secant", sensor_std=NOISE)
    date = {"date": "2026-06-30"} if "near" in known else {}
    here = elements_at(IGRF("2026-06-30"), torch.tensor([[73.0, 0.0]]))[0].tolist() if date else (3.5, 73.0, 15000.0)
    vehicle.start((here[0] - 4.0, *here[1:]), **known, **date)
    reasons = [vehicle.step(*here, 290.0, distance).reason for distance in (0.0, 6.0)]
    assert reasons == [
        ("" if known else "the sign of D and the compass were not checked: give here or near in start"),
        "",
    ]


def test_a_vehicle_without_true_north_takes_no_declination() -> None:
    vehicle = Onboard("kalman", north="magnetic", sensor_std=NOISE)
    vehicle.start((None, 74.0, 14000.0))
    with pytest.raises(ValueError, match=r"declination 3\.5: headings are from magnetic north, .* None"):
        vehicle.step(3.5, 73.0, 15000.0, 290.0)
    command = vehicle.step(None, 73.0, 15000.0, 290.0)
    assert command.reason.startswith("the compass was not checked")
    assert 0 < command.axes[1] < command.axes[0]


@pytest.mark.parametrize(("arrival_km", "stop"), [(25.0, None), (400.0, "arrived")])
def test_the_rule_of_arrival(arrival_km: float, stop: str | None) -> None:
    """At about 150 km from the destination, as flown before."""
    target, known, _ = episode(Secant(), environment())
    vehicle = Onboard("secant", arrival_km=arrival_km)
    vehicle.start(target)
    command = [vehicle.step(*step) for step in known[:-3]][-1]
    assert 100 < math.hypot(*command.way_km) < 200
    assert command.stop == stop


# The exported step


@pytest.mark.slow
def test_the_exported_step_is_the_vehicle_without_torchrl(tmp_path: Path) -> None:
    """But for rounding over an episode, in a process that can import neither TorchRL nor tensordict nor magrl.

    It is given the noise that the vehicle has corrected.
    """
    policy = load_pretrained("anywhere")
    write_step(tmp_path / "step.pt2", policy)
    vehicle = Onboard(policy, sensor_std=NOISE, confidence=1.0)
    target, known, _ = episode(Secant(), environment(), limit=9)
    vehicle.start(target)
    actions, noise = [], []
    for step in known:
        command = vehicle.step(*step)
        actions.append((command.distance_km, math.radians(command.turn_deg)))
        noise.append(vehicle._estimator.state["sensor_std"][0])
    content = {"known": known, "target": target, "actions": actions, "noise": noise}
    content |= {"first": list(first_state()), "mean": vehicle._estimator.belief.mean[0]}
    torch.save(content, tmp_path / "episode.pt")
    code = """
import math, sys, torch
for name in ("torchrl", "tensordict", "magrl"):
    sys.modules[name] = None
module, episode = torch.export.load(sys.argv[1]).module(), torch.load(sys.argv[2])
target, none, state = torch.tensor(episode["target"]), torch.zeros(3), episode["first"]
for (*reading, heading, distance), action, noise in zip(*(episode[key] for key in ("known", "actions", "noise"))):
    course = torch.tensor([distance, math.remainder(math.radians(heading), 2 * math.pi)])
    moved, _, _, *state = module(torch.tensor(reading), target, course, torch.stack((noise, none, none, none)), *state)
    torch.testing.assert_close(moved, torch.tensor(action), rtol=1e-5, atol=1e-5)
torch.testing.assert_close(state[1], episode["mean"], rtol=1e-6, atol=1e-3)
print(len(episode["actions"]), "equal")
"""
    command = [sys.executable, "-W", "ignore", "-c", code, str(tmp_path / "step.pt2"), str(tmp_path / "episode.pt")]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "10 equal", run.stderr


@pytest.mark.slow
def test_the_step_in_onnx(tmp_path: Path) -> None:
    """Over 120 moves at random through a linear field, each with its own state: the commands agree to a thousandth."""
    policy = load_pretrained("anywhere")
    write_step(tmp_path / "step.onnx", policy)
    session, module = InferenceSession(tmp_path / "step.onnx"), VehicleStep(policy)
    slope = torch.tensor([[-0.002, 0.012], [0.008, -0.001], [-6.0, 0.5]])  # per km northward and eastward
    target, accuracy = torch.tensor([-11.6, 75.4, 13240.0]), torch.tensor((NOISE, *[(0.0,) * 3] * 3))
    generator, place = torch.Generator().manual_seed(0), torch.zeros(2)
    state, other = first_state(), [value.numpy() for value in first_state()]
    for step in range(121):
        heading, distance = 6 * torch.rand(1, generator=generator) - 3, torch.tensor([30.0 * (step > 0)])
        place = place + distance * torch.cat((heading.cos(), heading.sin()))
        reading = torch.tensor([3.5, 73.0, 15000.0]) + slope @ place
        inputs = reading, target, torch.cat((distance, heading)), accuracy
        with torch.no_grad():
            action, _, _, *state = module(*inputs, *state)
        feed = dict(zip(ONNX_INPUTS, (*(value.numpy() for value in inputs), *other), strict=True))
        found, _, _, *other = session.run(None, feed)
        torch.testing.assert_close(torch.from_numpy(found), action, rtol=1e-3, atol=1e-4)


def test_only_a_policy_that_reads_its_own_track_is_exported() -> None:
    with pytest.raises(ValueError, match=r"must read its own track \(TrackView\)"):
        VehicleStep(region_policy())
    with pytest.raises(ValueError, match=r"must end with \.pt2 or \.onnx, got 'step\.pt'"):
        write_step("step.pt", region_policy())
