"""The example of an autopilot goes on where it was interrupted, and keeps the files of a flight that failed."""

import runpy
from pathlib import Path
from typing import Any

import pytest
import torch
from support.recipes import ROOT

import magrl.field
import magrl.files
from magrl.onboard import Onboard

FILES = {"flight.json", "ship.json"}


def fly() -> None:
    runpy.run_path(str(ROOT / "docs/examples/autopilot.py"))


@pytest.mark.parametrize(("owner", "name"), [(Onboard, "save"), (magrl.files, "write_json")])
@pytest.mark.parametrize("count", [1, 4])
def test_an_interrupted_flight_goes_on(
    owner: Any, name: str, count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """After the state is saved, before the leg; and after the leg, before its reading."""
    monkeypatch.chdir(tmp_path)
    fly()
    original, calls = getattr(owner, name), []

    def interrupted(*args: Any) -> None:
        original(*args)
        calls.append(args)
        if len(calls) == count:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, interrupted)
        with pytest.raises(KeyboardInterrupt):
            fly()
    assert (tmp_path / "flight.json").exists()
    fly()
    whole, resumed = capsys.readouterr().out.splitlines()
    assert resumed == whole
    assert whole.startswith("arrived 62.0 ")
    assert list(tmp_path.iterdir()) == []


def test_a_flight_that_is_lost_keeps_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """Here, as all sensors hang."""
    monkeypatch.chdir(tmp_path)
    hung = magrl.field.elements_at(magrl.field.IGRF("2026-06-30"), torch.tensor([60.4, 5.3]).double())
    monkeypatch.setattr(magrl.field, "elements_at", lambda *_: hung)
    with pytest.raises(SystemExit, match="a sensor is stuck"):
        fly()
    assert capsys.readouterr().out.startswith("lost")
    assert {path.name for path in tmp_path.iterdir()} == FILES
