"""Files of policies: one format, in which a file says what it is, and one way to rebuild what it holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from torch import Tensor, nn

from magrl.checks import check_finite, short
from magrl.files import load_tensors, save_tensors

FORMAT = 6
LARGEST_WEIGHT = 1e6
"""Largest size of a weight in a file."""
Network = TypeVar("Network", bound=nn.Module)


class PolicyFile(NamedTuple):
    """What the file of a policy holds.

    Args:
        kind: what it is: ``"pilot"``, ``"memory"``, or by what it observes, ``"region"``, ``"legs"``, ``"readings"``.
        config: what it is made from, beside the weights.
        weights: weights of its network.
        training: settings of its training that evaluations share.

    Example:
        >>> PolicyFile("memory", {"size": 128}, {}).training
        {}
    """

    kind: str
    config: Mapping[str, Any]
    weights: Mapping[str, Tensor]
    training: Mapping[str, Any] = {}

    def write(self, path: Path | str) -> None:
        """Write the file.

        Raises:
            OSError: if it cannot be written.
        """
        save_tensors({"format": FORMAT, **self._asdict()}, Path(path))

    def network(self, make: Callable[[str | None], Network]) -> Network:
        """Return a network with the weights; ``make`` returns one of the same shape on a device.

        Raises:
            ValueError: for weights of other shapes, that are not real, or larger than :data:`LARGEST_WEIGHT`.
        """
        # Compares the shapes before anything is allocated: a few bytes may ask for any number of cells
        network = make("meta")
        network.load_state_dict(self.weights, assign=True)
        check_finite(self.weights.items(), "weights")
        for name, weight in self.weights.items():
            if not weight.is_floating_point() or (weight.abs() > LARGEST_WEIGHT).any():
                raise ValueError(f"{name} must hold real numbers of size up to {LARGEST_WEIGHT:g}, got {weight.dtype}")
        return network.float().requires_grad_(False).eval()


def read_policy(path: Path | str, *kinds: str) -> PolicyFile:
    """Return what the file of a policy holds. Reading a file runs no code from it.

    Args:
        path: path of the file.
        kinds: kinds that are expected; any by default.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for a damaged file, or one of another format or kind.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no policy file at {path}")
    content = load_tensors(path)
    version = content.pop("format", None) if isinstance(content, dict) else None
    if version != FORMAT:
        text = f"{path} is a policy of format {short(version)}; this version reads format {FORMAT}: train it again"
        raise ValueError(text)
    with reading(path):
        file = PolicyFile(**content)
        if kinds and file.kind not in kinds:
            raise ValueError(f"it is of the kind {short(file.kind)}, expected is {' or '.join(kinds)}")
    return file


@contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """Name the file in the error of foreign content, whatever it raises."""
    try:
        yield
    except (FileNotFoundError, ImportError):
        raise
    except Exception as error:
        raise ValueError(f"{path} does not hold a valid policy: {' '.join(str(error).split())}") from error
