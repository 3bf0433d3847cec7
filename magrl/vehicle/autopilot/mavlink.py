"""MAVLink: the link to ArduPilot and PX4, by pymavlink."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from magrl.checks import check_choice
from magrl.field.elements import FIELD_NT
from magrl.vehicle.autopilot.loop import LOG, Measurement, patient, tolerated
from magrl.vehicle.logs.autopilots import package
from magrl.vehicle.onboard import Command

RATE_HZ = 10.0
"""Rate of the messages that are asked for."""
CENTRIPETAL_M_S2 = 3.6
"""Largest centripetal acceleration of a turn, with a bank of 20 degrees [m/s²]."""
SENSORS: Mapping[str, float] = {"HIGHRES_IMU": FIELD_NT["gauss"]} | dict.fromkeys(
    ("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3"), FIELD_NT["milligauss"]
)
"""Messages with a magnetometer, and their unit [nT]. Messages of integers have steps of 100 nT."""
_WAIT = 30  # coarser messages, before one of them is taken instead of HIGHRES_IMU
_CLOCKS_S = 60.0  # a message whose clock differs by more has another one
_VELOCITY_AND_YAW = 0b100111000111  # type_mask: position, acceleration and yaw rate are ignored
_VELOCITY = 0b110111000111  # a Rover of ArduPilot takes a velocity with a yaw to the south for one backward
_ROVERS = (10, 11)  # MAV_TYPE_GROUND_ROVER, MAV_TYPE_SURFACE_BOAT
_FIXED_WING = 1  # MAV_TYPE_FIXED_WING
_WINGS = (_FIXED_WING, *range(19, 26))  # and vehicles that start and land vertically
_BEATS = 10  # heartbeats, of about 1 Hz, after which the messages are asked for again
_OTHERS = (5, 6)  # MAV_TYPE_ANTENNA_TRACKER, MAV_TYPE_GCS
_CHANGE_HEADING = 43002  # MAV_CMD_GUIDED_CHANGE_HEADING
_DIALECT = "pymavlink.dialects.v20.ardupilotmega"


class Messages:
    """Turn messages of MAVLink into measurements on one clock, the attitude's.

    Args:
        speed: ``"airspeed"`` or ``"groundspeed"`` of VFR_HUD.

    Example:
        >>> from pymavlink.dialects.v20 import common
        >>> Messages().measurement(common.MAVLink_attitude_message(1500, 0.0, 0.0, -0.5, 0, 0, 0)).heading
        -28.64788975654116
    """

    def __init__(self, speed: str = "airspeed") -> None:
        check_choice(("airspeed", "groundspeed"), speed=speed)
        self.names, self.speed, self._wait = ("ATTITUDE", "VFR_HUD", *SENSORS), speed, _WAIT
        self._sensor: tuple[str, int] | None = None  # name and number of the chosen one
        self._now: float | None = None

    def measurement(self, message: Any) -> Measurement | None:
        """Return the content of a message; None for one that does not count, and before the first attitude."""
        name = message.get_type()
        if self._now is None and name != "ATTITUDE":
            return None
        time = self._time(message)
        if name == "ATTITUDE":
            self._now = time
            roll, pitch, heading = (math.degrees(angle) for angle in (message.roll, message.pitch, message.yaw))
            return Measurement(time, roll=roll, pitch=pitch, heading=heading)
        if name == "VFR_HUD":
            return Measurement(time, speed=getattr(message, self.speed))
        if name not in SENSORS or not self._chosen(name, getattr(message, "id", 0)):
            return None
        axes = (SENSORS[name] * getattr(message, axis) for axis in ("xmag", "ymag", "zmag"))
        return Measurement(time, *axes)

    def _time(self, message: Any) -> float:
        """Return the time of a message, or of the last attitude where it has none, or has another clock."""
        now = self._now or 0.0
        own = getattr(message, "time_usec", 1e3 * getattr(message, "time_boot_ms", 1e3 * now)) / 1e6
        return own if message.get_type() == "ATTITUDE" or abs(own - now) <= _CLOCKS_S else now

    def _chosen(self, name: str, number: int) -> bool:
        """Return whether a message is the magnetometer's; the first one that may be is chosen."""
        self._wait -= 1
        if self._sensor is None and (name == "HIGHRES_IMU" or self._wait < 0):
            self._sensor = name, number
        return self._sensor == (name, number)


class MavlinkLink:
    """Connection to an autopilot that speaks MAVLink.

    The messages ATTITUDE, VFR_HUD and HIGHRES_IMU (or another one of :data:`SENSORS`) are asked for and read. A heading
    goes out as MAV_CMD_GUIDED_CHANGE_HEADING to a fixed wing (ArduPlane in GUIDED), as velocity and yaw in
    SET_POSITION_TARGET_LOCAL_NED to others (ArduPilot's Copter and Rover in GUIDED, multicopters of PX4 in OFFBOARD).
    The operator arms the vehicle and chooses the mode. The estimates go out as NAMED_VALUE_FLOAT (``mg_north``,
    ``mg_east``, ``mg_error`` [km], ``mg_conf``).

    Args:
        connection: what ``pymavlink.mavutil.mavlink_connection`` returns; or its address, such as
            ``"udpin:0.0.0.0:14550"`` or ``"/dev/ttyUSB0,57600"``.
        cruise_m_s: speed to command to others than fixed wings [m/s].
        autopilot: numbers of the system and the component to steer; by default the first autopilot that can be steered.

    Raises:
        ImportError: without pymavlink.

    Example:
        >>> MavlinkLink(None, cruise_m_s=5.0).period_s
        0.4
    """

    period_s = 0.4  # PX4 leaves OFFBOARD below 2 Hz

    def __init__(
        self,
        connection: Any,
        *,
        cruise_m_s: float | None = None,
        autopilot: Sequence[int] | None = None,
    ) -> None:
        self._messages = Messages()
        self._connection = _connected(connection) if isinstance(connection, str) else connection
        self._wings, self._cruise = True, cruise_m_s
        self._wanted = autopilot and tuple(autopilot)
        self._vehicle: tuple[int, int] | None = None  # system and component of the autopilot
        self._mask, self._beats = _VELOCITY_AND_YAW, 0

    def __iter__(self) -> Iterator[Measurement | None]:
        """Iterate over the messages of the autopilot."""
        return patient(self._receive)

    def _receive(self) -> Measurement | None:
        """Return the content of the next message; None for one that is not of the autopilot, or where none comes."""
        kinds = ["HEARTBEAT", "COMMAND_ACK", *self._messages.names]
        message = self._connection.recv_match(type=kinds, blocking=True, timeout=1.0)
        if message is None:
            return None
        kind, source = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if kind == "HEARTBEAT":
            with tolerated("nothing is sent to the autopilot"):
                self._meet(message, source)
        elif source == self._vehicle and kind != "COMMAND_ACK":
            return self._messages.measurement(message)
        elif source == self._vehicle and message.command == _CHANGE_HEADING and message.result:
            LOG.warning("the autopilot refuses the heading (result %d): is it in GUIDED?", message.result)
        return None

    def _meet(self, heartbeat: Any, source: tuple[int, int]) -> None:
        """Learn the autopilot from its heartbeat, and ask for the messages, now and then again."""
        mav = self._connection.mav
        mav.heartbeat_send(18, 8, 0, 0, 4)  # an onboard controller without an autopilot, active
        is_autopilot = heartbeat.autopilot != 8 and heartbeat.type not in _OTHERS  # MAV_AUTOPILOT_INVALID
        if not (source == self._wanted if self._wanted else is_autopilot):
            return
        obstacle = "" if self._vehicle else self._obstacle(heartbeat.type, heartbeat.autopilot)
        if not (self._vehicle or obstacle):
            self._vehicle = source
        if source != self._vehicle:
            LOG.warning(f"system, component {source} is not steered: %s", obstacle or "another one is")
            return
        mav.srcSystem = source[0]
        dialect = package(_DIALECT, "pymavlink")
        for name in self._messages.names if self._beats % _BEATS == 0 else ():
            number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
            mav.command_long_send(*source, 511, 0, number, 1e6 / RATE_HZ, 0, 0, 0, 0, 0)  # SET_MESSAGE_INTERVAL
        self._beats += 1

    def _obstacle(self, kind: int, autopilot: int) -> str:
        """Choose how to steer a type of vehicle, or return why it cannot be steered."""
        if autopilot == 12 and kind in _WINGS:  # MAV_AUTOPILOT_PX4
            return "PX4 accepts no heading by MAVLink on a fixed wing: steer it by another program"
        self._wings = kind == _FIXED_WING
        if not self._wings and self._cruise is None:
            return "this vehicle is steered by velocity: state cruise_m_s, the speed to command"
        self._mask = _VELOCITY if kind in _ROVERS else _VELOCITY_AND_YAW
        self._messages.speed = "airspeed" if self._wings else "groundspeed"
        return ""

    def steer(self, heading_deg: float) -> None:
        """Send a heading."""
        if self._vehicle is None:
            return
        mav = self._connection.mav
        if self._wings:  # MAV_FRAME_GLOBAL, MAV_CMD_GUIDED_CHANGE_HEADING, HEADING_TYPE_HEADING
            heading = round(heading_deg, 2) % 360
            mav.command_int_send(*self._vehicle, 0, _CHANGE_HEADING, 0, 0, 1, heading, CENTRIPETAL_M_S2, 0, 0, 0, 0)
            return
        assert self._cruise is not None
        yaw = math.radians(heading_deg)
        velocity = self._cruise * math.cos(yaw), self._cruise * math.sin(yaw), 0.0
        rest, yaw = (0.0, 0.0, 0.0), math.remainder(yaw, 2 * math.pi)
        mav.set_position_target_local_ned_send(0, *self._vehicle, 1, self._mask, *rest, *velocity, *rest, yaw, 0.0)

    def report(self, command: Command) -> None:
        """Send the estimated displacement."""
        values = (*command.way_km, command.error_km, command.confidence)
        for name, value in zip((b"mg_north", b"mg_east", b"mg_error", b"mg_conf"), values, strict=True):
            self._connection.mav.named_value_float_send(0, name, value)


def _connected(address: str) -> Any:
    """Return the connection of an address, with the rate of a serial port after a comma."""
    name, _, baud = address.partition(",")
    mavutil = package("pymavlink.mavutil", "pymavlink")
    options = {"source_system": 1, "source_component": 191, "autoreconnect": True}  # MAV_COMP_ID_ONBOARD_COMPUTER
    return mavutil.mavlink_connection(name, baud=int(baud or 115200), dialect="ardupilotmega", **options)
