"""Calls of a function in other processes, of this machine or of a Ray cluster."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Literal

import torch

from magrl.checks import check_choice, check_number, library

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

    When the iterator ends or is closed, by Ctrl-C too, all processes have ended.

    Args:
        function: function of one value.
        values: the values.
        jobs: calls at a time, each with one thread; a single one of ``"loky"`` runs in this process.
        backend: where they run: ``"loky"`` on this machine, ``"ray"`` on a cluster.
        address: cluster of Ray, ``"auto"`` or ``"HOST:PORT"``; None starts one on this machine.
        unit: name of a value.

    Raises:
        ChildProcessError: with the value whose process was killed.
        ConnectionError: if there is no cluster at the address.
        ImportError: with the command that installs what is missing.

    Example:
        >>> list(mapped(abs, [-1, 2]))
        [1, 2]
    """
    check_choice(_BACKENDS, backend=backend)
    check_number(1, whole=True, jobs=jobs)
    bar = partial(library("tqdm", "recipes").tqdm, total=len(values), unit=unit)
    if jobs == 1 and backend == "loky":
        yield from bar(map(partial(_alone, function), values))
        return
    with _BACKENDS[backend](jobs, address) as (submit, killed):
        yield from bar(_ordered(partial(submit, function), values, jobs, killed, unit))


def _ordered(
    submit: Callable[[Any], Future], values: Sequence[Any], jobs: int, killed: Any, unit: str
) -> Iterator[Any]:
    futures: list[Future] = []
    for number, value in enumerate(values):
        while number == len(futures) or not futures[number].done():
            running = [future for future in futures if not future.done()]
            if len(running) < jobs and len(futures) < len(values):
                futures.append(submit(values[len(futures)]))
            else:
                wait([futures[number], *running], return_when=FIRST_COMPLETED)
        try:
            yield futures[number].result()
        except killed as error:
            if cause := getattr(error, "cause", None):  # Ray's error of the function
                raise cause from None
            raise ChildProcessError(f"the process of {unit} {value!r} was killed, maybe out of memory") from error


def _alone(function: Callable[[Any], Any], value: Any) -> Any:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return function(value)
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _loky(*_: Any) -> Iterator[tuple[Callable[..., Future], Any]]:
    """Executors of one process each, so that a process that is killed is known by its value."""
    loky = library("joblib.externals.loky", "recipes")
    last, groups = dict[Any, Future](), dict[Any, Future]()

    def submit(*call: Any) -> Future:
        idle = [executor for executor, future in last.items() if future.done() and not future.exception()]
        executor = idle[0] if idle else loky.ProcessPoolExecutor(1, initializer=_follow, initargs=(os.getpid(),))
        groups[executor] = executor.submit(os.getpid)
        last[executor] = executor.submit(_alone, *call)
        return last[executor]

    try:
        yield submit, loky.process_executor.TerminatedWorkerError
    finally:
        for executor, group in groups.items():
            with suppress(Exception):  # that has not begun, or has ended
                os.killpg(group.result(0), signal.SIGKILL)  # also what a killed process has started
            executor.shutdown(kill_workers=True)


def _follow(parent: int) -> None:
    """Kill this process, and those that it starts, soon after its parent has ended."""
    os.setpgrp()  # out of reach of Ctrl-C, which the parent handles

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def connected(address: str | None, processors: int, **options: Any) -> Any:
    """Return Ray, connected to a cluster.

    Args:
        address: ``"auto"`` or ``"HOST:PORT"``; None starts one with some processors on this machine.
        processors: their number.
        **options: of ``ray.init``.

    Raises:
        ConnectionError: if there is no cluster at the address.
        ImportError: without Ray.
    """
    ray = library("ray", "ray")
    host, colon, port = (address or "").rpartition(":")
    try:
        if colon:  # Ray would wait for minutes
            socket.create_connection((host, int(port)), timeout=10).close()
    except (OSError, ValueError) as error:
        message = f"address must be auto or HOST:PORT of a Ray cluster that runs, got {address!r} ({error})"
        raise ConnectionError(message) from error
    # Without an address, Ray would wait for the cluster of a file that is left where one was killed.
    own = {} if address else {"num_cpus": processors, "include_dashboard": False}
    ray.init(address or "local", logging_level="error", log_to_driver=False, **own, **options)
    return ray


@contextmanager
def _ray(jobs: int, address: str | None) -> Iterator[tuple[Callable[..., Future], Any]]:
    environment = {"env_vars": {"PYTHONPATH": os.pathsep.join(sys.path)}}  # modules beside a script or a test
    ray = connected(address, jobs, runtime_env=environment)
    task, refs = ray.remote(max_retries=0)(_alone), []

    def submit(*call: Any) -> Future:
        refs.append(task.remote(*call))
        return refs[-1].future()

    try:
        yield submit, ray.exceptions.RayError
    finally:
        for ref in refs:  # at once: a shutdown takes seconds
            ray.cancel(ref, force=True)
        ray.shutdown()


_BACKENDS = {"loky": _loky, "ray": _ray}
