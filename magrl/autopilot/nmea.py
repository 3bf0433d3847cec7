"""NMEA 0183: the link to the autopilot of a ship, over UDP or a serial port."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Iterator
from typing import Any

from magrl.autopilot.loop import Measurement
from magrl.checks import check_choice
from magrl.logs.autopilots import INVALID, nmea_values, package
from magrl.logs.samples import AXES
from magrl.onboard import Command

_TALKER = "EC"  # an electronic chart system
_SILENCE_S, _TEXT = 1.0, 50
_NAMES = {"heading_true": "heading", "heading_magnetic": "heading", "speed_water": "speed", "speed_ground": "speed"}
_QUANTITIES = Measurement._fields[1:]


class Sentences:
    """Turn sentences of NMEA 0183 into measurements.

    Args:
        north: ``"true"`` (HDT, THS) or ``"magnetic"`` (HDG, HDM).
        speed: ``"water"`` (VHW) or ``"ground"`` (VTG).
        level: whether roll and pitch are 0, as of a magnetometer in gimbals; otherwise they must come by XDR.

    Raises:
        ImportError: without pynmeagps.
        ValueError: for an unknown option.

    Example:
        >>> list(Sentences().measurements(b"$HEHDT,290.0,T*24", time=5.0))[0].heading
        290.0
    """

    def __init__(self, north: str = "true", speed: str = "water", level: bool = False) -> None:
        check_choice(("true", "magnetic"), north=north)
        check_choice(("water", "ground"), speed=speed)
        self._reader = package("pynmeagps", "pynmeagps").NMEAReader
        self._kinds = (f"heading_{north}", f"speed_{speed}")
        self._tilt = {"roll": 0.0, "pitch": 0.0} if level else {}

    def measurements(self, line: bytes, time: float) -> Iterator[Measurement]:
        """Yield the content of a sentence that came at a time [s]; nothing for a damaged one, or another kind."""
        try:
            message = self._reader.parse(line)
        except Exception:  # whatever the package raises for a foreign sentence
            return
        if message is None or any(getattr(message, field, None) == value for field, value in INVALID.items()):
            return
        pairs = nmea_values(message)
        values = {_NAMES.get(name, name): value for name, value in pairs if name in self._kinds or name not in _NAMES}
        values = {name: value for name, value in values.items() if name in _QUANTITIES}
        axes = [name for name in AXES if name in values]
        if values and len(axes) in (0, len(AXES)):
            yield Measurement(time, **(self._tilt | values if axes else values))


class NmeaLink:
    """Connection to instruments and the autopilot of a ship.

    It reads HDT, THS, HDG or HDM, VHW or VTG, and XDR with the axes of the magnetometer (names such as ``MAG_X_NT``)
    and PTCH and ROLL. It sends HSC and APB with the heading to steer, and ``$PMGRL`` with the way northward and
    eastward [km], its error [km], the confidence, and why to stop. Times are those of receipt.

    Args:
        address: ``"udp:10110"``, the port at which sentences arrive and to whose sender the answers go; or a serial
            port and its rate, such as ``"/dev/ttyUSB0,38400"``.
        north: that of :class:`Sentences`.
        options: those of :class:`Sentences`.

    Raises:
        ImportError: without pynmeagps, or without pyserial for a serial port.
        ValueError: for an unknown option.

    Example:
        >>> NmeaLink("udp:10110", north="left")
        Traceback (most recent call last):
        ValueError: north must be one of 'true', 'magnetic', got 'left'
    """

    period_s = 1.0

    def __init__(self, address: str, *, north: str = "true", **options: Any) -> None:
        self._sentences, self._north = Sentences(north, **options), north[0].upper()
        self._zero = time.time() - time.monotonic()  # the clock of the computer may be set in flight
        self.port = _Udp(int(address[4:])) if address.startswith("udp:") else _serial(address)

    def __iter__(self) -> Iterator[Measurement | None]:
        """Iterate over the sentences."""
        while True:
            lines = self.port.receive()
            if not lines:
                yield None
            for line in lines:
                yield from self._sentences.measurements(line, self._zero + time.monotonic())

    def steer(self, heading_deg: float) -> None:
        """Send a heading."""
        shown = f"{heading_deg % 360:.1f}"
        pair = f"{shown},T,,M" if self._north == "T" else f",T,{shown},M"
        self._send(f"{_TALKER}HSC,{pair}")
        course = f"{shown},{self._north}"
        self._send(f"{_TALKER}APB,A,A,0.00,R,N,V,V,{course},MAGRL,{course},{course}")

    def report(self, command: Command, text: str) -> None:
        """Send the estimated way and a text."""
        north, east = command.way_km
        end = command.stop or ""
        self._send(f"PMGRL,WAY,{north:.1f},{east:.1f},{command.error_km:.1f},{command.confidence:.2f},{end}")
        if text:
            self._send(f"{_TALKER}TXT,01,01,00,{re.sub('[,*$!~^]', ';', text)[:_TEXT]}")

    def _send(self, content: str) -> None:
        """Send a sentence with its checksum."""
        checksum = 0
        for byte in content.encode():
            checksum ^= byte
        self.port.send(f"${content}*{checksum:02X}\r\n".encode())


class _Udp:
    """Sentences as datagrams; answers go to the last sender."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("", port))
        self._socket.settimeout(_SILENCE_S)
        self.port = self._socket.getsockname()[1]
        self._sender: Any = None

    def receive(self) -> list[bytes]:
        try:
            content, self._sender = self._socket.recvfrom(65536)
        except TimeoutError:
            return []
        return content.splitlines()

    def send(self, content: bytes) -> None:
        if self._sender:
            self._socket.sendto(content, self._sender)

    def close(self) -> None:
        self._socket.close()


class _Serial:
    """Sentences of a serial port."""

    def __init__(self, port: Any) -> None:
        self._port = port

    def receive(self) -> list[bytes]:
        line = self._port.readline().strip()
        return [line] if line else []

    def send(self, content: bytes) -> None:
        self._port.write(content)

    def close(self) -> None:
        self._port.close()


def _serial(address: str) -> _Serial:
    name, _, baud = address.partition(",")
    return _Serial(package("serial", "pyserial").serial_for_url(name, baudrate=int(baud or 4800), timeout=_SILENCE_S))
