"""Readings along a track, made by hand."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor


def first_reading(batch: int = 4, dtype: torch.dtype = torch.float64) -> TensorDict:
    """Readings of D, I, B_H, targets and headings that are not special."""
    rand = torch.rand(batch, 7, dtype=dtype, generator=torch.Generator().manual_seed(3))
    middle, span = torch.tensor((8.0, -16.0, 35e3), dtype=dtype), torch.tensor((2.0, 8.0, 500.0), dtype=dtype)
    values = {"field": middle + span * rand[:, :3], "target_field": middle + span * rand[:, 3:6]}
    return TensorDict(
        values | {"leg": torch.zeros(batch, 2, dtype=dtype), "heading": 6 * rand[:, 6:] - 3}, batch_size=batch
    )


def moved(first: TensorDict, km: float, turn: float, change: Tensor) -> TensorDict:
    """The reading after a leg."""
    after = first.select("target_field").clone()
    after["heading"] = first["heading"] + turn
    after["leg"] = torch.tensor((km, turn), dtype=change.dtype).expand(len(first), 2)
    return after.set("field", first["field"] + change)
