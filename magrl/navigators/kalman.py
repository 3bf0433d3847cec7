"""Dual-control navigator: a filter estimates the gradient, and each move is also chosen for what it will teach."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from typing_extensions import Self

from magrl import guidance, tracking
from magrl.checks import check_number, check_numbers, check_type
from magrl.envs import GeomagneticNavEnv
from magrl.navigators.base import PERFECT, Std, steer
from magrl.navigators.quasi_newton import QuasiNewton
from magrl.navigators.secant import SLOPES
from magrl.tracking import DISTANCE_SCALE_KM, FieldTrack, GradientPrior

NEAR_KM = 30.0
"""Distance at which the uncertainty along the way starts to matter beside that across it [km]."""
LENGTHS = (0.0, 0.02, 0.1, 0.3, 0.6, 1.0)
"""Lengths of the moves that are compared, as fractions of the longest; the whole way, if shorter, is another."""
ANGLES_DEG = (-90, -60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60, 90)
"""Their directions, from that of the estimated way [deg]."""


class Kalman(QuasiNewton):
    """Dual control by the covariance of the filter: no map, no training, no oracle.

    The filter of :mod:`magrl.tracking` starts from the gradient of a dipole through the first reading. Before each
    step, the navigator compares moves of several lengths and directions, standing still for another reading included.
    For each it predicts the covariance of the filter after the reading at its end, which does not depend on what will
    be read, and chooses the least sum of three costs [km]:

    - the path: the length of the move minus the progress, that is, what it takes off the estimated way times the
      cosine of the typical error of its direction;
    - ``caution`` times the detour that the remaining uncertainty of the way may cost;
    - the price of the remaining steps, which rises as fewer of them are left.

    The way is that to the most probable destination, given that the episode has not ended at the places where the
    vehicle has been (:func:`~magrl.tracking.unvisited`). Constant errors of the readings (``bias``) widen the search,
    but no move reduces them, so that they count in none of the costs.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        noise: standard deviations of the sensors, their data sheet: D [deg], I [deg], B_H [nT].
        max_steps: step limit of the episode.
        caution: weight of the uncertainty; for None that of :func:`trade_off`.
        step_km: price of a step [km] while many are left; for None that of :func:`trade_off`.
        range_km: prior standard deviation of the way along each axis [km].
        bias: standard deviations of constant and slow errors of the readings, like ``noise``.
        zeta: arrival threshold on the objective. The search takes the objective with the paper's floors
            (:data:`magrl.guidance.OBJECTIVE_FLOORS`), as :class:`~magrl.transforms.SearchAim` does, in every region.
        search: whether the episode ends at arrival, so that the destination is not where the vehicle has been; without
            it, the way is the estimated one.

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

    needs = "nothing"

    def __init__(
        self,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        noise: Sequence[float] = (0.0, 0.0, 0.0),
        max_steps: int = 50,
        caution: float | None = None,
        step_km: float | None = None,
        range_km: float = 300.0,
        bias: Sequence[float] = (0.0, 0.0, 0.0),
        zeta: float = 0.01,
        search: bool = True,
    ) -> None:
        super().__init__(max_move_km, max_turn_rad, noise=noise)
        check_number(1, whole=True, max_steps=max_steps)
        check_numbers(3, bias=bias)
        check_number(0, bias=min(bias))
        usual_caution, usual_step_km = trade_off(noise)
        caution = usual_caution if caution is None else caution
        step_km = usual_step_km if step_km is None else step_km
        check_number(0, caution=caution)
        check_number(0, above=True, step_km=step_km, range_km=range_km, zeta=zeta)
        check_type(bool, search=search)
        self.max_steps, self.range_km, self.search = int(max_steps), float(range_km), search
        self.caution, self.step_km, self.bias, self.zeta = float(caution), float(step_km), tuple(bias), float(zeta)

    def prior(self, reading: Tensor) -> GradientPrior:
        return tracking.dipole_prior(reading)

    def _drift(self, seen: TensorDictBase) -> Tensor:
        return tracking.field_curvature(seen["field"].double())

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        field = seen["field"].double()
        floors = field.new_tensor(guidance.OBJECTIVE_FLOORS)
        weights = guidance.objective_weights(field, seen["target_field"].double(), floors) / self.zeta
        return super().first_memory(seen) | {"visited": tracking.unvisited_yet(field), "weights": weights}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        super().decide(seen, memory)  # the filter reads
        track = FieldTrack(memory["mean"], memory["covariance"])
        known, shared = self._related(track)
        target = self._continued(seen["target_field"], known)
        way = self._searched(known, target, shared, seen, memory)
        _, covariance = tracking.way_to(known, target, self.range_km, self.scales, shared)
        moves = self._moves(way)
        left = way.unsqueeze(1) - moves
        progress = (way.norm(dim=-1, keepdim=True) - left.norm(dim=-1)) * _certainty(way, covariance)
        cost = moves.norm(dim=-1) - progress
        cost = cost + left.norm(dim=-1) * self._price(way, seen["step_count"]) / self.max_move_km
        cost = cost + self.caution * _detour(left, self._covariance_after(track, moves, left))
        best = moves[torch.arange(len(moves), device=moves.device), cost.argmin(-1)]
        distance = best.norm(dim=-1)
        north, east = torch.where((distance > 0).unsqueeze(-1), best, way).unbind(-1)  # standing still, face the way
        heading = seen["heading"].squeeze(-1).double()
        return steer(heading, torch.atan2(east, north), distance, self.max_move_km, self.max_turn_rad)

    def _searched(
        self, known: FieldTrack, target: Tensor, shared: Tensor, seen: TensorDictBase, memory: TensorDictBase
    ) -> Tensor:
        """Return the way ``(N, 2)`` [km] to the most probable destination; remember the end of the last move."""
        heading = seen["heading"].squeeze(-1).double()
        leg = seen["move"][:, :1].double() * torch.stack((torch.cos(heading), torch.sin(heading)), -1)
        moved = tracking.visit(memory["visited"], leg)
        first = (memory["decisions"] == 1)[:, None, None]
        memory["visited"] = torch.where(first, memory["visited"], moved)
        way = tracking.way_to(known, target, self.range_km, self.scales, shared, self.bias)
        if not self.search:
            return way.displacement
        ellipse = tracking.arrival_ellipse(known, memory["weights"], self.scales)
        return tracking.unvisited(way, memory["visited"], ellipse)

    def _moves(self, way: Tensor) -> Tensor:
        """Return the displacements ``(N, M, 2)`` [km] that are compared, given the way ``(N, 2)``."""
        whole = way.norm(dim=-1, keepdim=True).clamp_max(self.max_move_km)
        fractions = way.new_tensor(LENGTHS) * self.max_move_km
        lengths = torch.cat((fractions.expand(len(way), -1), whole), -1)
        bearing = torch.atan2(way[:, 1:], way[:, :1]) + torch.deg2rad(way.new_tensor(ANGLES_DEG))
        directions = torch.stack((torch.cos(bearing), torch.sin(bearing)), -1)
        return (lengths[:, :, None, None] * directions.unsqueeze(1)).flatten(1, 2)

    def _price(self, way: Tensor, step: Tensor) -> Tensor:
        """Return the price of a step ``(N, 1)`` [km]: it rises as the steps beyond those of the way run out."""
        spare = self.max_steps - step.double() - 1.5 * way.norm(dim=-1, keepdim=True) / self.max_move_km
        return self.step_km * (self.max_steps / spare.clamp_min(1.0)).square()

    def _related(self, track: FieldTrack) -> tuple[FieldTrack, Tensor]:
        """Return the state given that the field has no curl, see :func:`~magrl.tracking.relate`."""
        elements = track.mean[..., 0] * track.mean.new_tensor(self.scales)
        return tracking.relate(track, tracking.curl_relation(elements), self.scales)

    def _covariance_after(self, track: FieldTrack, moves: Tensor, left: Tensor) -> Tensor:
        """Return the expected covariance ``(N, M, 2, 2)`` [km^2] of the way after moves and readings at their ends.

        The gradients that a reading will teach are unknown, but not their mean square: that of the present estimate
        plus what the covariance decreases. The drift of the gradients is left out, as it does not depend on the choice.
        """
        now, shared = self._related(FieldTrack(track.mean.unsqueeze(1), track.covariance.unsqueeze(1)))
        moved = tracking.predict(FieldTrack(track.mean.unsqueeze(1), now.covariance), moves, [0.0] * 3, self.scales)
        expected = moved.mean[..., 0] * moves.new_tensor(self.scales)
        after, shared_after = self._related(tracking.update(moved, expected, self.noise, self.scales))
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

    @classmethod
    def for_env(
        cls, env: GeomagneticNavEnv, *, sensor_std: Std = PERFECT, bias_std: Std = PERFECT, **options: Any
    ) -> Self:
        bounds = env.max_move_km, env.max_turn_rad, sensor_std, env.max_steps
        search = env.arrival.rule == "objective"  # else, an episode does not end where the objective is low
        return cls(*bounds, bias=bias_std, zeta=env.zeta, search=search, **options)


def _weights(covariance: Tensor, shared: Tensor, way: Tensor) -> Tensor:
    """Return the inverse covariance ``(..., 3, 3)`` of the elements at the end of a way ``(..., 2)`` [100 km]."""
    d = way.unsqueeze(-2)
    cross = 2 * covariance[..., 0, 1:] + (covariance[..., 1:, 1:] * d.unsqueeze(-2)).sum(-1)
    weight = (covariance[..., 0, 0] + (cross * d).sum(-1)).reciprocal()
    row = weight * (shared[..., 0] + (shared[..., 1:] * d).sum(-1))
    rest = 1 - (row.square() / weight).sum(-1)
    return torch.diag_embed(weight) + row.unsqueeze(-1) * row.unsqueeze(-2) / rest[..., None, None]


def trade_off(noise: Sequence[float]) -> tuple[float, float]:
    """Return the weight of the uncertainty and the price of a step [km] that suit the noise of the sensors.

    As for :func:`~magrl.navigators.secant.probe_length`, the noise of an element is expressed by the way over which the
    element typically changes as much, and the second smallest of the three counts. The larger it is, the less a reading
    teaches, and the more path and steps certainty costs. The factors are from a scan over regions of the Earth.

    Args:
        noise: standard deviations of D [deg], I [deg], B_H [nT].

    Raises:
        ValueError: for other than three numbers, or a negative one.

    Example:
        >>> trade_off((0, 0, 0))
        (5.0, 0.1)
        >>> [round(value, 2) for value in trade_off((0.1, 0.1, 10))]
        [0.45, 3.33]
    """
    check_numbers(3, noise=noise)
    check_number(0, noise=min(noise))
    noise_km = sorted(std / slope for std, slope in zip(noise, SLOPES, strict=True))[1]
    return min(5.0, 3.0 / max(noise_km, 0.1)), max(0.1, 0.5 * noise_km)


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
