"""Units in which vehicles log, and the names of columns."""

from __future__ import annotations

import re
from collections.abc import Mapping

from magrl.field.elements import FIELD_NT

EARTH_NT = 48000.0
"""Total intensity of the Earth's field, within 45 %."""
SYMBOLS = {"nt": "nanotesla", "mg": "milligauss", "ut": "microtesla", "µt": "microtesla", "g": "gauss"}
SYMBOLS |= {"mt": "millitesla", "t": "tesla"}
UNITS: Mapping[str, Mapping[str, float]] = {
    "field": FIELD_NT | {symbol: FIELD_NT[unit] for symbol, unit in SYMBOLS.items()},
    "angle": {"deg": 1.0, "rad": 57.29577951308232},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "utc": 1.0},
    "speed": {"m_s": 1.0, "mps": 1.0, "km_h": 1 / 3.6, "kmh": 1 / 3.6, "kn": 1852 / 3600, "kt": 1852 / 3600},
    "length": {"km": 1.0, "m": 1e-3, "nmi": 1.852},
}
"""Suffixes of a column, in nanotesla, degrees, seconds, meters per second and kilometers."""
COLUMNS: Mapping[str, tuple[str, str, str]] = {
    "time": ("time", r"t|time(stamp)?|date_?time|utc", "s"),
    "x": ("field", r"(mag|magnetometer|b|m)?_?x", "nt"),
    "y": ("field", r"(mag|magnetometer|b|m)?_?y", "nt"),
    "z": ("field", r"(mag|magnetometer|b|m)?_?z", "nt"),
    "roll": ("angle", "roll", "deg"),
    "pitch": ("angle", "pitch", "deg"),
    "heading": ("angle", r"(true_|mag(netic)?_)?(heading|hdg|yaw)(_true|_mag(netic)?)?", "deg"),
    "speed": ("speed", r"speed|stw|sog", ""),
    "distance": ("length", r"distance", "km"),
    "latitude": ("angle", r"lat(itude)?", "deg"),
    "longitude": ("angle", r"lon(gitude)?|lng", "deg"),
    "altitude": ("length", r"alt(itude)?|depth", "m"),
}
"""Columns of the samples of a log: kind of the unit, names (a regular expression), and the unit without a suffix.

A speed has no such unit. A depth is a negative altitude.
"""


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
    name = re.sub(r"[^a-z0-9µ]+", "_", header.lower()).strip("_")
    for column, (kind, names, usual) in COLUMNS.items():
        units = "|".join(sorted(UNITS[kind], key=len, reverse=True))
        if match := re.fullmatch(rf"(?P<name>{names})(_(?P<unit>{units}))?", name):
            unit = match["unit"] or usual
            if not unit:
                raise ValueError(f"column {header!r} has no unit: name it, such as speed_m_s, speed_km_h or speed_kn")
            return column, UNITS[kind][unit] * (-1 if match["name"] == "depth" else 1)
    return None


def guess_unit(length: float, total_nt: float) -> str | None:
    """Return the unit in which a field has a length, if it is not nanotesla; None where none fits within 45 %.

    Args:
        length: length of the vector, in an unknown unit.
        total_nt: known total intensity [nT].

    Example:
        >>> guess_unit(0.5, 50000.0), guess_unit(45000.0, 50000.0)
        ('gauss', None)
    """
    fitting = [unit for unit, size in FIELD_NT.items() if 0.55 < length * size / total_nt < 1.45]
    return fitting[0] if fitting and fitting[0] != "nanotesla" else None


def intensity_mistake(total: float) -> str | None:
    """Return what is wrong with a total intensity that is not the Earth's, as a sentence with the remedy.

    Args:
        total: median total intensity of a log [nT].

    Example:
        >>> intensity_mistake(48.0)
        'the total intensity is 48, which looks like microtesla: name the columns mag_x_microtesla, ...'
    """
    if unit := guess_unit(total, EARTH_NT):
        return f"the total intensity is {total:g}, which looks like {unit}: name the columns mag_x_{unit}, ..."
    if 0.25 < total / EARTH_NT < 4:
        return None
    return (
        f"the total intensity is {total:g}, where about {EARTH_NT:.0f} nT are expected: scale raw counts to nanotesla"
    )
