"""Models of the geomagnetic field: IGRF, spherical harmonic expansions, and fast regional expansions of either."""

from magrl.field.bank import FieldBank
from magrl.field.igrf import IGRF, Date, igrf_coefficients, parse_date
from magrl.field.model import FieldModel, elements_at, elements_gradient_at, elements_range
from magrl.field.planets import random_planets
from magrl.field.regional import RegionalField
from magrl.field.spherical import SphericalHarmonicField

__all__ = [
    "IGRF",
    "Date",
    "FieldBank",
    "FieldModel",
    "RegionalField",
    "SphericalHarmonicField",
    "elements_at",
    "elements_gradient_at",
    "elements_range",
    "igrf_coefficients",
    "parse_date",
    "random_planets",
]
