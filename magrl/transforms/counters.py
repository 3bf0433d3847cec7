"""Counter-based random numbers: pure functions of a seed and counters, the same on every device.

A number that belongs to a vehicle, an episode and a step depends neither on the batch size nor on when other vehicles
are reset, and no generator state has to be saved to repeat it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from magrl.checks import check_number


def counter_uniform(seed: int, counters: Tensor, draws: int) -> Tensor:
    """Return uniform numbers that are a pure function of a seed and counters.

    Args:
        seed: any 64-bit integer.
        counters: ``(..., C)`` int64; each distinct row is a stream of its own.
        draws: numbers to draw from each stream.

    Returns:
        ``(..., draws)`` float64 in [0, 1).

    Raises:
        ValueError: for a seed or a number of draws that is not a whole number, or counters that are not rows of int64.

    Source:
        The finalizer of SplitMix64 (Steele, Lea and Flood, Fast splittable pseudorandom number generators, 2014).

    Example:
        >>> rows = torch.tensor([[0, 0], [0, 1]])
        >>> bool((counter_uniform(7, rows, 2)[1] == counter_uniform(7, rows[1:], 2)[0]).all())
        True
    """
    check_number(whole=True, seed=seed)
    check_number(1, whole=True, draws=draws)
    if not isinstance(counters, Tensor) or counters.dtype != torch.int64 or not counters.ndim:
        raise ValueError(f"counters must be int64 of shape (..., C), got {counters!r}")
    key = _mix(torch.full(counters.shape[:-1], _signed(seed), dtype=torch.int64, device=counters.device))
    for counter in counters.unbind(-1):
        key = _mix(key ^ _mix(counter + _signed(0x9E3779B97F4A7C15)))
    steps = torch.arange(1, draws + 1, device=counters.device) * _signed(0x9E3779B97F4A7C15)
    return _shift(_mix(key.unsqueeze(-1) + steps), 11).double() * 2.0**-53


def _signed(value: int) -> int:
    """Return a 64-bit pattern as a signed integer (two's complement)."""
    value &= 0xFFFFFFFFFFFFFFFF
    return value - (1 << 64) if value >> 63 else value


def _shift(value: Tensor, bits: int) -> Tensor:
    """Return a logical right shift, which int64 lacks."""
    return (value >> bits) & ((1 << (64 - bits)) - 1)


def _mix(value: Tensor) -> Tensor:
    value = (value ^ _shift(value, 30)) * _signed(0xBF58476D1CE4E5B9)
    value = (value ^ _shift(value, 27)) * _signed(0x94D049BB133111EB)
    return value ^ _shift(value, 31)
