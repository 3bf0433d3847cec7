"""MAVLink: the link to ArduPilot and PX4, by pymavlink."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from magrl.autopilot.loop import Measurement
from magrl.checks import check_choice
from magrl.field.elements import FIELD_NT
from magrl.logs import attitude_of
from magrl.logs.autopilots import package
from magrl.logs.samples import ATTITUDE
from magrl.onboard import Command

STEERING = ("heading", "velocity")
"""Ways to steer: MAV_CMD_GUIDED_CHANGE_HEADING, and SET_POSITION_TARGET_LOCAL_NED with velocity and yaw."""
RATE_HZ = 10.0
"""Rate of the messages that are asked for."""
CENTRIPETAL_M_S2 = 3.6
"""Largest centripetal acceleration of a turn, that of a bank of 20 degrees [m/s²]."""
SENSORS: Mapping[str, float] = {"HIGHRES_IMU": FIELD_NT["gauss"]} | dict.fromkeys(
    ("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3"), FIELD_NT["milligauss"]
)
"""Messages with a magnetometer, and their unit [nT]. Those of integers have steps of 100 nT."""
_ATTITUDE = "ATTITUDE", "ATTITUDE_QUATERNION"
_WAIT_S = 3.0  # for HIGHRES_IMU, before a coarser message is taken
_CLOCKS_S = 60.0  # a message whose clock differs by more has another one
_VELOCITY_AND_YAW = 0b100111000111  # type_mask: position, acceleration and yaw rate are ignored
_VELOCITY = 0b110111000111  # a Rover of ArduPilot takes a velocity with a yaw to the south for one backward
_ROVERS = (10, 11)  # MAV_TYPE_GROUND_ROVER, MAV_TYPE_SURFACE_BOAT
_FIXED_WING = 1  # MAV_TYPE_FIXED_WING
_WINGS = (_FIXED_WING, *range(19, 26))  # and vehicles that start and land vertically
_BEATS = 10  # heartbeats, of about 1 Hz, after which the messages are asked for again
_CHANGE_HEADING = 43002  # MAV_CMD_GUIDED_CHANGE_HEADING
_SEVERITY = 5  # MAV_SEVERITY_NOTICE
_TEXT = 50  # characters of a STATUSTEXT


class Messages:
    """Turn messages of MAVLink into measurements on one clock, that of the attitude.

    Args:
        speed: ``"airspeed"`` or ``"groundspeed"`` of VFR_HUD.
        sensor: one of :data:`SENSORS`; by default HIGHRES_IMU, or the first of the others after three seconds.

    Example:
        >>> from pymavlink.dialects.v20 import common
        >>> Messages().measurement(common.MAVLink_attitude_message(1500, 0.0, 0.0, -0.5, 0, 0, 0)).heading
        -28.64788975654116
    """

    def __init__(self, speed: str = "airspeed", sensor: str | None = None) -> None:
        check_choice(("airspeed", "groundspeed"), speed=speed)
        if sensor is not None:
            check_choice(SENSORS, sensor=sensor)
        self.names = (*_ATTITUDE, "VFR_HUD", *([sensor] if sensor else SENSORS))
        self.speed, self._sensor = speed, sensor
        self._first: float | None = None
        self._now: float | None = None

    def measurement(self, message: Any) -> Measurement | None:
        """Return the content of a message; None for one that does not count, and before the first attitude."""
        name = message.get_type()
        if self._now is None and name not in _ATTITUDE:
            return None
        time = self._time(message)
        if name in _ATTITUDE:
            self._now = time
            if name == "ATTITUDE":
                angles = [math.degrees(angle) for angle in (message.roll, message.pitch, message.yaw)]
            else:  # NaN for a quaternion of zeros
                angles = attitude_of(torch.tensor([message.q1, message.q2, message.q3, message.q4])).tolist()
            return Measurement(time, **dict(zip(ATTITUDE, angles, strict=True)))
        if name == "VFR_HUD":
            return Measurement(time, speed=getattr(message, self.speed))
        if name not in SENSORS or not self._chosen(name, time):
            return None
        axes = (SENSORS[name] * getattr(message, axis) for axis in ("xmag", "ymag", "zmag"))
        return Measurement(time, *axes)

    def _time(self, message: Any) -> float:
        """Return the time of a message, or that of the last attitude where it has none, or that of another clock."""
        now = self._now or 0.0
        own = getattr(message, "time_boot_ms", None)
        time = now if own is None else own / 1e3
        if hasattr(message, "time_usec"):
            time = message.time_usec / 1e6
        return time if message.get_type() in _ATTITUDE or abs(time - now) <= _CLOCKS_S else now

    def _chosen(self, name: str, time: float) -> bool:
        """Return whether a message is that of the magnetometer; the first one that may be is chosen."""
        self._first = time if self._first is None else self._first
        if self._sensor is None and (name == "HIGHRES_IMU" or time - self._first >= _WAIT_S):
            self._sensor = name
        return name == self._sensor


class MavlinkLink:
    """Connection to an autopilot that speaks MAVLink.

    The messages ATTITUDE_QUATERNION, VFR_HUD and HIGHRES_IMU (or another one of :data:`SENSORS`) are asked for and
    read. A heading goes out as MAV_CMD_GUIDED_CHANGE_HEADING (``steering="heading"``; ArduPlane in GUIDED), or as
    velocity and yaw in SET_POSITION_TARGET_LOCAL_NED (``"velocity"``; ArduPilot's Copter and Rover in GUIDED, and
    multicopters of PX4 in OFFBOARD). The operator arms the vehicle and chooses the mode. The estimates go out as
    NAMED_VALUE_FLOAT (``mg_north``, ``mg_east``, ``mg_error`` [km], ``mg_conf``), texts as STATUSTEXT.

    Args:
        connection: what ``pymavlink.mavutil.mavlink_connection`` returns; or its address, such as
            ``"udpin:0.0.0.0:14550"`` or ``"/dev/ttyUSB0,57600"``.
        steering: one of :data:`STEERING`; by default by the type of the vehicle.
        cruise_m_s: speed to command with ``"velocity"`` [m/s].
        speed: ``"airspeed"`` or ``"groundspeed"`` of VFR_HUD, with which the moves are integrated; by default the
            airspeed of a fixed wing, the ground speed of others.
        sensor: message of the magnetometer, one of :data:`SENSORS`.

    Raises:
        ImportError: without pymavlink.
        ValueError: for an unknown option, or ``"velocity"`` without a speed.

    Example:
        >>> MavlinkLink(None, steering="velocity")
        Traceback (most recent call last):
        ValueError: steering by velocity needs cruise_m_s, the speed to command
    """

    period_s = 0.4  # PX4 leaves OFFBOARD below 2 Hz

    def __init__(
        self,
        connection: Any,
        *,
        steering: str | None = None,
        cruise_m_s: float | None = None,
        speed: str | None = None,
        sensor: str | None = None,
    ) -> None:
        if steering is not None:
            check_choice(STEERING, steering=steering)
        if steering == "velocity" and cruise_m_s is None:
            raise ValueError("steering by velocity needs cruise_m_s, the speed to command")
        self._messages, self._speed = Messages(speed or "airspeed", sensor), speed
        self._connection = _connected(connection) if isinstance(connection, str) else connection
        self._steering, self._cruise = steering, cruise_m_s
        self._vehicle: tuple[int, int] | None = None  # system and component of the autopilot
        self._mask, self._beats, self._refused = _VELOCITY_AND_YAW, 0, 0

    def __iter__(self) -> Iterator[Measurement | None]:
        """Iterate over the messages of the autopilot."""
        while True:
            kinds = ["HEARTBEAT", "COMMAND_ACK", *self._messages.names]
            message = self._connection.recv_match(type=kinds, blocking=True, timeout=1.0)
            if message is None:
                yield None
            elif message.get_type() == "HEARTBEAT":
                self._meet(message)
                yield None
            elif self._vehicle != (message.get_srcSystem(), message.get_srcComponent()):
                continue
            elif message.get_type() == "COMMAND_ACK":
                self._hear(message)
            else:
                yield self._messages.measurement(message)

    def _meet(self, heartbeat: Any) -> None:
        """Learn the autopilot from its heartbeat, and ask for the messages, now and then again."""
        mav, source = self._connection.mav, (heartbeat.get_srcSystem(), heartbeat.get_srcComponent())
        mav.heartbeat_send(18, 8, 0, 0, 4)  # an onboard controller without an autopilot, active
        if source != (self._vehicle or (source[0], 1)):
            return
        if self._vehicle is None:
            self._vehicle = source
            self._learn(heartbeat.type, heartbeat.autopilot)
        dialect = package("pymavlink.dialects.v20.ardupilotmega", "pymavlink")
        for name in self._messages.names if self._beats % _BEATS == 0 else ():
            number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
            mav.command_long_send(*source, 511, 0, number, 1e6 / RATE_HZ, 0, 0, 0, 0, 0)  # SET_MESSAGE_INTERVAL
        self._beats += 1

    def _learn(self, kind: int, autopilot: int) -> None:
        """Choose how to steer a type of vehicle."""
        if self._steering is None:
            self._steering = "heading" if kind == _FIXED_WING else "velocity"
        if autopilot == 12 and kind in _WINGS:  # MAV_AUTOPILOT_PX4
            raise ValueError("PX4 accepts no heading by MAVLink on a fixed wing: steer it by another program")
        if self._steering == "velocity" and self._cruise is None:
            raise ValueError("this vehicle is steered by velocity: state cruise_m_s, the speed to command")
        self._mask = _VELOCITY if kind in _ROVERS else _VELOCITY_AND_YAW
        self._messages.speed = self._speed or ("airspeed" if kind == _FIXED_WING else "groundspeed")

    def _hear(self, answer: Any) -> None:
        """Warn of a heading that the autopilot refuses."""
        if answer.command == _CHANGE_HEADING:
            if answer.result and answer.result != self._refused:
                warnings.warn(
                    f"the autopilot refuses the heading (result {answer.result}): is it in GUIDED?", stacklevel=2
                )
            self._refused = answer.result

    def steer(self, heading_deg: float) -> None:
        """Send a heading."""
        assert self._vehicle is not None
        mav = self._connection.mav
        if self._steering == "heading":  # MAV_FRAME_GLOBAL, MAV_CMD_GUIDED_CHANGE_HEADING, HEADING_TYPE_HEADING
            heading = round(heading_deg, 2) % 360
            mav.command_int_send(*self._vehicle, 0, _CHANGE_HEADING, 0, 0, 1, heading, CENTRIPETAL_M_S2, 0, 0, 0, 0)
            return
        assert self._cruise is not None
        yaw = math.radians(heading_deg)
        velocity = self._cruise * math.cos(yaw), self._cruise * math.sin(yaw), 0.0
        rest = (0.0, 0.0, 0.0)
        mav.set_position_target_local_ned_send(
            0, *self._vehicle, 1, self._mask, *rest, *velocity, *rest, math.remainder(yaw, 2 * math.pi), 0.0
        )

    def report(self, command: Command, text: str) -> None:
        """Send the estimated way and a text."""
        mav = self._connection.mav
        values = {"mg_north": command.way_km[0], "mg_east": command.way_km[1]}
        values |= {"mg_error": command.error_km, "mg_conf": command.confidence}
        for name, value in values.items():
            mav.named_value_float_send(0, name.encode(), value)
        if text:
            mav.statustext_send(_SEVERITY, f"magrl {command.stop or ''}: {text}".encode("ascii", "replace")[:_TEXT])


def _connected(address: str) -> Any:
    """Return the connection of an address, with the rate of a serial port after a comma."""
    name, _, baud = address.partition(",")
    mavutil = package("pymavlink.mavutil", "pymavlink")
    source = {"source_system": 1, "source_component": 191}  # MAV_COMP_ID_ONBOARD_COMPUTER
    return mavutil.mavlink_connection(name, baud=int(baud or 115200), dialect="ardupilotmega", **source)
