"""Runs: folders that are never overwritten, curves that are on disk at once, statistics and the best policy."""

import csv
import json
import math
from pathlib import Path

import pytest
import td3_gradient_guided as recipe
import torch
from tensordict import TensorDict
from torch import nn

from magrl import paper
from magrl.files import write_json
from magrl.training import Run, RunConfig, UsageError
from magrl.training.checkpoints import create_run_folder, locked
from magrl.training.curves import BestPolicy, RunLog, TrainingStatistics, selection_score
from magrl.training.run import passes_paper

ROW = {"frames": 512, "return": 1.5, "eval_spl": 88.4, "return_alignment": -0.5}


# The folder


def test_new_and_empty_folders_are_accepted(tmp_path: Path) -> None:
    folder = create_run_folder(tmp_path / "a" / "run")
    assert folder.is_dir()
    assert create_run_folder(folder) == folder


def test_each_folder_in_use_has_its_message(tmp_path: Path) -> None:
    """A complete run, an interrupted run and a foreign folder need different actions of the user."""
    complete, interrupted, foreign = (tmp_path / name for name in ("complete", "interrupted", "foreign"))
    for folder, files in (
        (complete, ("config.json", "eval.json")),
        (interrupted, ("config.json",)),
        (foreign, ("notes.txt",)),
    ):
        folder.mkdir()
        for name in files:
            (folder / name).touch()
    for folder, message in (
        (complete, f"the run in {complete} is complete: choose another --out, or remove it"),
        (interrupted, f"{interrupted} holds a run that is not complete: --resume {interrupted}, choose another --out"),
        (foreign, f"the run folder {foreign} is not empty: choose another --out"),
        (foreign / "notes.txt", "notes.txt is not empty: choose another --out"),
    ):
        with pytest.raises(UsageError) as error:
            create_run_folder(folder)
        assert message in str(error.value)
    with pytest.raises(UsageError, match=r"notes\.txt/run cannot be made \(Not a directory\): choose another --out"):
        create_run_folder(foreign / "notes.txt" / "run")


def in_run(config: RunConfig) -> Run:
    return Run(config, recipe="mine.py", name="mine")


def test_config_is_written_with_the_folder(tmp_path: Path) -> None:
    config = RunConfig(out=tmp_path / "run", seed=4, wandb_mode="disabled")
    with in_run(config) as run:
        assert {path.name for path in run.folder.iterdir()} == {".lock", "config.json"}
        written = json.loads((run.folder / "config.json").read_text())
        assert (written["recipe"], written["seed"]) == ("mine.py", 4)
        assert (written["out"], written["resume"], written["scenario"]) == ("run", None, None)
        with pytest.raises(UsageError, match="another process"), locked(run.folder):
            pass
    with locked(run.folder):
        pass


def test_scenario_is_copied_with_the_config(tmp_path: Path) -> None:
    path = tmp_path / "azores.toml"
    path.write_text("date = 2026-07-01\nregion = {latitude = [40, 50], longitude = [-30, -20]}\n")
    with in_run(RunConfig(out=tmp_path / "run", scenario=path)) as run:
        assert run.scenario.region.latitude == (40.0, 50.0)
        assert (run.folder / "scenario.toml").read_text() == path.read_text()
        assert json.loads((run.folder / "config.json").read_text())["scenario"] == "scenario.toml"


def test_start_that_fails_leaves_no_folder(tmp_path: Path, monkeypatch) -> None:
    """Before anything was collected; so the same command can be given again."""

    def broken(*_: object, **__: object) -> None:
        raise MemoryError("no room for the collector")

    monkeypatch.setattr(recipe, "make_collector", broken)
    out = tmp_path / "run"
    with pytest.raises(MemoryError, match="no room"):
        recipe.train(recipe.Config(out=out, num_envs=4, eval_tasks_small=2, eval_tasks=2, num_cells=(8,)))
    assert not out.exists()


def test_config_that_cannot_be_written_leaves_no_folder(tmp_path: Path, monkeypatch) -> None:
    def full(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(Run, "_write_config", full)
    with pytest.raises(OSError, match="no space"), in_run(RunConfig(out=tmp_path / "run")):
        pass
    assert not (tmp_path / "run").exists()


def test_failure_after_the_first_batch_keeps_the_folder(tmp_path: Path) -> None:
    run = in_run(RunConfig(out=tmp_path / "run"))
    run.statistics.frames = 1
    with pytest.raises(RuntimeError), run:
        raise RuntimeError
    assert (tmp_path / "run" / "config.json").is_file()


def test_failure_of_a_resumed_run_keeps_the_folder(tmp_path: Path) -> None:
    """Even before its first batch."""
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(RuntimeError), in_run(RunConfig(out=tmp_path, resume=tmp_path)):
        raise RuntimeError
    assert (tmp_path / "config.json").read_text() == "{}"


def test_folder_of_another_is_not_removed(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(UsageError), in_run(RunConfig(out=tmp_path)):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


# Curves


def test_json_has_no_nan(tmp_path: Path) -> None:
    write_json(tmp_path / "x.json", {"a": math.nan, "b": 1.5, "c": "text", "d": (1, 2)})
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": None, "b": 1.5, "c": "text", "d": [1, 2]}


def test_rows_are_on_disk_when_written(tmp_path: Path) -> None:
    log = RunLog(tmp_path, list(ROW), {"seed": 0})
    log.row(ROW)
    with (tmp_path / "train.csv").open() as file:
        assert [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)] == [ROW]
    with pytest.raises(ValueError, match="unknown_column"):
        log.row({"unknown_column": 1.0})
    log.close()
    assert {path.name for path in tmp_path.iterdir()} == {"train.csv"}


@pytest.mark.parametrize(("rate", "spl", "passes"), [(97.0, 88.4, True), (96.9, 99.0, False), (99.0, 88.3, False)])
def test_results_of_the_paper(rate: float, spl: float, passes: bool) -> None:
    assert passes_paper({"eval_success_rate": rate, "eval_spl": spl}) is passes


# Statistics and the best policy


def steps(done: list[bool], success: list[bool], **sums: list[float]) -> TensorDict:
    """Return a batch of transitions; TorchRL's RewardSum writes sums from the start of the episode."""
    flags = {"done": torch.tensor(done).unsqueeze(-1), "success": torch.tensor(success).unsqueeze(-1)}
    values = {key: torch.tensor(value).unsqueeze(-1) for key, value in sums.items()}
    return TensorDict(next=TensorDict(**flags, **values), batch_size=[len(done)])


def test_statistics_count_ended_episodes_only() -> None:
    statistics = TrainingStatistics(window=3)
    statistics.add(
        steps(
            [False, True, True],
            [False, True, False],
            episode_reward=[9.0, 100.0, -50.0],
            episode_reward_destination=[9.0, 200.0, 0.0],
            episode_reward_proximity=[9.0, -100.0, -50.0],
        )
    )
    row = statistics.row()
    assert (row["frames"], row["episodes"], row["updates"]) == (3, 2, 0)
    assert (row["success_rate"], row["return"]) == (50.0, 25.0)
    assert (row["return_destination"], row["return_proximity"]) == (100.0, -75.0)
    assert math.isnan(row["return_alignment"]), "an agent without guidance has no such term"
    statistics.add(steps([True, True], [True, True], episode_reward=[10.0, 20.0]))
    assert statistics.row()["return"] == pytest.approx((-50 + 10 + 20) / 3), "the last three episodes"


def test_statistics_are_restored() -> None:
    statistics, other = TrainingStatistics(), TrainingStatistics()
    statistics.add(steps([True], [True], episode_reward=[7.0]))
    statistics.updates, statistics.losses = 5, {"loss_critic": torch.tensor(0.25)}
    other.load_state_dict(statistics.state_dict())
    row, expected = other.row(), statistics.row()
    assert row.keys() == expected.keys()
    assert all(row[key] == expected[key] or math.isnan(row[key]) for key in row)
    assert (row["updates"], row["loss_critic"], other.iterations) == (5, 0.25, 1)


def test_selection_score_by_hand() -> None:
    steps_taken, success = torch.tensor([10, 20, 30]), torch.tensor([True, True, False])
    assert selection_score(60.0, success, steps_taken, max_steps=50) == pytest.approx(60 - (10 + 20 + 50) / 3)


def test_selection_score_cannot_prefer_early_failure() -> None:
    """Of policies with the same successes, leaving the map at once is worth no more than flying to the end."""
    success = torch.tensor([True, False, False])
    early, late = torch.tensor([20, 1, 1]), torch.tensor([20, 50, 50])
    assert selection_score(30.0, success, early, 50) == selection_score(30.0, success, late, 50)
    arrives = torch.tensor([True, True, False])
    for taken in (1, 30, 50):
        later = torch.tensor([20, taken, 1])
        assert selection_score(30.0, arrives, later, 50) >= selection_score(30.0, success, early, 50)


def test_best_policy_refuses_a_score_that_is_not_finite() -> None:
    best = BestPolicy()
    for score in (math.nan, math.inf):
        with pytest.raises(ValueError, match="score must be a finite number"):
            best.offer(score, nn.Linear(1, 1))
    assert best.weights is None


# Settings


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"device": "foo"}, "device 'foo' cannot be used here"),
        ({"device": "meta"}, "device 'meta' cannot be used here"),
        ({"scenario": Path("nowhere.toml")}, "there is no scenario file at nowhere.toml"),
        ({"seed": paper.TEST_SEED}, "seed must be less than"),
        ({"seed": paper.VALIDATION_SEED}, "seed must be less than"),
        ({"total_frames": 0}, "total_frames must be greater than or equal to 1, got 0"),
        ({"total_episodes": 0}, "total_episodes"),
        ({"checkpoint_every": math.nan}, "checkpoint_every"),
        ({"logger": "paper"}, "logger"),
        ({"speed": 1}, "unknown key 'speed'"),
    ],
    ids=str,
)
def test_bad_settings_are_refused(bad: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RunConfig(**bad)


def test_linear_goes_from_start_to_end() -> None:
    config = recipe.Config(learning_rate=3e-3, final_learning_rate=1e-3)
    assert [config.linear("learning_rate", x) for x in (1.0, 0.5, 0.0)] == pytest.approx([3e-3, 2e-3, 1e-3])
