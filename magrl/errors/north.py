"""Error of the north reference: its effect on heading and declination, and units on the market."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn.functional import pad

from magrl.checks import check_choice, check_number
from magrl.errors.base import EpisodeErrors, ReadingErrors, gauss_markov
from magrl.errors.magnetic_north import MagneticNorth
from magrl.geodesy import wrap_angle, wrap_longitude
from magrl.random_numbers import stream_normal
from magrl.sensor_std import SensorStd
from magrl.transforms.base import Keys
from magrl.transforms.episode import Episode

MAGNETIC = "magnetic"
"""North of a vehicle without a true-north reference."""

SCHULER_HOURS = 1.407
"""Period of a gyrocompass's slow oscillation, 84.4 minutes (M. Schuler, Physikalische Zeitschrift 24, 1923)."""

NORTH_REFERENCES: Mapping[str, Mapping[str, float]] = {
    "fiber-optic": {"constant_deg": 0.1},
    "marine": {"constant_deg": 0.375, "drift_deg": 0.125, "random_deg": 0.25},
    "low-cost": {"constant_deg": 0.5, "random_deg": 0.75},
}
"""Standard deviations, chosen in the size of units on the market. We take a standard's limit as two of them; we did
not read the documents.

- ``fiber-optic``: 0.1° times the secant of the latitude, as of the fiber-optic gyrocompass Octans; all of it taken as
  constant, the worst case for D.
- ``marine``: as IMO Resolution A.424(XI), Performance standards for gyro-compasses (1979), times the secant of the
  latitude: settle point error up to 0.75°; residual steady-state error after the correction for speed and course up to
  0.25°, taken as the drift; root mean square of single indications 0.25°.
- ``low-cost``: as IMO Resolution MSC.116(73), Performance standards for marine transmitting heading devices (2000), for
  ships too small to carry a gyrocompass: static error up to 1.0°, dynamic error up to 1.5°, at all latitudes.
"""


_STEEPEST_DEG = 82.0  # inclination of a dipole at a latitude of 74 degrees


class NorthReferenceError(ReadingErrors):
    """Measure directions from the vehicle's own north, which lies at an error b clockwise of true north.

    Every direction that the vehicle measures is smaller by b: its ``heading`` and D. A vehicle that steers a measured
    heading therefore moves along that heading plus b, in a world whose D is smaller by b.

    b has a constant part, a drift (first-order Gauss-Markov) and a part that is new at each reading, each normal, cut
    at four standard deviations. The measured ``heading`` takes the place of the true one, which is kept in
    ``true_heading`` and given back to the environment for its step. ``sensor_std`` of D grows by the random part,
    ``bias_std`` by the others, and ``drift_std`` by the drift. A vehicle does not know its latitude: where b grows with
    the latitude, these grow with that at which the field of a dipole has the inclination that the vehicle reads.

    It stands after the transforms of the field's errors, and after those that read the true heading.

    Args:
        constant_deg: standard deviation of the constant part [deg].
        drift_deg: standard deviation of the drift [deg].
        random_deg: standard deviation of the random part [deg].
        drift_length_km: correlation length of the drift, with ``drift_deg`` alone [km].
        fixed: whether ``constant_deg`` is the constant part itself, in every episode; it may then be negative.
        in_keys: heading ``(..., 1)`` [rad], elements ``(..., 3)`` with D [deg] first, the last leg, whose first number
            is the distance [km], and optionally the position ``(..., 2)``, latitude and longitude [deg]: b then grows
            with the secant of the latitude, as with every gyrocompass.
        out_keys: the heading and the elements that the vehicle reads, in place by default.
        **options: ``seed`` of :class:`~magrl.errors.base.ReadingErrors`. The errors of the
            episode are constant part, drift and b itself [deg].

    Raises:
        ValueError: for a negative size, a drift without its length, or another number of keys.
        KeyError: for a step from a TensorDict without the true heading.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> error = NorthReferenceError(2.0, fixed=True)
        >>> state = TransformedEnv(GeomagneticNavEnv(num_envs=1, seed=0), error).reset()
        >>> state["heading"].rad2deg().round(), (state["field"] - state["true_field"])[0, 0].round()
        (tensor([[-2.]]), tensor(-2.))
    """

    channel, changes_inclination = 3, False
    true_keys = ("true_field", "true_heading")
    hidden = {"heading": "true_heading"}
    default_in_keys = ("heading", "field", "leg")
    default_out_keys = ("heading", "field")
    optional_in_keys = ("position",)
    numbers_key, stream_key = "north_error", "north_stream"
    in_sizes = {"heading": (1,), "field": (3,), "position": (2,)}
    size, draws, step_draws = 3, 1, 2

    def __init__(
        self,
        constant_deg: float = 0.0,
        drift_deg: float = 0.0,
        random_deg: float = 0.0,
        *,
        drift_length_km: float | None = None,
        fixed: bool = False,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        **options: Any,
    ) -> None:
        super().__init__(in_keys, out_keys, **options)
        self.out_keys: list[NestedKey] = self.in_keys[:2] if out_keys is None else self.out_keys
        check_number(-math.inf if fixed else 0, constant_deg=constant_deg)
        check_number(0, drift_deg=drift_deg, random_deg=random_deg)
        check_number(0, above=True, optional=not drift_deg, drift_length_km=drift_length_km)
        self.sizes, self.drift_length_km = (constant_deg, drift_deg, random_deg), float(drift_length_km or 1)
        self.fixed = fixed
        self._set_accuracy()

    @classmethod
    def from_options(cls, options: Any, speed_km_h: float, seed: int = 0) -> EpisodeErrors:
        """Return the error with options by name, of a unit of :data:`NORTH_REFERENCES`, or of a compass alone.

        Args:
            options: options; name of a unit; or :data:`MAGNETIC` for a :class:`~magrl.errors.MagneticNorth`.
            speed_km_h: speed of the vehicle [km/h].
            seed: seed of the errors.

        Raises:
            ValueError: for an unknown unit, or as for other errors.

        Example:
            >>> NorthReferenceError.from_options("marine", 24.0).sizes
            (0.375, 0.125, 0.25)
        """
        if not isinstance(options, str):
            return super().from_options(options, speed_km_h, seed)
        check_choice((MAGNETIC, *NORTH_REFERENCES), north=options)
        return MagneticNorth() if options == MAGNETIC else north_reference(options, speed_km_h=speed_km_h, seed=seed)

    # Data

    def _constants(self, stream: Tensor) -> Tensor:
        normal = stream_normal(stream, 1).to(torch.get_default_dtype())
        return pad(self.sizes[0] * (torch.ones_like(normal) if self.fixed else normal), (0, 2))

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        heading, field, leg, *position = values
        errors, stream, first = episode
        constant, drift, _ = errors.split(1, -1)
        walk, white = stream_normal(stream, 2).to(errors.dtype).split(1, -1)
        drift = gauss_markov(drift, self.sizes[1], math.inf if first else leg[..., :1], self.drift_length_km, walk)
        error = constant + drift + self.sizes[2] * white
        if position:
            error = error / torch.cos(torch.deg2rad(position[0][..., :1])).to(error.dtype)
        tensordict.set(self.true_keys[1], heading)
        tensordict.set(self.out_keys[0], wrap_angle(heading - torch.deg2rad(error)))
        declination = wrap_longitude(field[..., :1] - error)
        growth = _secant(field[..., 1:2]) if position else torch.ones_like(declination)
        accuracy = growth * self._accuracy.to(field.dtype).reshape(-1, *[1] * (field.ndim - 1), 3)
        self._measure(tensordict, field, torch.cat((declination, field[..., 1:]), -1), SensorStd(*accuracy))
        return torch.cat((constant, drift, error), -1)

    def accuracy(self, field: Tensor) -> SensorStd:
        """Return the standard deviations that the errors add to a reading, each ``(..., 3)``.

        Example:
            >>> NorthReferenceError(2.0, random_deg=1.0).accuracy(torch.zeros(3)).bias
            tensor([2., 0., 0.])
        """
        constant, drift, random = self.sizes
        of_declination = field.new_tensor((1.0, 0.0, 0.0)).expand_as(field)
        return SensorStd(*(size * of_declination for size in (random, math.hypot(constant, drift), drift, 0.0)))


def _secant(inclination: Tensor) -> Tensor:
    """Return the secant of the latitude at which an axial dipole has an inclination [deg]: tan I = 2 tan(latitude)."""
    tangent = torch.tan(torch.deg2rad(inclination.clamp(-_STEEPEST_DEG, _STEEPEST_DEG))) / 2
    return torch.hypot(torch.ones_like(tangent), tangent)


def north_reference(name: str, *, speed_km_h: float, **options: Any) -> NorthReferenceError:
    """Return the error of a north reference on the market, see :data:`NORTH_REFERENCES`.

    Args:
        name: ``"fiber-optic"``, ``"marine"`` or ``"low-cost"``.
        speed_km_h: speed of the vehicle, at which a drift has Schuler's period as correlation time [km/h].
        **options: of :class:`NorthReferenceError`, other than sizes and ``in_keys``.

    Raises:
        ValueError: for an unknown name, or a speed that is not above 0.

    Example:
        >>> north_reference("marine", speed_km_h=30).sizes
        (0.375, 0.125, 0.25)
    """
    check_choice(NORTH_REFERENCES, north_reference=name)
    check_number(0, above=True, speed_km_h=speed_km_h)
    keys = ("heading", "field", "leg") if name == "low-cost" else ("heading", "field", "leg", "position")
    options = {**NORTH_REFERENCES[name], "drift_length_km": SCHULER_HOURS * speed_km_h, "in_keys": keys, **options}
    return NorthReferenceError(**options)
