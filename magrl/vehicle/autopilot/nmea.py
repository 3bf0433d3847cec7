"""NMEA 0183: the link to the autopilot of a ship, over UDP or a serial port."""

from __future__ import annotations

import logging
import math
import socket
from collections.abc import Iterator, Sequence
from typing import Any

from magrl.checks import check_choice
from magrl.vehicle.autopilot.loop import LOG, SILENT_S, Measurement, clock, patient
from magrl.vehicle.logs.autopilots import INVALID, nmea_values, package
from magrl.vehicle.logs.samples import AXES
from magrl.vehicle.onboard import Command

_TALKER = "EC"  # an electronic chart system
_SILENCE_S = 1.0
_QUANTITIES = ("heading", "roll", "pitch", "speed", *AXES)


class Sentences:
    """Turn sentences of NMEA 0183 into measurements.

    Args:
        north: ``"true"`` (HDT, THS) or ``"magnetic"`` (HDG, HDM).
        speed: ``"water"`` (VHW) or ``"ground"`` (VTG).
        level: whether roll and pitch are 0, as of a magnetometer in gimbals; otherwise they must come by XDR.
        sources: talkers and sentences that count, such as ``"HEHDT"``; by default all. Of each value, the first source
            counts, and another one where that is silent.

    Raises:
        ImportError: without pynmeagps.
        ValueError: for an unknown option.

    Example:
        >>> list(Sentences().measurements(b"$HEHDT,290.0,T*24", time=5.0))[0].heading
        290.0
    """

    def __init__(
        self, north: str = "true", speed: str = "water", level: bool = False, sources: Sequence[str] = ()
    ) -> None:
        check_choice(("true", "magnetic"), north=north)
        check_choice(("water", "ground"), speed=speed)
        self._reader = package("pynmeagps", "pynmeagps").NMEAReader
        self._names = {name: name for name in _QUANTITIES} | {f"heading_{north}": "heading", f"speed_{speed}": "speed"}
        self._sources, self._tilt = sources, {"roll": 0.0, "pitch": 0.0} if level else {}
        self._chosen: dict[str, tuple[str, float]] = {}  # source of the quantities, and when it was heard

    def measurements(self, line: bytes, time: float) -> Iterator[Measurement]:
        """Yield the content of a sentence that came at a time [s]; nothing for a damaged one, or another kind."""
        try:
            message = self._reader.parse(line)
        except Exception:  # whatever the package raises for a foreign sentence
            return
        if message is None or any(getattr(message, field, None) in values for field, values in INVALID.items()):
            return
        found = {self._names[name]: value for name, value in nmea_values(message).items() if name in self._names}
        source = f"{message.talker}{message.msgID}"
        if self._sources and source not in self._sources:
            return
        values = {name: value for name, value in found.items() if self._counts(name, source, time)}
        axes = [name for name in AXES if name in values]
        if values and len(axes) in (0, len(AXES)):
            yield Measurement(time, **(self._tilt | values if axes else values))

    def _counts(self, name: str, source: str, time: float) -> bool:
        """Return whether a source of a quantity counts: the first one, or another one where that is silent."""
        chosen, heard = self._chosen.get(name, ("", -math.inf))
        if chosen != source:
            if time - heard <= SILENT_S:
                return False
            silent = f", as {chosen} is silent" if chosen else ""
            LOG.log(logging.WARNING if chosen else logging.INFO, f"{name} from {source}{silent}")
        self._chosen[name] = source, time
        return True


class NmeaLink:
    """Connection to instruments and the autopilot of a ship.

    It reads HDT, THS, HDG or HDM, VHW, VBW or VTG, and XDR with the axes of the magnetometer (names such as
    ``MAG_X_NT``) and PTCH and ROLL. It sends HSC and APB with the heading to steer, and ``$PMGRL`` with the
    displacement northward and eastward [km], its error [km], the confidence, and why to stop. A message has its
    time of receipt.

    Args:
        address: ``"udp:10110"``, the port at which sentences arrive and to the sender of the last one that counts the
            answers go; or a serial port and its rate, such as ``"/dev/ttyUSB0,38400"``.
        north: as of :class:`Sentences`.
        options: of :class:`Sentences`.

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
        self.port: Any
        self.port = _Udp(int(address[4:])) if address.startswith("udp:") else _serial(address)

    def __iter__(self) -> Iterator[Measurement | None]:
        """Iterate over the sentences."""
        for content in patient(lambda: self.port.readline()):
            now = clock()
            found = [each for line in (content or b"").splitlines() for each in self._sentences.measurements(line, now)]
            if found and isinstance(self.port, _Udp):
                self.port.receiver = self.port.sender
            yield from found
            if not found:
                yield None

    def steer(self, heading_deg: float) -> None:
        """Send a heading."""
        shown = f"{heading_deg % 360:.1f}"
        pair = f"{shown},T,,M" if self._north == "T" else f",T,{shown},M"
        self._send(f"{_TALKER}HSC,{pair}")
        course = f"{shown},{self._north}"
        self._send(f"{_TALKER}APB,A,A,0.00,R,N,V,V,{course},MAGRL,{course},{course}")

    def report(self, command: Command) -> None:
        """Send the estimated displacement."""
        north, east = command.way_km
        way = f"{north:.1f},{east:.1f},{command.error_km:.1f},{command.confidence:.2f},{command.stop or ''}"
        self._send(f"PMGRL,WAY,{way}")

    def _send(self, content: str) -> None:
        """Send a sentence with its checksum."""
        checksum = package("pynmeagps", "pynmeagps").calc_checksum(content)
        self.port.write(f"${content}*{checksum}\r\n".encode())


class _Udp:
    """Sentences as datagrams, with the interface of pyserial; answers go to a receiver."""

    def __init__(self, port: int) -> None:
        self.sender: Any = None
        self.receiver: Any = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("", port))
        self._socket.settimeout(_SILENCE_S)
        self.port = self._socket.getsockname()[1]

    def readline(self) -> bytes:
        try:
            content, self.sender = self._socket.recvfrom(65536)
        except TimeoutError:
            return b""
        return content

    def write(self, content: bytes) -> None:
        if self.receiver:
            self._socket.sendto(content, self.receiver)

    def close(self) -> None:
        self._socket.close()


def _serial(address: str) -> Any:
    name, _, baud = address.partition(",")
    return package("serial", "pyserial").serial_for_url(name, baudrate=int(baud or 4800), timeout=_SILENCE_S)
