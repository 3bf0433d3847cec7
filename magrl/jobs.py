"""Calls of a function in other processes, of this machine or of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Literal

import torch

from magrl.checks import library

Backend = Literal["loky", "ray"]
"""Where jobs run."""


def mapped(
    function: Callable[[Any], Any],
    values: Sequence[Any],
    jobs: int = 1,
    backend: Backend = "loky",
    address: str | None = None,
    unit: str = "cell",
) -> Iterator[Any]:
    """Yield the results of a function in the order of its values, with a progress bar.

    Args:
        function: function of one value.
        values: the values.
        jobs: processes at a time, with one thread each; 1 for this process.
        backend: where they are: ``"loky"`` for this machine, ``"ray"`` for a cluster.
        address: cluster of Ray, ``"auto"`` or ``"HOST:PORT"``; None starts one on this machine.
        unit: name of a value.

    Example:
        >>> list(mapped(abs, [-1, 2]))
        [1, 2]
    """
    bar = partial(library("tqdm", "recipes").tqdm, total=len(values), unit=unit)
    if jobs == 1:
        yield from bar(map(function, values))
        return
    if backend == "ray":
        ray = library("ray", "ray")
        ray.init(address or "local", ignore_reinit_error=True)
        with library("ray.util.multiprocessing", "ray").Pool(jobs) as pool:
            yield from bar(pool.imap(partial(_alone, function), values))
        return
    joblib = library("joblib", "recipes")
    with joblib.parallel_config(backend):
        calls = (joblib.delayed(_alone)(function, value) for value in values)
        yield from bar(joblib.Parallel(jobs, return_as="generator")(calls))


def _alone(function: Callable[[Any], Any], value: Any) -> Any:
    torch.set_num_threads(1)
    return function(value)
