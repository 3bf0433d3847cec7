"""The observation of an agent without a map: what its own track tells of the field, in the vehicle's frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Transform

from magrl import guidance
from magrl.checks import check_number, check_tensor, check_type
from magrl.field.elements import element_difference
from magrl.transforms.base import (
    Keys,
    ObservationTransform,
    expect_keys,
    observed_spec,
    several_keys,
    sorted_keys,
    with_state,
)
from magrl.transforms.scaling import MinMaxNorm
from magrl.transforms.search import SearchAim
from magrl.transforms.track import OUT_KEYS, TrackGradient

OBSERVATION_SIZE = 15
DATA_SHEET = ("sensor_std", "bias_std")
"""What a vehicle is told of its readings: the standard deviations of their new errors, and of constant or slow ones."""
OBSERVED_KEYS = ("field", "target_field", *OUT_KEYS[2:4], "aim", OUT_KEYS[5], "sensor_std", "step_count")
_STD_UNITS = (1.0, 1.0, 100.0)
_LEAST_STD = 0.002


def track_observation(
    way: Tensor,
    way_covariance: Tensor,
    gradient: Tensor,
    remaining: Tensor,
    weights: Tensor,
    noise_std: Tensor,
    time: Tensor,
) -> Tensor:
    """Return the observation of an agent that navigates by the estimates of its own track.

    All vectors are in the vehicle's frame, so that what is learned at one heading holds at every heading. Lengths are
    seen through logarithms, because the right move depends on their ratios.

    Args:
        way: ``(..., 2)`` way to aim at, forward and to the right [km].
        way_covariance: ``(..., 2, 2)`` covariance of the estimated way to the target [km^2].
        gradient: ``(..., E, 2)`` estimated gradient, forward and to the right [element unit / km].
        remaining: ``(..., E)`` target elements minus estimated elements.
        weights: ``(..., E)`` weights of the objective F (Eq. 2-6), divided by the arrival threshold.
        noise_std: ``(..., E)`` standard deviation of the readings' noise: D [deg], I [deg], B_H [nT].
        time: ``(..., 1)`` share of the step limit that is over.

    Returns:
        ``(..., 15)``: direction (2) and length (2) of the way; logarithms of its standard deviations (2) and their
        correlation; the same three of the arrival ellipse by the estimated gradient; logarithm of F over the threshold;
        time; logarithms of the noise (3).

    Example:
        >>> eye = torch.eye(2)
        >>> gradient = torch.tensor([[0.01, 0.0], [0.0, 0.01], [1.0, 1.0]])
        >>> ones = torch.ones(3)
        >>> track_observation(torch.tensor([30.0, 40.0]), eye, gradient, ones, ones, ones, torch.zeros(1))[:2]
        tensor([0.6000, 0.8000])
    """
    check_tensor(2, way=way)
    check_tensor(2, 2, way_covariance=way_covariance)
    length = way.norm(dim=-1, keepdim=True)
    ellipse = (weights[..., None, None] * gradient.unsqueeze(-1) * gradient.unsqueeze(-2)).sum(-3)
    objective = (weights * remaining.square()).sum(-1, keepdim=True)
    units = torch.tensor(_STD_UNITS, dtype=noise_std.dtype, device=noise_std.device)
    std, std_correlation = _axes(way_covariance, least=1e-6)
    axes, axes_correlation = _axes(ellipse, least=1e-12)
    return torch.cat(
        (
            way / length.clamp_min(1e-3),
            torch.log1p(length / 20) - 2,
            length.clamp(max=2500) / 400 - 0.5,
            torch.log(std / 20) / 2,
            std_correlation,
            torch.log(axes * 20) / 2,
            axes_correlation,
            torch.log(objective + 1e-2) / 3 - 0.5,
            time,
            torch.log((noise_std / units).clamp_min(_LEAST_STD)) / 2 + 2,
        ),
        -1,
    )


def _axes(matrix: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Return the roots of the diagonal ``(..., 2)`` and the correlation ``(..., 1)`` of symmetric matrices."""
    roots = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(least).sqrt()
    return roots, (matrix[..., 0, 1] / roots.prod(-1)).unsqueeze(-1)


class TrackObservation(ObservationTransform):
    """Write the observation of an agent that navigates by its own track, see :func:`track_observation`.

    It stands after :class:`~magrl.transforms.TrackGradient` and :class:`~magrl.transforms.SearchAim` in the vehicle's
    frame; without the latter, its fifth key is that of the estimated way. The weights of the objective follow from the
    first reading, which is kept as state in the TensorDict.

    Args:
        in_keys: reading and target ``(..., 3)``, estimated field ``(..., 3)``, its gradient ``(..., 3, 2)``, way to aim
            at ``(..., 2)``, covariance of the estimated way ``(..., 2, 2)``, standard deviation of the noise
            ``(..., 3)``, and the number of the step ``(..., 1)``.
        out_keys: observation ``(..., 15)`` and the first reading ``(..., 3)``.
        zeta: arrival threshold on the objective.
        max_steps: step limit.

    Raises:
        ValueError: for an option out of its range, or another number of keys.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import SensorNoise
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> track = TrackGradient(("field", "target_field", "move", "heading", "sensor_std"), frame="vehicle")
        >>> aim, observation = SearchAim(zeta=0.01, frame="vehicle"), TrackObservation(zeta=0.01, max_steps=50)
        >>> steps = Compose(SensorNoise((0.05, 0.05, 5.0)), track, aim, observation)
        >>> TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)["observation"].shape
        torch.Size([2, 3, 15])
    """

    def __init__(
        self,
        in_keys: Keys = OBSERVED_KEYS,
        out_keys: Keys = ("observation", "first_field"),
        *,
        zeta: float,
        max_steps: int,
    ) -> None:
        super().__init__(in_keys=several_keys(in_keys), out_keys=several_keys(out_keys))
        expect_keys(self, 8, 2)
        check_number(0, above=True, zeta=zeta)
        check_number(1, whole=True, max_steps=max_steps)
        self.zeta, self.max_steps = zeta, max_steps

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._start(tensordict_reset)

    def _start(self, first: TensorDictBase) -> TensorDictBase:
        values = self._read(first)
        return first if values is None else self._write(first, values[0], values)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is None:
            return next_tensordict
        first = tensordict.get(self.out_keys[1], None)
        if first is None:
            raise KeyError(
                f"TrackObservation reads its state {self.out_keys[1]!r}, which a reset writes: step from what reset() "
                f"or step_mdp() returned; got {sorted_keys(tensordict)}"
            )
        return self._write(next_tensordict, first, values)

    def _write(self, tensordict: TensorDictBase, first: Tensor, values: list[Tensor]) -> TensorDictBase:
        _, target, estimate, gradient, way, covariance, noise_std, step = values
        floors = first.new_tensor(guidance.OBJECTIVE_FLOORS)
        at_first, remaining = element_difference(target, first), element_difference(target, estimate)
        weights = guidance.objective_weights(torch.zeros_like(at_first), at_first, floors) / self.zeta
        time = (step.to(way.dtype) / self.max_steps).clamp(max=1)  # a policy may fly longer than it was trained for
        observed = track_observation(way, covariance, gradient, remaining, weights, noise_std, time)
        return tensordict.set(self.out_keys[0], observed).set(self.out_keys[1], first)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the observation of a first reading; on transitions, that of the step from the state at the root."""
        if tensordict.get("next", None) is None:
            return self._start(tensordict)
        self._step(tensordict, tensordict["next"])
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the observation and the first reading, unbounded."""
        leaf = self._leaf(observation_spec, self.in_keys[0])
        for key, size in zip(self.out_keys, (OBSERVATION_SIZE, 3), strict=True):
            shape = (*leaf.shape[:-1], size)
            observation_spec[key] = Unbounded(shape, device=leaf.device, dtype=leaf.dtype)
        return observation_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Make the first reading part of the state, so that batched and parallel environments pass it on."""
        leaf = self._leaf(observed_spec(self), self.in_keys[0])
        first = Unbounded(leaf.shape, device=leaf.device, dtype=leaf.dtype)
        return with_state(super().transform_input_spec(input_spec), {self.out_keys[1]: first})


@dataclass(frozen=True, kw_only=True)
class TrackView:
    """Describe what an agent without a map observes: the estimates of a Kalman filter along its own track.

    Args:
        zeta: arrival threshold that the agent is trained for.
        max_steps: step limit that the agent is trained for.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        range_km: prior standard deviation of the way along each axis [km].
        search: whether it observes the way to where the vehicle has not been (:class:`~magrl.transforms.SearchAim`), as
            suits environments that end the episode at arrival.

    Raises:
        ValueError: for a number out of its range.
        TypeError: for ``search`` other than a bool.

    Example:
        >>> TrackView(zeta=0.01, max_steps=50, max_move_km=50.0, max_turn_rad=1.5).size
        15
    """

    zeta: float
    max_steps: int
    max_move_km: float
    max_turn_rad: float
    range_km: float = 300.0
    search: bool = True

    size: ClassVar[int] = OBSERVATION_SIZE
    in_keys: ClassVar[tuple[str, ...]] = ("field", "target_field", "move", "heading", "step_count")

    def __post_init__(self) -> None:
        check_number(0, above=True, zeta=self.zeta, max_move_km=self.max_move_km, range_km=self.range_km)
        check_number(1, whole=True, max_steps=self.max_steps)
        check_number(0, math.pi, above=True, max_turn_rad=self.max_turn_rad)
        check_type(bool, search=self.search)

    @property
    def state_keys(self) -> tuple[str, ...]:
        """Keys of the state that a step reads from the one before."""
        return *OUT_KEYS[:2], "first_field", *(("visited", "arrival_weights") if self.search else ())

    def observation_transforms(self) -> list[Transform]:
        """Return the transforms from the public keys and :data:`DATA_SHEET` to ``observation`` ``(..., 15)``."""
        keys = ("field", "target_field", "move", "heading", *DATA_SHEET)
        track = TrackGradient(keys, range_km=self.range_km, frame="vehicle")
        search = [SearchAim(zeta=self.zeta, frame="vehicle")] if self.search else []
        observed = [key if key != "aim" or self.search else "way" for key in OBSERVED_KEYS]
        return [track, *search, TrackObservation(observed, zeta=self.zeta, max_steps=self.max_steps)]

    def action_transform(self) -> MinMaxNorm:
        """Return the transform from actions in [-1, 1] to distance [km] and turn [rad]."""
        high = torch.tensor((self.max_move_km, self.max_turn_rad))
        return MinMaxNorm(in_keys_inv=["action"], bounds={"action": (high * torch.tensor((0, -1)), high)})
