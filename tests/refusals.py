"""Rows of bad calls: what a call must raise and say, or that it must return NaN."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from magrl import files

NAN, INF = math.nan, math.inf


class Refused(NamedTuple):
    """A call, the error that it must raise, and what the message must contain."""

    call: Callable[[], object]
    error: type[Exception]
    says: tuple[str, ...]

    def failure(self) -> str | None:
        try:
            self.call()
        except self.error as error:
            missing = [text for text in self.says if text not in str(error)]
            return f"{error!r} does not say {missing}" if missing else None
        except Exception as error:
            return f"raised {error!r}, not {self.error.__name__}"
        return f"did not raise {self.error.__name__} with {self.says}"


class Nan(NamedTuple):
    """A call whose result must be NaN throughout, because an input is."""

    call: Callable[[], object]

    def failure(self) -> str | None:
        result = self.call()
        return None if all(leaf.isnan().all() and leaf.numel() for leaf in leaves(result)) else f"{result} is not NaN"


Rows = dict[str, list[Refused | Nan]]


def leaves(result: object) -> Iterator[Tensor]:
    if isinstance(result, (tuple, list)):
        for part in result:
            yield from leaves(part)
    else:
        yield torch.as_tensor(result)


def refused(call: Callable[[], object], error: type[Exception], *says: str) -> Refused:
    return Refused(call, error, says)


def t(*values: complex) -> Tensor:
    """A vector, complex where a value is."""
    return torch.tensor(values)


def zeros(*shape: int) -> Tensor:
    return torch.zeros(shape)


def int64(*shape: int) -> Tensor:
    return torch.zeros(shape, dtype=torch.int64)


def folder() -> Path:
    return Path(tempfile.mkdtemp())


def written(content: object) -> Path:
    """A tensor file with some content."""
    path = folder() / "content.pt"
    files.save_tensors(content, path)
    return path


def text_file(name: str, text: str) -> Path:
    path = folder() / name
    path.write_text(text)
    return path


def bad_numbers(build: Callable[..., object], **options: tuple[Any, ...]) -> list[Refused | Nan]:
    """An option of each name with each of some values: a ValueError that contains both."""
    return [
        refused(lambda n=name, v=value: build(**{n: v}), ValueError, name, repr(value))  # type: ignore[misc]
        for name, values in options.items()
        for value in values
    ]


def bad_tensors(function: Callable[..., object], *names: str) -> list[Refused | Nan]:
    """Numbers, texts, bools and complex numbers in the place of each of some tensors."""
    rows: list[Refused | Nan] = []
    for place in range(len(names)):
        for value, says in ((1.5, "float 1.5"), ("a", "str 'a'"), (t(1j), "complex64"), (zeros(1).bool(), "bool")):
            given = [zeros(1)] * place + [value] + [zeros(1)] * (len(names) - place - 1)
            rows.append(refused(lambda g=given: function(*g), TypeError, names[place], says))  # type: ignore[misc]
    return rows


def bad_vectors(function: Callable[[Any], object], name: str, size: int = 3) -> list[Refused | Nan]:
    """What is not a ``(..., size)`` tensor of real numbers."""
    shapes = ((), (2, size - 1), (2, size + 1))
    rows = [refused(lambda s=s: function(zeros(*s)), ValueError, name, str(s)) for s in shapes]  # type: ignore[misc]
    return [row for row in bad_tensors(function, name) if "bool" not in row.says] + rows  # type: ignore[union-attr]
