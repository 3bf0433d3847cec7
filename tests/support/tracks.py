"""States of the filter that tests of the tracking package share."""

from __future__ import annotations

import torch
from torch import Tensor

from magrl.tracking import ELEMENT_SCALES, FieldTrack, dipole_prior, start

F64 = torch.float64
SCALES = torch.tensor(ELEMENT_SCALES, dtype=F64)
STD = (0.05, 0.05, 5.0)


def f64(*values: object) -> Tensor:
    return torch.tensor(values, dtype=F64)


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def random_track(*shape: int, seed: int = 0, spread: float = 1.0) -> FieldTrack:
    """A state with random means and positive definite covariances."""
    root = randn(*shape, 3, 3, seed=seed + 1)
    return FieldTrack(randn(*shape, 3, seed=seed), spread * (root @ root.mT + 0.1 * torch.eye(3, dtype=F64)))


def started(reading: Tensor, sensor_std: tuple[float, ...] = STD) -> FieldTrack:
    return start(reading, dipole_prior(reading), sensor_std)
