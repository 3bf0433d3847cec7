"""Content of wandb's logs. An offline run is read back by record, as `wandb sync` reads it."""

from __future__ import annotations

import json
import os
import re
import socket
import struct
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from matplotlib.figure import Figure

from magrl.training import wandb_run
from magrl.training.checkpoints import create_run_folder
from magrl.training.curves import RunLog
from magrl.training.wandb_run import WandbRun

ROWS = (
    {"frames": 512, "updates": 8, "seconds": 2.0, "return": 1.5, "loss_critic": 0.25, "eval_spl": 80.0},
    {"frames": 1024, "updates": 24, "seconds": 4.0, "return": 2.5, "loss_critic": 0.5, "eval_spl": 90.0},
)
ROWS = tuple({**row, "return_alignment": -0.5, "success_rate": float("nan")} for row in ROWS)
BLOCK, HEADER, FULL, LAST = 32768, 7, 1, 4
"""Constants of the log format of LevelDB, in which wandb writes offline runs."""


def records(path: Path) -> Iterator[Any]:
    """Yield the records of an offline run: blocks of 32 kB, each part after its checksum, length and kind."""
    from wandb.proto import wandb_internal_pb2

    content, at, parts = path.read_bytes(), HEADER, b""
    while at + HEADER <= len(content):  # a record that is still being written is left out
        _, length, kind = struct.unpack_from("<IHB", content, at)
        parts += content[at + HEADER : at + HEADER + length]
        at += HEADER + length
        if BLOCK - at % BLOCK < HEADER:
            at += BLOCK - at % BLOCK
        if kind in (FULL, LAST) and at <= len(content):
            yield wandb_internal_pb2.Record.FromString(parts)
            parts = b""


def values(items: Any) -> dict[str, Any]:
    """Return items of a config, a history row or a summary as a dictionary of their dotted names."""
    return {".".join(item.nested_key) or item.key: json.loads(item.value_json) for item in items}


class Offline:
    """Content of an offline run, once it is complete: the service of wandb may write after ``finish``."""

    def __init__(self, folder: Path, patience: float = 10.0) -> None:
        self.folder, deadline = folder, time.monotonic() + patience
        self.records: dict[str, list[Any]] = {}
        while "exit" not in self.records and time.monotonic() < deadline:
            time.sleep(0.05)
            self.records = {}
            for record in records(next(folder.glob("*.wandb"))):
                kind = record.WhichOneof("record_type")
                self.records.setdefault(kind, []).append(getattr(record, kind))
        self.run = self.records["run"][-1]
        self.history = [values(row.item) for row in self.records["history"]]


def only(folder: Path) -> Offline:
    """Return the one offline run of a run folder."""
    (found,) = (folder / "wandb").glob("offline-run-*")
    return Offline(found)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run that was logged offline, with everything that a training logs."""
    folder = create_run_folder(tmp_path_factory.mktemp("offline") / "a run=1")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("A_SECRET_OF_MINE", "do-not-tell-anyone")
        patch.setenv("WANDB_MODE", "online")
        settings, labels = {"seed": 7, "num_cells": [8, 8]}, {"group": "a-label", "tags": ["a-label"]}
        log = RunLog(folder, list(ROWS[0]), partial(WandbRun, folder, "offline", settings, **labels))
        for row in ROWS:
            log.row(row)
        log.figure("trajectories", Figure())
        log.result({"spl": 97.5, "steps": float("nan"), "num_trips": 3})
        log.close()
    return folder


def test_run_and_its_curves(finished: Path) -> None:
    offline = only(finished)
    run, config = offline.run, values(offline.run.config.update)
    assert (run.display_name, run.run_group, list(run.tags)) == ("a run=1", "a-label", ["a-label"])
    assert (run.project, run.host, config["num_cells"]) == ("magrl", "private", [8, 8])
    axes = {metric.name or metric.glob_name: metric.step_metric for metric in offline.records["metric"]}
    assert axes == {"frames": "", "*": "frames"}
    curves = [row for row in offline.history if "train/return" in row]
    expected = {"frames": 512, "train/updates": 8, "time/seconds": 2, "train/return": 1.5, "eval/spl": 80}
    expected |= {"return/alignment": -0.5, "train/loss_critic": 0.25, "_step": 512}
    expected |= {"time/frames_per_second": 256, "time/updates_per_second": 4}
    assert {key: curves[0][key] for key in expected} == expected
    assert (curves[1]["frames"], curves[1]["_step"], curves[1]["time/updates_per_second"]) == (1024, 1024, 8)
    assert not any("success_rate" in row for row in curves), "NaN is not a point of a curve"


def test_picture_and_final_values(finished: Path) -> None:
    offline = only(finished)
    assert 97.5 in [values(record.update).get("final/spl") for record in offline.records["summary"]]
    (picture,) = (row["figures/trajectories.path"] for row in offline.history if "figures/trajectories.path" in row)
    assert (offline.folder / "files" / picture).read_bytes() == (finished / "trajectories.png").read_bytes()


def test_nothing_about_the_machine_is_logged(finished: Path) -> None:
    private = [b"do-not-tell-anyone", *(os.fsencode(x) for x in (finished.parent, f"{Path.home()}/", os.getcwd()))]
    private += [host] if len(host := socket.gethostname().encode()) > 4 else []
    told = [path.read_bytes() for path in (finished / "wandb").rglob("*") if path.is_file() and path.suffix != ".wandb"]
    told += [record.SerializeToString() for record in records(next(only(finished).folder.glob("*.wandb")))]
    assert len(told) > 10
    for secret in private:
        assert not any(secret in content for content in told), secret


def test_wandb_writes_to_the_run_folder_and_reports_nothing(tmp_path: Path, monkeypatch) -> None:
    """By default its crash reports look up a host when it starts, and its data goes to the home folder."""
    seen: dict[str, str | None] = {}
    names = ("WANDB_ERROR_REPORTING", "WANDB_DATA_DIR", "WANDB_CACHE_DIR")
    monkeypatch.setenv("WANDB_DATA_DIR", "before")

    def spy(*_: object) -> None:
        seen.update({name: os.environ.get(name) for name in names})

    monkeypatch.setattr(wandb_run, "_opened", spy)
    WandbRun(tmp_path, "offline", {})
    assert seen == dict.fromkeys(names, str(tmp_path / "wandb")) | {"WANDB_ERROR_REPORTING": "false"}
    assert [os.environ.get(name) for name in names] == [None, "before", None]


def resumed(folder: Path) -> RunLog:
    """Return a run that logged both rows, was killed, and is resumed from a checkpoint after the first."""
    opened = partial(WandbRun, folder, "offline", {})
    log = RunLog(folder, list(ROWS[0]), opened)
    log.row(ROWS[0])
    state = log.state_dict()
    log.row(ROWS[1])
    log.close()
    again = RunLog(folder, list(ROWS[0]), opened, resumed=True)
    again.load_state_dict(state)
    return again


def test_resumed_run_of_wandb_continues_its_curve(tmp_path: Path) -> None:
    log = resumed(tmp_path)
    log.row({**ROWS[1], "return": 9.0})
    log.close()
    parts = [Offline(path) for path in (tmp_path / "wandb").glob("offline-run-*")]
    assert {part.run.run_id for part in parts} == {log.state_dict()["wandb_id"]}, "one run in wandb"
    (newest,) = (part for part in parts if any(row.get("train/return") == 9.0 for row in part.history))
    points = [(row["_step"], row["frames"], row["train/return"]) for row in newest.history]
    assert points == [(512, 512, 1.5), (1024, 1024, 9.0)]
    assert newest.history[1]["time/frames_per_second"] == 256


def test_a_failing_wandb_is_reported_and_disabled(tmp_path: Path, monkeypatch, capsys) -> None:
    """It is missing, fails later, or cannot start."""

    def unwritable(*_: object) -> None:
        raise PermissionError("wandb folder")

    real = wandb_run._opened
    monkeypatch.setitem(sys.modules, "wandb", None)
    for make, reason in (
        (real, "import of wandb"),
        (lambda *_: SimpleNamespace(), "no attribute 'log'"),
        (unwritable, "wandb folder"),
    ):
        monkeypatch.setattr(wandb_run, "_opened", make)
        log = WandbRun(tmp_path, "offline", {})
        log.row(ROWS[0])
        log.summary({"a": 1.0})
        log.close()
        message = rf"wandb failed and is disabled for the rest of this run: .*{reason}.*\n"
        assert re.fullmatch(message, capsys.readouterr().err)
