"""The current at the vehicle's place, and the currents to expect around it."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from magrl.checks import check_number
from magrl.field.elements import element_difference, elements_gradient, measured_elements
from magrl.field.model import FieldModel, elements_at
from magrl.geodesy import move_place, polar
from magrl.guidance import displacement_to
from magrl.random_numbers import stream_normal
from magrl.sensor_std import STD_KEYS
from magrl.transforms.areas import turned
from magrl.transforms.base import Keys, ObservationTransform
from magrl.transforms.episode import Episode, EpisodeNumbers
from magrl.transforms.legs import LEG_KM
from magrl.transforms.sequences import per_nanotesla

BASE_KM = 2.0
"""Distance of two readings that show a current [km]; chosen."""
RINGS_KM, DIRECTIONS = (15.0, 40.0, 75.0, 120.0), 8
"""Distances of the places at which currents are expected [km], and number of their directions; chosen."""
PLACE_STD, LEG_STD = 0.015, 0.05
"""Standard deviations of the current at the vehicle's place, and of the set of a leg as the current at its middle, over
the root mean square of the currents along an axis; chosen."""


class CurrentReading(EpisodeNumbers):
    """Write the current at the vehicle's place, as two readings show it: there, and 2 km of its way before.

    A vehicle that reads all along its way sees by a map of the field how far it was carried between two readings. Their
    errors are those of the reading: what is constant cancels, and the white noise that the vehicle states moves a fix.
    Nothing that it writes is privileged: the true current and position say where the second reading was made.

    Args:
        field: map of the field, such as ``env.field``; no bank.
        **options: ``in_keys``, ``out_keys`` and ``seed`` of :class:`~magrl.transforms.episode.EpisodeNumbers`. The
            keys read are the reading ``(..., 3)``: D [deg], I [deg], B_H [nT]; heading ``(..., 1)`` [rad]; fix and true
            position ``(..., 2)`` [deg]; and, where they are given, the true current over the speed ``(..., 2)``, the
            true elements at the place, and the noise of a reading ``(..., 3)``. Written is the current over the speed,
            ``(..., 2)`` forward and to the right.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from magrl.transforms import Fix
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env = TransformedEnv(base, Compose(Fix(base.field, base.region), CurrentReading(base.field)))
        >>> bool((env.rollout(3)["next", "current"].abs() < 0.01).all())  # in water without currents
        True
    """

    channel = 13
    stream_key = "current_stream"
    size, step_draws = 2, 3
    default_in_keys = ("field", "heading", "fix", "position")
    default_out_keys = ("current",)
    optional_in_keys = ("true_current", "true_field", STD_KEYS[0])

    def __init__(self, field: FieldModel, **options: Any) -> None:
        super().__init__(**options)
        self.field, self.numbers_key = field, self.out_keys[0]

    def _constants(self, stream: Tensor) -> Tensor:
        return stream.new_zeros(*stream.shape, self.size, dtype=torch.float64)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:  # noqa: ARG002
        seen = self._named(values)
        course = seen["heading"].double().squeeze(-1)
        ahead = torch.stack((torch.cos(course), torch.sin(course)), -1)
        distance, bearing = polar(-BASE_KM * (ahead + seen.get("true_current", torch.zeros_like(ahead))))
        before = elements_at(self.field, move_place(seen["position"], bearing, distance)).double()
        difference = element_difference(seen.get("true_field", seen["field"]).double(), before)
        if STD_KEYS[0] in seen:  # of the difference of two readings
            difference = difference + math.sqrt(2) * seen[STD_KEYS[0]] * stream_normal(episode.stream, self.step_draws)
        value, gradient = self.field.value_and_gradient(*seen["fix"].unbind(-1))
        unit = per_nanotesla(measured_elements(value))
        jacobian = elements_gradient(value, gradient) / unit.unsqueeze(-1)
        current = displacement_to(difference / unit, jacobian) / BASE_KM - ahead
        return turned(current, -course.unsqueeze(-1)).to(seen["heading"].dtype)


class ExpectedCurrents(ObservationTransform):
    """Write the currents to expect around the vehicle, given the current at its place and the sets of the last legs.

    They are the mean of a Gaussian process with the covariance of :func:`eddy_covariance`: a vehicle knows the
    wavelength of the eddies, and no more of them than it met.

    Args:
        eddy_km: wavelength of the eddies [km].
        in_keys: observation of :class:`~magrl.transforms.RecentLegs` and of :class:`CurrentReading`.
        out_keys: currents ``(..., 64)`` over the speed, along the bearing of the destination and to the right of it: at
            15, 40, 75 and 120 km from the vehicle, each in eight directions clockwise from that bearing.

    Raises:
        ValueError: for a wavelength that is not above 0.

    Example:
        >>> from tensordict import TensorDict
        >>> seen = TensorDict(recent_legs=torch.zeros(45), current=torch.tensor([0.5, 0.0]))
        >>> seen["recent_legs"][0] = 1.0  # the destination is ahead, and the first leg is still to come
        >>> ExpectedCurrents()(seen)["expected_currents"][[0, 16, 32, 48]]  # 15 to 120 km ahead
        tensor([0.4928, 0.4512, 0.3434, 0.1704])
    """

    default_in_keys = ("recent_legs", "current")
    default_out_keys = ("expected_currents",)
    in_sizes = {"current": (2,)}
    size = 2 * DIRECTIONS * len(RINGS_KM)

    def __init__(self, eddy_km: float = 250.0, in_keys: Keys | None = None, out_keys: Keys | None = None) -> None:
        super().__init__(in_keys, out_keys)
        check_number(0, above=True, eddy_km=eddy_km)
        self.eddy_km = float(eddy_km)
        angle = torch.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS)
        directions = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
        self.points = (torch.tensor(RINGS_KM)[:, None, None] * directions).flatten(0, 1).double()  # (P, 2)

    @staticmethod
    def mirror() -> Tensor:
        """Return the linear map ``(64, 64)`` of the currents to those in mirror image."""
        other = torch.eye(DIRECTIONS)[-torch.arange(DIRECTIONS) % DIRECTIONS]
        return torch.kron(torch.eye(len(RINGS_KM)), torch.kron(other, torch.diag(torch.tensor([1.0, -1.0]))))

    def _compute(self, values: list[Tensor]) -> list[Tensor]:
        (recent, current), dtype = (value.double() for value in values), values[1].dtype
        target, legs = recent[..., :2], recent[..., 5:].unflatten(-1, (-1, 5))
        to_target = torch.stack((target, turned(target, torch.full_like(target[..., :1], math.pi / 2))), -2)
        met = torch.cat((torch.zeros_like(current).unsqueeze(-2), -LEG_KM * legs[..., :2]), -2) @ to_target.mT
        currents = torch.cat((current.unsqueeze(-2), legs[..., 2:4]), -2) @ to_target.mT
        known = torch.nn.functional.pad(legs[..., 4], (1, 0), value=1.0).repeat_interleave(2, -1)
        error = torch.full_like(known, LEG_STD**2)
        error[..., :2] = PLACE_STD**2
        gram = self._covariance(met, met) * known.unsqueeze(-1) * known.unsqueeze(-2) + torch.diag_embed(error)
        weights = (known * torch.linalg.solve(gram, known * currents.flatten(-2))).unflatten(-1, (-1, 2))
        return [self._sum(self.points.to(met.device), met, weights).flatten(-2).to(dtype)]

    def _sum(self, places: Tensor, others: Tensor, weights: Tensor) -> Tensor:
        """Return the covariance of currents at places and others, times weights ``(..., Q, 2)``: ``(..., P, 2)``."""
        apart = (places.unsqueeze(-2) - others.unsqueeze(-3)) * (2 * math.pi / self.eddy_km)
        along, across, unit = eddy_covariances(apart)
        straight = (along - across) * (unit * weights.unsqueeze(-3)).sum(-1)
        return (straight.unsqueeze(-2) @ unit).squeeze(-2) + across @ weights

    def _covariance(self, places: Tensor, others: Tensor) -> Tensor:
        """Return the covariance ``(..., 2 P, 2 Q)`` of currents at places ``(..., P, 2)`` and ``(..., Q, 2)``."""
        apart = (places.unsqueeze(-2) - others.unsqueeze(-3)) * (2 * math.pi / self.eddy_km)
        return eddy_covariance(apart).movedim(-2, -3).flatten(-2).flatten(-3, -2)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the currents."""
        observation_spec = super().transform_observation_spec(observation_spec)
        self._add(observation_spec, self._leaf(observation_spec, self.in_keys[1]), self.out_keys[0], self.size)
        return observation_spec


def eddy_covariance(apart: Tensor) -> Tensor:
    """Return the covariance of currents in eddies of one wavelength, with a mean square of 1 along each axis.

    The stream function is a sum of plane waves in space of random directions, whose covariance is sin(x) / x.

    Args:
        apart: ``(..., 2)`` displacement between two places, times 2 pi over the wavelength.

    Returns:
        ``(..., 2, 2)``.

    Source:
        G. K. Batchelor, The Theory of Homogeneous Turbulence, 1953: of a flow without divergence, the covariance across
        the displacement is the derivative of x times the one along it.

    Example:
        >>> eddy_covariance(torch.tensor([0.0, math.pi])).round(decimals=2)
        tensor([[-0.6100,  0.0000],
                [ 0.0000,  0.3000]])
    """
    along, across, unit = (part[..., None] for part in eddy_covariances(apart))
    return (along - across).unsqueeze(-1) * unit * unit.mT + across.unsqueeze(-1) * torch.eye(2, device=unit.device)


def eddy_covariances(apart: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the covariances of :func:`eddy_covariance` along and across the displacement, ``(...)`` each, and its
    unit vector ``(..., 2)``."""
    x = apart.square().sum(-1).clamp_min(1e-12).sqrt()
    whole = torch.sin(x) / x
    along = torch.where(x < 0.01, 1 - x.square() / 10, 3 * (whole - torch.cos(x)) / x.square())
    return along, 3 * whole - 2 * along, apart / x.unsqueeze(-1)
