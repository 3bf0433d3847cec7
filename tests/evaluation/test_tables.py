"""Tables of runs: averages, intervals and ranges by hand, groups of runs, and noise levels."""

import json
import math
import re
from pathlib import Path

import pytest
from matplotlib.image import imread
from support.recipes import load

from magrl import paper
from magrl.evaluation.tables import cell, comparison_table, mean_of_runs, short_table, worst
from magrl.training import UsageError

RUNS = [97.0, 98.0, 99.0, 100.0]


def cells(line: str) -> list[str]:
    return [text.strip() for text in line.strip("|").split("|")]


def interval(text: str) -> tuple[float, float, float]:
    """Return middle, low and high end of a cell such as ``99.0 (98.5–99.5)``."""
    found = re.fullmatch(r"([\d.]+) \(([\d.]+)–([\d.]+)\)", text)
    assert found, text
    return float(found[1]), float(found[2]), float(found[3])


def test_mean_of_runs_by_hand() -> None:
    """One run, its value; a few, interquartile mean and range; ten or more, the interval, which is narrower."""
    assert mean_of_runs([99.0], form=".1f") == "99.0"
    assert mean_of_runs([math.nan, 2.0, None], form=".1f") == "2.0"
    assert mean_of_runs([None, math.nan], form=".1f") == "—"
    assert mean_of_runs(RUNS, form=".2f") == "98.50 [97.00–100.00]"
    assert mean_of_runs([0.0, *RUNS], form=".1f") == "98.0 [0.0–100.0]"
    assert mean_of_runs(RUNS[:2], RUNS[2:], form=".1f", interval=False) == "98.5"
    assert "[" in mean_of_runs(RUNS * 2, [99.0], form=".1f")
    middle, low, high = interval(mean_of_runs(RUNS * 2, RUNS[1:3], form=".3f"))
    assert 97 < low < middle == 98.5 < high < 100


def test_worst_run_and_interval_over_tasks() -> None:
    assert worst([{"spl": 99.0}, {"spl": None}, {"spl": 98.456}], ".2f") == "98.46"
    assert worst([{"spl": 99.0}, {"spl": None}], ".2f") == worst([], ".2f") == "—"
    one = {"spl": 98.0, "spl_low": 97.5, "spl_high": 98.5, "steps": None}
    assert cell([one], "spl", ".1f") == "98.0 (97.5–98.5)"
    assert cell([one, one], "spl", ".1f") == "98.0 [98.0–98.0]"
    assert cell([one], "steps", ".1f") == cell([one], "unknown", ".1f") == "—"
    assert cell([{**one, "spl": None, "spl_low": None, "spl_high": None}], "spl", ".1f") == "—"


def test_rows_of_one_and_of_several_runs() -> None:
    one = {"success_rate": 100.0, "success_rate_low": 99.6, "success_rate_high": 100.0, "spl": 99.0, "steps": 9.0}
    one |= {"spl_low": 98.0, "spl_high": 99.5, "path_efficiency": 97.0, "spl_to_arrival": 96.0, "smoothness_deg": 170.0}
    several = [{**one, "spl": spl} for spl in RUNS]
    head, _, published, guided, secant = comparison_table({"gg_td3": several, "secant": [one]}).splitlines()
    rows = [dict(zip(cells(head), cells(line), strict=True)) for line in (published, guided, secant)]
    assert [row["needs"] for row in rows] == ["—", "training in the region", "nothing"]
    assert [row["runs"] for row in rows] == ["1", "4", "1"]
    assert [row["SPL %"] for row in rows] == ["88.41", "98.50 [97.00–100.00]", "99.00 (98.00–99.50)"]
    assert [row["worst run, SPL %"] for row in rows] == ["—", "97.00", "—"]
    assert [row["SR %"] for row in rows] == ["97.0", "100.0 [100.0–100.0]", "100.0 (99.6–100.0)"]
    assert [row["SPL to arrival %"] for row in rows] == ["—", "96.00 [96.00–96.00]", "96.00"]
    assert [row["smoothness °"] for row in rows] == ["—", "170.0", "170.0"]
    head, _, guided, _ = short_table({"gg_td3": several, "secant": [one]}).splitlines()
    assert cells(guided)[2:5] == ["100.0 [100.0–100.0]", "98.5 [97.0–100.0]", "97.0"]
    with pytest.raises(ValueError, match="unknown navigator 'dowsing'"):
        comparison_table({"dowsing": [one]})


def finished(folder: Path, seed: int, **values: float | None) -> Path:
    """Return a run folder with a result."""
    folder.mkdir(parents=True)
    (folder / "eval.json").write_text(json.dumps({"seed": seed, **values}))
    return folder


def test_results_table_of_one_run(tmp_path: Path) -> None:
    results = load("tables/results_table")
    run = finished(
        tmp_path / "run",
        3,
        success_rate=99.5,
        spl=98.0,
        trajectory_length_m=4e5,
        steps=9.0,
        seconds_to_97_sr_88_spl=None,
    )
    published = paper.TABLE_2["gg_td3"]
    lines = results.table(results.grouped([str(run)])).splitlines()
    assert cells(lines[2])[:4] == ["paper", "1", f"{published.success_rate:.1f}", f"{published.spl:.2f}"]
    assert cells(lines[3]) == ["seed 3", "1", "99.5", "98.00", "—", "400000", "9.00", "—", "—", "—", "—", "—"]
    named = results.table(results.grouped([f"a=b={run}"])).splitlines()
    assert named[3:] == [lines[3].replace("seed 3", "a=b")]


def test_results_table_groups_runs(tmp_path: Path) -> None:
    """Twelve runs with one thread and twelve with two, worse by one; in order of the seeds, and together."""
    results = load("tables/results_table")
    for seed in range(12):
        for threads in (1, 2):
            finished(tmp_path / f"t{threads}-seed{seed}", seed, spl=100.0 - threads - seed / 10, success_rate=100.0)
    texts = [f"one thread={tmp_path}/t1-*", f"two threads={tmp_path}/t2-*"]
    groups = results.grouped(texts)
    assert [run["seed"] for run in groups["one thread"]] == list(range(12))
    rows = [cells(line) for line in results.table(groups, pooled=True).splitlines()[3:]]
    assert [row[:2] for row in rows] == [["one thread", "12"], ["two threads", "12"], ["together", "24"]]
    assert [row[4] for row in rows] == ["97.90–99.00", "96.90–98.00", "96.90–99.00"]
    for row, expected in zip(rows, (98.45, 97.45, 97.95), strict=True):
        middle, low, high = interval(row[3])
        assert middle == pytest.approx(expected, abs=0.006)
        assert low < middle < high
    each = results.table(groups, each=True).splitlines()[3:]
    assert len(each) == 26
    assert cells(each[0])[:4] == ["one thread, seed 0", "1", "100.0", "99.00"]
    unnamed = results.table(results.grouped([f"{tmp_path}/t1-*"]), each=True).splitlines()[3:]
    assert [cells(line)[0] for line in unnamed[-2:]] == ["seed 11", "all runs"]


def test_results_table_of_another_scenario_has_no_row_of_the_paper(tmp_path: Path) -> None:
    results = load("tables/results_table")
    for name, scenario in (("paper", None), ("own", "scenario.toml")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "eval.json").write_text('{"seed": 0, "spl": 99.0}')
        (tmp_path / name / "config.json").write_text(json.dumps({"scenario": scenario}))
    assert "| paper |" in results.table(results.grouped([str(tmp_path / "paper")]))
    assert "| paper |" not in results.table(results.grouped([str(tmp_path / "own")]))


def test_results_table_does_not_mix_settings_in_one_row(tmp_path: Path) -> None:
    """Other seeds are welcome; a name for each group takes any."""
    results = load("tables/results_table")
    for name, seed, gamma in (("a", 0, 0.9), ("b", 1, 0.9), ("c", 0, 0.97)):
        finished(tmp_path / name, seed)
        (tmp_path / name / "config.json").write_text(json.dumps({"seed": seed, "gamma": gamma, "out": name}))
    with pytest.raises(UsageError, match=r"gamma is 0\.9 and 0\.97; give each a name, as in NAME=.*/c$"):
        results.grouped([f"{tmp_path}/*"])
    groups = results.grouped([f"{tmp_path}/[ab]", f"low={tmp_path}/c"])
    assert {name: len(runs) for name, runs in groups.items()} == {"": 2, "low": 1}


def test_results_table_does_not_mix_scenarios_in_one_row(tmp_path: Path) -> None:
    """All their files have the same name."""
    results = load("tables/results_table")
    for seed, text in enumerate(("date = 2026-01-01", "date = 2026-01-01", "date = 2027-01-01")):
        folder = finished(tmp_path / str(seed), seed)
        (folder / "config.json").write_text(json.dumps({"seed": seed, "scenario": "scenario.toml"}))
        (folder / "scenario.toml").write_text(text)
    assert len(results.grouped([f"{tmp_path}/[01]"])[""]) == 2
    with pytest.raises(UsageError, match="not seeds of one training: their scenarios differ; give each a name"):
        results.grouped([f"{tmp_path}/*"])


def test_results_table_says_what_is_wrong(tmp_path: Path) -> None:
    results = load("tables/results_table")
    run = finished(tmp_path / "run", 0)
    (tmp_path / "empty").mkdir()
    for texts, message in (
        ([], "name at least one run"),
        ([str(tmp_path / "empty")], r"no eval\.json in .*empty: is the training complete"),
        ([f"a={tmp_path}/no*"], r"no eval\.json in .*/no\*"),
        ([f"{tmp_path}/*"], r"no eval\.json in .*empty"),
        ([f"a={run}", f"b={tmp_path}/empty/../run"], "run is given twice"),
    ):
        with pytest.raises(UsageError, match=message):
            results.grouped(texts)


def evaluation(
    folder: Path, noise: list[float], summaries: dict[str, list[tuple[float, float | None]]], **other
) -> Path:
    """Return a folder as recipes/evaluate.py leaves it: success rate and SPL of each run of a navigator."""
    folder.mkdir()
    settings = {"tasks": "test-1000", "zeta": 0.01, "mode": "flown", "noise": noise, **other}
    (folder / "settings.json").write_text(json.dumps(settings))
    content = {
        name: [dict(zip(("success_rate", "spl"), run, strict=True)) for run in runs] for name, runs in summaries.items()
    }
    (folder / "summary.json").write_text(json.dumps(content))
    return folder


def test_noise_table_and_figure(tmp_path: Path) -> None:
    noise = load("tables/noise_table")
    high = evaluation(tmp_path / "b", [0.05, 0.05, 5], {"gg_td3": [(99.0, 92.0), (100.0, 94.0)], "ga": [(0.0, None)]})
    low = evaluation(tmp_path / "a", [0, 0, 0], {"gg_td3": [(100.0, 99.0)], "secant": [(100.0, 99.5)]})
    config = noise.Config((high, low), tmp_path / "new" / "noise.md", tmp_path / "noise.png")
    noise.make(config)
    assert config.table.read_text().splitlines()[0] == "| navigator | needs | runs | no noise | 0.05°, 0.05°, 5 nT |"
    rows = [cells(line) for line in config.table.read_text().splitlines()[2:]]
    assert [row[2:] for row in rows] == [
        ["2", "100.0 / 99.0", "99.5 / 93.0"],
        ["1", "100.0 / 99.5", "—"],
        ["1", "—", "0.0 / —"],
    ]
    assert rows[2][:2] == ["GA, flown", "nothing"]
    assert imread(config.figure).std() > 0.01


def test_noise_table_refuses_evaluations_that_cannot_be_compared(tmp_path: Path) -> None:
    noise = load("tables/noise_table")
    flown = {"secant": [(100.0, 99.0)]}
    clean = evaluation(tmp_path / "clean", [0, 0, 0], flown)
    again = evaluation(tmp_path / "again", [0, 0, 0], flown)
    strict = evaluation(tmp_path / "strict", [0.1, 0.1, 10], flown, zeta=0.001)
    ship = evaluation(tmp_path / "ship", [0.1, 0.1, 10], flown, conditions="ship")
    calm = evaluation(tmp_path / "calm", [0.2, 0.2, 20], flown, conditions=None)
    old = evaluation(tmp_path / "old", [0.1, 0.1, 10], flown)
    (old / "settings.json").write_text("{}")
    (tmp_path / "file").touch()
    for folders, message in (
        ([], "name at least one folder"),
        ([tmp_path], r"there is no .*settings\.json: is the evaluation complete"),
        ([old], r"settings\.json holds no noise level"),
        ([clean, again], r"again has the noise \[0\.0, 0\.0, 0\.0\], as a folder before it"),
        ([clean, strict], "strict has zeta 0.001, the folders before it 0.01"),
        ([calm, ship], "ship has conditions 'ship', the folders before it None"),
    ):
        with pytest.raises(UsageError, match=message):
            noise.make(noise.Config(tuple(folders), tmp_path / "t.md", tmp_path / "f.png"))
    with pytest.raises(UsageError, match=r"cannot write .*t\.md"):
        noise.make(noise.Config((clean,), tmp_path / "file" / "t.md", tmp_path / "f.png"))
    assert not (tmp_path / "t.md").exists()


def swept(folder: Path, result: bool = True, **settings) -> Path:
    """Return the folder of a run of a sweep: SPL is 90 and the seed."""
    folder.mkdir(parents=True)
    defaults = {"recipe": "sac.py", "seed": 0, "gamma": 0.9, "num_cells": [8, 8], "out": folder.name}
    (folder / "config.json").write_text(json.dumps(defaults | settings))
    if result:
        values = {"success_rate": 100.0, "spl": 90.0 + settings.get("seed", 0), "training_seconds": 60.0}
        (folder / "eval.json").write_text(json.dumps(values))
    return folder


def test_sweep_table_groups_runs_by_setting_and_seed(tmp_path: Path, capsys) -> None:
    """Settings in natural order, an interval from ten seeds on, and a warning for a run without results."""
    sweep = load("tables/sweep_table")
    for seed in range(10):
        swept(tmp_path / f"a{seed}", seed=seed, gamma=0.5, wandb_mode="offline", logger="csv")
    for seed in (2, 0):
        swept(tmp_path / f"b{seed}", seed=seed, num_cells=[16], gamma=0.10)
    swept(tmp_path / "unfinished", False, seed=3, gamma=0.99)
    (tmp_path / "notes").mkdir()
    runs = sweep.finished(sweep.run_folders([f"{tmp_path}/*", f"{tmp_path}/a1"]))
    said = capsys.readouterr().err
    assert said == f"Warning: {tmp_path}/unfinished is left out: it holds no eval.json, the run is not complete\n"
    head, _, few, many = sweep.table(runs).splitlines()
    assert cells(head)[:5] == ["gamma", "num_cells", "seeds", "SR %", "SPL %"]
    assert cells(few) == ["0.1", "16", "2", "100.0 [100.0–100.0]", "91.00 [90.00–92.00]", "—", "—", "60"]
    assert cells(many)[:3] == ["0.5", "8 8", "10"]
    middle, low, high = interval(cells(many)[4])
    assert 90 < low < middle == 94.5 < high < 99


def test_sweep_table_tells_scenarios_apart(tmp_path: Path) -> None:
    """By the content of the files, which have one name."""
    sweep = load("tables/sweep_table")
    for name, text in (("a", "date = 2020-01-01"), ("b", "date = 2025-01-01"), ("c", "date = 2020-01-01")):
        folder = swept(tmp_path / name, seed=ord(name), scenario="scenario.toml")
        (folder / "scenario.toml").write_text(text)
    lines = sweep.table(sweep.finished(sweep.run_folders([f"{tmp_path}/?"]))).splitlines()[2:]
    assert [cells(line)[:2] for line in lines] == [[f"{tmp_path}/{name}/scenario.toml", n] for name, n in ("a2", "b1")]


def test_sweep_table_says_what_is_wrong(tmp_path: Path) -> None:
    sweep = load("tables/sweep_table")
    swept(tmp_path / "sac")
    swept(tmp_path / "again", out="elsewhere")
    swept(tmp_path / "ppo", seed=1, recipe="ppo.py")
    swept(tmp_path / "unfinished", False)
    (swept(tmp_path / "damaged") / "eval.json").write_text("{")
    for names, message in (
        ([], "name at least one run or a pattern"),
        (["no*"], r"there is no run at .*no\*: a run folder holds config\.json"),
        (["unfinished"], "none of 1 runs is complete"),
        (["damaged"], "damaged cannot be read"),
        (["sac", "again"], "sac and .*again have the same settings and seed 0: name one"),
        (["sac", "ppo"], r"several recipes, ppo\.py, sac\.py: compare them with results_table\.py"),
    ):
        with pytest.raises(UsageError, match=message):
            sweep.table(sweep.finished(sweep.run_folders([str(tmp_path / name) for name in names])))
