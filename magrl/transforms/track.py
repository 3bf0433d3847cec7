"""Transform that estimates a field, its gradient and the way to the target by a Kalman filter along the track."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from magrl import tracking
from magrl.checks import check_number, check_numbers
from magrl.tracking import FieldTrack, GradientPrior, GradientRelation, curl_relation, dipole_prior, field_curvature
from magrl.transforms.base import Keys, ObservationTransform, observed_spec, several_keys, sorted_keys, with_state

FRAMES = ("world", "vehicle")
OUT_KEYS = ("track_mean", "track_covariance", "estimated_field", "estimated_gradient", "way", "way_covariance")


class TrackGradient(ObservationTransform):
    """Estimate the field, its gradient and the way to the target from the readings along the track.

    The filter of :mod:`magrl.tracking`. It starts at a reset from the first reading and a prior of the gradient; each
    step moves it by the last move and corrects it by the reading at its end. Its state is in the TensorDict: it is
    reset by row, stored with the data, and resumed with them. Nothing that it writes is privileged unless an input is.

    Args:
        in_keys: readings ``(..., E)``, values at the target ``(..., E)``, the last move ``(..., K)`` (its first number
            is the distance [km]), the heading after the move ``(..., 1)`` [rad], and optionally the standard deviation
            of the readings' noise ``(..., E)`` and that of their constant error ``(..., E)``, which only widens the
            covariance of the way.
        out_keys: the state, in the scaled units of :class:`~magrl.tracking.FieldTrack`: mean ``(..., E, 3)`` and
            covariance ``(..., E, 3, 3)``, always northward and eastward; then the estimates: the field ``(..., E)``,
            its gradient ``(..., E, 2)`` [element unit / km], the way to the target ``(..., 2)`` [km] and its covariance
            ``(..., 2, 2)`` [km^2].
        noise_std: standard deviation of the readings' noise, E numbers, where it is not among the ``in_keys``; by
            default 0. The filter has a floor, :data:`~magrl.tracking.VARIANCE_FLOOR`.
        prior: function from a first reading ``(..., E)`` to a :class:`~magrl.tracking.GradientPrior`; for other
            elements than D, I, B_H, give one, and also ``relation``, ``scales``, ``curvature`` and ``angles``.
        relation: function from the estimated field ``(..., E)`` to a :class:`~magrl.tracking.GradientRelation` that the
            gradients obey; None for none.
        scales: units of the elements in the state, E numbers; see :func:`magrl.tracking.start`.
        curvature: standard deviation of the change of a gradient along the way, E numbers or a function from the
            estimated field ``(..., E)`` to them; see :func:`magrl.tracking.predict`.
        angles: elements that are angles in degrees, by index: their differences are wrapped, and their estimate is
            continued beyond 180 degrees.
        range_km: prior standard deviation of the way along each axis [km].
        frame: axes of the estimated gradient and way: ``"world"`` for north and east, ``"vehicle"`` for forward and to
            the right.

    Raises:
        ValueError: for an option out of its range, another number of keys, or shapes that do not match.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), TrackGradient())
        >>> env.rollout(5)["next", "estimated_gradient"].shape
        torch.Size([2, 5, 3, 2])
    """

    scales: Tensor
    noise_std: Tensor
    period: Tensor
    constant_curvature: Tensor

    def __init__(
        self,
        in_keys: Keys = ("field", "target_field", "move", "heading"),
        out_keys: Keys = OUT_KEYS,
        *,
        noise_std: Sequence[float] | None = None,
        prior: Callable[[Tensor], GradientPrior] = dipole_prior,
        relation: Callable[[Tensor], GradientRelation] | None = curl_relation,
        scales: Sequence[float] = tracking.ELEMENT_SCALES,
        curvature: Sequence[float] | Callable[[Tensor], Tensor] = field_curvature,
        angles: Sequence[int] = (0,),
        range_km: float = 300.0,
        frame: str = "world",
    ) -> None:
        super().__init__(in_keys=several_keys(in_keys), out_keys=several_keys(out_keys))
        if len(self.in_keys) not in (4, 5, 6) or len(self.out_keys) != 6:
            raise ValueError(
                "TrackGradient takes 4 to 6 in_keys (reading, target, move, heading, standard deviations of the noise "
                f"and of the constant error) and 6 out_keys (such as {OUT_KEYS}), got {self.in_keys} and "
                f"{self.out_keys}"
            )
        if noise_std is not None and len(self.in_keys) > 4:
            raise ValueError(f"give noise_std or its key {self.in_keys[4]!r}, not both: got noise_std {noise_std}")
        check_number(0, above=True, range_km=range_km)
        if frame not in FRAMES or not callable(prior):
            raise ValueError(f"frame must be one of {FRAMES} and prior a function, got {frame!r} and {prior!r}")
        if relation is not None and not callable(relation):
            raise ValueError(f"relation must be a function or None, got {relation!r}")
        self.prior, self.relation, self.range_km, self.frame = prior, relation, float(range_km), frame
        self._register(scales, curvature, noise_std, angles)

    def _register(
        self,
        scales: Sequence[float],
        curvature: Sequence[float] | Callable[[Tensor], Tensor],
        noise_std: Sequence[float] | None,
        angles: Sequence[int],
    ) -> None:
        """Check and keep the numbers of each element; float64, as a 0.3 of float32 is another in float64."""
        count = len(scales) if isinstance(scales, (tuple, list)) else 0
        if not count or not isinstance(angles, (tuple, list)) or not set(angles) <= set(range(count)):
            raise ValueError(f"scales must be numbers and angles among their indices, got {scales!r} and {angles!r}")
        numbers = {"noise_std": (0.0,) * count if noise_std is None else noise_std}
        self.curvature = curvature if callable(curvature) else None
        if not callable(curvature):
            numbers["constant_curvature"] = curvature
        for name, values in ({"scales": scales} | numbers).items():
            check_numbers(count, **{name: values})
            if min(values) < 0 or (name == "scales" and min(values) == 0):
                raise ValueError(f"{name} must not be negative, nor scales zero, got {values!r}")
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64), persistent=False)
        period = torch.tensor([360.0 * (index in angles) for index in range(count)], dtype=torch.float64)
        self.register_buffer("period", period, persistent=False)

    # Data

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._start(tensordict_reset)

    def _start(self, first: TensorDictBase) -> TensorDictBase:
        """Write the state after a first reading, and the estimates."""
        values = self._read(first)
        if values is None:
            return first
        reading, target, _, heading, *std = values
        prior = self.prior(reading)
        noise = std[0] if std else self.noise_std
        track = tracking.start(reading, prior.gradient, prior.std, noise, prior.azimuth, self.scales)
        return self._write(first, track, target, heading, *std[1:])

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is None:
            return next_tensordict
        reading, target, move, heading, *std = values
        displacement = move[..., :1] * torch.cat((torch.cos(heading), torch.sin(heading)), -1)
        track = self._state(tensordict)
        track = tracking.predict(track, displacement, self._curvature_at(track), self.scales)
        noise = std[0] if std else self.noise_std
        track = tracking.update(track, self._continued(reading, track), noise, self.scales)
        return self._write(next_tensordict, track, target, heading, *std[1:])

    def _state(self, tensordict: TensorDictBase) -> FieldTrack:
        missing = [key for key in self.out_keys[:2] if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"TrackGradient reads its state {missing}, which a reset writes: step from what reset() or step_mdp() "
                f"returned; got {sorted_keys(tensordict)}"
            )
        return FieldTrack(*(tensordict.get(key) for key in self.out_keys[:2]))

    def _curvature_at(self, track: FieldTrack) -> Tensor:
        if self.curvature is None:
            return self.constant_curvature
        return self.curvature(track.mean[..., 0] * self.scales.to(track.mean.dtype))

    def _continued(self, values: Tensor, track: FieldTrack) -> Tensor:
        """Return values whose angles are within half a turn of the estimate."""
        near, period = track.mean[..., 0] * self.scales.to(values.dtype), self.period.to(values.dtype)
        return values - period * torch.round((values - near) / 360)

    def _write(
        self,
        tensordict: TensorDictBase,
        track: FieldTrack,
        target: Tensor,
        heading: Tensor,
        bias_std: Tensor | None = None,
    ) -> TensorDictBase:
        """Write the state and the estimates."""
        scales = self.scales.to(target.dtype)
        known, shared = track, None
        if self.relation is not None:
            known, shared = tracking.relate(track, self.relation(track.mean[..., 0] * scales), scales)
        value, gradient = known.mean[..., 0] * scales, tracking.estimated_gradient(known, scales)
        target = self._continued(target, known)
        way, covariance = tracking.way_to(known, target, self.range_km, scales, shared, bias_std)
        if self.frame == "vehicle":
            gradient, covariance = _turned(gradient, heading), _turned(_turned(covariance, heading).mT, heading)
            way = _turned(way.unsqueeze(-2), heading).squeeze(-2)
        value = value - self.period.to(value.dtype) * torch.round(value / 360)
        for key, entry in zip(self.out_keys, (*track, value, gradient, way, covariance), strict=True):
            tensordict.set(key, entry)
        return tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Start the filter from a first reading; on transitions, compute the step from the state at the root."""
        if tensordict.get("next", None) is None:
            return self._start(tensordict)
        self._step(tensordict, tensordict["next"])
        return tensordict

    # Specs

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the state and the estimates, unbounded."""
        leaves = [self._leaf(observation_spec, key) for key in self.in_keys]
        shape, count = leaves[0].shape, len(self.scales)
        if shape[-1:] != (count,) or any(leaf.shape != shape for leaf in (leaves[1], *leaves[4:])):
            raise ValueError(
                f"TrackGradient needs readings, targets and standard deviations of the same shape (..., {count}), with "
                f"an element for each of its scales, got {[tuple(leaf.shape) for leaf in leaves]}"
            )
        if leaves[3].shape != (*shape[:-1], 1):
            raise ValueError(f"TrackGradient needs a heading {(*shape[:-1], 1)}, got {tuple(leaves[3].shape)}")
        for key, last in zip(self.out_keys, self._sizes(count), strict=True):
            spec = Unbounded((*shape[:-1], *last), device=leaves[0].device, dtype=leaves[0].dtype)
            observation_spec[key] = spec
        return observation_spec

    @staticmethod
    def _sizes(count: int) -> tuple[tuple[int, ...], ...]:
        """Return the last dimensions of what is written."""
        return (count, 3), (count, 3, 3), (count,), (count, 2), (2,), (2, 2)

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Make the filter part of the state, so that batched and parallel environments pass it to the next step."""
        input_spec = super().transform_input_spec(input_spec)
        reading = self._leaf(observed_spec(self), self.in_keys[0])
        sizes = zip(self.out_keys[:2], self._sizes(len(self.scales)), strict=False)
        shapes = {key: (*reading.shape[:-1], *last) for key, last in sizes}
        state = {key: Unbounded(shape, device=reading.device, dtype=reading.dtype) for key, shape in shapes.items()}
        return with_state(input_spec, state)


def _turned(vectors: Tensor, heading: Tensor) -> Tensor:
    """Return vectors ``(..., K, 2)`` northward and eastward as forward and to the right of a heading ``(..., 1)``."""
    (north, east), cos, sin = vectors.unbind(-1), torch.cos(heading), torch.sin(heading)
    return torch.stack((cos * north + sin * east, cos * east - sin * north), -1)
