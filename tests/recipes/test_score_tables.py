"""The scores of algorithms on the named tasks, and their bars."""

from __future__ import annotations

import math
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import tyro
from pandas import DataFrame, concat, read_csv
from support.recipes import ROOT, TABLES, load

from magrl.evaluation.tracks import write_episodes
from magrl.training import parse_config

pytest.importorskip("stable_baselines3")
scores = load("docs/tables/scores")
bars = sys.modules["bars"]
RESULTS = ROOT / "docs" / "results"
RECIPES = [path for path in (ROOT / "recipes").glob("*.py") if path.stem.startswith(("ppo", "td3"))]


@pytest.fixture
def without_bars(monkeypatch) -> None:
    """Fly no navigators, and draw small figures."""
    monkeypatch.setattr(scores, "bars_of", lambda task: [])  # noqa: ARG005


def test_each_command_of_the_file_can_be_given() -> None:
    known = {"sb3": load("docs/examples/sb3"), **{path.stem: load(f"recipes/{path.stem}") for path in RECIPES}}
    for job in scores.planned(scores.Config(seeds=(3,))):
        python, script, *options = job.line.split()
        module = known[Path(script).stem]
        options += ["--task", job.task, "--seed", "3", "--out", "runs/x"]
        own = hasattr(module, "PRESETS")
        parsed = parse_config(module.Config, module.PRESETS, "", None, options) if own else None
        config = parsed or tyro.cli(module.Config, args=options)
        assert python == "python"
        assert (ROOT / script).is_file()
        assert (config.task, config.seed, config.out) == (job.task, 3, Path("runs/x"))


def episodes(task: str, algorithm: str, seed: int, score: list[float]) -> DataFrame:
    about = {"task": task, "algorithm": algorithm, "seed": seed, "episode": range(len(score))}
    return DataFrame({**about, "score": score, "success": 1, "SPL": [x / 100 for x in score], "steps": 9})


def test_rows_of_a_run_replace_its_old_ones(tmp_path: Path, monkeypatch, without_bars) -> None:  # noqa: ARG001
    """Curve and episodes, and the CPU time as the last point; other runs and tasks stay."""
    text = "task,algorithm,seed,steps,cpu_s,score,SR,SPL\nbox,mine,0,1,1,1,1,1\nbox,PPO,0,5,7.5,85,90,80\n"
    (tmp_path / "scores.csv").write_text(text, encoding="utf-8")
    known = [episodes("box", "mine", 0, [0.0, 0.0]), episodes("box", "PPO", 0, [85.0, 86.0])]
    write_episodes(tmp_path / "scores.csv.gz", known)

    def swept(runs: list, **options: object) -> DataFrame:
        assert options == {"jobs": 2, "backend": "loky", "address": None}
        (job,) = runs
        job.folder.mkdir(parents=True)
        (job.folder / "train.csv").write_text(
            "frames,eval_score,eval_success_rate,eval_spl\n9,45,50,40\n20,55,60,50\n", "utf-8"
        )
        (job.folder / "policy.safetensors").touch()
        Path(f"{job.folder}.log").write_text("python mine.py\nhello\nCPU time 83.2 s\n", "utf-8")
        return episodes("box", "mine", 0, [1.0, 3.0]).rename(columns={"algorithm": "agent"})

    monkeypatch.setattr(scores, "sweep", swept)
    options = ["--tasks", "box", "--seeds", "0", "--algorithms", "--command", "mine=python mine.py"]
    scores.main(
        [*options, "--out", str(tmp_path / "runs"), "--results", str(tmp_path), "--agents", str(tmp_path / "agents")]
    )
    rows = read_csv(tmp_path / "scores.csv")
    assert rows[["algorithm", "steps", "cpu_s", "score", "SR", "SPL"]].fillna(-1).to_numpy().tolist() == [
        ["PPO", 5, 7.5, 85, 90, 80],
        ["mine", 9, -1, 45, 50, 40],
        ["mine", 20, -1, 55, 60, 50],
        ["mine", 20, 83.2, -1, -1, -1],
    ]
    assert read_csv(tmp_path / "scores.csv.gz")["score"].tolist() == [85.0, 86.0, 1.0, 3.0]
    assert "| box | mine | 1 × 0 k | 1.4 min | 2.0 (1.0 to 3.0) | — | 100.0 | 2.0 | 9.0 |" in (
        tmp_path / "scores.md"
    ).read_text("utf-8")
    assert (tmp_path / "agents" / "box-mine.safetensors").exists()
    with (tmp_path / "runs" / "box-mine-seed0.log").open("a", encoding="utf-8") as log:
        log.write("python mine.py\nCPU time 1.0 s\n")
    (job,) = scores.planned(scores.Config(("box",), (), ("mine=python mine.py",), (0,), out=tmp_path / "runs"))
    assert math.isnan(scores.cpu_s(job))  # it was resumed, and its first part is not known


def test_an_interval_is_of_seeds_and_episodes_and_a_difference_of_pairs() -> None:
    """Of two seeds that differ by 2, and 1000 episodes of a standard deviation of 10, which pairs have in common."""
    draw = np.random.default_rng(3)
    luck = 10 * draw.standard_normal(1000)
    seeds = np.stack((90 + luck, 92 + luck))
    low, high = scores.interval(seeds)
    assert low == pytest.approx(90 + luck.mean() - 1.2 * 0.32, abs=0.35)
    assert high == pytest.approx(92 + luck.mean() + 1.2 * 0.32, abs=0.35)
    rows = [episodes("eddies", "TD3", seed, list(values)) for seed, values in enumerate(seeds)]
    rows += [episodes("eddies", "estimated", 0, list(89 + luck)), episodes("eddies", "mapped", 0, [99.0])]
    assert scores.behind(concat(rows), "TD3") == "+2.0 (+1.0 to +3.0)"


def test_known_results_are_drawn_without_training(tmp_path: Path, monkeypatch) -> None:
    for name in ("scores.csv", "scores.csv.gz"):
        (tmp_path / name).write_bytes((RESULTS / name).read_bytes())
    monkeypatch.setattr(scores, "sweep", None)
    monkeypatch.setattr(scores, "DRAWS", 20)
    scores.main(["--no-train", "--results", str(tmp_path), "--out", str(tmp_path), "--agents", str(tmp_path)])
    found, kept = ((path / "scores.md").read_text("utf-8") for path in (tmp_path, RESULTS))
    assert re.sub(r" \(.*? to .*?\)", "", found) == re.sub(r" \(.*? to .*?\)", "", kept)
    assert (tmp_path / "scores.png").exists()


def test_a_panel_has_the_curves_of_a_task_and_two_levels() -> None:
    """The CPU time of a run that states it at its end is in proportion to its steps."""
    rows = [[name, steps, cpu, 10.0 * steps] for name, last in (("TD3", 120.0), ("PPO", 600.0))
            for steps, cpu in ((1, None), (2, None), (4, last))]  # fmt: skip
    curves = DataFrame(rows, columns=["algorithm", "steps", "cpu_s", "score"]).assign(task="eddies", seed=0)
    flights = read_csv(RESULTS / "scores.csv.gz")
    steps, cpu = scores.figure(curves, flights).subfigs[0].axes
    assert [line.get_xydata().tolist() for line in steps.lines[:2]] == [[[1, 10], [2, 20]]] * 2
    assert [line.get_xdata().tolist() for line in cpu.lines[:2]] == [[0.5, 1.0], [2.5, 5.0]]
    means = flights[flights["task"] == "eddies"].groupby("algorithm")["score"].mean()
    assert [line.get_ydata()[0] for line in cpu.lines[2:]] == [means["estimated"], means["mapped"]]


def test_a_sweep_is_refused_before_anything_is_trained(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for results, options, message in (
        ("new/folder", [], "has no runs"),
        ("file/folder", [], "cannot write"),
        ("new", ["--tasks", "mars"], "task must be one of .*, got 'mars'"),
        ("new", ["--algorithms", "A2C"], "algorithm must be one of .*, got 'A2C'"),
    ):
        with pytest.raises((ValueError, OSError), match=message):
            scores.main(["--no-train", "--out", str(tmp_path / "runs"), "--results", str(tmp_path / results), *options])
    assert (tmp_path / "new" / "folder").is_dir()


@pytest.mark.parametrize("name", ["bars", "publish"])
def test_help_is_printed(name: str, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(TABLES / f"{name}.py"), run_name="__main__")
    assert "usage" in capsys.readouterr().out


def test_jobs_of_one_seed_come_first() -> None:
    jobs = scores.planned(scores.Config(tasks=("box", "storm"), seeds=(3, 4)))
    assert [job.seed for job in jobs] == sorted(job.seed for job in jobs)
    names = {"SB3-PPO", "SB3-SAC", "SB3-TD3", "GG-TD3", "TD3"}
    assert {job[:2] for job in jobs if job.seed == 4} == {("box", name) for name in names} | {
        ("storm", name) for name in ("SB3-PPO", "ppo_memory")
    }


def test_references_around_areas_keep_their_order(monkeypatch) -> None:
    monkeypatch.setattr(bars, "VEHICLES", 24)
    bars.bar.cache_clear()
    straight, rule, sighted, around = (bars.bar("nogo", name) for name in ("geodesic", "around", "sighted", "detour"))
    bars.bar.cache_clear()
    assert 90 < rule["SPL"] < sighted["SPL"] < around["SPL"]
    assert straight["SR"] < 50 < 90 < rule["SR"]
    assert around["SR"] == sighted["SR"] == 100
