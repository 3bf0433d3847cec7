"""The interface of a field model, and the magnetic elements of any model at positions.

A field model maps geodetic positions in degrees to the vector north, east, down in nanotesla, ``(..., 3)``, and with
``value_and_gradient`` also to its exact derivative northward and eastward in nT/km, ``(..., 3, 2)``. Models are float64
inside and out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, Self

import torch
from torch import Tensor, nn

from magrl.field.elements import elements_gradient, measured_elements


class FieldModel(Protocol):
    """Interface of a field model, as environments use it.

    Example:
        >>> class UniformField:
        ...     def __call__(self, latitude, longitude):
        ...         return torch.tensor([30000.0, 0.0, 30000.0]).expand(*latitude.shape, 3)
        ...
        ...     def value_and_gradient(self, latitude, longitude):
        ...         return self(latitude, longitude), torch.zeros(*latitude.shape, 3, 2)
        >>> model: FieldModel = UniformField()
        >>> elements_at(model, torch.zeros(2))
        tensor([    0.,    45., 30000.])
    """

    def __call__(self, latitude: Tensor, longitude: Tensor, /) -> Tensor:
        """Return the field vector north, east, down, ``(..., 3)`` [nT], at latitude and longitude ``(...)`` [deg]."""

    def value_and_gradient(self, latitude: Tensor, longitude: Tensor, /) -> tuple[Tensor, Tensor]:
        """Return the vector and its derivative northward and eastward, ``(..., 3, 2)`` [nT/km]."""


class Float64Module(nn.Module):
    """A module that follows device moves but keeps float64: float32 coefficients would cost meters of position.

    Example:
        >>> from magrl.field import IGRF
        >>> field = IGRF("2022-01-01").half()
        >>> isinstance(field, Float64Module), field.value_weights.dtype
        (True, torch.float64)
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)


def in_chunks(function: Callable[..., Tensor], points: Sequence[Tensor], rows: int, chunk: int) -> Tensor:
    """Evaluate a function of many points in chunks, so that its arrays stay small and in the cache.

    Args:
        function: from tensors ``(..., P)`` to ``(rows, P)``.
        points: arguments, each ``(..., P)``.
        rows: number of rows of the result.
        chunk: largest P of one call.

    Returns:
        ``(rows, P)``.

    Example:
        >>> in_chunks(lambda x: torch.stack((x, x * x)), [torch.arange(5.0)], rows=2, chunk=2)
        tensor([[ 0.,  1.,  2.,  3.,  4.],
                [ 0.,  1.,  4.,  9., 16.]])
    """
    count = points[0].shape[-1]
    if count <= chunk:
        return function(*points)
    out = points[0].new_empty(rows, count)
    for start in range(0, count, chunk):
        out[:, start : start + chunk] = function(*(x[..., start : start + chunk] for x in points))
    return out


def elements_at(field: Any, position: Tensor, index: Tensor | None = None) -> Tensor:
    """Return D, I, B_H of a field at positions.

    Args:
        field: field model, or a bank of them.
        position: ``(..., 2)`` latitude, longitude [deg].
        index: ``(...)`` int64, the field of each position in a bank; a single model ignores it.

    Returns:
        ``(..., 3)``: D [deg], I [deg], B_H [nT].

    Example:
        >>> from magrl.field import IGRF
        >>> paper = IGRF("2022-01-01", generation=13)
        >>> [round(x, 2) for x in elements_at(paper, torch.tensor([-2.0, 162.0])).tolist()]
        [8.02, -16.15, 35467.99]
    """
    return measured_elements(field(*_place(field, position, index)))


def elements_range(field: FieldModel, position: Tensor) -> tuple[Tensor, Tensor]:
    """Return the smallest and largest D, I, B_H of a field over positions.

    Args:
        field: field model.
        position: ``(..., 2)`` latitude, longitude [deg], for example :meth:`magrl.envs.Regions.grid`.

    Returns:
        Two tensors ``(3,)``: D [deg], I [deg], B_H [nT].

    Example:
        >>> from magrl.field import IGRF
        >>> corners = torch.tensor([[-10.0, 160.0], [-10.0, 170.0], [0.0, 160.0], [0.0, 170.0]])
        >>> low, high = elements_range(IGRF("2022-01-01"), corners)
        >>> (high - low).round(decimals=1)
        tensor([  3.1000,  22.4000, 783.4000], dtype=torch.float64)
    """
    values = elements_at(field, position).reshape(-1, 3)
    return values.amin(0), values.amax(0)


def elements_gradient_at(field: Any, position: Tensor, index: Tensor | None = None) -> Tensor:
    """Return the horizontal gradient of D, I, B_H of a field at positions.

    Args:
        field: field model, or a bank of them.
        position: ``(..., 2)`` latitude, longitude [deg].
        index: ``(...)`` int64, the field of each position in a bank; a single model ignores it.

    Returns:
        ``(..., 3, 2)``: element unit per km, northward and eastward.

    Example:
        >>> from magrl.field import IGRF
        >>> elements_gradient_at(IGRF("2022-01-01"), torch.tensor([-5.0, 165.0])).round(decimals=4)
        tensor([[-0.0012,  0.0015],
                [ 0.0173,  0.0030],
                [ 0.1423, -0.4990]], dtype=torch.float64)
    """
    return elements_gradient(*field.value_and_gradient(*_place(field, position, index)))


def device_of(field: object) -> torch.device:
    """Return the device of the tensors of a field model; the CPU for one without any.

    Example:
        >>> from magrl.field import IGRF
        >>> device_of(IGRF("2022-01-01"))
        device(type='cpu')
    """
    tensors = (*field.parameters(), *field.buffers()) if isinstance(field, nn.Module) else ()
    return next((values.device for values in tensors), torch.device("cpu"))


def _place(field: Any, position: Tensor, index: Tensor | None) -> tuple[Tensor, ...]:
    """Return the arguments of a field model, or of a bank, which alone takes the index."""
    place = (position[..., 0], position[..., 1])
    return (*place, index) if index is not None and getattr(field, "indexed", False) else place
