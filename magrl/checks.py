"""Checks of arguments: what cannot be used is refused by its name and value.

Types, shapes and numbers are looked at, the values inside tensors never: that would make an accelerator wait.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Integral, Real

import torch
from torch import Tensor


def check_tensor(*last: int, **tensors: object) -> None:
    """Refuses what is no tensor of real numbers, or does not end in the dimensions ``last``.

    Args:
        last: sizes of the last dimensions; any shape will do without them.
        tensors: by the name that the message shall give them.

    Raises:
        TypeError: for what is no tensor, or one of bools or of complex numbers.
        ValueError: for another shape.

    Example:
        >>> check_tensor(3, b_ned=torch.zeros(5, 2))
        Traceback (most recent call last):
        ValueError: b_ned must have the shape (..., 3), got (5, 2)
    """
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor):
            raise TypeError(f"{name} must be a tensor, got the {type(tensor).__name__} {tensor!r}")
        if tensor.is_complex() or tensor.dtype == torch.bool:
            raise TypeError(f"{name} must hold real numbers, got {tensor.dtype}")
        if last and tensor.shape[-len(last) :] != last:
            wanted = ", ".join(map(str, last))
            raise ValueError(f"{name} must have the shape (..., {wanted}), got {tuple(tensor.shape)}")


def check_number(
    low: float = -math.inf, high: float = math.inf, *, above: bool = False, whole: bool = False, **numbers: object
) -> None:
    """Refuses what is no finite number from ``low`` to ``high``.

    Args:
        low: least that is allowed.
        high: most that is allowed.
        above: whether ``low`` itself is refused.
        whole: whether fractions are refused.
        numbers: by the name that the message shall give them.

    Raises:
        ValueError: with the name and the value.

    Example:
        >>> check_number(1, whole=True, num_envs=1.5)
        Traceback (most recent call last):
        ValueError: num_envs must be a whole number from 1 on, got 1.5
    """
    for name, value in numbers.items():
        sound = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
        if not (sound and math.isfinite(value) and low <= value <= high and not (above and value == low)):  # type: ignore
            kind = "a whole number" if whole else "a finite number"
            start = "" if low == -math.inf else f" {'above' if above else 'from'} {low:g}"
            end = f" up to {high:g}" if high < math.inf else " on" if start and not above else ""
            raise ValueError(f"{name} must be {kind}{start}{end}, got {value!r}")


def check_numbers(count: int, **values: object) -> None:
    """Refuses what is not ``count`` finite numbers.

    Raises:
        ValueError: with the name and the values.

    Example:
        >>> check_numbers(2, interval=(0.0, "a"))
        Traceback (most recent call last):
        ValueError: interval must be 2 finite numbers, got (0.0, 'a')
    """
    for name, value in values.items():
        given = list(value) if isinstance(value, Iterable) else []
        sound = all(isinstance(x, Real) and not isinstance(x, bool) and math.isfinite(x) for x in given)
        if len(given) != count or not sound:
            raise ValueError(f"{name} must be {count} finite numbers, got {value!r}")


def check_type(kind: type | tuple[type, ...], **values: object) -> None:
    """Refuses what is no instance of a class.

    Raises:
        TypeError: with the name and the value.

    Example:
        >>> check_type(str, name=5)
        Traceback (most recent call last):
        TypeError: name must be a str, got 5
    """
    for name, value in values.items():
        if not isinstance(value, kind):
            kinds = kind if isinstance(kind, tuple) else (kind,)
            raise TypeError(f"{name} must be a {' or '.join(k.__name__ for k in kinds)}, got {value!r}")
