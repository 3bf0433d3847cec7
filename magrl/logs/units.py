"""Units in which vehicles log."""

from __future__ import annotations

from collections.abc import Mapping

FIELD_NT: Mapping[str, float] = {"nT": 1.0, "mG": 100.0, "uT": 1e3, "G": 1e5, "mT": 1e6, "T": 1e9}
"""Units of a magnetic field [nT]: nanotesla, milligauss, microtesla, gauss, millitesla, tesla."""


def guess_unit(length: float, total_nt: float) -> str | None:
    """Return the unit in which a field has a length, if it is not nanotesla; None where none fits within 40 %.

    Args:
        length: length of the vector, in an unknown unit.
        total_nt: total intensity that is known [nT].

    Example:
        >>> guess_unit(0.5, 50000.0), guess_unit(45000.0, 50000.0)
        ('G', None)
    """
    fitting = [unit for unit, size in FIELD_NT.items() if 0.6 < length * size / total_nt < 1.4]
    return fitting[0] if fitting and fitting[0] != "nT" else None
