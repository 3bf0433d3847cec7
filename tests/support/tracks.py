"""Numbers and errors of sensors that tests of several packages share."""

from __future__ import annotations

import math

import torch
from torch import Tensor

F64 = torch.float64
STD = (0.05, 0.05, 5.0)


def f64(*values: object) -> Tensor:
    return torch.tensor(values, dtype=F64)


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def unknown(latitude: Tensor | float) -> Tensor:
    """A place of which only the latitude is known."""
    latitude = torch.as_tensor(latitude, dtype=F64)
    return torch.stack((latitude, torch.full_like(latitude, math.nan)), -1)
