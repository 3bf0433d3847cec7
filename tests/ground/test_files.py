"""Files: written whole or not at all, and damage is named."""

import math
from pathlib import Path

import pytest
import torch

from magrl.files import DamagedFileError, check_writable, json_ready, load_tensors, save_tensors, write_json


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "numbers.pt"
    save_tensors([1], path)

    def fail(*_) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_tensors([2], path)
    assert load_tensors(path) == [1]
    assert list(tmp_path.iterdir()) == [path]


def test_damaged_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    torch.save([1], path)  # without the checksum
    for name in (path, tmp_path / "nowhere.pt"):
        with pytest.raises(DamagedFileError, match=f"^{name} is damaged: "):
            load_tensors(name)


def test_json_holds_no_infinity() -> None:
    assert json_ready({"a": [math.inf, (1.5, math.nan)], "b": "nan"}) == {"a": [None, [1.5, None]], "b": "nan"}
    with pytest.raises(TypeError, match="path must be a Path, got 'here'"):
        write_json("here", {})


def test_check_writable_makes_folders_and_keeps_files(tmp_path: Path) -> None:
    (tmp_path / "old.html").write_text("kept")
    check_writable(tmp_path / "old.html")
    assert (tmp_path / "old.html").read_text() == "kept"
    check_writable(tmp_path / "new" / "page.html")
    assert list((tmp_path / "new").iterdir()) == []
    with pytest.raises(OSError, match=r"cannot write .*old\.html/page\.html"):
        check_writable(tmp_path / "old.html" / "page.html")
