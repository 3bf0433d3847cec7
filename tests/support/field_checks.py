"""Points and differences for the tests of field models."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl.geodesy import curvature_radii


def globe(count: int, seed: int, highest_latitude: float = 89.9) -> tuple[Tensor, Tensor]:
    """Latitude and longitude [deg] of points uniform over the globe."""
    generator = torch.Generator().manual_seed(seed)
    reach = math.sin(math.radians(highest_latitude))
    latitude = torch.rad2deg(torch.asin(reach * (2 * torch.rand(count, generator=generator, dtype=torch.float64) - 1)))
    return latitude, 360 * torch.rand(count, generator=generator, dtype=torch.float64) - 180


def central_differences(model, latitude: Tensor, longitude: Tensor, altitude_km: float = 0.0) -> Tensor:
    """Fourth-order derivative northward and eastward [unit of the model / km] at constant altitude."""

    def slope(north: float, east: float) -> Tensor:
        def at(k: float) -> Tensor:
            return model(latitude + 0.02 * k * north, longitude + 0.02 * k * east)

        return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * math.radians(0.02))

    meridian, prime_vertical = curvature_radii(latitude)
    per_north = 1 / (meridian + altitude_km)
    per_east = 1 / ((prime_vertical + altitude_km) * torch.cos(torch.deg2rad(latitude)))
    return torch.stack((slope(1, 0) * per_north[:, None], slope(0, 1) * per_east[:, None]), -1)


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Largest difference over the last two dimensions, against the largest entry, of the worst point."""
    return float(((found - expected).abs().amax((-2, -1)) / expected.abs().amax((-2, -1))).max())
