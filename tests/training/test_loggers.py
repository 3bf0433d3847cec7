"""Content of wandb, TensorBoard and CSV logs. An offline run is read back by record, as `wandb sync` reads it."""

from __future__ import annotations

import importlib.util
import json
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from magrl.training import loggers
from magrl.training.checkpoints import create_run_folder
from magrl.training.curves import RunLog
from magrl.training.loggers import WandbRun, check_logger, open_log, panels

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
    while at < len(content):
        left = BLOCK - at % BLOCK
        if left < HEADER:
            at += left
            continue
        if at + HEADER > len(content):
            return  # it is still being written
        _, length, kind = struct.unpack_from("<IHB", content, at)
        if at + HEADER + length > len(content):
            return
        parts += content[at + HEADER : at + HEADER + length]
        at += HEADER + length
        if kind in (FULL, LAST):
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

    def table(self, name: str) -> list[dict[str, Any]]:
        """Return the rows of a table."""
        (path,) = (row[f"{name}.path"] for row in self.history if f"{name}.path" in row)
        table = json.loads((self.folder / "files" / path).read_text())
        return [dict(zip(table["columns"], row, strict=True)) for row in table["data"]]


def only(folder: Path) -> Offline:
    """Return the one offline run of a run folder."""
    (found,) = (folder / "wandb").glob("offline-run-*")
    return Offline(found)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run that was logged offline, with everything that a training logs."""
    folder = create_run_folder(tmp_path_factory.mktemp("offline") / "a run=1")
    os.environ["A_SECRET_OF_MINE"], os.environ["WANDB_MODE"] = "do-not-tell-anyone", "online"
    try:
        settings = {"seed": 7, "num_cells": [8, 8]}
        log = RunLog(folder, list(ROWS[0]), settings, wandb_mode="offline", label="a-label")
        for row in ROWS:
            log.row(row)
        log.figure("trajectories", Figure())
        (folder / "policy.pt").write_bytes(b"weights")
        log.result({"spl": 97.5, "steps": float("nan"), "num_tasks": 3}, navigator="a-navigator")
        log.close()
    finally:
        del os.environ["A_SECRET_OF_MINE"], os.environ["WANDB_MODE"]
    return folder


def test_run_has_its_name_group_tags_and_config(finished: Path) -> None:
    run = only(finished).run
    assert (run.display_name, run.run_group, list(run.tags)) == ("a run=1", "a-label", ["a-label"])
    assert (run.project, run.host) == ("magrl", "private")
    config = values(run.config.update)
    assert (config["seed"], config["num_cells"]) == (7, [8, 8])


def test_curves_are_grouped_over_frames(finished: Path) -> None:
    offline = only(finished)
    axes = {metric.name or metric.glob_name: metric.step_metric for metric in offline.records["metric"]}
    assert axes == {"frames": "", "*": "frames"}
    curves = [row for row in offline.history if "train/return" in row]
    expected = {"frames": 512, "train/updates": 8, "time/seconds": 2, "train/return": 1.5, "eval/spl": 80}
    expected |= {"return/alignment": -0.5, "train/loss_critic": 0.25, "_step": 512}
    expected |= {"time/frames_per_second": 256, "time/updates_per_second": 4}
    assert {key: curves[0][key] for key in expected} == expected
    assert (curves[1]["frames"], curves[1]["_step"], curves[1]["time/updates_per_second"]) == (1024, 1024, 8)
    assert {key.partition("/")[0] for key in curves[1] if "/" in key} == {"train", "eval", "return", "time"}
    assert not any("success_rate" in row for row in curves), "NaN is not a point of a curve"


def test_table_picture_policy_and_final_values(finished: Path) -> None:
    offline = only(finished)
    row = {"navigator": "a-navigator", "spl": 97.5, "steps": None, "num_tasks": 3}
    assert offline.table("eval/navigators") == [row]
    final = [values(record.update).get("final/spl") for record in offline.records["summary"]]
    assert 97.5 in final
    (picture,) = (row["figures/trajectories.path"] for row in offline.history if "figures/trajectories.path" in row)
    assert (offline.folder / "files" / picture).read_bytes() == (finished / "trajectories.png").read_bytes()
    (model,) = (artifact for artifact in offline.records["artifact"] if artifact.type == "model")
    assert model.name == "policy-a-run-1"
    assert json.loads(model.metadata) == row
    (entry,) = model.manifest.contents
    assert (entry.path, Path(entry.local_path)) == ("policy.pt", finished / "policy.pt")
    assert entry.size == Path(entry.local_path).stat().st_size


def test_nothing_about_the_machine_is_logged(finished: Path) -> None:
    """Except the paths of artifacts, which `wandb sync` reads and does not send."""
    private = [os.fsencode(finished.parent), os.fsencode(Path.home()) + b"/", os.fsencode(os.getcwd())]
    private += [b"do-not-tell-anyone", *([host] if len(host := socket.gethostname().encode()) > 4 else [])]
    told = [path.read_bytes() for path in (finished / "wandb").rglob("*") if path.is_file() and path.suffix != ".wandb"]
    for record in records(next(only(finished).folder.glob("*.wandb"))):
        for entry in record.artifact.manifest.contents:
            entry.local_path = ""
        told.append(record.SerializeToString())
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

    monkeypatch.setattr(loggers, "_wandb_logger", spy)
    WandbRun(tmp_path, "offline", {})
    assert seen == dict.fromkeys(names, str(tmp_path / "wandb")) | {"WANDB_ERROR_REPORTING": "false"}
    assert [os.environ.get(name) for name in names] == [None, "before", None]


@pytest.mark.slow
def test_disabled_wandb_is_not_imported(tmp_path: Path) -> None:
    code = f"""
import sys
from pathlib import Path
from magrl.training.curves import RunLog
log = RunLog(Path({str(tmp_path)!r}), ["frames"], {{}}, wandb_mode="disabled")
log.row({{"frames": 1}})
log.result({{"spl": 1.0}})
log.close()
print("wandb" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"train.csv", "eval.json"}


def resumed(folder: Path, **options: Any) -> RunLog:
    """Return a run that logged both rows, was killed, and is resumed from a checkpoint after the first."""
    log = RunLog(folder, list(ROWS[0]), {}, **options)
    log.row(ROWS[0])
    state = log.state_dict()
    log.row(ROWS[1])
    log.close()
    again = RunLog(folder, list(ROWS[0]), {}, resumed=True, **options)
    again.load_state_dict(state)
    return again


def test_resumed_run_of_wandb_continues_its_curve(tmp_path: Path) -> None:
    log = resumed(tmp_path, wandb_mode="offline")
    other = {**ROWS[1], "return": 9.0}
    log.row(other)
    log.close()
    parts = [Offline(path) for path in (tmp_path / "wandb").glob("offline-run-*")]
    assert {part.run.run_id for part in parts} == {log.state_dict()["wandb_id"]}, "one run in wandb"
    (newest,) = (part for part in parts if any(row.get("train/return") == 9.0 for row in part.history))
    points = [(row["_step"], row["frames"], row["train/return"]) for row in newest.history]
    assert points == [(512, 512, 1.5), (1024, 1024, 9.0)]
    assert newest.history[1]["time/frames_per_second"] == 256


@pytest.mark.parametrize("name", ["csv", "tensorboard"])
def test_the_same_curves_in_files(tmp_path: Path, name: str) -> None:
    if name == "tensorboard":
        pytest.importorskip("tensorboard")
    log = resumed(tmp_path, logger=name)
    log.row({**ROWS[1], "return": 9.0})
    log.result({"spl": 97.5, "steps": float("nan")})
    log.close()
    read = scalars if name == "csv" else events
    found = read(tmp_path / name)
    assert found["train/return"] == [(512, 1.5), (1024, 9.0)]
    assert found["final/spl"] == [(1024, 97.5)]
    assert found.keys() - {"final/spl"} == panels(ROWS[1]).keys()
    assert not (tmp_path / "wandb").exists()


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return what TorchRL's CSV logger wrote."""
    found = {}
    for path in (folder / "scalars").rglob("*.csv"):
        lines = [line.split(",") for line in path.read_text().splitlines()]
        name = path.relative_to(folder / "scalars").with_suffix("").as_posix()
        found[name] = [(int(step), float(value)) for step, value in lines]
    return found


def events(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return what TensorBoard reads."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = EventAccumulator(str(folder))
    board.Reload()
    return {tag: [(event.step, event.value) for event in board.Scalars(tag)] for tag in board.Tags()["scalars"]}


def test_missing_tensorboard_is_named(tmp_path: Path, monkeypatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "tensorboard" else found(name))
    with pytest.raises(ValueError, match=r"pip install 'magrl\[tensorboard\]'"):
        RunLog(tmp_path, [], {}, logger="tensorboard")
    assert not list(tmp_path.iterdir())
    check_logger("csv")


def test_failing_files_are_reported_and_disabled(tmp_path: Path, capsys) -> None:
    (tmp_path / "csv").write_text("in the way")
    log = open_log("csv", tmp_path, {}, "disabled")
    log.row(ROWS[0])
    log.close()
    message = capsys.readouterr().err
    assert message.startswith("csv failed and is disabled for the rest of this run: ")
    assert message.count("\n") == 1


def test_failing_wandb_is_reported_and_disabled(tmp_path: Path, monkeypatch, capsys) -> None:
    """Where it cannot start, and where it fails later."""

    def unwritable(*_: object) -> None:
        raise PermissionError("wandb folder")

    class Broken:
        @property
        def experiment(self) -> None:
            raise OSError("no space left")

    for make, reason in ((unwritable, "wandb folder"), (lambda *_: Broken(), "no space left")):
        monkeypatch.setattr(loggers, "_wandb_logger", make)
        log = WandbRun(tmp_path, "offline", {})
        log.row({"frames": 1, "loss": 2.0, "return": 3.0})
        log.summary({"a": 1.0})
        log.close()
        assert capsys.readouterr().err == f"wandb failed and is disabled for the rest of this run: {reason}\n"


def test_evaluation_logs_a_row_per_navigator(tmp_path: Path) -> None:
    import evaluate

    out = tmp_path / "comparison"
    evaluate.evaluate(evaluate.Config(navigators=("secant", "parallel"), tasks="figure-4-1", out=out))
    offline = only(out)
    rows = offline.table("eval/navigators")
    assert [row["navigator"] for row in rows] == ["secant", "parallel"]
    assert {"success_rate", "spl", "steps", "navigation_error_km"} <= rows[0].keys()
    assert (offline.run.run_group, list(offline.run.tags)) == ("evaluation", ["secant", "parallel"])
    assert values(offline.run.config.update)["tasks"] == "figure-4-1"
