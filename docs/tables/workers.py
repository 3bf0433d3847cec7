"""Calls of a function in other processes, of this machine or of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import torch
from joblib import Parallel, delayed, parallel_config
from tqdm import tqdm

Backend = Literal["loky", "ray"]


def mapped(
    function: Callable[[Any], Any], values: Sequence[Any], jobs: int = 1, backend: Backend = "loky", unit: str = "cell"
) -> Iterator[Any]:
    """Yield the results of a function in the order of its values, with a progress bar.

    Args:
        function: function of one value.
        values: the values.
        jobs: processes at a time, with one thread each; 1 for this process.
        backend: where they are: ``"loky"`` for this machine, ``"ray"`` for a cluster (``pip install ray``).
        unit: name of a value.
    """
    if jobs == 1:
        yield from tqdm(map(function, values), total=len(values), unit=unit)
        return
    if backend == "ray":
        from ray.util.joblib import register_ray

        register_ray()
    with parallel_config(backend):
        results = Parallel(jobs, return_as="generator")(delayed(_alone)(function, value) for value in values)
        yield from tqdm(results, total=len(values), unit=unit)


def _alone(function: Callable[[Any], Any], value: Any) -> Any:
    torch.set_num_threads(1)
    return function(value)
