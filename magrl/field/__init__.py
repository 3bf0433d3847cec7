"""Models of the geomagnetic field: IGRF, WMMHR, spherical harmonics, and fast regional expansions of each."""

from magrl.field.bank import FieldBank as FieldBank
from magrl.field.igrf import IGRF as IGRF
from magrl.field.igrf import Date as Date
from magrl.field.igrf import igrf_coefficients as igrf_coefficients
from magrl.field.igrf import parse_date as parse_date
from magrl.field.model import FieldModel as FieldModel
from magrl.field.model import elements_at as elements_at
from magrl.field.model import elements_gradient_at as elements_gradient_at
from magrl.field.model import elements_range as elements_range
from magrl.field.planets import random_planets as random_planets
from magrl.field.regional import RegionalField as RegionalField
from magrl.field.spherical import SphericalHarmonicField as SphericalHarmonicField
from magrl.field.weather import WEATHER as WEATHER
from magrl.field.weather import WeatherRecord as WeatherRecord
from magrl.field.weather import weather_record as weather_record
from magrl.field.wmmhr import WMMHR as WMMHR
from magrl.field.wmmhr import wmmhr_coefficients as wmmhr_coefficients
