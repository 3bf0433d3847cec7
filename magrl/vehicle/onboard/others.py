"""Navigators on board that read a TensorDict, such as ``"secant"`` and policies of a region. It imports TorchRL."""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from magrl.agents import load_policy
from magrl.envs import PUBLIC_KEYS
from magrl.field.elements import NAMES, element_difference
from magrl.geodesy import wrap_angle
from magrl.navigators import Secant
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import Reading
from magrl.transforms import calibration
from magrl.vehicle.onboard.journal import Options

READS = {*PUBLIC_KEYS, *STD_KEYS, "elapsed_steps", "done"}
"""Keys that a vehicle knows."""


class Other:
    """Another navigator: from readings to moves.

    Args:
        navigator: ``"secant"``, a file of :func:`magrl.save_policy`, a policy, or a navigator.

    Raises:
        ValueError: for an unknown name, or a navigator that reads more than a vehicle knows.

    Example:
        >>> Other(Secant(max_move_km=20.0)).most["max_move_km"]
        20.0
    """

    def __init__(self, navigator: str | nn.Module) -> None:
        if isinstance(navigator, str) and navigator.endswith(".safetensors"):
            navigator = load_policy(navigator)
        if isinstance(navigator, str) and navigator != Secant.name:
            raise ValueError(
                f"unknown navigator {navigator!r}: choose anywhere, kalman, secant or a file ending in .safetensors"
            )
        self.navigator: Any = Secant() if isinstance(navigator, str) else copy.deepcopy(navigator).cpu()
        self.error, self.left, self.course = torch.zeros(3), SensorStd(), torch.zeros(())
        self._secant, self.name = isinstance(navigator, str), type(self.navigator).__name__
        keys: Any = self.navigator.in_keys
        if unknown := sorted({*map(str, keys)} - READS):
            raise ValueError(f"{self.name} reads {', '.join(unknown)}, which a vehicle does not know")
        view = getattr(self.navigator, "view", self.navigator)
        moves = () if self._secant else ("max_move_km", "max_turn_rad")
        self.most = {name: getattr(view, name) for name in moves if hasattr(view, name)}
        self.range = getattr(view, "field_limits", ((-180.0, -90.0, 0.0), (180.0, 90.0, math.inf)))

    def begun(self, options: Options, reading: Reading) -> Other:
        """Return the navigator at the start of a way, where a known start shows the constant errors of the sensors."""
        new = copy.deepcopy(self)
        new.left, new.course = reading.std, reading.heading
        if reading.known is not None and reading.known_std is not None:
            new.error, new.left = calibration(reading.field, reading.known, reading.std, reading.known_std)
        if self._secant:
            elements, std = NAMES[1:] if options.magnetic else NAMES, SensorStd(*(part.tolist() for part in new.left))
            new.navigator = Secant(options.max_move_km, options.max_turn_rad, elements=elements, sensor_std=std)
        return new

    def move(self, reading: Reading) -> Tensor:
        """Return distance [km] and turn [rad] ``(2,)`` after a reading."""
        turn, self.course = wrap_angle(reading.heading - self.course), reading.heading
        rows = {"field": element_difference(reading.field, self.error), "target_field": reading.target}
        rows |= {"move": torch.stack((reading.distance, turn)), "heading": reading.heading.reshape(1)}
        rows |= dict(zip(STD_KEYS, reading.std._replace(bias=self.left.bias), strict=True))
        seen = {key: row.float().unsqueeze(0) for key, row in rows.items()}
        seen |= {"elapsed_steps": reading.step.reshape(1, 1), "done": torch.zeros(1, 1, dtype=torch.bool)}
        return self.navigator(TensorDict(seen, [1]))["action"][0, :2]
