"""Steering an autopilot: flights of simulated vehicles through the loop and its links, restarts, damaged messages."""

from __future__ import annotations

import errno
import math
import random
import runpy
import socket
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch

from magrl.field import IGRF, elements_at
from magrl.geodesy import geodesic, move
from magrl.vehicle.autopilot import Loop, Measurement, fly
from magrl.vehicle.autopilot import __main__ as program
from magrl.vehicle.autopilot.loop import LOG, SAID
from magrl.vehicle.autopilot.mavlink import MavlinkLink, Messages
from magrl.vehicle.autopilot.nmea import NmeaLink, Sentences
from magrl.vehicle.logs import axes_of_elements, read_log
from magrl.vehicle.onboard import Command, Onboard

pytest.importorskip("pymavlink")
from pymavlink.dialects.v20 import ardupilotmega as mavlink

FIELD = IGRF("2026-01-01")
HERE, THERE = (60.0, 5.0), (61.2, 4.0)  # 144 km apart
SPEED, STEP_S = 60.0, 10.0
OFFSET = 17.0  # of the autopilot's heading from true north, where the vehicle has a compass [deg]
EXAMPLE = Path(__file__).parent.parent.parent / "docs" / "examples" / "jsbsim_vehicle.py"


@pytest.fixture(autouse=True)
def _forget() -> None:
    """Nothing was logged before a test."""
    SAID.clear()
    LOG.handlers.clear()


def elements(place: tuple[float, float]) -> list[float]:
    return elements_at(FIELD, torch.tensor(place, dtype=torch.float64)).tolist()


class World:
    """A vehicle that turns at once and moves at a constant speed, as a link."""

    period_s = 55.0

    def __init__(self, north: str = "true", noise: float = 20.0) -> None:
        self.speed, self.place, self.time, self.heading = SPEED, HERE, 0.0, 320.0
        self.north, self.rng, self.noise = north, random.Random(0), noise
        self.said: list[Command] = []
        self.steered = 0

    @property
    def left_km(self) -> float:
        place = torch.tensor([*self.place, *THERE], dtype=torch.float64)
        return geodesic(*place)[0].item()

    def __iter__(self) -> Iterator[Measurement]:
        while self.time < 20_000:
            yield from self.messages()

    def messages(self) -> Iterator[Measurement]:
        """Move on and measure."""
        self.time += STEP_S
        length = torch.tensor(self.speed * STEP_S / 1000, dtype=torch.float64)
        here, course = torch.tensor(self.place, dtype=torch.float64), torch.tensor(math.radians(self.heading))
        self.place = tuple(value.item() for value in move(*here, course, length))
        attitude = 1.0 + 0.1 * self.rng.random(), -2.0, self.heading
        axes = axes_of_elements(torch.tensor(elements(self.place)), torch.tensor(attitude))
        shown = self.heading - OFFSET * (self.north == "magnetic")
        field = [self.rng.gauss(value, self.noise) for value in axes.tolist()]
        yield Measurement(self.time, None, None, None, *attitude[:2], shown % 360)
        yield Measurement(self.time + 0.01, *field)
        yield Measurement(self.time + 0.02, speed=self.speed)

    def steer(self, heading_deg: float) -> None:
        self.steered += 1
        self.heading = heading_deg + OFFSET * (self.north == "magnetic")

    def report(self, command: Command) -> None:
        self.said.append(command)


def loop(north: str = "true") -> Loop:
    board = Onboard("anywhere", north=north, sensor_std=(0.05 * (north == "true"), 0.05, 20.0))
    board.start([None if north == "magnetic" else elements(THERE)[0], *elements(THERE)[1:]])
    return Loop(board, read_s=60.0)


@pytest.fixture
def steps(monkeypatch) -> list[tuple[Any, ...]]:
    """D, I, B_H, heading and distance of each step that a vehicle was told, also of those that it refused."""
    made, step = [], Onboard.step
    monkeypatch.setattr(Onboard, "step", lambda self, *a, **b: made.append(a) or step(self, *a, **b))
    return made


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> tuple[World, list[Command], Path]:
    """A flight with true north."""
    world, folder = World(), tmp_path_factory.mktemp("flight")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("magrl.vehicle.autopilot.flight.clock", lambda: world.time)
        return world, list(fly(loop(), world, folder)), folder


def test_a_vehicle_arrives(flown) -> None:
    world, commands, folder = flown
    assert commands[-1].stop == world.said[-1].stop == "arrived"
    assert world.left_km < 25
    assert world.time * SPEED / 1000 < 3 * 144
    assert world.time / 60 < world.steered < world.time / 50 + len(commands)  # with each command, and now and then
    assert read_log(folder / "messages.csv").north == "true"  # the record is a log


class Silent(World):
    """A vehicle that slows down to a third after 20 minutes; from then on for half an hour, it does not send some
    quantities, or nothing (``""``), as to a suspended computer."""

    unheard = "speed"

    def messages(self) -> Iterator[Measurement]:
        slow = 1200 < self.time < 3000
        self.speed = SPEED / 3 if slow else SPEED
        for message in super().messages():
            if not slow or (self.unheard and getattr(message, self.unheard) is None):
                yield message


@pytest.mark.parametrize("unheard", ["speed", ""])
def test_the_place_is_in_its_region_where_something_is_not_heard(unheard, tmp_path, caplog) -> None:
    """But for 4.2 km, which are flown during a reading. Taking the last speed as true, it is 35 to 67 km off at 3."""
    board, world, errors = Onboard("kalman", sensor_std=(0.05, 0.05, 20.0), drift=0.01), Silent(noise=5.0), []
    world.unheard = unheard
    board.start(THERE, HERE, date="2026-01-01")
    for command in fly(Loop(board, read_s=60.0), world, tmp_path):
        distance = geodesic(*torch.tensor([*command.place, *world.place], dtype=torch.float64))[0].item()
        (north, _), (_, east) = command.place_covariance_km2
        errors.append((distance - 4.2, math.sqrt(north + east)))
    assert all(off <= 1.73 * stated for off, stated in errors)  # 95 % of a normal distribution in two equal axes
    assert max(stated for _, stated in errors) > 7 - 2.5 * (unheard == "speed")
    assert command.stop == "arrived"
    for name in [unheard] if unheard else ["speed", "heading"]:
        assert f"no {name} for" in caplog.text


def test_a_second_talker_takes_over(caplog) -> None:
    sentences, said = Sentences(), []
    for time, line in ((0, b"$HEHDT,290.0,T*24"), (10, b"$IIHDT,200.0,T*20"), (26, b"$IIHDT,201.0,T*21")):
        said += [each.heading for each in sentences.measurements(line, float(time))]
    assert said == [290.0, 201.0]
    assert "heading from IIHDT, as HEHDT is silent" in caplog.text


class Played(World):
    """Messages of a record, and a line on which nothing is sent."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__()
        self.lines = lines

    def __iter__(self) -> Iterator[Measurement]:
        for line in self.lines:
            yield Measurement(*(float(cell) if cell else None for cell in line.strip().split(",")))

    def steer(self, *_: Any) -> None:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    report = steer


def half(folder: Path) -> list[str]:
    """The first messages of a record."""
    lines = (folder / "messages.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    return lines[1 : len(lines) // 2]


def test_a_killed_flight_continues_with_the_same_commands(flown, tmp_path, caplog) -> None:
    """After a torn line, a damaged one, and one with a cell too many."""
    lines, commands = half(flown[2]), []
    cuts = sorted(random.Random(0).sample(range(len(lines) // 4, len(lines)), 3))
    damages = lines[cuts[0]][:7], "\0\0\0\n", f"{lines[cuts[2]].strip()},5.0\n", ""
    for begin, end, damage in zip([0, *cuts], [*cuts, None], damages, strict=True):
        SAID.clear()
        found = [*fly(loop(), Played(lines[begin:end]), tmp_path)]
        assert found[:1] == commands[-1:] or not commands  # the last one is yielded again
        commands += found[bool(commands) :]
        with (tmp_path / "messages.csv").open("a", encoding="utf-8") as file:
            file.write(damage)
    assert commands == flown[1][: len(commands)]
    assert len(commands) > 5
    skipped = [text.partition(" ")[0] for text in caplog.messages if "are no messages and are skipped" in text]
    assert skipped == ["1", "1", "2"]
    for text in "the heading is not sent", "the command is not reported":
        assert caplog.text.count(text) == 4  # once a flight


def test_a_flight_with_other_options_is_refused(tmp_path) -> None:
    def made(navigator: str = "secant", read_s: float = 30.0, start: Any = None, date: Any = None, **rest: Any) -> Loop:
        board = Onboard(navigator, **rest)
        board.start((-11.6, 75.4, 13240.0), start, date=date)
        return Loop(board, read_s=read_s)

    for _ in range(2):
        assert [*fly(made(), Played([]), tmp_path)] == []
    for name, change in {"read_s": 10.0, "confidence": 0.9, "north": "magnetic", "start": HERE}.items():
        given = {name: change} | ({"date": "2026-01-01"} if name == "start" else {})
        with pytest.raises(ValueError, match=rf"is of a flight with.* {name} "):
            [*fly(made(**given), Played([]), tmp_path)]


def test_a_folder_has_one_process(tmp_path) -> None:
    first = fly(loop(), World(), tmp_path)
    next(first)
    with pytest.raises(ValueError, match="another process"):
        next(fly(loop(), World(), tmp_path))
    first.close()
    assert next(fly(loop(), World(), tmp_path))


def test_messages_may_come_late_twice_and_out_of_order(steps, tmp_path) -> None:
    """One step is made at the end of each move."""

    class Late(World):
        def messages(self) -> Iterator[Measurement]:
            messages = [*super().messages()]
            order = messages + messages[:2] if self.rng.random() < 0.5 else messages[::-1]
            old = Measurement(self.time - 3 * STEP_S, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0)
            yield from (*order, old)

    commands = [*islice(fly(loop(), Late(noise=0.0), tmp_path), 6)]
    assert len(steps) == len(commands)
    for (*_, distance), command in zip(steps[1:], commands, strict=False):
        assert command.distance_km <= 5 or distance == pytest.approx(command.distance_km, abs=1.0)


def test_a_clock_that_is_set_does_not_move_the_vehicle(caplog) -> None:
    """Back to 0, as after a restart of the autopilot, and forward by a day."""
    flight, times = loop(), [*range(100, 110), *range(5), *range(86400, 86405)]
    for time in times:
        flight.take(Measurement(time, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, SPEED))
    assert flight.now == 109 + 4 + 4
    assert "was set by" in caplog.text


def test_a_message_that_is_not_possible_does_not_count(caplog) -> None:
    flight = loop()
    for wrong in {"time": math.nan}, {"x": math.inf}, {"pitch": 91.0}, {"speed": -1.0}, {"speed": 1e4}:
        flight.take(Measurement(**({"time": 1.0} | wrong)))
        assert flight.heard is None
    assert "does not count" in caplog.text


# Readings


def readings(change: Callable[[int, Measurement], Measurement | None], steps: int = 40) -> Loop:
    """A loop after messages that a function changes; None leaves one out."""
    flight, world = loop(), World()
    for number in range(steps):
        for message in world.messages():
            changed = change(number, message)
            if changed:
                flight.take(changed)
        if flight.steer_deg is not None:
            world.steer(flight.steer_deg)
    return flight


def stuck(number: int, message: Measurement) -> Measurement:
    return message if message.x is None or number < 9 else message._replace(x=5000.0, y=14000.0, z=49000.0)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (stuck, "the magnetometer is stuck"),
        (lambda n, m: m if m.x is None or n < 9 else None, "no sample of the field"),
        (lambda n, m: m if m.x is None or n < 9 else m._replace(x=-m.x), "changed from"),
        (lambda n, m: m._replace(heading=None) if n else m, "no sample of the field with an attitude"),
    ],
)
def test_a_bad_reading_is_named_and_the_vehicle_goes_on(steps, change, text) -> None:
    flight = readings(change)
    assert text in flight.note
    first = "attitude" in text
    assert (flight.command is None) == first  # nothing is commanded before the first reading
    if not first:
        assert steps[-1][1] is None


@pytest.mark.parametrize("good", [True, False])
def test_a_long_way_is_reported_in_parts_and_once(steps, good) -> None:
    flight = readings(lambda _, m: m, 10)
    before = len(steps)
    messages = (m._replace(time=m.time + gap) for gap in range(2000, 2100, 20) for m in World().messages())
    while len(steps) == before:  # it was not heard of for half an hour
        message = next(messages)
        flight.take(message if good or message.x is None else message._replace(x=-message.x))
    distances = [distance for *_, distance in steps[before:]][: None if good else -1]  # the last one is repeated
    assert distances[:2] == [50.0, 50.0]
    assert sum(distances) == pytest.approx(SPEED * 2000 / 1000, abs=5.0)


def test_the_north_of_a_compass_is_measured_and_a_refused_reading_does_not_turn_the_vehicle(steps) -> None:
    """The angle of the autopilot's north from magnetic north is D less its offset, and then stays as measured."""
    flight, world = loop("magnetic"), World("magnetic")
    while len(steps) < 5:
        count = len(steps)
        for message in world.messages():
            wrong = count > 2 and message.x is not None
            flight.take(message._replace(x=message.y, y=message.z) if wrong else message)
        if flight.command:
            off = flight.steer_deg - flight.command.heading_deg - (elements(world.place)[0] - OFFSET)
            assert math.remainder(off, 360) == pytest.approx(0, abs=0.5)
            world.steer(flight.steer_deg)
    assert "not possible" in flight.note or "changed from" in flight.note


def test_a_loop_is_refused_after_the_end(flown) -> None:
    flight = loop()
    flight.command = flown[1][-1]
    with pytest.raises(RuntimeError, match="has stopped: within 25 km"):
        flight.take(Measurement(0.0))


# Links


class Line:
    """A connection of pymavlink: what it receives, and what was sent."""

    def __init__(self, messages: list[Any]) -> None:
        self.messages, self.sent = iter(messages), []
        self.mav = mavlink.MAVLink(self)

    def write(self, content: bytes) -> None:
        self.sent += mavlink.MAVLink(None).parse_buffer(content)

    def recv_match(self, **_: Any) -> Any:
        return next(self.messages, None)


def packed(*messages: Any, system: int = 1, component: int = 1) -> list[Any]:
    source = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    return [mavlink.MAVLink(None).parse_buffer(message.pack(source))[0] for message in messages]


def heartbeat(kind: int = 1, autopilot: int = 3) -> Any:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)


def received(link: MavlinkLink, count: int = 0) -> list[Measurement | None]:
    """What comes before the silence after some messages."""
    return [*islice(link, count + 1)][:count]


def test_mavlink_is_read_in_our_units_from_one_vehicle() -> None:
    attitude = mavlink.MAVLink_attitude_message(5000, 0.0, 0.0, math.pi / 2, 0, 0, 0)
    imu = mavlink.MAVLink_highres_imu_message(5_100_000, *[0] * 6, 0.15, -0.02, 0.5, *[0] * 4, 0x1C0)
    coarse = mavlink.MAVLink_scaled_imu_message(5200, *[0] * 6, 150, 0, 500)
    line = Line([*packed(heartbeat(), attitude, imu, coarse, mavlink.MAVLink_vfr_hud_message(50, 40, 0, 0, 0, 0))])
    line.messages = iter([*line.messages, *packed(attitude, system=9)])
    beat, turned, field, ignored, speed, silence = received(MavlinkLink(line), 6)
    assert turned == pytest.approx(Measurement(5.0, roll=0.0, pitch=0.0, heading=90.0), abs=1e-4)
    assert field[:4] == pytest.approx((5.1, 15000.0, -2000.0, 50000.0), abs=1e-2)
    assert [beat, ignored, silence] == [None] * 3
    assert speed == Measurement(5.0, speed=50.0)
    asked = [message.param1 for message in line.sent if message.get_type() == "COMMAND_LONG"]
    assert {mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, mavlink.MAVLINK_MSG_ID_VFR_HUD} <= set(asked)


def test_a_coarse_magnetometer_is_taken_after_some_messages_and_another_clock_is_set_aside() -> None:
    messages = Messages("groundspeed")
    speed = mavlink.MAVLink_vfr_hud_message(50, 40, 0, 0, 0, 0)
    assert messages.measurement(speed) is None  # its time is not known before the first attitude
    messages.measurement(mavlink.MAVLink_attitude_message(2**32 - 1, *[0.0] * 6))  # a clock that ran out
    messages.measurement(mavlink.MAVLink_attitude_message(3000, *[0.0] * 6))
    raw = [mavlink.MAVLink_raw_imu_message(10**15 + n, *[0] * 6, 150, 0, 500, id=n % 2) for n in range(64)]
    found = [messages.measurement(message) for message in raw]
    assert found[:30] == [None] * 30
    assert found[30:] == [Measurement(3.0, 15000.0, 0.0, 50000.0), None] * 17  # of one of two
    assert messages.measurement(speed) == Measurement(3.0, speed=40.0)


@pytest.mark.parametrize(
    ("kind", "name"), [(1, "COMMAND_INT"), (2, "SET_POSITION_TARGET_LOCAL_NED"), (10, "SET_POSITION_TARGET_LOCAL_NED")]
)
def test_mavlink_steers(kind, name) -> None:
    speed = mavlink.MAVLink_vfr_hud_message(50, 40, *[0] * 4)
    line = Line(packed(heartbeat(kind), mavlink.MAVLink_attitude_message(1000, *[0.0] * 6), speed))
    link = MavlinkLink(line, cruise_m_s=5.0)
    assert received(link, 3)[-1].speed == (50 if kind == 1 else 40)  # through the air, or over ground
    link.steer(120.0)
    sent = line.sent[-1]
    assert sent.get_type() == name
    assert (sent.target_system, sent.target_component) == (1, 1)
    if kind == 1:
        assert (sent.command, sent.param1, sent.param2) == (mavlink.MAV_CMD_GUIDED_CHANGE_HEADING, 1, 120)
    else:
        assert (sent.vx, sent.vy, sent.yaw) == pytest.approx((-2.5, 4.3301, 2.0944), abs=1e-3)
        ignored = mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
        assert sent.type_mask & ignored == ignored
        assert not sent.type_mask & mavlink.POSITION_TARGET_TYPEMASK_VX_IGNORE
        yaw_ignored = bool(sent.type_mask & mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE)
        assert yaw_ignored == (kind == 10)  # a Rover would drive to the south backward


def test_a_refused_heading_and_lost_requests_are_noticed(caplog) -> None:
    answer = mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_GUIDED_CHANGE_HEADING, 4)
    line = Line(packed(*[heartbeat()] * 11, answer, answer))
    received(MavlinkLink(line), 13)
    assert caplog.text.count("is it in GUIDED") == 1
    asked = [m.param1 for m in line.sent if m.get_type() == "COMMAND_LONG"]
    assert asked.count(mavlink.MAVLINK_MSG_ID_VFR_HUD) == 2


FOREIGN = [(6, 8, 255, 1), (18, 8, 1, 191), (26, 8, 7, 154), (27, 8, 9, 156), (5, 3, 3, 1), (1, 12, 4, 1), (2, 3, 5, 1)]
"""Ground station, onboard computer, gimbal, ADS-B, antenna tracker, a fixed wing of PX4, a copter without a speed."""


def test_only_an_autopilot_that_can_be_steered_is_steered(caplog) -> None:
    def beat(kind: int, autopilot: int, system: int, component: int) -> Any:
        return packed(heartbeat(kind, autopilot), system=system, component=component)[0]

    others = [beat(*source) for source in FOREIGN]
    mine, attitude = beat(1, 3, 7, 1), mavlink.MAVLink_attitude_message(1000, *[0.0] * 6)
    foreign, own = packed(attitude, system=1), packed(attitude, system=7)
    line = Line([*others, mine, *foreign, *own, beat(1, 3, 8, 1), *others])
    link = MavlinkLink(line)
    link.steer(10.0)  # nobody is there yet
    assert [item is not None for item in received(link, 18)].index(True) == 9
    link.steer(120.0)
    assert (line.sent[-1].target_system, line.sent[-1].target_component) == (7, 1)
    assert line.sent[-1].get_srcSystem() == 7
    assert {message.target_system for message in line.sent if message.get_type() == "COMMAND_LONG"} == {7}
    assert "is not steered: PX4 accepts no heading" in caplog.text
    line.messages = iter([mine, beat(1, 3, 8, 2), *others])
    link = MavlinkLink(line, autopilot=(8, 2))
    received(link, 9)
    link.steer(120.0)
    assert (line.sent[-1].target_system, line.sent[-1].target_component) == (8, 2)


def test_a_link_that_fails_goes_on(monkeypatch, caplog) -> None:
    monkeypatch.setattr("time.sleep", lambda _: None)

    class Torn(Line):
        def recv_match(self, **options: Any) -> Any:
            message = super().recv_match(**options)
            if isinstance(message, OSError):
                raise message
            return message

    attitude = packed(mavlink.MAVLink_attitude_message(1000, *[0.0] * 6))
    link = MavlinkLink(Torn([OSError("unplugged"), *packed(heartbeat()), OSError("unplugged"), *attitude]))
    assert [item and item.heading for item in islice(link, 4)] == [None, None, None, 0.0]
    assert "nothing is received: unplugged" in caplog.text


def sentence(content: str) -> bytes:
    checksum = 0
    for byte in content.encode():
        checksum ^= byte
    return f"${content}*{checksum:02X}\r\n".encode()


def test_nmea_over_udp_steers_a_ship() -> None:
    link, found = NmeaLink("udp:0"), []
    axes = "G,14000.0,,MAG_X_NT,G,-500.0,,MAG_Y_NT,G,49000.0,,MAG_Z_NT,A,1.0,D,ROLL,A,-2.0,D,PTCH"
    said = "HEHDT,320.0,T", f"IIXDR,{axes}", "VWVHW,,T,,M,116.63,N,,K"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ship:
        ship.settimeout(10)
        for line in (*map(sentence, said), b"$HEHDT,nonsense*00"):
            ship.sendto(line, ("127.0.0.1", link.port.port))
        for item in link:
            found.append(item)
            if item is None or len(found) == 3:
                break
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:  # it does not get the answers
            other.sendto(sentence("GPGSV,1,1,00"), ("127.0.0.1", link.port.port))
            next(iter(link))
        link.steer(120.0)
        assert ship.recv(99) == sentence("ECHSC,120.0,T,,M")
        assert ship.recv(99).startswith(b"$ECAPB,A,A,0.00,R,N,V,V,120.0,T,MAGRL,120.0,T,120.0,T*")
        link.report(Command(1.0, 0.0, 0.0, (90.0, -12.0), ((9.0, 0.0), (0.0, 16.0)), 0.5))
        assert ship.recv(99) == sentence("PMGRL,WAY,90.0,-12.0,5.0,0.50,")
    link.port.close()
    heading, field, speed = found
    assert heading.heading == 320.0
    assert field[1:6] == (14000.0, -500.0, 49000.0, 1.0, -2.0)
    assert speed.speed == pytest.approx(60.0, abs=0.01)


def read(*contents: str, **options: Any) -> list[dict[str, float]]:
    """What sentences say, that comes one a second."""
    kind = Sentences(**options)
    found = [item for n, content in enumerate(contents) for item in kind.measurements(sentence(content), float(n))]
    return [{k: v for k, v in item._asdict().items() if v is not None and k != "time"} for item in found]


SPEEDS = ["VWVHW,,T,,M,10.0,N,18.52,K", "VWVHW,,T,,M,,N,18.52,K", "VWVBW,10.0,0.0,A,9.0,0.0,V,,V,,V"]
SPEEDS += ["GPVTG,,T,,M,10.0,N,18.52,K,A", "GPVTG,,T,,M,,N,18.52,K,A", "VWVBW,9.0,0.0,V,10.0,0.0,A,,V,,V"]


def test_sentences_of_another_north_or_speed_do_not_count() -> None:
    for line in SPEEDS:
        water = SPEEDS.index(line) < 3
        assert read(line, speed="water" if water else "ground") == [{"speed": pytest.approx(10 * 1852 / 3600)}]
        assert read(line, speed="ground" if water else "water") == []
    assert [read("HCHDM,350.0,M", north=north) for north in ("true", "magnetic")] == [[], [{"heading": 350.0}]]


def test_a_heading_that_is_not_valid_does_not_count() -> None:
    for line in "HETHS,290.0,V", "HETHS,290.0,S", "HETHS,290.0,M", "HEHDT,720.0,T", "HEHDT,-1.0,T":
        assert read(line, "HEHDT,290.0,T") == [{"heading": 290.0}]


def test_a_serial_port_is_read_and_written() -> None:
    link = NmeaLink("loop://,4800", level=True, north="magnetic")
    link.port.write(sentence("HCHDM,350.0,M"))
    assert next(iter(link)).heading == 350.0
    link.steer(20.0)
    assert link.port.readline() == sentence("ECHSC,,T,20.0,M")
    link.port.close()


# The command


WORDS = ["--target", *map(str, THERE), "--noise", "0.05", "0.05", "5"]


def test_the_command_looks_up_its_destination() -> None:
    here = ["--start", *map(str, HERE), "--date", "2026-01-01", "--navigator", "secant", "--bias", "0", "0", "0"]
    board = program.vehicle(program.parser().parse_args(["udp:0", *WORDS, *here]))
    assert board.target == pytest.approx(elements(THERE), rel=1e-6)


def test_the_command_flies_on(flown, monkeypatch, capsys, tmp_path) -> None:
    lines, target = half(flown[2]), loop().vehicle.target
    options = ["--noise", "0.05", "0.05", "20", "--read-s", "60", "--out", str(tmp_path)]
    said = []
    for messages in lines[:150], lines[150:]:
        monkeypatch.setattr("magrl.vehicle.autopilot.__main__.link", lambda _, messages=messages: Played(messages))
        program.main(["udp:0", "--target", *map(repr, target), *options])
        said.append([text for text in capsys.readouterr().out.splitlines() if "Network" not in text])
    assert said[0][1].endswith("; the sign of D and the compass were not checked: give the start")
    assert said[1][0].startswith(f"continues the flight in {tmp_path}")
    assert said[1][2] == said[0][-1].replace(f"{len(said[0]) - 2}:", "0:", 1)
    assert program.line(7, flown[1][-1], "").startswith("7: steer ")
    assert "; stop: arrived, within 25 km" in program.line(7, flown[1][-1], "")


@pytest.mark.slow
def test_a_cessna_of_jsbsim_arrives_after_an_interruption(tmp_path) -> None:
    """200 km in wind; its magnetometer sticks for a while."""
    pytest.importorskip("jsbsim")
    example, rng = runpy.run_path(str(EXAMPLE)), random.Random(5)
    here, there, heading, wind = example["task"](rng, 200.0, 12.0)
    aircraft = example["Cessna"](here, heading, wind, rng)
    line, commands = example["Loopback"](aircraft), []
    for limit in (8, 200):
        board = Onboard("anywhere", sensor_std=example["NOISE"])
        board.start(example["elements"](there))
        for command in islice(fly(Loop(board), MavlinkLink(line), tmp_path), limit):
            aircraft.stuck = 1500 < aircraft.time < 1800
            commands.append(command)
        line._queue.extendleft([heartbeat()])
    assert commands[7] == commands[8]  # the last one before the interruption is yielded again
    assert commands[-1].stop == "arrived"
    assert example["EARTH"].Inverse(*aircraft.place, *there)["s12"] < 25_000
