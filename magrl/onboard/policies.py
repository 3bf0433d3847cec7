"""Navigators on board that read a TensorDict, such as ``"secant"`` and policies of a region. It imports TorchRL."""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from magrl.envs import PUBLIC_KEYS
from magrl.field.elements import NAMES, element_difference
from magrl.geodesy import wrap_angle
from magrl.navigators import Memory, Secant, load_policy
from magrl.navigators.base import MEMORY
from magrl.onboard.journal import Options
from magrl.pilot import Reading
from magrl.sensor_std import STD_KEYS, SensorStd

READS = {*PUBLIC_KEYS, *STD_KEYS, "elapsed_steps", "done"}
"""Keys that a vehicle knows."""


def calibrated(reading: Reading, known: Tensor, known_std: Tensor) -> tuple[Tensor, SensorStd]:
    """Return the constant errors of the sensors ``(3,)``, given a reading where the elements are known, and what is
    left.

    With ``c^2 = bias^2 - drift^2`` and ``m^2 = noise^2 + drift^2 + known_std^2``, the difference of reading and known
    elements has the variance ``c^2 + m^2``. The error is ``c^2 / (c^2 + m^2)`` times the difference, and ``c^2 m^2 /
    (c^2 + m^2) + drift^2`` is the variance that is left. An element whose bias is infinite is not measured.

    Example:
        >>> here, none = torch.tensor([8.0, -16.0, 35000.0]), torch.zeros(3)
        >>> std = SensorStd(none, torch.tensor([0.5, 0.0, 0.0]), torch.tensor([0.3, 0.0, 0.0]))
        >>> zero = torch.tensor(0.0)
        >>> error, left = calibrated(Reading(here + std.bias, here, zero, zero, std, zero), here, none)
        >>> error[0], left.bias[0]
        (tensor(0.3200), tensor(0.3842))
    """
    noise, bias, slow = (std.square() for std in reading.std[:3])
    constant, other = torch.where(bias < math.inf, bias - slow, 0.0).clamp_min(0), noise + slow + known_std.square()
    gain = torch.where(constant > 0, constant / (constant + other), 0.0)
    left = torch.where(bias < math.inf, gain * other + slow, math.inf).sqrt()
    return gain * element_difference(reading.field, known), reading.std._replace(bias=left)


class Other:
    """Another navigator: from readings to legs.

    Args:
        navigator: ``"secant"``, ``"memory"``, a file of :func:`magrl.save_policy`, a policy, or a navigator.

    Raises:
        ValueError: for an unknown name, or a navigator that reads more than a vehicle knows.

    Example:
        >>> Other(Secant(max_leg_km=20.0)).most["max_leg_km"]
        20.0
    """

    def __init__(self, navigator: str | nn.Module) -> None:
        if isinstance(navigator, str) and navigator.endswith(".safetensors"):
            navigator = load_policy(navigator)
        navigator = Memory() if navigator == Memory.name else navigator
        if isinstance(navigator, str) and navigator != Secant.name:
            names = "anywhere, kalman, memory, secant or a file ending in .safetensors"
            raise ValueError(f"unknown navigator {navigator!r}: choose {names}")
        self.navigator: Any = Secant() if isinstance(navigator, str) else copy.deepcopy(navigator).cpu()
        self.error, self.left, self.course = torch.zeros(3), SensorStd(), torch.zeros(())
        self.memory = TensorDict({}, [1])
        self._secant, self.name = isinstance(navigator, str), type(self.navigator).__name__
        keys: Any = self.navigator.in_keys
        if unknown := sorted({*map(str, keys)} - READS):
            raise ValueError(f"{self.name} reads {', '.join(unknown)}, which a vehicle does not know")
        view: Any = getattr(self.navigator, "view", self.navigator)
        self.most: dict[str, float] = {}
        if hasattr(view, "max_turn_rad") and not self._secant:
            self.most = {"max_leg_km": view.max_leg_km, "max_turn_deg": math.degrees(view.max_turn_rad)}
        self.range = getattr(view, "field_limits", ((-180.0, -90.0, 0.0), (180.0, 90.0, math.inf)))

    def begun(self, options: Options, reading: Reading) -> Other:
        """Return the navigator at the start of a path, where a known start shows the constant errors of the sensors."""
        new = copy.deepcopy(self)
        new.left, new.course = reading.std, reading.heading
        if reading.known is not None and reading.known_std is not None:
            new.error, new.left = calibrated(reading, reading.known, reading.known_std)
        if self._secant:
            elements, std = NAMES[1:] if options.magnetic else NAMES, SensorStd(*(part.tolist() for part in new.left))
            new.navigator = Secant(options.max_leg_km, options.max_turn_rad, elements=elements, sensor_std=std)
        return new

    def act(self, reading: Reading) -> Tensor:
        """Return distance [km] and turn [rad] ``(2,)`` after a reading."""
        turn, self.course = wrap_angle(reading.heading - self.course), reading.heading
        rows = {"field": element_difference(reading.field, self.error), "target_field": reading.target}
        rows |= {"leg": torch.stack((reading.distance, turn)), "heading": reading.heading.reshape(1)}
        rows |= dict(zip(STD_KEYS, reading.std._replace(bias=self.left.bias), strict=True))
        seen = {key: row.float().unsqueeze(0) for key, row in rows.items()}
        seen |= {"elapsed_steps": reading.step.reshape(1, 1), "done": torch.zeros(1, 1, dtype=torch.bool)}
        acted = self.navigator(TensorDict({**seen, MEMORY: self.memory}, [1]))
        self.memory = acted.get(("next", MEMORY), self.memory)
        return acted["action"][0, :2]
