"""Quasi-Newton navigator without prior knowledge: two probing legs give a first Jacobian of the elements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl import tracking
from magrl.checks import check_number, check_numbers
from magrl.field.elements import NAMES
from magrl.navigators.filter import FieldTrack, GradientPrior
from magrl.navigators.quasi_newton import QuasiNewton
from magrl.sensor_std import PERFECT, SensorStd

SHORTEST_PROBE_KM = 0.5
"""Length of a probing leg with perfect sensors [km]: the rounding of float32 readings does not matter there."""


def probe_length(noise: Sequence[float]) -> float:
    """Return the length of a probing leg [km]: longer legs lengthen the path, shorter ones suffer more from noise.

    The loss by both legs grows with their length p, the loss by the wrong direction with (noise / p)^2, the noise as in
    :func:`magrl.tracking.sensor_length`; their sum is smallest for p proportional to noise^(2/3). The factor is from
    simulations.

    Args:
        noise: standard deviations of D [deg], I [deg], B_H [nT].

    Example:
        >>> [round(probe_length(std), 1) for std in ((0, 0, 0), (0.02, 0.02, 2), (0.05, 0.05, 5), (0.1, 0.1, 10))]
        [0.5, 6.1, 11.2, 17.7]
    """
    check_numbers(3, 0, noise=noise)
    length = float(tracking.sensor_length(torch.tensor(noise, dtype=torch.float64)))
    return max(SHORTEST_PROBE_KM, 5.0 * length ** (2 / 3))


class Secant(QuasiNewton):
    """Quasi-Newton navigation with a Jacobian estimated along the vehicle's own track: no map, no training, no oracle.

    Two short legs across each other give a first Jacobian of the elements by north and east. From then on each move is
    a quasi-Newton step to the destination's elements, and each reading corrects the Jacobian.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        probe_km: length of the two legs [km]; for None that of :func:`probe_length`, at most the longest move.
        elements: all three by default, each weighted by how well it determines the way; or two of them.
        sensor_std: accuracy of the sensors; three numbers are white noise of D [deg], I [deg], B_H [nT].
        **options: ``zeta`` and ``search`` of :class:`QuasiNewton`.

    Raises:
        ValueError: for a bound or a leg out of its range, fewer than two elements, or a negative standard deviation.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(2, Secant())["action"][0].round(decimals=2)
        tensor([[0.5000, 0.0000],
                [0.5000, 1.5700]])
    """

    def __init__(
        self,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        probe_km: float | None = None,
        elements: Sequence[str] = NAMES,
        sensor_std: SensorStd | Sequence[float] = PERFECT,
        **options: Any,
    ) -> None:
        super().__init__(max_move_km, max_turn_rad, elements, sensor_std, **options)
        noise = SensorStd.of(sensor_std).noise
        probe_km = min(probe_length(noise), self.max_move_km) if probe_km is None else probe_km
        check_number(0, max_move_km, above=True, probe_km=probe_km)
        self.probe_km, self.probe_turn = float(probe_km), min(math.pi / 2, self.max_turn_rad)

    def prior(self, reading: Tensor, target: Tensor) -> GradientPrior:  # noqa: ARG002
        std = reading.new_tensor([tracking.SLOPES[i] for i in self.elements]).unsqueeze(-1).expand(-1, 2)
        return GradientPrior(torch.zeros_like(std), std)

    def move(self, track: FieldTrack, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        distance, turn = super().move(track, seen, memory)
        decisions = memory["decisions"]
        probing, probe_turn = decisions <= 2, torch.where(decisions == 2, self.probe_turn, 0.0)
        return torch.where(probing, self.probe_km, distance), torch.where(probing, probe_turn, turn)

    name = label = "secant"
    description = "secant (quasi-Newton)"
