"""The run folder: never written over, curves on disk at once, wandb telling nothing of the machine."""

import csv
import json
import math
import os
import socket
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from magrl.runs import RunLog, create_run_folder, write_json

ROW = {"frames": 512, "return": 1.5, "eval_spl": 88.4, "reward_alignment": -0.5}


def test_folder_in_use_is_refused(tmp_path: Path) -> None:
    folder = create_run_folder(tmp_path / "a" / "run")
    assert folder.is_dir()
    assert create_run_folder(folder) == folder  # empty: nothing to lose
    (folder / "policy.pt").touch()
    with pytest.raises(FileExistsError, match="run is in use"):
        create_run_folder(folder)
    with pytest.raises(FileExistsError, match="policy"):
        create_run_folder(folder / "policy.pt")


def test_json_has_no_nan(tmp_path: Path) -> None:
    write_json(tmp_path / "x.json", {"a": math.nan, "b": 1.5, "c": "text", "d": (1, 2)})
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": None, "b": 1.5, "c": "text", "d": [1, 2]}


def test_rows_are_on_disk_when_written(tmp_path: Path) -> None:
    log = RunLog(tmp_path, list(ROW), {"seed": 0})
    log.row(ROW)
    with (tmp_path / "train.csv").open() as file:
        assert [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)] == [ROW]
    with pytest.raises(ValueError, match="unheard"):
        log.row({"unheard": 1.0})
    log.close()
    assert json.loads((tmp_path / "config.json").read_text()) == {"seed": 0}
    assert not (tmp_path / "wandb").exists()


def test_wandb_offline_holds_the_run_and_nothing_of_the_machine(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("A_SECRET_OF_MINE", "do-not-tell-anyone")
    folder = create_run_folder(tmp_path / "run")
    log = RunLog(folder, list(ROW), {"seed": 7}, wandb_mode="offline", group="a-group", tags=["a-tag"])
    log.row(ROW)
    log.figure("picture", Figure())
    log.result({"spl": 97.5, "num_tasks": 3})
    log.close()
    (run,) = (folder / "wandb").glob("offline-run-*")
    (binary,) = run.glob("*.wandb")
    content = binary.read_bytes()
    names = ("eval/spl", "reward/alignment", "final/spl", "a-group", "a-tag", "figures/picture", "final/table")
    for name in names:
        assert name.encode() in content, name
    assert list((run / "files" / "media" / "images" / "figures").glob("picture*.png"))
    private = [os.fsencode(tmp_path), os.fsencode(Path.home()) + b"/", os.fsencode(os.getcwd())]
    private += [b"do-not-tell-anyone", *([host] if len(host := socket.gethostname().encode()) > 4 else [])]
    for path in (p for p in (folder / "wandb").rglob("*") if p.is_file()):
        for secret in private:
            assert secret not in path.read_bytes(), f"{secret!r} is in {path.name}"
