"""The sweep of algorithms over the named tasks, and its bars."""

from __future__ import annotations

import math
import runpy
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from pandas import read_csv
from support.recipes import ROOT, TABLES, load
from tensordict import TensorDict

from magrl import score
from magrl.files import locked
from magrl.navigators import Secant
from magrl.training import UsageError

pytest.importorskip("stable_baselines3")
sweep = load("docs/tables/sweep")
bars = sys.modules["bars"]
RESULTS = ROOT / "docs" / "results"


@pytest.mark.parametrize(("task", "name"), [("nogo", "PPO")])
def test_a_run_is_trained_once_and_scored_at_several_points(tmp_path: Path, monkeypatch, task: str, name: str) -> None:
    monkeypatch.setattr(sweep, "VEHICLES", 4)
    monkeypatch.setattr(sweep, "POINTS", 2)
    monkeypatch.setattr(sweep, "score", partial(score, max_steps=2))
    chosen = sweep.ALGORITHMS[name]
    settings = chosen.settings | {"n_steps": 2, "batch_size": 16}
    monkeypatch.setitem(sweep.ALGORITHMS, name, chosen._replace(num_envs=8, settings=settings))
    monkeypatch.setitem(sweep.TASKS, task, sweep.TASKS[task]._replace(budget={name: 0.032}))
    job = (sweep.Config(out=tmp_path), task, name, 0)
    rows = read_csv(sweep.run(job[0], job[1:]))
    assert rows["steps"].tolist() == [8, 16, 32, 32]
    assert rows[["task", "algorithm", "seed"]].drop_duplicates().to_numpy().tolist() == [[*job[1:]]]
    assert rows[["SR", "SPL"]].to_numpy().min() >= 0
    assert rows["cpu_s"].is_monotonic_increasing
    kept = score(tmp_path / f"{task}-{name}-seed0.onnx", task, episodes=4, max_steps=2)
    assert rows[["SPL", "return"]].iloc[-1].tolist() == pytest.approx([kept["SPL"], kept["return"]], abs=0.02)
    monkeypatch.setattr(sweep, "trained", None)
    assert len(read_csv(sweep.run(job[0], job[1:]))) == len(rows)


def test_an_interrupted_training_by_a_recipe_begins_again(tmp_path: Path, monkeypatch) -> None:
    """The recipe refuses the folder of a run."""
    (tmp_path / "box-GG-TD3-seed0").mkdir()
    monkeypatch.setattr(sweep, "recipe", lambda *about: [{"steps": about[-1].exists()}])
    assert read_csv(sweep.run(sweep.Config(out=tmp_path), ("box", "GG-TD3", 0)))["steps"].tolist() == [False]


def test_a_sweep_is_refused_before_anything_is_trained(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for results, options, message in (
        ("new/folder", [], "none of the algorithms"),
        ("file/folder", [], "cannot write"),
        ("new", ["--tasks", "mars"], "task must be one of .*, got 'mars'"),
    ):
        with pytest.raises((UsageError, OSError), match=message):
            sweep.main(["--no-train", "--out", str(tmp_path / "runs"), "--results", str(tmp_path / results), *options])
    assert (tmp_path / "new" / "folder").is_dir()
    with locked(tmp_path), pytest.raises(UsageError, match="another process is writing"):
        sweep.main(["--out", str(tmp_path), "--results", str(tmp_path)])


def test_a_recipe_that_fails_says_why(tmp_path: Path, monkeypatch) -> None:
    assert all((ROOT / "recipes" / script).is_file() for script, *_ in sweep.RECIPES.values())
    (tmp_path / "fails.py").write_text("raise SystemExit('no power')", encoding="utf-8")
    monkeypatch.setitem(sweep.RECIPES, "GG-TD3", (str(tmp_path / "fails.py"),))
    with pytest.raises(UsageError, match=r"fails\.py ended with status 1: no power"):
        sweep.recipe("box", "GG-TD3", 0, tmp_path)


@pytest.mark.parametrize("name", ["bars", "publish"])
def test_help_is_printed(name: str, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(TABLES / f"{name}.py"), run_name="__main__")
    assert "usage" in capsys.readouterr().out


def test_jobs_of_one_seed_come_first() -> None:
    jobs = list(sweep.planned(sweep.Config(tasks=("box", "storm"), seeds=(3, 4))))
    assert [seed for *_, seed in jobs] == sorted(seed for *_, seed in jobs)
    names = {"PPO", "SAC", "TD3", "GG-TD3"}
    assert {(task, name) for task, name, seed in jobs if seed == 4} == {("box", name) for name in names} | {
        ("storm", name) for name in ("PPO", "ppo_memory")
    }


def test_the_rule_turns_as_little_as_clears_the_area_ahead() -> None:
    """From 60 km before the edge of a disc of 20 km, slightly to the left: to the right of it, and no further."""
    rule = bars.Around(Secant())
    rule.navigator.forward = lambda state: state.set("action", torch.tensor([[50.0, 0.0], [30.0, 0.0]]))
    angle, closeness = math.radians(-5.0), 1 - 60 / bars.SIGHT_KM
    disc = torch.tensor([closeness * math.cos(angle), closeness * math.sin(angle), 20 / bars.RADIUS_KM[1]])
    whole, short = rule(TensorDict(areas=torch.cat((disc, torch.zeros(6))).expand(2, 9), batch_size=2))["action"]
    tangent = angle + math.asin((20 + rule.BESIDE_KM) / 80)
    torch.testing.assert_close(whole, torch.tensor([50.0, tangent]), atol=0.01, rtol=0)
    assert short.tolist() == [30.0, 0.0]  # the destination is before the disc


def test_references_around_areas_keep_their_order(monkeypatch) -> None:
    monkeypatch.setattr(bars, "VEHICLES", 24)
    bars.bar.cache_clear()
    straight, rule, sighted, around = (bars.bar("nogo", name) for name in ("geodesic", "around", "sighted", "detour"))
    bars.bar.cache_clear()
    assert 90 < rule["SPL"] < sighted["SPL"] < around["SPL"]
    assert straight["SR"] < 50 < 90 < rule["SR"]
    assert around["SR"] == sighted["SR"] == 100


def test_the_table_has_the_middle_of_the_runs(monkeypatch) -> None:
    monkeypatch.setattr(sweep, "bars_of", lambda task: [])  # noqa: ARG005
    curves = read_csv(RESULTS / "scores.csv")
    chosen = curves[(curves["task"] == "storm") & (curves["algorithm"] == "PPO")]
    last = torch.tensor(chosen.groupby("seed")["SPL"].last().to_numpy()).sort().values
    (line,) = [line for line in sweep.table(chosen).splitlines() if "| PPO |" in line]
    assert f"{last[1:4].mean():.1f} (" in line
    assert line.split(" (")[0] in (RESULTS / "scores.md").read_text("utf-8")
