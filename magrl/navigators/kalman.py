"""Dual-control navigator: a filter estimates the gradient, and each move is also chosen for what it will teach."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl import tracking
from magrl.checks import check_number, check_numbers
from magrl.envs import GeomagneticNavEnv
from magrl.navigators.base import PERFECT, Std
from magrl.navigators.quasi_newton import QuasiNewton
from magrl.navigators.secant import sensor_length
from magrl.tracking import DISTANCE_SCALE_KM, FieldTrack, GradientPrior, LearnedPrior

NEAR_KM = 30.0
"""Distance at which the uncertainty along the way starts to matter beside that across it [km]."""
LENGTHS = (0.1, 0.3, 0.6, 1.0)
"""Lengths of the moves that are compared by default; the whole way, if it is shorter, is another."""
ANGLES_DEG = (-90, -60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60, 90)
"""Their directions, from that of the estimated way [deg]."""


class Kalman(QuasiNewton):
    """Dual control by the covariance of the filter: no map, no training, no oracle.

    The filter of :mod:`magrl.tracking` starts from a :class:`~magrl.tracking.LearnedPrior`. Before each step, the
    navigator compares moves of several lengths and directions. For each it predicts the covariance of the filter after
    the reading at its end, which does not depend on what will be read, and chooses the least sum of three costs [km]:

    - the path: the length of the move minus the progress, that is, what it takes off the estimated way times the
      cosine of the typical error of its direction;
    - the detour that the remaining uncertainty of the way may cost, times a weight (:func:`trade_off`);
    - the price of the remaining steps, which rises as fewer of them are left.

    It searches by default. Constant errors of the readings (``bias_std``) widen the search, but no move reduces them,
    so that they count in none of the costs.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        sensor_std: standard deviations of new errors of a reading: D [deg], I [deg], B_H [nT].
        max_steps: step limit of the episode.
        caution: weight of the uncertainty; for None that of :func:`trade_off`.
        step_km: price of a step [km] while many are left; for None that of :func:`trade_off`.
        range_km: prior standard deviation of the way along each axis [km].
        lengths: of the moves that are compared, as fractions of the longest.
        search: as of :class:`QuasiNewton`, here by default.
        **options: ``bias_std`` and ``zeta`` of :class:`QuasiNewton`.

    Raises:
        ValueError: for an option out of its range, or a negative standard deviation.
        TypeError: for ``search`` other than a bool.

    Source:
        A. A. Feldbaum, Dual control theory, Automation and Remote Control 21 (1960): an action both steers and probes.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> bool(env.rollout(50, Kalman(), break_when_any_done=False)["next", "success"].any(1).all())
        True
    """

    def __init__(
        self,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        sensor_std: Std = PERFECT,
        max_steps: int = 50,
        caution: float | None = None,
        step_km: float | None = None,
        range_km: float = 300.0,
        lengths: Sequence[float] = LENGTHS,
        search: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(max_move_km, max_turn_rad, sensor_std=sensor_std, search=search, **options)
        check_number(1, whole=True, max_steps=max_steps)
        check_numbers(len(lengths), 0, lengths=lengths)
        self.lengths = tuple(lengths)
        check_number(0, above=True, range_km=range_km)
        self.max_steps, self.range_km = int(max_steps), float(range_km)
        usual_caution, usual_step_km = trade_off(tracking.reading_std(self.sensor_std, self.bias_std).tolist())
        self.caution = usual_caution if caution is None else caution
        self.step_km = usual_step_km if step_km is None else step_km
        self.gradient_prior = LearnedPrior.pretrained()
        check_number(0, caution=self.caution)
        check_number(0, above=True, step_km=self.step_km)

    def prior(self, reading: Tensor, target: Tensor) -> GradientPrior:
        return self.gradient_prior(reading, target)

    def drift(self, reading: Tensor) -> Tensor:
        return tracking.field_curvature(reading)

    def move(self, track: FieldTrack, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        known, shared = tracking.related(track, tracking.curl_relation, self.scales)
        curvature = self.drift(tracking.estimated_field(known, self.scales))
        estimate = partial(tracking.way_to, known, seen["target_field"].double(), self.range_km, self.scales, shared)
        covariance = estimate(None, self.periods).covariance  # of what moves can reduce
        way = self.aim(known, estimate(self.bias_std, self.periods, curvature), seen, memory)
        moves = self._moves(way)
        left = way.unsqueeze(1) - moves
        progress = (way.norm(dim=-1, keepdim=True) - left.norm(dim=-1)) * _certainty(way, covariance)
        cost = moves.norm(dim=-1) - progress
        cost = cost + left.norm(dim=-1) * self._price(way, seen["step_count"]) / self.max_move_km
        cost = cost + self.caution * _detour(left, self._covariance_after(track, moves, left, self.reading_std(seen)))
        best = moves[torch.arange(len(moves), device=moves.device), cost.argmin(-1)]
        distance = best.norm(dim=-1)
        direction = torch.where((distance > 0).unsqueeze(-1), best, way)  # standing still, face the way
        return self.steer(seen, direction, distance)

    def _moves(self, way: Tensor) -> Tensor:
        """Return the displacements ``(N, M, 2)`` [km] that are compared, given the way ``(N, 2)``."""
        whole = way.norm(dim=-1, keepdim=True).clamp_max(self.max_move_km)
        fractions = way.new_tensor(self.lengths) * self.max_move_km
        lengths = torch.cat((fractions.expand(len(way), -1), whole), -1)
        bearing = torch.atan2(way[:, 1:], way[:, :1]) + torch.deg2rad(way.new_tensor(ANGLES_DEG))
        directions = torch.stack((torch.cos(bearing), torch.sin(bearing)), -1)
        return (lengths[:, :, None, None] * directions.unsqueeze(1)).flatten(1, 2)

    def _price(self, way: Tensor, step: Tensor) -> Tensor:
        """Return the price of a step ``(N, 1)`` [km]: it rises as the steps beyond those of the way run out."""
        spare = self.max_steps - step.double() - 1.5 * way.norm(dim=-1, keepdim=True) / self.max_move_km
        return self.step_km * (self.max_steps / spare.clamp_min(1.0)).square()

    def _covariance_after(self, track: FieldTrack, moves: Tensor, left: Tensor, std: Tensor) -> Tensor:
        """Return the expected covariance ``(N, M, 2, 2)`` [km^2] of the way after moves and readings at their ends.

        ``std`` holds the standard deviations ``(..., 3)`` of these readings.

        The gradients that a reading will teach are unknown, but not their mean square: that of the present estimate
        plus what the covariance decreases. The drift of the gradients is left out, as it does not depend on the choice.
        """
        track = FieldTrack(track.mean.unsqueeze(1), track.covariance.unsqueeze(1))
        now, shared = tracking.related(track, tracking.curl_relation, self.scales)
        moved = tracking.predict(track, moves, 0 * self.curvature, self.scales)
        expected = tracking.estimated_field(moved, self.scales)
        reading = tracking.update(moved, expected, std.unsqueeze(-2), self.scales)
        after, shared_after = tracking.related(reading, tracking.curl_relation, self.scales)
        weights = _weights(after.covariance, shared_after, left / DISTANCE_SCALE_KM)
        learned = (now.covariance - after.covariance)[..., 1:, 1:]
        normal = (weights.diagonal(dim1=-2, dim2=-1)[..., None, None] * learned).sum(-3)
        for rows, sign in ((now.mean, 1), (shared, -1), (shared_after, 1)):
            normal = normal + sign * rows[..., 1:].mT @ weights @ rows[..., 1:]
        unknown = torch.eye(2, dtype=normal.dtype, device=normal.device) * (self.range_km / DISTANCE_SCALE_KM) ** 2
        inverse, info = torch.linalg.inv_ex(normal + torch.diag(1 / unknown.diagonal()))
        # Where rounding leaves a singular matrix, the way is as unknown as before.
        return torch.where((info == 0)[..., None, None], inverse, unknown) * DISTANCE_SCALE_KM**2

    name, label = "kalman", "Kalman"
    description = "Kalman (dual control)"

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: Std, bias_std: Std) -> dict[str, Any]:
        return QuasiNewton.env_options(env, sensor_std, bias_std) | {"max_steps": env.max_steps}


def _weights(covariance: Tensor, shared: Tensor, way: Tensor) -> Tensor:
    """Return the inverse covariance ``(..., 3, 3)`` of the elements at the end of a way ``(..., 2)`` [100 km]."""
    d = way.unsqueeze(-2)
    cross = 2 * covariance[..., 0, 1:] + (covariance[..., 1:, 1:] * d.unsqueeze(-2)).sum(-1)
    weight = (covariance[..., 0, 0] + (cross * d).sum(-1)).reciprocal()
    row = weight * (shared[..., 0] + (shared[..., 1:] * d).sum(-1))
    rest = 1 - (row.square() / weight).sum(-1)
    return torch.diag_embed(weight) + row.unsqueeze(-1) * row.unsqueeze(-2) / rest[..., None, None]


def trade_off(reading_std: Sequence[float]) -> tuple[float, float]:
    """Return the weight of the uncertainty and the price of a step [km] that suit the errors of a reading.

    The larger they are (:func:`~magrl.navigators.secant.sensor_length`), the less a reading teaches, and the more path
    and steps certainty costs. The factors, and :data:`LENGTHS`, are from scans on random planets (docs/navigators.md).

    Args:
        reading_std: standard deviations of D [deg], I [deg], B_H [nT].

    Raises:
        ValueError: for other than three numbers, or a negative one.

    Example:
        >>> trade_off((0, 0, 0))
        (5.0, 0.1)
        >>> [round(value, 2) for value in trade_off((0.1, 0.1, 10))]
        [0.45, 1.67]
    """
    length_km = sensor_length(reading_std)
    return min(5.0, 3.0 / max(length_km, 0.1)), max(0.1, 0.25 * length_km, 0.025 * length_km**2)


def _certainty(way: Tensor, covariance: Tensor) -> Tensor:
    """Return the share ``(N, 1)`` of a move along a way that is progress: the cosine of its typical error."""
    distance = way.norm(dim=-1).clamp_min(1e-9)
    unit = way / distance.unsqueeze(-1)
    across = torch.stack((-unit[..., 1], unit[..., 0]), -1)
    variance = ((covariance * across.unsqueeze(-2)).sum(-1) * across).sum(-1)
    return (distance / (distance.square() + variance).sqrt()).unsqueeze(-1)


def _detour(left: Tensor, covariance: Tensor) -> Tensor:
    """Return the detour [km] for a remaining way ``(..., 2)`` of a covariance ``(..., 2, 2)``.

    It is the hypotenuse over the way and the standard deviation across it, minus the way. Near the destination, the
    standard deviation along the way counts as well.
    """
    distance = left.norm(dim=-1)
    unit = left / distance.clamp_min(1e-9).unsqueeze(-1)
    along = ((covariance * unit.unsqueeze(-2)).sum(-1) * unit).sum(-1)
    across = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) - along
    return torch.sqrt(distance.square() + across + along / (1 + (distance / NEAR_KM).square())) - distance
