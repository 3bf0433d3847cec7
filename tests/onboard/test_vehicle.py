"""On board: the commands of the environment from plain numbers, refusals, stops, saved states."""

from __future__ import annotations

import copy
import importlib
import json
import math
import operator
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from support.networks import network_file
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, ObservationNorm, TransformedEnv
from torchrl.envs.utils import step_mdp

from magrl.envs import GeomagneticNavEnv
from magrl.errors import MagneticNorth, SensorErrors
from magrl.evaluation.episodes import restart
from magrl.field import IGRF, elements_at
from magrl.geodesy import move, move_place
from magrl.navigators import Anywhere, FieldPolicy, Navigator, PolicyConfig, export_policy, policy_env
from magrl.navigators.names import make_navigator
from magrl.onboard import Command, Onboard, check_earth_jump, check_earth_reading
from magrl.pilot import Rules
from magrl.pilot.network import load_pilot, pretrained, save_pilot
from magrl.sensor_std import SensorStd
from magrl.transforms import ReadingView

TARGET, HERE = (-11.6, 75.4, 13240.0), (3.5, 73.0, 15000.0)
SECOND = (3.49, 73.001, 14999.0, 290.0, 0.5)
NOISE, NONE = (0.02, 0.02, 2.0), (0.0, 0.0, 0.0)
SLOPE = torch.tensor([[-0.002, 0.012], [0.008, -0.001], [-6.0, 0.5]])  # of a linear field, per km
field = cache(IGRF)
Triple = tuple[float, float, float]


def nav() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=1, seed=3, start_heading="random", arrival="declared")


def navigator(name: str, env: GeomagneticNavEnv, sensor_std: SensorStd | Triple = NONE) -> Navigator:
    return make_navigator(name, env, sensor_std=sensor_std).fitted(env, {"confidence": 0.0})


def numbers(state: TensorDictBase) -> tuple[float, ...]:
    """What a vehicle reads in a state of the environment: D, I, B_H, heading [deg] and distance [km]."""
    return (*state["field"][0].tolist(), math.degrees(state["heading"].item()), state["leg"][0, 0].item())


def begun(
    name: Any = "secant", target: Any = TARGET, start: Any = None, start_std: Any = None, **options: Any
) -> Onboard:
    vehicle = Onboard(name, **options)
    vehicle.start(target, start, start_std=start_std, target_std=NONE)
    return vehicle


def at(latitude: float, longitude: float, date: str = "2026-06-30") -> list[float]:
    return elements_at(field(date), torch.tensor([latitude, longitude], dtype=torch.float64)).tolist()


def fly(env: EnvBase, policy: Navigator, vehicle: Onboard, limit: int = 99, none: int = 0) -> Iterator[tuple]:
    """Fly one vehicle in the environment and beside it the one on board, and yield commands and states."""
    restart(env)
    env = policy_env(env, policy, confidence=0.0)
    state = env.reset()
    for _ in range(limit):
        reading = numbers(state)
        missing = state.get("sensor_std", torch.zeros(1)).max().item() > 100
        command = vehicle.step(*[None] * (3 if missing else none), *reading[3 if missing else none :])
        with torch.no_grad():
            acted = env.step(policy(state.clone()))
        yield command, state, acted["next"]
        if acted["next", "done"].item():
            return
        state = step_mdp(acted)


def check(command: Command, state: TensorDictBase, after: TensorDictBase) -> None:
    """The command is the action of the environment, and the probability that of its navigator."""
    distance, turn = after["leg"][0].tolist()
    assert (command.distance_km, math.radians(command.turn_deg)) == pytest.approx((distance, turn), abs=1e-3)
    off = command.heading_deg - math.degrees(after["heading"].item())
    assert math.remainder(off, 360) == pytest.approx(0, abs=0.05)
    assert command.confidence == pytest.approx(state["arrival_probability"].item(), abs=1e-4)
    assert (command.stop == "arrived") == after["declared"].item()


# The same commands as in the environment


@pytest.mark.parametrize(
    ("name", "noise", "stated", "north", "missed"),
    [
        ("kalman", (0.05, 0.05, 5.0), 2.5, "true", 0.0),
        ("secant", NOISE, 1.0, "magnetic", 0.0),
        ("memory", NOISE, 1.0, "true", 0.5),
    ],
)
def test_commands_are_those_of_the_environment(
    name: str, noise: Triple, stated: float, north: str, missed: float
) -> None:
    """Over a whole episode where other noise is stated, with the declaration at its end; without D; and where
    readings are missed: the vehicle gets None, the policy in the environment the last reading with a large error."""
    base, magnetic, sensor_std = nav(), north == "magnetic", tuple(stated * std for std in noise)
    env = TransformedEnv(base, SensorErrors(noise, outage_rate=missed, seed=2), auto_unwrap=True)
    env = TransformedEnv(env, MagneticNorth(), auto_unwrap=True) if magnetic else env
    if stated != 1:
        env = TransformedEnv(env, ObservationNorm(0.0, stated, in_keys=["sensor_std"]), auto_unwrap=True)
    policy = navigator(name, base, SensorStd(sensor_std, (math.inf, 0.0, 0.0)) if magnetic else sensor_std)
    vehicle = Onboard(name, north=north, sensor_std=sensor_std, max_steps=50, confidence=0.0)
    restart(env)
    target = env.reset()["target_field"][0].tolist()
    vehicle.start((None, *target[1:]) if magnetic else target, target_std=NONE)
    outages = []
    for command, state, after in fly(env, policy, vehicle, 99 if name == "kalman" else 6, none=int(magnetic)):
        check(command, state, after)
        outages.append(state["sensor_std"].max().item() > 100)
    assert len(outages) > 5
    assert after["declared"].item() == (name == "kalman")
    assert (0 < sum(outages) < len(outages)) == (missed > 0)


@pytest.mark.parametrize("name", ["kalman", "secant"])
def test_a_known_start_shows_constant_errors(name: str) -> None:
    """The commands are about those of sensors without them."""
    base, errors, options = nav(), (0.4, 0.1, -30.0, 0.0, 0.0), {"max_steps": 50, "confidence": 0.0}
    here, target = (base.reset()[key][0].tolist() for key in ("field", "target_field"))
    exact = begun(name, target, **options)
    vehicle = begun(name, target, here, sensor_std=SensorStd(bias=(0.5, 0.2, 40.0)), **options)
    for wanted, state, _ in fly(base, navigator(name, base), exact, 4):
        command = vehicle.step(*map(operator.add, numbers(state), errors))
        assert command.distance_km == pytest.approx(wanted.distance_km, abs=1.0)
        assert math.remainder(command.heading_deg - wanted.heading_deg, 360) == pytest.approx(0, abs=2.5)


def test_a_start_that_is_hardly_known_shows_no_constant_error() -> None:
    """The commands are those without a start."""
    target = (torch.tensor(HERE) + SLOPE @ torch.tensor([120.0, 90.0])).tolist()
    told, untold = (
        begun("secant", target, *start, sensor_std=SensorStd(bias=(0.5, 0.2, 40.0)))
        for start in ((HERE, (50.0, 20.0, 5000.0)), ())
    )
    place = torch.zeros(2)
    for leg in ([0.0, 0.0], [30.0, 0.0], [0.0, 30.0], [20.0, 20.0]):
        place, course = place + torch.tensor(leg), math.degrees(math.atan2(leg[1], leg[0]))
        reading = torch.tensor(HERE) + torch.tensor([0.9, 0.4, -80.0]) + SLOPE @ place
        found, wanted = (vehicle.step(*reading.tolist(), course, math.hypot(*leg)) for vehicle in (told, untold))
        assert (found.stop, found.distance_km) == (None, pytest.approx(wanted.distance_km, abs=0.1))
        assert math.remainder(found.heading_deg - wanted.heading_deg, 360) == pytest.approx(0, abs=0.1)


def region_policy() -> FieldPolicy:
    torch.manual_seed(0)
    return FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=3).observation_view(), (8,)))


@pytest.mark.parametrize("kind", ["region", "ONNX"])
def test_commands_of_own_policies(kind: str, tmp_path: Path) -> None:
    """Of the turn and the field of a region, or, of another library, of heading and time; their own limits count."""
    base, view = nav(), ReadingView(keys=["heading", "elapsed_steps"], max_leg_km=50.0, max_turn_rad=math.pi / 2)
    policy = region_policy() if kind == "region" else export_policy(network_file(tmp_path, view.size), view)
    vehicle = begun(policy, base.reset()["target_field"][0].tolist(), max_leg_km=200.0)
    assert vehicle.options.max_leg_km == pytest.approx(50.0)
    for command, state, after in fly(base, policy, vehicle, 6):  # noqa: B007 - the last one is used below
        action = policy(state.clone())["action"][0].tolist()
        assert (command.distance_km, math.radians(command.turn_deg)) == pytest.approx(action, abs=1e-5)
    again = Onboard(policy, max_leg_km=200.0)
    vehicle.save(tmp_path / "flight.json")
    again.restore(tmp_path / "flight.json")
    assert again.step(*numbers(after)) == vehicle.step(*numbers(after))


def test_a_policy_of_a_region_stays_in_its_range() -> None:
    vehicle = Onboard(region_policy())
    with pytest.raises(ValueError, match=r"the target: D -11\.6 deg is out of the range of the navigator"):
        vehicle.start(TARGET, target_std=NONE)
    vehicle.start((9.0, -25.0, 34500.0), target_std=NONE)
    with pytest.raises(ValueError, match=r"the reading at the start: D 3\.5 deg is out of the range"):
        vehicle.step(*HERE, 0.0)
    vehicle.step(9.0, -36.5, 35000.0, 180.0)
    command = vehicle.step(9.0, -37.4, 34900.0, 180.0, 50.0)
    assert (command.stop, command.distance_km) == ("out of range", 0.0)


def test_a_file_of_a_pilot_and_shorter_legs(tmp_path: Path) -> None:
    """As flown by its own network, with all rules that it was trained for but those that are given."""
    rules, network = load_pilot(pretrained("anywhere"))
    save_pilot(tmp_path / "own.safetensors", rules.replace(range_km=800.0), network)
    file = begun(str(tmp_path / "own.safetensors"), max_leg_km=20.0)
    same = begun(Anywhere(Rules(range_km=800.0, max_steps=120), source=network), max_leg_km=20.0)
    assert file.options.range_km == same.options.range_km == 800.0
    places = [(*HERE, 290.0), SECOND, (3.4, 73.1, 14980.0, 0.0, 15.0)]
    commands = [file.step(*place) for place in places]
    assert commands == [same.step(*place) for place in places]
    assert 15 < max(command.distance_km for command in commands) <= 20
    assert begun(max_leg_km=60.0, name="anywhere").options.max_leg_km == 50.0  # as trained


# What runs


def test_a_pilot_runs_without_torchrl_in_few_calls() -> None:
    """Imported anew, where TorchRL and TensorDict cannot be."""
    made: list[tuple[str, str]] = []

    def profile(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event == "call" and "/magrl/" in code.co_filename and "<" not in code.co_name:
            made.append((code.co_filename, code.co_qualname))

    with patch.dict(sys.modules):
        for name in [name for name in sys.modules if name.partition(".")[0] == "magrl"]:
            del sys.modules[name]
        sys.modules |= {name: None for name in list(sys.modules) if name.partition(".")[0] in ("torchrl", "tensordict")}
        vehicle = importlib.import_module("magrl.onboard").Onboard("anywhere", sensor_std=NOISE)
        vehicle.start(TARGET, target_std=NONE)
        vehicle.step(*HERE, 290.0)
        vehicle.step(3.4, 73.0, 14995.0, 290.0, 20.0)
        sys.setprofile(profile)
        vehicle.step(3.3, 73.1, 14985.0, 290.0, 20.0)
        sys.setprofile(None)
    assert 99 < len(set(made)) <= 152
    assert len(made) <= 715


# A known start


@pytest.mark.parametrize(
    ("reading", "cause"),
    [
        ((65.0, 8.0, 30000.0), "D and I are swapped"),
        ((82.0, 65.0, 30000.0), "the horizontal axes are swapped"),
        ((8.0, 60.0, 30000.0), "check sensors, calibration"),
        ((0.3, 65.2, 30050.0), "the heading is from magnetic north"),  # iron of 4200 nT explains all, as it always does
    ],
)
def test_a_first_reading_that_does_not_fit_the_start_is_refused(reading: Triple, cause: str) -> None:
    """Where a mistake explains it, that is named; the right reading is then taken."""
    here = (8.0, 65.0, 30000.0)
    vehicle = begun("kalman", (5.0, 67.0, 28000.0), here, sensor_std=SensorStd(NOISE, (0.1, 0.1, 10.0)))
    with pytest.raises(ValueError, match=rf"^the first reading, .* does not fit the start, .*: .*{cause}"):
        vehicle.step(*reading, heading=0.0)
    assert vehicle.step(*here, heading=0.0).stop is None


def test_a_position_at_the_start_gives_the_elements_of_the_model() -> None:
    """With the accuracy of the model, by which iron is noticed; and with a larger one, of a coarse place."""
    vehicle, here = Onboard("secant", sensor_std=SensorStd(bias=(0.5, 0.0, 0.0))), at(60.4, 5.3)
    known: Any = {"date": "2026-06-30", "target_std": NONE}
    vehicle.start(TARGET, (60.4, 5.3), **known)
    with pytest.raises(ValueError, match=r"D deviates by 4\.3.*: check sensors, calibration"):
        vehicle.step(here[0] - 4.3, here[1] + 0.6, here[2] - 500, heading=0.0)  # iron, or nearly -D
    vehicle.start(TARGET, (60.4, 5.3), start_std=(2.0, 0.7, 600.0), **known)
    with pytest.raises(ValueError, match=r"\(I deviates by 80.75, where 3\.6. is likely\): check sensors, calibration"):
        vehicle.step(-8.0, -7.7, 35603.0, heading=0.0)
    vehicle.start(TARGET, (60.4, 5.3), start_km=100.0, **known)
    assert vehicle.step(*at(58.5, 5.3), heading=0.0).reason == ""
    assert begun().step(*HERE, 290.0).reason == "the sign of D and the compass were not checked: give the start"


# Legs and messages


def test_a_displacement_that_is_longer_than_a_leg_is_reported_in_parts() -> None:
    """The path of all parts explains the change of I and B_H; that D is the same at both ends is no stuck sensor."""
    after, vehicle = (3.5, 79.0, 9000.0), begun(sensor_std=NOISE)
    before = vehicle.step(*HERE, 0.0)
    with pytest.raises(ValueError, match="report a longer distance in parts"):
        vehicle.step(*after, 0.0, 700.0)
    for _ in range(13):
        command = vehicle.step(None, None, None, 0.0, 50.0)
        assert command.stop is None
    assert command.error_km > before.error_km
    assert vehicle.step(*after, 0.0, 50.0).stop is None
    with pytest.raises(ValueError, match="over 50 km"):
        vehicle.step(*HERE, 0.0, 50.0)


# State


@pytest.mark.parametrize("name", ["secant", "memory"])
def test_a_restored_vehicle_goes_on_bit_for_bit(name: str, tmp_path: Path) -> None:
    """From each step on, also after a missed reading, whatever kind of number was given."""
    first, path = Onboard(name, sensor_std=np.float32(NOISE), max_steps=np.int64(50)), tmp_path / "state"
    first.start(torch.tensor(TARGET), HERE, start_std=NOISE, target_std=NONE)
    kinds = (np.float64, np.float32, torch.tensor, np.array, float)
    for number, kind in enumerate(kinds):
        reading = (torch.tensor(HERE) + SLOPE @ torch.tensor([4.0, 9.0]) * number).tolist()
        values = (*([None] * 3 if number == 3 else map(kind, reading)), kind(66.0), kind(10.0 * (number > 0)))
        if number in (0, 1, 4):
            first.save(path)
            second = Onboard(name, sensor_std=np.float32(NOISE), max_steps=50)
            second.restore(path)
        assert first.step(*values) == second.step(*(value and float(value) for value in values))
    first.save(path)
    second.save(tmp_path / "again")
    assert path.read_bytes() == (tmp_path / "again").read_bytes()


@pytest.mark.parametrize("name", ["secant", "memory"])
def test_a_second_flight_is_that_of_a_new_vehicle(name: str) -> None:
    """Bit for bit, after one that found errors of its sensors at a known start."""
    used, new = (Onboard(name, sensor_std=SensorStd(bias=(0.5, 0.2, 40.0))) for _ in range(2))
    used.start(TARGET, HERE, target_std=NONE)
    used.step(3.9, 73.2, 15030.0, 290.0)
    for vehicle in (used, new):
        vehicle.start(TARGET, target_std=NONE)
    for number in range(5):
        reading = (torch.tensor(HERE) + SLOPE @ torch.tensor([4.0, 9.0]) * number).tolist()
        commands = [vehicle.step(*reading, 66.0, 10.0 * (number > 0)) for vehicle in (used, new)]
        assert commands[0] == commands[1]


def test_a_state_of_another_vehicle_is_refused(tmp_path: Path) -> None:
    path, vehicle = tmp_path / "state", Onboard("secant", sensor_std=NOISE)
    for call in (lambda: vehicle.save(path), lambda: vehicle.step(*HERE, 0.0)):
        with pytest.raises(RuntimeError, match=r"call start\(target\) first"):
            call()
    vehicle.start(TARGET, target_std=NONE)
    vehicle.save(path)
    others = {"sensor_std": Onboard("secant"), "navigator": Onboard("kalman", sensor_std=NOISE)}
    others["max_leg_km"] = Onboard("secant", sensor_std=NOISE, max_leg_km=20.0)
    for name, other in others.items():
        with pytest.raises(ValueError, match=f"another {name}, "):
            other.restore(path)
    begun(region_policy(), (9.0, -25.0, 34500.0)).save(path)
    with pytest.raises(ValueError, match="another weights"):
        Onboard(FieldPolicy(region_policy().config)).restore(path)


def changed(content: Any) -> Iterator[Any]:
    """The content of a state with one part replaced by what no vehicle writes, or with another part."""
    yield from ("x", math.nan, True, [[]], {})
    if isinstance(content, dict):
        yield content | {"forward": 5.0}
    for key in content if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ():
        for part in changed(content[key]):
            copied = copy.copy(content)
            copied[key] = part
            yield copied


def test_a_changed_state_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    """Whichever part is changed, but the record of commands; and cut."""
    path, vehicle, other = tmp_path / "state", *(begun(start=HERE, start_std=NOISE, sensor_std=NOISE) for _ in range(2))
    for each in (vehicle, other):
        each.step(*HERE, 290.0)
        each.step(*SECOND)
    vehicle.save(path)
    whole = path.read_text(encoding="utf-8")
    jump = json.loads(whole)
    jump["steps"][1]["inclination"] = -73.0
    states = [*map(json.dumps, (*changed(json.loads(whole) | {"commands": []}), jump)), whole[:-1]]
    for content in states:
        path.write_text(content, encoding="utf-8")
        with pytest.raises(ValueError, match=r"state|date|another|inclination changed"):
            vehicle.restore(path)
    assert len(states) > 200
    assert vehicle.step(*HERE, 290.0, 0.5) == other.step(*HERE, 290.0, 0.5)


# Readings of the Earth


def test_readings_all_over_the_earth_are_taken() -> None:
    """Of IGRF, 1900 and 2030; legs of 50 km eastward and northward up to 85 degrees of latitude."""
    for date in ("1900-01-01", "2030-01-01"):
        latitude = torch.arange(-85.0, 85.1, 5.0, dtype=torch.float64)
        place = torch.cartesian_prod(latitude, torch.arange(-180.0, 180.0, 30.0, dtype=torch.float64))
        north = place + torch.tensor([0.45, 0.0])
        east = torch.stack((place[:, 0], place[:, 1] + 0.45 / torch.cos(torch.deg2rad(place[:, 0]))), -1)
        here, *there = (elements_at(IGRF(date), places).tolist() for places in (place, north, east))
        for before, *after in zip(here, *there, strict=True):
            check_earth_reading(*before)
            for reading in after:
                check_earth_jump(before, reading, 50.0)


# Stops


def test_a_log_in_radians_at_middle_latitudes_is_never_an_arrival() -> None:
    """A reading of 0.66 is possible at the magnetic equator; that it hardly changes along the path is not."""
    place, command, distance = torch.tensor([26.0, 30.0]).double(), None, 0.0

    def reading(latitude: float, longitude: float) -> list[float]:
        d, i, h = at(latitude, longitude)
        return [math.radians(d), math.radians(i), h]

    vehicle = begun("secant", reading(28.5, 32.0))
    for _ in range(14):
        heading = command.heading_deg if command else 0.0
        place = move_place(place, torch.tensor(heading).deg2rad().double(), torch.tensor(distance).double())
        command = vehicle.step(*reading(*place.tolist()), heading, distance)
        distance = command.distance_km or 20.0
        if command.stop:
            break
    assert command.stop == "lost"
    assert "looks like radians" in command.reason


def test_the_magnetic_equator_is_no_log_in_radians() -> None:
    latitudes = torch.arange(8.0, 11.0, 0.1, dtype=torch.float64)
    dips = elements_at(IGRF("2026-06-30"), torch.stack((latitudes, torch.full_like(latitudes, 33.0)), -1))[:, 1]
    equator, vehicle = latitudes[dips.abs().argmin()].item(), begun(target=at(8.0, 40.0))
    for number, longitude in enumerate(np.arange(31.5, 33.3, 0.3)):
        here = at(equator, longitude)
        assert abs(here[1]) < 1.57
        assert vehicle.step(*here, 90.0, 32.9 if number else 0.0).stop is None


def test_the_last_step_stops_and_says_how_near() -> None:
    """In each of its trips."""
    vehicle = begun(max_steps=3)
    for _ in range(2):
        stops = [vehicle.step(*HERE, 290.0, distance) for distance in (0.0, 0.5, 0.5)]
        assert [command.stop for command in stops] == [None, None, "nearest"]
        vehicle.retarget(TARGET, target_std=NONE)
    near = f"within {stops[-1].error_radius_km:.0f} km with an estimated probability of 0.80"
    assert stops[-1].reason == f"out of steps: {near}"
    assert (stops[-1].distance_km, stops[-1].turn_deg) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("sign", "zero", "lost"),
    [(1.0, 0.0, False), (-1.0, 0.0, True), (-1.0, 90.0, True)],
    ids=["right", "-I", "vertical"],
)
def test_readings_of_no_field_are_noticed(sign: float, zero: float, lost: bool) -> None:
    """Inclinations with another sign, or from the vertical, have a curl and a divergence after two legs."""
    latitude, longitude, heading = (torch.tensor(x, dtype=torch.float64) for x in (30.0, 30.0, 1.0))
    stops = []
    for step in range(4):
        d, i, b_h = at(latitude.item(), longitude.item())
        if not step:
            vehicle = begun("kalman", (d + 2.0, sign * i + zero + 2.0, b_h - 800.0), sensor_std=NOISE)
        course = math.degrees(heading.item())
        stops.append(vehicle.step(d, sign * i + zero, b_h, course, 50.0 if step else 0.0).stop)
        heading = heading + 0.6
        latitude, longitude = move(latitude, longitude, heading, torch.full_like(heading, 50.0))
    assert ("lost" in stops[2:]) == lost


@pytest.mark.parametrize(
    ("held", "std", "legs", "reason"),
    [
        ((0, 1, 2), (0.5, 0.5, 50.0), 2, "no change of D, I, B_H over 100 km: a sensor is stuck"),
        ((1,), (0.5, 0.5, 50.0), 8, "no change of I over 400 km: a sensor is stuck"),
        ((0,), (5.0, *NOISE[1:]), None, ""),
        ((1,), (NOISE[0], 1e4, NOISE[2]), None, ""),
    ],
)
def test_a_stuck_sensor(held: tuple[int, ...], std: Triple, legs: int | None, reason: str) -> None:
    """Legs of 50 km along which readings change, but those of a sensor that always shows the same; where it is stated
    as useless, it never ends a flight, even with an inclination that looks like radians."""
    radians = std[1] == 1e4
    here, target = ((3.5, 1.3, 30000.0), (-1.0, 4.0, 30500.0)) if radians else (HERE, TARGET)
    vehicle = begun(target=target, sensor_std=std)
    for step in range(9):
        reading = [x + (0.01, 0.02, 2.0)[n] * step * (n not in held) for n, x in enumerate(here)]
        command = vehicle.step(*reading, 290.0, 50.0 if step else 0.0)
        assert (command.stop == "lost") == (step == legs)
        assert math.isfinite(command.turn_deg + command.error_km)
        if step == legs:
            assert command.reason == reason
            break


@pytest.mark.parametrize("missing", [(0, 1, 2), (0,)])
def test_a_long_path_without_a_complete_reading_is_reported(missing: tuple[int, ...]) -> None:
    """It is no stop, and ends with a complete reading."""
    vehicle = begun(sensor_std=NOISE)
    vehicle.step(*HERE, 290.0)
    read = [None if index in missing else value + 0.01 for index, value in enumerate(HERE)]
    commands = [vehicle.step(*read, 290.0, leg) for leg in (50.0, 49.9, 0.1, 0.0)]
    commands.append(vehicle.step(HERE[0] + 0.1, HERE[1] + 0.1, HERE[2] - 9.0, 290.0, 0.0))
    text = "no complete reading over the last 100 km"
    assert [command.reason for command in commands] == ["", "", text, text, ""]
    assert {command.stop for command in commands} == {None}


def test_a_vehicle_without_true_north_takes_no_declination() -> None:
    vehicle = begun("kalman", (None, 74.0, 14000.0), north="magnetic", sensor_std=NOISE)
    with pytest.raises(ValueError, match=r"declination 3\.5: headings are from magnetic north, .* None"):
        vehicle.step(3.5, 73.0, 15000.0, 290.0)
    command = vehicle.step(None, 73.0, 15000.0, 290.0)
    assert command.reason.startswith("the compass was not checked")
    assert 0 < command.axes[1] < command.axes[0]
    first = begun("kalman", TARGET, HERE, sensor_std=NOISE).step(*HERE, 290.0)
    assert replace(first, reason="") == first
