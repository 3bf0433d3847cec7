"""Episodes made by hand, as rollouts."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict

from magrl.geodesy import move


def episode(legs: list[tuple[float, float]], target: tuple[float, float], success: bool, steps: int) -> TensorDict:
    """Return a rollout ``(1, steps)`` from (-5, 165): legs of (km, heading in degrees), then the last state."""
    rows, position = [], torch.tensor([-5.0, 165.0], dtype=torch.float64)
    start, end = position, torch.tensor(target, dtype=torch.float64)
    for index in range(steps):
        made = index < len(legs)
        distance, heading = legs[index] if made else legs[-1]
        heading_rad = torch.tensor(math.radians(heading), dtype=torch.float64)
        after = torch.stack(move(*position, heading_rad, torch.tensor(distance, dtype=torch.float64)))
        last = index >= len(legs) - 1
        following = {
            "position": after,
            "leg": torch.tensor([distance, 0.0]),
            "heading": heading_rad.float().reshape(1),
            "success": torch.tensor([success and last]),
            "done": torch.tensor([last]),
        }
        rows.append(
            TensorDict(position=position, start_position=start, target_position=end, next=TensorDict(following))
        )
        position = after if made and not last else position
    return torch.stack(rows).unsqueeze(0)


def point(distance: float, bearing: float) -> tuple[float, float]:
    """Return the point at a distance [km] and bearing [deg] from (-5, 165)."""
    origin = torch.tensor([-5.0, 165.0, math.radians(bearing), distance], dtype=torch.float64)
    latitude, longitude = move(*origin)
    return float(latitude), float(longitude)
