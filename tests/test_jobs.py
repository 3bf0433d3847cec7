"""Jobs in other processes: equal results, and none is left by Ctrl-C, an error or a death."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from magrl.jobs import mapped

KILLED = 5


def drawn(seed: int) -> tuple[float, int]:
    if seed == KILLED:
        os.kill(os.getpid(), signal.SIGKILL)
    draws = torch.randn(100_000, generator=torch.Generator().manual_seed(seed))
    return draws.exp().sum().item(), torch.get_num_threads()


def waiting(path: Path) -> None:
    child = subprocess.Popen(["sleep", "300"])
    path.write_text(f"{os.getpid()} {child.pid}", encoding="utf-8")
    child.wait()


def processes(path: Path) -> list[int]:
    """The job and what it has started, when both run."""
    until(60, lambda: path.exists() and len(path.read_text(encoding="utf-8").split()) == 2)
    known = [int(name) for name in path.read_text(encoding="utf-8").split()]
    assert all(map(running, known))
    return known


def running(process: int) -> bool:
    """Whether a process has not ended; an orphan may stay a zombie, for want of a real init in a container."""
    try:
        return Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(") ")[2][0] not in "ZX"
    except OSError:
        return False


def until(limit_s: float, condition: Callable[[], bool]) -> None:
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() - begin < limit_s
        time.sleep(0.02)


def test_results_are_those_of_this_process_until_one_is_killed_which_is_named() -> None:
    torch.set_num_threads(2)
    try:
        alone = list(mapped(drawn, range(KILLED)))
    finally:
        torch.set_num_threads(1)
    results = mapped(drawn, range(KILLED + 2), jobs=2)
    assert [next(results) for _ in alone] == alone == [drawn(seed) for seed in range(KILLED)]
    with pytest.raises(ChildProcessError, match=f"the process of cell {KILLED} was killed, maybe out of memory"):
        next(results)


def test_ctrl_c_ends_a_job_and_what_it_has_started_within_two_seconds(tmp_path: Path) -> None:
    known, begin = [], []

    def interrupt() -> None:
        known.extend(processes(tmp_path / "job"))
        begin.append(time.monotonic())
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=interrupt).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            list(mapped(waiting, [tmp_path / "job"], jobs=2))
    finally:
        signal.signal(signal.SIGINT, previous)
    until(2 + begin[0] - time.monotonic(), lambda: not any(map(running, known)))


def test_no_process_is_left_when_the_command_is_killed(tmp_path: Path) -> None:
    code = f"import sys, pathlib; sys.path.insert(0, {str(Path(__file__).parent)!r}); import test_jobs as t\n"
    code += "list(t.mapped(t.waiting, [pathlib.Path('job')], jobs=2))"
    main = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stderr=subprocess.DEVNULL)
    known = processes(tmp_path / "job")
    main.kill()
    main.wait()
    until(5, lambda: not any(map(running, known)))


def test_wrong_arguments_name_the_remedy(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace())
    for address in ("127.0.0.1:9", "localhost:port", "nowhere.invalid:6379"):
        with pytest.raises(ConnectionError, match=f"or HOST:PORT of a Ray cluster that runs, got '{address}'"):
            list(mapped(abs, [1], backend="ray", address=address))
    monkeypatch.setitem(sys.modules, "ray", None)
    for options, error, message in (
        ({"backend": "ray"}, ImportError, r"pip install 'magrl\[ray\]'"),
        ({"backend": "dask"}, ValueError, "backend must be .*loky.*dask"),
        ({"jobs": 0}, ValueError, "jobs must be a whole number from 1 on, got 0"),
    ):
        with pytest.raises(error, match=message):
            list(mapped(abs, [1], **options))
