"""Settings of runs, the command line, the settings of a run that is resumed, and how a command ends."""

import importlib
import io
import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import td3_gradient_guided as recipe

from magrl.random_numbers import TEST_SEED
from magrl.training import RegionConfig, UsageError, command, parse_config
from magrl.training.config import make_presets, read_presets

ROOT = Path(__file__).parent.parent.parent
OWN = "date = 2026-07-01\nregion = {latitude = [40, 50], longitude = [-30, -20]}\n"


def parse(*args: str) -> recipe.Config:
    return parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, recipe.__doc__, args)


def test_bad_settings_of_a_run(tmp_path: Path) -> None:
    """Each alone, and those that do not agree with their scenario."""
    for bad, message in (
        ({"device": "foo"}, "device 'foo' cannot be used here"),
        ({"scenario": Path("nowhere.toml")}, "there is no scenario file at nowhere.toml"),
        ({"seed": TEST_SEED}, "seed must be less than"),
        ({"total_frames": 0}, "total_frames must be greater than or equal to 1, got 0"),
        ({"zeta": 3.0}, "zeta must be less than 3, got 3"),
        ({"noise": (0.05, -0.05, 5.0)}, "noise.1 must be greater than or equal to 0, got -0.05"),
    ):
        with pytest.raises(ValueError, match=message):
            RegionConfig(**bad)
    path = tmp_path / "mine.toml"
    for text, message in (
        (OWN + "zeta = 0.02\n", r"zeta = 0\.02, the training 0\.01: add --zeta 0\.02"),
        (OWN + 'arrival = "declared"\n', "only ppo_anywhere"),
        (OWN.replace("[40, 50]", "[75, 85]"), r"mine.toml: region.latitude \(75.0, 85.0\): with margin_deg 5"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=message):
            RegionConfig(scenario=path)


def test_linear_goes_from_start_to_end() -> None:
    config = recipe.Config(learning_rate=3e-3, final_learning_rate=1e-3)
    assert [config.linear("learning_rate", x) for x in (1.0, 0.5, 0.0)] == pytest.approx([3e-3, 2e-3, 1e-3])


@pytest.mark.parametrize("name", ["td3_gradient_guided", "ppo_anywhere"])
def test_every_setting_can_be_given_as_wandb_sweeps_write_it(name: str) -> None:
    """``--key=value`` with the value as Python prints it; so an own form of each switch and list is equal to it."""
    module = importlib.import_module(name)
    changed = {"seed": 3, "noise": (0.05, 0.05, 5.0), "num_cells": (8, 4), "wandb_tags": ("a",)}
    defaults = module.Config()
    switches = {key: not value for key, value in defaults.model_dump().items() if isinstance(value, bool)}
    config = defaults.replace(**changed, **switches)
    settings = {key: value for key, value in config.model_dump(mode="json").items() if key != "resume"}
    words = [f"--{key}={value}" for key, value in settings.items()]
    presets = getattr(module, "PRESETS", {"default": defaults})
    assert parse_config(module.Config, presets, "mine.py", None, words) == config
    assert "--noise=[0.05, 0.05, 5.0]" in words
    own = parse_config(module.Config, presets, "mine.py", None, ["--noise", "0.05", "0.05", "5"])
    assert own.noise == config.noise


def test_presets_are_read_beside_their_recipe(tmp_path: Path, monkeypatch) -> None:
    """From any directory; a preset has its own settings before those of the one that it extends."""
    folder = tmp_path / "recipes"
    folder.mkdir()
    text = '[mine.fast]\nextends = "table"\nseed = 2\n[mine.slow]\nextends = "fast"\nnoise = [0, 0.1, 5]\n'
    (folder / "presets.toml").write_text(text + '[mine.bad]\nextends = "tabel"\n[other.fast]\n', encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="extends must be one of 'fast', 'slow', 'bad', 'table', got 'tabel'"):
        read_presets("recipes/mine.py", table={"seed": 1, "gamma": 0.5})
    (folder / "presets.toml").write_text(text, encoding="utf-8")
    found = read_presets("recipes/mine.py", table={"seed": 1, "gamma": 0.5})
    assert found["slow"] == {"preset": "slow", "seed": 2, "gamma": 0.5, "noise": (0, 0.1, 5)}
    assert make_presets(dict, found) == found


# Runs that are resumed

MINE = '"recipe": "td3_gradient_guided.py"'


def test_other_files_are_not_resumed(tmp_path: Path) -> None:
    for content, message in (
        (None, "holds no config.json"),
        ("", "cannot resume"),
        ("[]", "not of this version of magrl: start the training again in a new folder"),
        ('{"recipe": "ppo.py"}', r"the run was started by ppo\.py: resume it with that recipe"),
        (f'{{{MINE}, "wings": 2}}', "unknown key 'wings'"),
        (f'{{{MINE}, "scenario": "scenario.toml"}}', "there is no scenario file at"),
        (f'{{{MINE}, "wandb_mode": "loud"}}', "wandb_mode must be 'offline', 'online' or 'disabled'"),
    ):
        if content is not None:
            (tmp_path / "config.json").write_text(content, encoding="utf-8")
        with pytest.raises(UsageError, match=message) as error:
            parse("--resume", str(tmp_path))
        assert str(tmp_path) in str(error.value)


def test_complete_run_and_other_options_are_refused(tmp_path: Path) -> None:
    for name in ("config.json", "eval.json"):
        (tmp_path / name).write_text("{}", encoding="utf-8")
    for options, message in (
        ((), r"is complete: its results are in .*eval\.json"),
        (("--preset", "paper", "--seed", "1"), r"leave out --seed 1 --preset paper$"),
        (("--task", "nogo"), r"leave out --task nogo$"),
    ):
        with pytest.raises(UsageError, match=message):
            parse(*options, "--resume", str(tmp_path))


def test_resumed_settings_are_those_of_the_run(tmp_path: Path) -> None:
    """However the folder is written; paths are those of this machine."""
    settings = {"recipe": recipe.RECIPE, "seed": 7, "num_cells": [8, 8], "guided": False, "scenario": "scenario.toml"}
    (tmp_path / "config.json").write_text(json.dumps(settings), encoding="utf-8")
    (tmp_path / "scenario.toml").write_text(OWN, encoding="utf-8")
    for text in (f"--resume={tmp_path}", f"--resume {tmp_path}/."):
        config = parse(*text.split())
        assert (config.seed, config.num_cells, config.guided) == (7, (8, 8), False)
        assert (config.out, config.resume, config.scenario) == (tmp_path, tmp_path, tmp_path / "scenario.toml")


# The end of a command


def test_bad_usage_is_one_line_and_bugs_keep_their_traceback(capsys) -> None:
    def fail(kind: type[Exception]) -> None:
        raise kind("no such\nrun")

    for kind, more in ((UsageError, ()), (OSError, ()), (ValueError, (KeyError, ValueError))):
        with pytest.raises(SystemExit) as stop:
            command("mine.py", lambda kind=kind: fail(kind), *more)
        assert (stop.value.code, capsys.readouterr().err) == (2, "mine.py: no such run\n")
    with pytest.raises(ValueError, match="no such"):
        command("mine.py", lambda: fail(ValueError))


def test_reader_that_ends_first_leaves_no_traceback(tmp_path: Path, monkeypatch, capsys) -> None:
    """As in `command --help | head -1`."""
    with (tmp_path / "out").open("w", encoding="utf-8") as file, monkeypatch.context() as patch:

        def broken(*_: object) -> None:
            raise BrokenPipeError

        patch.setattr(sys, "stdout", SimpleNamespace(write=broken, flush=broken, fileno=file.fileno))
        with pytest.raises(SystemExit) as stop:
            command("mine.py", lambda: print("help"))
    assert (stop.value.code, capsys.readouterr().err) == (141, "")
    for script in ROOT.glob("recipes/**/[!_]*.py"):
        end = script.read_text("utf-8").partition('if __name__ == "__main__":\n')[2]
        assert not end or end.startswith("    command("), script.name


def test_ctrl_c_ends_a_command_without_a_traceback(capsys, monkeypatch) -> None:
    """What it prints is UTF-8 in every locale, of any path."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    screen = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", screen)
    with pytest.raises(SystemExit, match="130"):
        command("mine.py", interrupted)
    assert capsys.readouterr().err.endswith(": interrupted\n")
    command("mine.py", lambda: print("°", Path(os.fsdecode(b"a\xff"))))
    assert screen.buffer.getvalue().endswith("° a\\udcff\n".encode())
