"""Dead reckoning: by compass and log from a known start to the coordinates of the destination."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.envs import GeomagneticNavEnv
from magrl.geodesy import geodesic, move_place, steer
from magrl.navigators.base import Navigator
from magrl.pilot.earth import EarthModel
from magrl.sensor_std import SensorStd
from magrl.transforms.track import PLACE_KEYS

ARRIVED_KM = 0.5
"""Reckoned distance from the destination at which it has arrived [km]."""


class DeadReckoning(Navigator):
    """Steer to the coordinates of the destination by the reckoned place alone; the field is not read.

    What every vehicle with a known start does without this library. Where the environment has no
    :class:`~magrl.errors.KnownPlace`, start and destination are the environment's, without an error.
    Headings from magnetic north are corrected by the declination of a chart at the reckoned place, if it has one. Where
    the arrival must be declared, it declares at the reckoned destination.

    Args:
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].
        declares: whether the action has a third number, which declares the arrival.
        chart: model of the Earth (:func:`magrl.pilot.earth_model`), of which it reads the declination.

    Example:
        >>> from magrl.navigators import policy_env
        >>> env, reckoning = GeomagneticNavEnv(num_envs=2, seed=0), DeadReckoning()
        >>> flown = policy_env(env, reckoning).rollout(50, reckoning, break_when_any_done=False)
        >>> bool(flown["next", "success"].any(1).all())
        True
    """

    name = "dead_reckoning"
    label = "dead reckoning"
    needs = "the start and the destination"
    optional_keys: ClassVar[tuple[str, ...]] = (*PLACE_KEYS, "bias_std")

    def __init__(self, declares: bool = False, chart: EarthModel | None = None, **limits: Any) -> None:
        super().__init__(**limits)
        self.action_size, self.chart = 2 + declares, chart
        self.in_keys = ["leg", "heading", "start_position", "target_position", "elapsed_steps"]

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: SensorStd) -> dict[str, Any]:  # noqa: ARG004
        """Return whether the arrival must be declared."""
        return {"declares": env.scenario.declared}

    def fitted(self, env: GeomagneticNavEnv, rules: Mapping[str, Any]) -> DeadReckoning:
        """Return it with the vehicle's model of the Earth as its chart."""
        return DeadReckoning.for_env(env, chart=rules["model"]) if "model" in rules else self

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        """Return the reckoned place ``(N, 2)``."""
        return {"place": _known(seen, 0).double().clone()}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:
        """Return the action toward the destination."""
        heading = seen["heading"].squeeze(-1).double()
        place = move_place(
            memory["place"], self._from_north(heading, memory["place"], seen), seen["leg"][..., 0].double()
        )
        memory["place"] = place
        heading = self._from_north(heading, place, seen)
        distance, bearing = geodesic(*place.unbind(-1), *_known(seen, 1).double().unbind(-1))
        action = torch.stack(steer(heading, bearing, distance, self.max_leg_km, self.max_turn_rad), -1)
        if not self.declares:
            return action
        arrived = (distance < ARRIVED_KM).unsqueeze(-1)
        return torch.cat((action.masked_fill(arrived, 0.0), 2.0 * arrived - 1), -1)

    def _from_north(self, heading: Tensor, place: Tensor, seen: TensorDictBase) -> Tensor:
        """Return headings ``(N,)`` from true north: a compass that states nothing of D is corrected by the chart."""
        std = seen.get("bias_std", None)
        if self.chart is None or std is None:
            return heading
        declination = torch.deg2rad(self.chart.elements(place).to(place)[..., 0])
        return heading + torch.where(std[..., 0].isinf(), declination, 0.0)


def _known(seen: TensorDictBase, which: int) -> Tensor:
    """Return the place of the start (0) or the destination (1) that the vehicle knows."""
    key = PLACE_KEYS[which]
    return seen[key] if key in seen.keys() else seen[("start_position", "target_position")[which]]  # noqa: SIM118
