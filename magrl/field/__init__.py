"""Models of the geomagnetic field: IGRF, WMMHR, spherical harmonics, and fast regional expansions of each."""

from magrl.field.bank import FieldBank
from magrl.field.igrf import IGRF, Date, igrf_coefficients, parse_date
from magrl.field.model import FieldModel, elements_at, elements_gradient_at, elements_range
from magrl.field.planets import random_planets
from magrl.field.records import WEATHER, WeatherRecord, weather_record
from magrl.field.regional import RegionalField
from magrl.field.spherical import SphericalHarmonicField
from magrl.field.wmmhr import WMMHR, wmmhr_coefficients

__all__ = [
    "IGRF",
    "WEATHER",
    "WMMHR",
    "Date",
    "FieldBank",
    "FieldModel",
    "RegionalField",
    "SphericalHarmonicField",
    "WeatherRecord",
    "elements_at",
    "elements_gradient_at",
    "elements_range",
    "igrf_coefficients",
    "parse_date",
    "random_planets",
    "weather_record",
    "wmmhr_coefficients",
]
