"""Dual-control navigator: a filter estimates the gradient, and moves are chosen also for the information they give."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl import tracking
from magrl.checks import check_number, check_numbers
from magrl.envs import GeomagneticNavEnv
from magrl.navigators.quasi_newton import QuasiNewton
from magrl.sensor_std import PERFECT, SensorStd
from magrl.tracking import CAUTION, LENGTHS, STEP_PRICE, FieldTrack, GradientPrior, LearnedPrior


class Kalman(QuasiNewton):
    """Dual control by the covariance of the filter: no map, no training, no oracle.

    The filter of :mod:`magrl.tracking` starts from a :class:`~magrl.tracking.LearnedPrior`. Each move is that of
    :func:`magrl.tracking.planned_move`, which weighs the path, the detour that the remaining uncertainty of the way may
    cost, and the price of the remaining steps, which rises as fewer of them are left.

    It searches by default. The bias of the readings widens the posterior of the way and the search.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        sensor_std: accuracy of the sensors; three numbers are white noise of D [deg], I [deg], B_H [nT].
        max_steps: step limit of the episode.
        caution: weight of the uncertainty of the way.
        step_price: price of a step while many are left [% of SPL]; a way of ``range_km`` is 100 %.
        range_km: prior standard deviation of the way along each axis [km].
        lengths: lengths of the candidate moves, as fractions of the longest move.
        search: as of :class:`QuasiNewton`, here by default.
        prior: prior of the gradients: ``"learned"`` on random planets, or ``"dipole"``, without training.
        **options: ``zeta`` of :class:`QuasiNewton`.

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
        sensor_std: SensorStd | Sequence[float] = PERFECT,
        max_steps: int = 50,
        caution: float = CAUTION,
        step_price: float = STEP_PRICE,
        range_km: float = 300.0,
        lengths: Sequence[float] = LENGTHS,
        search: bool = True,
        prior: Literal["learned", "dipole"] = "learned",
        **options: Any,
    ) -> None:
        super().__init__(max_move_km, max_turn_rad, sensor_std=sensor_std, search=search, **options)
        check_number(1, whole=True, max_steps=max_steps)
        check_numbers(len(lengths), 0, lengths=lengths)
        self.lengths = tuple(lengths)
        check_number(0, above=True, range_km=range_km)
        check_number(0, caution=caution)
        check_number(0, above=True, step_price=step_price)
        self.max_steps, self.range_km = int(max_steps), float(range_km)
        self.caution, self.step_price = float(caution), float(step_price)
        if prior not in ("learned", "dipole"):
            raise ValueError(f"prior must be 'learned' or 'dipole', got {prior!r}")
        self.learned_prior = LearnedPrior.pretrained() if prior == "learned" else None

    def prior(self, reading: Tensor, target: Tensor) -> GradientPrior:
        return tracking.dipole_prior(reading) if self.learned_prior is None else self.learned_prior(reading, target)

    def drift(self, reading: Tensor) -> Tensor:
        return tracking.field_curvature(reading)

    def move(self, track: FieldTrack, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        related, shared = tracking.related(track, tracking.curl_relation, self.scales)
        field = tracking.estimated_field(related, self.scales)
        bias = self.accuracy(seen).bias
        options = self.range_km, self.scales, shared, bias, self.periods, self.drift(field)
        target = seen["target_field"].double()
        posterior = tracking.way_posterior(related, target, *options, tracking.common_error(field), fine=False)
        way = tracking.Way(*(part.double() for part in posterior.aim(tracking.way_to(related, target, *options))))
        aim, std = self.aim(related, way, seen, memory), self.reading_std(seen)
        step, limits = seen["step_count"].squeeze(-1), (self.max_steps, self.max_move_km)
        price = tracking.step_price(self.step_price, self.range_km, aim, step, std, *limits)
        costs = self.caution, self.lengths, self.scales, bias, self.drift(field)
        best = tracking.planned_move(track, aim, posterior, std, price, self.max_move_km, self.range_km, *costs)
        distance = best.norm(dim=-1)
        direction = torch.where((distance > 0).unsqueeze(-1), best, aim)  # standing still, face the way
        return self.steer(seen, direction, distance)

    name, label = "kalman", "Kalman"
    description = "Kalman (dual control)"

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: SensorStd) -> dict[str, Any]:
        return QuasiNewton.env_options(env, sensor_std) | {"max_steps": env.max_steps}
