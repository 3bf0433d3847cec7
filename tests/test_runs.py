"""The run folder: never written over, curves on disk at once."""

import csv
import json
import math
from pathlib import Path

import pytest

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
