"""Argument checks. Each error names the argument, the value and what would be right.

Checks that run in every call read types, shapes and Python numbers, never values inside tensors, since that would wait
for an accelerator. :func:`check_finite` and :func:`require` do read values.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from importlib import import_module
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, Self

import torch
from pydantic import BaseModel, ConfigDict, ValidationError
from torch import Tensor, nn

if TYPE_CHECKING:
    from tensordict import TensorDictBase


def check_device(device: torch.device | str) -> None:
    """Raise unless tensors can be made on a device.

    Raises:
        ValueError: with the reason.

    Example:
        >>> check_device("cpu")
    """
    try:
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        problem = f"device {str(device)!r} cannot be used here ({str(error).splitlines()[0]})"
        raise ValueError(f"{problem}: choose another, such as cpu") from None


def check_finite(data: TensorDictBase | Iterable[tuple[str, Tensor]], what: str) -> None:
    """Raise unless every floating-point value is finite.

    Args:
        data: batch ``(N, ...)``, or pairs of name and tensor.
        what: context, at the start of the message.

    Raises:
        FloatingPointError: naming the key and the rows (vehicles of a batch) that hold NaN or an infinite value.

    Example:
        >>> check_finite([("loss", torch.tensor([1.0, float("nan")]))], "update 7")
        Traceback (most recent call last):
            ...
        FloatingPointError: update 7: loss is not finite in rows [1]
    """
    items = data.items(True, True) if hasattr(data, "items") else data
    for key, value in items:
        # A sum is finite unless an entry is not, or it overflows: one kernel in nearly all cases.
        if value.is_floating_point() and not torch.isfinite(value.detach().sum()):
            bad = ~torch.isfinite(value.detach())
            if bad.any():
                rows = bad.reshape(len(bad) if bad.ndim else 1, -1).any(1).nonzero().squeeze(1)[:8].tolist()
                name = ".".join(key) if isinstance(key, tuple) else key
                raise FloatingPointError(f"{what}: {name} is not finite in rows {rows}")


def require(good: Tensor, values: Tensor, message: str) -> None:
    """Raise unless every entry of a mask is True.

    Compiled code cannot put the value into the message, and an accelerator does not wait for the answer.

    Args:
        good: bool mask.
        values: values of the same shape.
        message: message with ``{}`` for the first value that is not good.

    Raises:
        ValueError: with the message.

    Example:
        >>> speed = torch.tensor([3.0, -1.0])
        >>> require(speed >= 0, speed, "speed {} is negative")
        Traceback (most recent call last):
        ValueError: speed -1.0 is negative
    """
    if torch.compiler.is_compiling() or good.device.type != "cpu":
        torch._assert_async(good.all(), message)
    elif not good.all():
        raise ValueError(message.format(values[~good].flatten()[0].item()))


def library(name: str, extra: str) -> Any:
    """Return a library that an extra of this package installs.

    Raises:
        ImportError: without it, with the command that installs it.

    Example:
        >>> library("math", "plots").pi > 3
        True
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(f"this needs the package {name.partition('.')[0]}: pip install 'magrl[{extra}]'") from error


def check_tensor(*last: int, **tensors: object) -> None:
    """Raise unless each value is a tensor of real numbers whose last dimensions have the sizes ``last``.

    Args:
        last: sizes of the last dimensions; any shape is accepted without them.
        tensors: values by the name that the message uses.

    Raises:
        TypeError: for a value that is not a tensor, or a tensor of bools or complex numbers.
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
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: bool = False,
    whole: bool = False,
    optional: bool = False,
    **numbers: object,
) -> None:
    """Raise unless each value is a finite number from ``low`` to ``high``.

    Args:
        low: smallest allowed value.
        high: largest allowed value.
        above: whether ``low`` itself is excluded.
        whole: whether the number must be an integer.
        optional: whether None is allowed.
        numbers: values by the name that the message uses.

    Raises:
        ValueError: with the name and the value.

    Example:
        >>> check_number(1, whole=True, num_envs=1.5)
        Traceback (most recent call last):
        ValueError: num_envs must be a whole number from 1 on, got 1.5
    """
    for name, value in numbers.items():
        if optional and value is None:
            continue
        sound = _is_finite(value, Integral if whole else Real) and low <= value <= high  # type: ignore[operator]
        if not sound or (above and value == low):
            kind = "a whole number" if whole else "a finite number"
            start = "" if low == -math.inf else f" {'above' if above else 'from'} {low:g}"
            end = f" up to {high:g}" if high < math.inf else " on" if start and not above else ""
            hint = ": give its number, value.item()" if getattr(value, "shape", None) == () else ""
            raise ValueError(f"{name} must be {kind}{start}{end}, got {short(value)}{hint}")


def _is_finite(value: object, kind: type = Real) -> bool:
    """Return whether a value is a finite number of a kind, and not a bool."""
    return isinstance(value, kind) and not isinstance(value, bool) and math.isfinite(value)  # type: ignore[arg-type]


def check_numbers(count: int, low: float = -math.inf, /, **values: object) -> None:
    """Raise unless each value consists of ``count`` finite numbers, each from ``low`` on.

    Args:
        count: how many.
        low: smallest allowed number.
        values: numbers by the name that the message uses.

    Raises:
        ValueError: with the name and the values.

    Example:
        >>> check_numbers(2, interval=(0.0, "a"))
        Traceback (most recent call last):
        ValueError: interval must be 2 finite numbers, got (0.0, 'a')
    """
    for name, value in values.items():
        given = list(value) if isinstance(value, Iterable) else []
        if len(given) != count or not all(map(_is_finite, given)):
            raise ValueError(f"{name} must be {count} finite numbers, got {short(value)}")
        smallest: dict[str, Any] = {name: min(given)}
        check_number(low, **smallest)


def check_type(kind: type | tuple[type, ...], **values: object) -> None:
    """Raise unless each value is an instance of a class.

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


def check_float32(network: nn.Module, name: str) -> None:
    """Raise unless a network has float32 weights, as observations are.

    Raises:
        TypeError: with the remedy.

    Example:
        >>> check_float32(nn.Linear(2, 1).double(), "agent")
        Traceback (most recent call last):
        TypeError: agent must have float32 weights, as observations are, got torch.float64: .float()
    """
    for weight in network.parameters():
        if weight.is_floating_point() and weight.dtype != torch.float32:
            raise TypeError(f"{name} must have float32 weights, as observations are, got {weight.dtype}: .float()")


def check_choice(choices: Collection[object], **values: object) -> None:
    """Raise unless each value is one of some choices.

    Raises:
        ValueError: with the name, the choices and the value.

    Example:
        >>> check_choice(("guided", "base"), reward="sparse")
        Traceback (most recent call last):
        ValueError: reward must be one of 'guided', 'base', got 'sparse'
    """
    for name, value in values.items():
        if value not in choices:
            raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")


class CheckedModel(BaseModel):
    """A pydantic model whose errors name the field, the value and what would be right, in one line.

    Fields are strict (no text for a number, no bool for an integer), finite and frozen; unknown names raise an error.

    Raises:
        ValueError: naming each field that is wrong.

    Example:
        >>> from pydantic import Field
        >>> class Options(CheckedModel):
        ...     tau: float = Field(0.01, gt=0, le=1)
        >>> Options(tau=2.0)
        Traceback (most recent call last):
        ValueError: tau must be less than or equal to 1, got 2.0
    """

    model_config = ConfigDict(
        strict=True,
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
        validate_default=True,
    )

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ValueError("; ".join(dict.fromkeys(map(self._sentence, error.errors())))) from None

    def replace(self, **values: Any) -> Self:
        """Return a copy with other values, validated again; what was not given keeps its default."""
        return type(self)(**{name: getattr(self, name) for name in self.model_fields_set} | values)

    def taking(self, options: dict[str, Any]) -> Self:
        """Return a copy with those of its fields that are among some options, which are taken out of them."""
        return self.replace(**{name: options.pop(name) for name in type(self).model_fields if name in options})

    @classmethod
    def _sentence(cls, item: Any) -> str:
        name, kind, value = ".".join(map(str, item["loc"])), item["type"], short(item["input"])
        if kind == "extra_forbidden":
            return f"unknown key {name!r}: choose from {', '.join(cls.model_fields)}"
        if kind == "missing":
            return f"{name} is missing"
        if kind == "too_short":
            return f"{name} must hold at least {item['ctx']['min_length']} value, got {value}"
        text = item["msg"].removeprefix("Value error, ")
        if kind == "value_error":
            return text if not name or text.startswith(name) else f"{name}: {text}"
        return f"{name} {text.replace('Input should be', 'must be')}, got {value}"


def short(value: object, length: int = 80) -> str:
    """Return the representation of a value in one line, cut to a length that fits in a message.

    Example:
        >>> short("x" * 100, 10)
        "'xxxxxx..."
    """
    text = " ".join(repr(value).split())
    return text if len(text) <= length else f"{text[: length - 3]}..."


def printable(text: object) -> str:
    r"""Return a text in one line, with escapes for control characters, which could rewrite what a user sees.

    Example:
        >>> printable("a\x1b[2J\nb")
        'a\\x1b[2J b'
    """
    line = " ".join(str(text).split())
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in line)
