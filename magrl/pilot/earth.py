"""A model of the Earth's field as prior knowledge: local coefficients at places, and how far the field is from them."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from magrl.field import IGRF
from magrl.field.elements import measured_elements
from magrl.field.igrf import Date, igrf_coefficients, parse_date
from magrl.field.model import FieldModel
from magrl.field.planets import gauss_moments
from magrl.geodesy import move_place
from magrl.pilot.harmonics import RADIUS, UNIT_KM, constant, turning
from magrl.pilot.local import COEFFICIENTS, carried_back, levers, slopes
from magrl.pilot.prior import DEGREE, Cells, cells, local_covariance

RINGS_KM = (80.0, 200.0, 350.0, 500.0)
"""Distances of the places to which local coefficients are fitted [km]; 12 in each ring, and the place itself."""
PLACES = 12_000
"""Number of places that are the prior where the vehicle does not know its own; an eighth of them gives the same on
random trips within .5 points."""
SPREAD_YEARS = 20.0
"""Least age of a model in the prior of a vehicle that knows no place [years]: places far apart are joined to one normal
distribution, which is too sure where the places that fit are few. Set on the trips of table
known, to the age of the model beside it."""
LEAST_NT = 20.0
"""Least standard deviation of the error of a model in each axis at the ground [nT]: currents above the Earth, and what
the crust has at long wavelengths; chosen."""
HIGHEST_LATITUDE = 78.0
"""Latitude up to which these are [deg]."""


class EarthModel:
    """A model of the Earth's field that a vehicle carries, with its error.

    Args:
        name: name in tables and messages.
        field: the model.
        variance: ``(14,)`` mean square error of its Gauss coefficients by degree [nT^2].

    Example:
        >>> earth_model("IGRF-13", "2025-01-01").name
        'IGRF-13'
    """

    def __init__(self, name: str, field: FieldModel, variance: Tensor) -> None:
        self.name, self.field, self.variance = name, field, variance
        self.error = local_covariance(variance, DEGREE)
        planets = local_covariance(gauss_moments()[2], DEGREE)
        degree = slice(8, COEFFICIENTS)  # what changes most along a leg
        self.share = float(self.error.diagonal()[degree].mean() / planets.diagonal()[degree].mean())
        self._cells: dict[bool, Cells] = {}

    @property
    def error_nt(self) -> float:
        """Root mean square error of the field [nT]."""
        return float(self.error.diagonal()[:3].sum().sqrt())

    def coefficients(self, place: Tensor) -> Tensor:
        """Return the local coefficients ``(..., K)`` at places ``(..., 2)`` latitude, longitude [deg].

        The field is exact there; the others are fitted by least squares to the field at 48 places around.
        """
        points, pull, fit = (part.to(place) for part in _fit())
        shape, place = place.shape[:-1], place.reshape(-1, 1, 2)
        bearing, distance = torch.atan2(points[:, 1], points[:, 0]), points.norm(dim=-1)
        there = move_place(place.expand(-1, len(points), 2), bearing.expand(len(place), -1), distance)
        field = self.field(*there.reshape(-1, 2).unbind(-1)).to(place).reshape(len(place), len(points), 3)
        carried = carried_back(field, place[:, 0, 0], (points / UNIT_KM).expand(len(place), -1, 2))
        own = carried[:, 0]
        rest = (carried[:, 1:].flatten(1) - own @ pull.mT) @ fit.mT
        return torch.cat((own, rest), -1).reshape(*shape, COEFFICIENTS)

    def elements(self, place: Tensor) -> Tensor:
        """Return D, I [deg], B_H [nT] ``(..., 3)`` at places ``(..., 2)``."""
        return measured_elements(self.field(*place.unbind(-1)))

    def cells(self, magnetic: bool = False) -> Cells:
        """Return places all over the Earth as the prior of a vehicle that knows none.

        Each is a normal distribution as wide as its share of the surface.

        Args:
            magnetic: whether axes are from magnetic north.
        """
        if magnetic not in self._cells:
            self._cells[magnetic] = self._make_cells(magnetic)
        return self._cells[magnetic]

    def _make_cells(self, magnetic: bool) -> Cells:
        share = torch.quasirandom.SobolEngine(2, scramble=True, seed=0).draw(PLACES, dtype=torch.float64)
        top = math.sin(math.radians(HIGHEST_LATITUDE))
        latitude = torch.rad2deg(torch.asin((2 * share[:, 0] - 1) * top))
        place = torch.stack((latitude, 360 * share[:, 1] - 180), -1)
        mean = torch.cat([self.coefficients(some) for some in place.split(2000)])
        jacobian = slopes(mean, place)
        area = 4 * math.pi * (RADIUS * UNIT_KM) ** 2 * top / PLACES
        north = torch.zeros_like(jacobian[:, :1])
        north[..., 0] = 1 / (RADIUS * UNIT_KM)  # radians of latitude
        lever = torch.cat((jacobian, north), -2)
        error = local_covariance(torch.maximum(self.variance, secular_variance(SPREAD_YEARS)), DEGREE)
        joint = lever @ lever.mT * (area / 12) + torch.nn.functional.pad(error, (0, 1, 0, 1))
        if magnetic:
            level = torch.hypot(mean[:, 0], mean[:, 1])
            turn = turning(mean[:, 0] / level, -mean[:, 1] / level, DEGREE)
            mean = (turn @ mean.unsqueeze(-1)).squeeze(-1)
            turn = torch.nn.functional.pad(turn, (0, 1, 0, 1))
            turn[:, -1, -1] = 1.0
            joint = turn @ joint @ turn.mT
        return cells(torch.deg2rad(latitude), torch.ones(PLACES, dtype=torch.float64), mean, joint)


@constant
def _fit() -> tuple[Tensor, Tensor, Tensor]:
    """Return the places ``(P, 2)`` [km] of the fit, what the field at the middle adds to the others ``(3 (P - 1), 3)``,
    and the pseudoinverse for the other coefficients ``(K - 3, 3 (P - 1))``."""
    angle = torch.arange(12, dtype=torch.float64) / 12 * 2 * math.pi
    ring = torch.tensor(RINGS_KM, dtype=torch.float64)
    around = (ring[:, None, None] * torch.stack((angle.cos(), angle.sin()), -1)).reshape(-1, 2)
    points = torch.cat((torch.zeros(1, 2, dtype=torch.float64), around))
    rows = levers(around / UNIT_KM)  # (P - 1, 3, K)
    weight = 1 / (2 + 17.5 * (around.norm(dim=-1) / UNIT_KM) ** 3)
    weighted = (rows[..., 3:] * weight[:, None, None]).flatten(0, 1)
    fit = torch.linalg.pinv(weighted) * weight.repeat_interleave(3)
    return points, rows[..., :3].flatten(0, 1), fit


@constant
def _history() -> tuple[Tensor, Tensor]:
    """Return the epochs of IGRF-14 and its coefficients ``(Y, N, N)`` there."""
    years = torch.arange(1900, 2026, 5)
    return years, torch.stack([igrf_coefficients(f"{year}-01-01") for year in years.tolist()])


def secular_variance(years: float, predicted: bool = False) -> Tensor:
    """Return the mean square change of the Gauss coefficients ``(14,)`` by degree [nT^2] over some years.

    It is measured on the history of IGRF-14 since 1900: over 5 years, times the square of the years over 5; or, where
    the change is predicted, the error of linear predictions since 1980, times the fourth power.

    Args:
        years: age of a model.
        predicted: whether the model predicts the change, as IGRF does for the five years after its last epoch.

    Example:
        >>> bool(secular_variance(20.0)[1] > secular_variance(5.0)[1])
        True
    """
    epochs, gauss = _history()
    change = gauss[1:] - gauss[:-1]
    if predicted:
        change = (change[1:] - change[:-1])[epochs[2:] > 1985]
    square = change.abs().square().mean(0).sum(-1)
    degree = torch.arange(len(square), dtype=torch.float64)
    return square / (2 * degree + 1) * (years / 5) ** (4 if predicted else 2)


NEWEST = "IGRF-14"
"""Newest model that ships with the library."""
_LAST = {"IGRF-13": 2020.0, "IGRF-14": 2025.0}  # epochs after which the change is predicted


def _at_the_ground(variance: Tensor) -> Tensor:
    """Return mean square errors of Gauss coefficients by degree, scaled so that the field's error is not below
    :data:`LEAST_NT`."""
    square = local_covariance(variance, DEGREE).diagonal()[:3].mean()
    return variance * (LEAST_NT**2 / square).clamp_min(1)


@lru_cache(maxsize=8)
def _model(name: str, year: float, altitude_km: float) -> EarthModel:
    if name in _LAST:
        ahead = max(year - _LAST[name], 0.5)
        if ahead > 5:
            raise ValueError(f"model {name} is valid to {_LAST[name] + 5:.0f}, not in {year:.1f}: give a newer one")
        return EarthModel(
            name,
            IGRF(year, generation=int(name[-2:]), altitude_km=altitude_km),
            _at_the_ground(secular_variance(ahead, predicted=True)),
        )
    date = float(name.removeprefix("IGRF-"))
    return EarthModel(
        name, IGRF(date, altitude_km=altitude_km), _at_the_ground(secular_variance(max(year - date, 0.5)))
    )


def earth_model(model: EarthModel | str, date: Date, altitude_km: float = 0.0) -> EarthModel:
    """Return a model of the Earth as a vehicle carries it at a date.

    Args:
        model: ``"IGRF-14"`` (:data:`NEWEST`) or ``"IGRF-13"``, at the date; ``"IGRF-2005"``, as of a year, without any
            later change; or a model of one's own.
        date: date of the flight.
        altitude_km: its altitude above the ellipsoid.

    Raises:
        ValueError: for an unknown name, or a date that a model does not cover.

    Example:
        >>> [round(earth_model(name, "2025-01-01").error_nt) for name in ("IGRF-14", "IGRF-13", "IGRF-2005")]
        [35, 110, 1601]
    """
    if isinstance(model, EarthModel):
        return model
    moment = parse_date(date)
    year = moment.year + (moment.timetuple().tm_yday - 1) / 365.25
    if model not in _LAST and not (model[:5] == "IGRF-" and model[5:].isdigit() and 1900 <= int(model[5:]) <= year):
        raise ValueError(f"model {model!r} must be {', '.join(_LAST)}, or IGRF- and a year from 1900 to {year:.0f}")
    return _model(model, year, float(altitude_km))
