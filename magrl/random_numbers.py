"""Counter-based random numbers: pure functions of a seed and counters, the same on every device.

A number that belongs to a vehicle, an episode and a step depends neither on the batch size nor on when other vehicles
are reset, and no generator state has to be saved to repeat it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl.checks import check_number

VALIDATION_SEED, TEST_SEED, SWEEP_SEED, PAPER_SEED = (2_000_000_011 + i for i in range(4))
"""Seeds of frozen trip sets: to choose a policy, to test it, to tune metaheuristics, and the paper's 100 trips."""
FIRST_RESERVED_SEED = 2_000_000_000
"""Training refuses seeds from here on."""

NORMAL_LIMIT = 4.0
"""Largest absolute value of the numbers of :func:`stream_normal`."""


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
    return stream_uniform(counter_stream(seed, counters), draws)


def counter_stream(seed: int, counters: Tensor) -> Tensor:
    """Return the state of a stream of random numbers for each row of counters, for :func:`stream_uniform`.

    Args:
        seed: any 64-bit integer.
        counters: ``(..., C)`` int64.

    Returns:
        ``(...)`` int64.

    Raises:
        ValueError: for a seed that is not a whole number, or counters that are not rows of int64.

    Example:
        >>> state = counter_stream(7, torch.tensor([[0, 0], [0, 1]]))
        >>> bool((stream_uniform(state, 2) == counter_uniform(7, torch.tensor([[0, 0], [0, 1]]), 2)).all())
        True
    """
    check_number(whole=True, seed=seed)
    if not isinstance(counters, Tensor) or counters.dtype != torch.int64 or not counters.ndim:
        raise ValueError(f"counters must be int64 of shape (..., C), got {counters!r}")
    key = _mix(torch.full(counters.shape[:-1], _signed(seed), dtype=torch.int64, device=counters.device))
    for mixed in _mix(counters + _GOLDEN).unbind(-1):
        key = _mix(key ^ mixed)
    return key


def stream_uniform(state: Tensor, draws: int) -> Tensor:
    """Return the next uniform numbers of streams: ``(...)`` int64 to ``(..., draws)`` float64 in [0, 1).

    Raises:
        ValueError: for a number of draws that is not a positive whole number.

    Example:
        >>> state = counter_stream(7, torch.tensor([[0, 0]]))
        >>> bool((stream_uniform(advanced(state, 1), 1) == stream_uniform(state, 2)[:, 1:]).all())
        True
    """
    check_number(1, whole=True, draws=draws)
    steps = torch.arange(1, draws + 1, device=state.device) * _GOLDEN
    return _shift(_mix(state.unsqueeze(-1) + steps), 11).double() * 2.0**-53


def stream_normal(state: Tensor, draws: int) -> Tensor:
    """Return standard normal numbers of streams, cut at :data:`NORMAL_LIMIT`: ``(...)`` int64 to ``(..., draws)``.

    The cut lowers the standard deviation to 0.9995. It makes every error bounded, so that a limit can be stated.

    Example:
        >>> bool(stream_normal(counter_stream(7, torch.arange(9).unsqueeze(-1)), 100).abs().max() < NORMAL_LIMIT)
        True
    """
    return normal_of(stream_uniform(state, draws))


def normal_of(uniform: Tensor) -> Tensor:
    """Return the standard normal numbers, cut at :data:`NORMAL_LIMIT`, that belong to uniform numbers in [0, 1).

    Example:
        >>> normal_of(torch.tensor([0.0, 0.5], dtype=torch.float64)).round(decimals=6)
        tensor([-4.,  0.], dtype=torch.float64)
    """
    return math.sqrt(2) * torch.erfinv((2 * uniform - 1) * math.erf(NORMAL_LIMIT / math.sqrt(2)))


def advanced(state: Tensor, draws: int | Tensor) -> Tensor:
    """Return the state of streams after some draws, ``(...)`` int64.

    Example:
        >>> state = torch.tensor([5])
        >>> bool(advanced(advanced(state, 2), 1) == advanced(state, torch.tensor(3)))
        True
    """
    return state + (draws * _GOLDEN if isinstance(draws, Tensor) else _signed(draws * _GOLDEN))


def _signed(value: int) -> int:
    """Return a 64-bit pattern as a signed integer (two's complement)."""
    value &= 0xFFFFFFFFFFFFFFFF
    return value - (1 << 64) if value >> 63 else value


_GOLDEN = _signed(0x9E3779B97F4A7C15)  # the step of SplitMix64


def _shift(value: Tensor, bits: int) -> Tensor:
    """Return a logical right shift, which int64 lacks, as a new tensor."""
    return (value >> bits).bitwise_and_((1 << (64 - bits)) - 1)


def _mix(value: Tensor) -> Tensor:
    value = _shift(value, 30).bitwise_xor_(value).mul_(_signed(0xBF58476D1CE4E5B9))
    value = _shift(value, 27).bitwise_xor_(value).mul_(_signed(0x94D049BB133111EB))
    return _shift(value, 31).bitwise_xor_(value)
