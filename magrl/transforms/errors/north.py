"""Error of the north reference: what it does to the heading and to the declination, and units on the market."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn.functional import pad
from torchrl.data import TensorSpec, Unbounded

from magrl.checks import check_number, check_tensor
from magrl.counters import advanced, stream_normal
from magrl.geodesy import wrap_angle, wrap_longitude
from magrl.transforms.base import Keys, several_keys
from magrl.transforms.errors.base import EpisodeErrors, check_sizes, gauss_markov

SCHULER_HOURS = 1.407
"""Period of a gyrocompass's slow oscillation, 84.4 minutes (M. Schuler, Physikalische Zeitschrift 24, 1923)."""

NORTH_REFERENCES: Mapping[str, Mapping[str, float]] = {
    "fiber-optic": {"constant_deg": 0.1},
    "marine": {"constant_deg": 0.375, "drift_deg": 0.125, "random_deg": 0.25},
    "low-cost": {"constant_deg": 0.5, "random_deg": 0.75},
}
"""Standard deviations of units on the market. Limits of the standards are read as two standard deviations.

- ``fiber-optic``: heading accuracy 0.1° times the secant of the latitude, root mean square, as the data sheet of the
  fiber-optic gyrocompass Octans (iXblue, now Exail) gives it; all of it taken as constant, the worst case for D.
- ``marine``: IMO Resolution A.424(XI), Performance standards for gyro-compasses (1979), times the secant of the
  latitude: settle point error up to 0.75°; residual steady-state error after the correction for speed and course up to
  0.25°, taken as the drift; root mean square of single indications 0.25°.
- ``low-cost``: IMO Resolution MSC.116(73), Performance standards for marine transmitting heading devices (2000), for
  ships too small to carry a gyrocompass: static error up to 1.0°, dynamic error up to 1.5°, at all latitudes.
"""


class NorthReferenceError(EpisodeErrors):
    """Measure directions from the vehicle's own north, which lies at an error b clockwise of true north.

    Every direction that the vehicle measures is smaller by b: its ``heading`` and D. A vehicle that steers a measured
    heading therefore moves along that heading plus b, in a world whose D is smaller by b.

    b has a constant part, a drift (first-order Gauss-Markov) and a part that is new at each reading, each normal, cut
    at four standard deviations. The measured ``heading`` takes the place of the true one, which is kept in
    ``true_heading`` and given back to the environment for its step. What the vehicle is told of D grows: ``sensor_std``
    by the random part, ``bias_std`` by the others (without the factor of the latitude, which it does not know).

    It stands after the transforms of the field's errors, and after those that read the true heading.

    Args:
        constant_deg: standard deviation of the constant part [deg].
        drift_deg: standard deviation of the drift [deg].
        random_deg: standard deviation of the random part [deg].
        drift_length_km: correlation length of the drift, with ``drift_deg`` alone [km].
        fixed: whether ``constant_deg`` is the constant part itself, in every episode; it may then be negative.
        in_keys: heading ``(..., 1)`` [rad], elements ``(..., E)`` with D [deg] first, the last move, whose first number
            is the distance [km], and optionally the position ``(..., 2)``, latitude and longitude [deg]: b then grows
            with the secant of the latitude, as that of every gyrocompass does.
        true_heading_key: key of the true heading ``(..., 1)``. Privileged.
        true_key: key of the true elements, if no transform before this one has written it. Privileged.
        std_key: key of the standard deviations of the elements ``(..., E)``.
        bias_key: key of those of their constant and slow errors ``(..., E)``.
        rated_key: key of the former that a transform before this one wrote; for its next step.
        error_key: key of constant part, drift and b itself ``(..., 3)`` [deg]. Privileged.
        stream_key: key of the state of the random numbers ``(..., 1)``, int64.
        seed: seed of the errors.

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

    channel = 3

    def __init__(
        self,
        constant_deg: float = 0.0,
        drift_deg: float = 0.0,
        random_deg: float = 0.0,
        *,
        drift_length_km: float | None = None,
        fixed: bool = False,
        in_keys: Keys = ("heading", "field", "move"),
        true_heading_key: NestedKey = "true_heading",
        true_key: NestedKey = "true_field",
        std_key: NestedKey = "sensor_std",
        bias_key: NestedKey = "bias_std",
        rated_key: NestedKey = "rated_std",
        error_key: NestedKey = "north_error",
        stream_key: NestedKey = "north_stream",
        seed: int = 0,
    ) -> None:
        keys = several_keys(in_keys)
        if len(keys) not in (3, 4):
            raise ValueError(
                f"NorthReferenceError takes 3 or 4 in_keys (heading, elements, move, and the position), got {keys}"
            )
        super().__init__(keys, keys[:2], stream_key=stream_key, seed=seed)
        self.in_keys_inv, self.out_keys_inv = [keys[0]], [true_heading_key]
        check_sizes(1, fixed=fixed, constant_deg=(constant_deg,))
        check_number(0, drift_deg=drift_deg, random_deg=random_deg)
        if drift_deg:
            check_number(0, above=True, drift_length_km=drift_length_km)
        self.sizes, self.drift_length_km, self.fixed = (constant_deg, drift_deg, random_deg), drift_length_km, fixed
        told = torch.tensor([[random_deg], [math.hypot(constant_deg, drift_deg)]])
        self.register_buffer("_told", told, persistent=False)
        self.true_heading_key, self.true_key, self.std_key = true_heading_key, true_key, std_key
        self.bias_key, self.rated_key, self.error_key = bias_key, rated_key, error_key

    # Data

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        values = self._read(tensordict_reset)
        if values is None:
            return tensordict_reset
        stream = self._next_episode(tensordict, tensordict_reset.batch_size, values[0].device)
        first, drift, white = stream_normal(stream, 3).to(values[0].dtype).split(1, -1)
        constant = self.sizes[0] * (torch.ones_like(first) if self.fixed else first)
        tensordict_reset.set(self.stream_key, advanced(stream, 3).unsqueeze(-1))
        return self._measure(tensordict_reset, values, constant, self.sizes[1] * drift, white)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is None:
            return next_tensordict
        stream, error = (self._written(tensordict, key) for key in (self.stream_key, self.error_key))
        next_tensordict.set(self.stream_key, advanced(stream, 2))
        constant, drift, _ = error.split(1, -1)
        white = torch.zeros_like(drift)
        if any(self.sizes[1:]):
            walk, white = stream_normal(stream.squeeze(-1), 2).to(drift.dtype).split(1, -1)
        if self.sizes[1]:
            drift = gauss_markov(drift, self.sizes[1], values[2][..., :1], float(self.drift_length_km or 0), walk)
        return self._measure(next_tensordict, values, constant, drift, white)

    def _measure(
        self, tensordict: TensorDictBase, values: list[Tensor], constant: Tensor, drift: Tensor, white: Tensor
    ) -> TensorDictBase:
        """Write the measured heading and elements, what is true, and the error."""
        heading, field, _, *position = values
        error = constant + drift + self.sizes[2] * white
        if not any(self.sizes):
            return self._write(tensordict, heading, field, torch.cat((constant, drift, error), -1), values[:2])
        if position:
            error = error / torch.cos(torch.deg2rad(position[0][..., :1])).to(error.dtype)
        seen = [wrap_angle(heading - torch.deg2rad(error)), _less(field, error)]
        return self._write(tensordict, heading, field, torch.cat((constant, drift, error), -1), seen)

    def _write(
        self, tensordict: TensorDictBase, heading: Tensor, field: Tensor, error: Tensor, seen: list[Tensor]
    ) -> TensorDictBase:
        """Write what is true, the error, and the measured heading and elements."""
        self._keep(tensordict, self.true_key, field)
        tensordict.set(self.true_heading_key, heading)
        tensordict.set(self.error_key, error)
        for key, value in zip(self.out_keys, seen, strict=True):
            tensordict.set(key, value)
        if self._comes_before(self.std_key):
            tensordict.set(self.rated_key, tensordict[self.std_key])
        of_elements = pad(self._told, (0, field.shape[-1] - 1))  # 0 but for D
        for told, std in zip((self.std_key, self.bias_key), of_elements, strict=True):
            self._tell(tensordict, told, std, field)
        return tensordict

    def variances(self, field: Tensor) -> tuple[Tensor, Tensor]:
        """Return the variances of the errors of a reading: of new errors, and of constant and slow ones.

        Args:
            field: ``(..., E)`` reading.

        Returns:
            Both ``(..., E)``.

        Example:
            >>> NorthReferenceError(2.0, random_deg=1.0).variances(torch.zeros(3))
            (tensor([1., 0., 0.]), tensor([4., 0., 0.]))
        """
        check_tensor(field=field)
        white, slow = pad(self._told.square(), (0, field.shape[-1] - 1)).to(field.dtype)
        return white.expand_as(field), slow.expand_as(field)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Give the true heading to the environment, and their standard deviations to the transforms before this one."""
        if tensordict.get(self.true_heading_key, None) is None and self.missing_tolerance:
            return tensordict
        tensordict.set(self.in_keys[0], self._written(tensordict, self.true_heading_key))
        if self._comes_before(self.std_key):
            tensordict.set(self.std_key, self._written(tensordict, self.rated_key))
        return tensordict

    # Specs

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add what is true, the error and the state of the numbers; the elements are unbounded."""
        heading, field, *others = (self._leaf(observation_spec, key) for key in self.in_keys)
        if heading.shape[-1:] != (1,) or (others[1:] and others[1].shape[-1:] != (2,)):
            shapes = [tuple(leaf.shape) for leaf in (heading, *others[1:])]
            raise ValueError(f"NorthReferenceError needs a heading (..., 1) and a position (..., 2), got {shapes}")
        if not self._comes_before(self.true_key):
            observation_spec[self.true_key] = field.clone()
        if self._comes_before(self.std_key):
            observation_spec[self.rated_key] = observation_spec[self.std_key].clone()
        observation_spec[self.true_heading_key] = heading.clone()
        for key in (self.out_keys[1], self.std_key, self.bias_key):
            observation_spec[key] = Unbounded(field.shape, device=field.device, dtype=field.dtype)
        of_error = (*heading.shape[:-1], 3)
        observation_spec[self.error_key] = Unbounded(of_error, device=heading.device, dtype=heading.dtype)
        observation_spec[self.stream_key] = Unbounded(heading.shape, device=heading.device, dtype=torch.int64)
        return observation_spec

    @property
    def _state_keys(self) -> list[NestedKey]:
        rated = [self.rated_key] if self._comes_before(self.std_key) else []
        return [*super()._state_keys, self.true_heading_key, self.error_key, *rated]


def _less(field: Tensor, error_deg: Tensor) -> Tensor:
    """Return elements whose declination is smaller by an error, in (-180, 180]."""
    declination = wrap_longitude(field[..., :1] - error_deg)
    return torch.cat((declination, field[..., 1:]), -1)


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
    if name not in NORTH_REFERENCES:
        raise ValueError(f"unknown north reference {name!r}: choose from {', '.join(NORTH_REFERENCES)}")
    check_number(0, above=True, speed_km_h=speed_km_h)
    keys = ("heading", "field", "move") if name == "low-cost" else ("heading", "field", "move", "position")
    sizes = (NORTH_REFERENCES[name].get(f"{part}_deg", 0.0) for part in ("constant", "drift", "random"))
    return NorthReferenceError(*sizes, drift_length_km=SCHULER_HOURS * speed_km_h, in_keys=keys, **options)
