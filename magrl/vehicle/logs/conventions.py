"""Conventions of logs: units and names of columns, the north of headings, axes and attitudes.

The vehicle's axes are forward, right, down (FRD), the world's north, east, down (NED). Roll (right side down), pitch
(nose up) and heading (clockwise) turn the world's axes into the vehicle's in the order heading, pitch, roll (ZYX).
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from magrl.checks import check_tensor, short
from magrl.field import IGRF
from magrl.field.elements import FIELD_NT, field_vector, measured_elements

Array = NDArray[np.float64]

NORTHS = ("true", "magnetic", "model")
"""North of a heading: of a gyrocompass, of a compass, or of a compass that adds the declination of a model."""
EARTH_NT = 48000.0
"""Total intensity of the Earth's field, within 45 %."""
SYMBOLS = {"nt": "nanotesla", "mg": "milligauss", "ut": "microtesla", "μt": "microtesla", "g": "gauss"}
SYMBOLS |= {"mt": "millitesla", "t": "tesla"}
_KNOTS = ("kn", "kt", "kts", "knots")
UNITS: Mapping[str, Mapping[str, float]] = {
    "field": FIELD_NT | {symbol: FIELD_NT[unit] for symbol, unit in SYMBOLS.items()},
    "angle": {"deg": 1.0, "rad": 57.29577951308232, "degrees": 1.0, "radians": 57.29577951308232},
    "time": {"s": 1.0, "ms": 1e-3, "sec": 1.0, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "utc": 1.0},
    "speed": {"m_s": 1.0, "mps": 1.0, "km_h": 1 / 3.6, "kmh": 1 / 3.6, **dict.fromkeys(_KNOTS, 1852 / 3600)},
    "length": {"km": 1.0, "m": 1e-3, "nmi": 1.852, "ft": 3.048e-4},
}
"""Suffixes of a column, in the first unit of each kind: nanotesla, degrees, seconds, meters per second, kilometers."""
_ANY, _ROUNDING = (-math.inf, math.inf), 1e-3
COLUMNS: Mapping[str, tuple[str, str, str, float, float]] = {
    "time": ("time", r"t|time(stamp)?|date_?time|utc", "s", -4.1e9, 4.1e9),  # up to the year 2099
    "x": ("field", r"(mag|magnetometer|b|m)?_?x", "nt", *_ANY),
    "y": ("field", r"(mag|magnetometer|b|m)?_?y", "nt", *_ANY),
    "z": ("field", r"(mag|magnetometer|b|m)?_?z", "nt", *_ANY),
    "roll": ("angle", "roll", "deg", -360, 360),
    "pitch": ("angle", "pitch", "deg", -90, 90),
    "heading": ("angle", r"(true_|mag(netic)?_)?(heading|hdg|yaw)(_true|_mag(netic)?)?", "deg", *_ANY),
    "speed": ("speed", r"speed|stw|sog", "", -12000, 12000),
    "distance": ("length", r"distance", "km", 0, 40000),
    "latitude": ("angle", r"lat(itude)?", "deg", -90, 90),
    "longitude": ("angle", r"lon(gitude)?|lng", "deg", -360, 360),
    "altitude": ("length", r"alt(itude)?|depth", "m", *IGRF.altitude_range_km),
}
"""Columns of the samples of a log: kind of the unit, names (a regular expression), the unit without a suffix, and the
least and the greatest value. A speed has no such unit. A depth is a negative altitude."""
_PATTERNS = {
    name: re.compile(f"(?P<name>{names})(_(?P<unit>{'|'.join(UNITS[kind])}))?")
    for name, (kind, names, *_) in COLUMNS.items()
}


def unit_of(header: str, kind: str) -> float | None:
    """Return the unit that ends a header, as a factor to the first one of its kind; None where none does.

    Example:
        >>> unit_of("alt_km", "length"), unit_of("dip (rad)", "angle"), unit_of("altitude", "length")
        (1.0, 57.29577951308232, None)
    """
    name = _plain(header)
    return next((size for unit, size in UNITS[kind].items() if name.endswith(f"_{unit}")), None)


def _plain(header: str) -> str:
    """Return a header in lower case, with underscores between words and one of the two characters for micro."""
    return re.sub(r"[^a-z0-9μ]+", "_", unicodedata.normalize("NFKC", header).lower()).strip("_")


def column_of(header: str) -> tuple[str, float] | None:
    """Return the column that a header names, and the factor to its unit; None for another header.

    Args:
        header: such as ``mag_x_uT``, ``Heading [deg]`` or ``speed_kn``.

    Raises:
        ValueError: for a speed without a unit.

    Example:
        >>> column_of("mag_x_uT"), column_of("Heading [rad]"), column_of("battery_V")
        (('x', 1000.0), ('heading', 57.29577951308232), None)
    """
    name = _plain(header)
    for column, (kind, _, usual, *_) in COLUMNS.items():
        if match := _PATTERNS[column].fullmatch(name):
            if not (unit := match["unit"] or usual):
                raise ValueError(f"column {short(header)} has no unit: name it speed_m_s, speed_km_h or speed_kn")
            return column, UNITS[kind][unit] * (-1 if match["name"] == "depth" else 1)
    return None


def check_range(name: str, values: Array) -> None:
    """Raise unless all values of a column are possible.

    Args:
        name: one of :data:`COLUMNS`, or another angle.
        values: in the units of the samples of a log.

    Raises:
        ValueError: with the first value that is not possible, and its unit.

    Example:
        >>> check_range("pitch", np.array([2.0, 200.0]))
        Traceback (most recent call last):
        ValueError: pitch 200 is not from -90 to 90 deg: check it and its unit, as in pitch_rad
    """
    kind, _, _, low, high = COLUMNS.get(name, ("angle", "", "", *_ANY))
    wrong = values[(values < low - _ROUNDING) | (values > high + _ROUNDING)]
    if len(wrong):
        unit, other, *_ = UNITS[kind]
        limits = f"{name} {wrong[0]:.10g} is not from {low:g} to {high:g} {unit}"
        raise ValueError(f"{limits}: check it and its unit, as in {name}_{other}")


def check_intensity(total: float, expected: float = EARTH_NT) -> None:
    """Raise unless a total intensity is within 45 %, or within a factor of 4 and in no other unit.

    Args:
        total: median total intensity of a log, in an unknown unit.
        expected: total intensity at its place [nT], by default the Earth's.

    Raises:
        ValueError: with the unit that it probably has, also where a format states tesla.

    Example:
        >>> check_intensity(48.0)
        Traceback (most recent call last):
        ValueError: the total intensity is 48, which looks like microtesla: name the columns mag_x_microtesla, ...
    """
    ratio = total / expected
    unit = next((unit for unit, size in FIELD_NT.items() if 0.55 < ratio * size < 1.45), "")
    if unit == "nanotesla" or (not unit and 0.25 < ratio < 4):
        return
    looks = f"which looks like {unit}: name the columns mag_x_{unit}, ..."
    meant = next((unit for unit, size in FIELD_NT.items() if 0.55 < ratio * size / FIELD_NT["tesla"] < 1.45), "")
    if meant:
        raise ValueError(
            f"the topic of the field is in {meant}, where ROS states tesla: convert it to tesla in the bag"
        )
    raw = f"where about {expected:.0f} nT are expected: scale raw counts to nanotesla"
    raise ValueError(f"the total intensity is {total:g}, {looks if unit else raw}")


# Axes and attitudes


def rotation(attitude_deg: Tensor) -> Tensor:
    """Return the rotation from the vehicle's axes to the world's.

    Args:
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg].

    Returns:
        ``(..., 3, 3)``: forward, right, down to north, east, down, if the heading is from true north.

    Example:
        >>> (rotation(torch.tensor([0.0, 0.0, 90.0])) @ torch.tensor([1.0, 0.0, 0.0])).round()  # forward is east
        tensor([-0., 1., 0.])
    """
    check_tensor(3, attitude_deg=attitude_deg)
    (sr, sp, sh), (cr, cp, ch) = (f(torch.deg2rad(attitude_deg)).unbind(-1) for f in (torch.sin, torch.cos))
    north = cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh
    east = cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch
    return torch.stack((*north, *east, -sp, sr * cp, cr * cp), -1).unflatten(-1, (3, 3))


def attitude_of(quaternion: Tensor) -> Tensor:
    """Return roll, pitch, heading [deg] ``(..., 3)`` of a rotation from the vehicle's axes to the world's.

    Args:
        quaternion: ``(..., 4)`` w, x, y, z, of any length.

    Example:
        >>> attitude_of(torch.tensor([1.0, 0.0, 0.0, 1.0])).round()
        tensor([ 0., 0., 90.])
    """
    check_tensor(4, quaternion=quaternion)
    w, x, y, z = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(-1)
    roll = torch.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = torch.asin((2 * (w * y - x * z)).clamp(-1, 1))
    heading = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return torch.rad2deg(torch.stack((roll, pitch, heading), -1))


def from_enu(attitude_deg: Tensor) -> Tensor:
    """Return the attitude in FRD and NED of one in FLU and east, north, up (ROS, REP 103), and the reverse.

    Args:
        attitude_deg: ``(..., 3)`` roll, pitch (nose down), yaw (counterclockwise from east) [deg].

    Example:
        >>> from_enu(torch.tensor([1.0, 2.0, 90.0]))
        tensor([ 1., -2., 0.])
    """
    check_tensor(3, attitude_deg=attitude_deg)
    roll, pitch, yaw = attitude_deg.unbind(-1)
    return torch.stack((roll, -pitch, 90 - yaw), -1)


def elements_of_axes(axes_nt: Tensor, attitude_deg: Tensor) -> Tensor:
    """Return D [deg], I [deg], B_H [nT] ``(..., 3)`` of three axes and an attitude.

    D is from the north of the heading: it is the field's if this is true north.

    Args:
        axes_nt: ``(..., 3)`` the field forward, right, down [nT].
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg].

    Example:
        >>> elements_of_axes(torch.tensor([0.0, -20000.0, 40000.0]), torch.tensor([0.0, 0.0, 90.0])).round()
        tensor([    0.,    63., 20000.])
    """
    check_tensor(3, axes_nt=axes_nt)
    return measured_elements((rotation(attitude_deg) @ axes_nt.unsqueeze(-1)).squeeze(-1))


def axes_of_elements(elements: Tensor, attitude_deg: Tensor) -> Tensor:
    """Return the field along the vehicle's axes [nT] ``(..., 3)``: the inverse of :func:`elements_of_axes`.

    Args:
        elements: ``(..., 3)`` D [deg], I [deg, inside (-90, 90)], B_H [nT].
        attitude_deg: ``(..., 3)`` roll, pitch, heading [deg], the heading from the north of D.

    Example:
        >>> axes_of_elements(torch.tensor([0.0, 0.0, 20000.0]), torch.tensor([0.0, 0.0, 90.0])).round()
        tensor([ -0., -20000., 0.])
    """
    return (rotation(attitude_deg).mT @ field_vector(elements).unsqueeze(-1)).squeeze(-1)
