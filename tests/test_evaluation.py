"""The commands that compare navigators and draw the paper's figures."""

import csv
import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from test_metrics import journey, point

from magrl import td3
from magrl.env import GeomagneticNavEnv

RECIPES = Path(__file__).parent.parent / "recipes"


def load(name: str):
    spec = importlib.util.spec_from_file_location(name, RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def evaluate():
    return load("evaluate")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The folder of a run whose agent has learned nothing."""
    folder = tmp_path_factory.mktemp("runs") / "agent"
    folder.mkdir()
    torch.manual_seed(0)
    env = GeomagneticNavEnv(seed=0)
    td3.save_policy(folder / "policy.pt", td3.FieldPolicy(td3.policy_config(env, (8,), layer_norm=False)))
    columns = ("frames", "return", "success_rate", "eval_success_rate", "eval_spl")
    rows = [(100, "nan", "nan", 0, 0), (200, 10, 50, 92, 80), (300, 20, 100, 98, 90)]
    with (folder / "train.csv").open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])
    return folder


@pytest.fixture(scope="module")
def results(evaluate, run: Path, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("results") / "comparison"
    names = (f"gg_td3={run}", f"gg_td3={run}", "parallel", "secant", "pso", "afsa:flown")
    evaluate.evaluate(evaluate.Config(navigators=names, tasks="paper-100", out=out, wandb_mode="disabled"))
    return out


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_every_navigator_flies_the_same_tasks(results: Path) -> None:
    episodes = rows(results / "episodes.csv")
    assert len(episodes) == 6 * 100
    shortest = {name: [r["shortest_km"] for r in episodes if r["navigator"] == name] for name in ("parallel", "secant")}
    assert shortest["parallel"] == shortest["secant"]
    assert {r["run"] for r in episodes if r["navigator"] == "gg_td3"} == {"0", "1"}


def test_summary_is_that_of_the_episodes(results: Path) -> None:
    summary = json.loads((results / "summary.json").read_text())
    episodes = [r for r in rows(results / "episodes.csv") if r["navigator"] == "secant"]
    assert summary["secant"][0]["spl"] == pytest.approx(sum(float(r["spl"]) for r in episodes))
    assert summary["parallel"][0]["success_rate"] == 100
    assert summary["secant"][0]["success_rate"] > 98
    assert summary["secant"][0]["field_readings"] == 0 < summary["pso"][0]["field_readings"]


def test_table_has_the_papers_row_beside_ours(results: Path) -> None:
    lines = (results / "table.md").read_text().splitlines()
    assert len({line.count("|") for line in lines}) == 1
    labels = [line.split("|")[1].strip() for line in lines[2:]]
    assert labels[:2] == ["Gradient-Guided TD3, paper", "Gradient-Guided TD3"]
    assert "AFSA, flown" in labels
    assert "PSO, look-ahead (an oracle)" in labels
    assert lines[2].split("|")[3:6] == [" 97 ", " 445564 ", " 88.4 "]
    assert lines[3].split("|")[2] == " 2 "
    assert "0.0 ± 0.0" in lines[3]  # twice the same run
    assert " — " in lines[3]  # that never arrives


def test_paths_are_those_of_the_papers_example(results: Path) -> None:
    paths = rows(results / "paths.csv")
    starts = [r for r in paths if r["step"] == "0"]
    assert {(float(r["latitude"]), float(r["longitude"])) for r in starts} == {(-2.0, 162.0)}
    assert len(starts) == 5
    last = [r for r in paths if r["navigator"] == "parallel"][-1]
    assert float(last["I"]) == pytest.approx(-26.92, abs=0.1)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gg_td3", "needs the folder"),
        ("dowsing", "unknown navigator 'dowsing'"),
        ("secant=runs/a", "unknown navigator"),
        ("secant:flown", "unknown navigator"),
        ("ga:dreamt", "dreamt"),
    ],
)
def test_unknown_navigators_are_refused_before_anything_is_written(evaluate, tmp_path, name, message) -> None:
    config = evaluate.Config(navigators=(name,), tasks="figure-4-1", out=tmp_path / "out", wandb_mode="disabled")
    with pytest.raises(ValueError, match=message):
        evaluate.evaluate(config)
    assert not (tmp_path / "out").exists()


def test_a_run_without_a_policy_is_said_in_a_line(tmp_path: Path) -> None:
    command = [sys.executable, RECIPES / "evaluate.py", f"td3={tmp_path}", "--out", tmp_path / "out"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("evaluate.py: there is no policy file at")


def test_figures_are_drawn_from_the_files(results: Path, run: Path, tmp_path: Path) -> None:
    figures = load("figures")
    figures.main(figures.Config(results=results, gg_td3=(run, run), out=tmp_path))
    names = {path.name for path in tmp_path.iterdir()}
    assert {name[:7] for name in names} == {"fig-4-1", "fig-4-2", "fig-4-3", "fig-4-4", "fig-4-5", "fig-4-6", "learnin"}
    with pytest.raises(SystemExit, match=r"no .*paths\.csv"):
        figures.main(figures.Config(results=tmp_path, out=tmp_path))


def test_path_loss_is_what_a_detour_costs(monkeypatch) -> None:
    """A square corner of 30 and 40 km for 50 km of way, then straight on: 20 km lost, all of it at the start."""
    monkeypatch.syspath_prepend(str(RECIPES))
    loss = load("path_loss")
    heading = math.degrees(math.atan2(40, 30))
    legs = [(30.0, 0.0), (40.0, 90.0), *[(50.0, heading)] * 3]
    got = loss.losses(journey(legs, point(200.0, heading), True, 6))
    assert got["first two moves"] == pytest.approx(20, abs=0.5)  # the course holds while the bearing turns a little
    assert got["between"] == pytest.approx(0, abs=0.5)
    assert got["last two moves"] == pytest.approx(0, abs=0.5)


def test_learning_table(run: Path) -> None:
    learning = load("learning_table")
    lines = learning.table({"agent": [run, run]}).splitlines()
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    # frames 0 to 100 at 0, then the mean of 0 and 92, then of 92 and 98, over 300 frames
    assert cells == ["agent", "2", "200 ± 0", "300 ± 0", f"{(0 + 46 + 95) / 3:.1f} ± 0.0", "90.00 ± 0.00"]
    assert learning.spread([1.0, float("nan")], ".0f") == "1, 1 of 2 never"


def test_results_table(run: Path, tmp_path: Path) -> None:
    table = load("results_table")
    result = {"seed": 3, "success_rate": 99.5, "spl": 98.0, "trajectory_length_m": 4e5, "steps": 9.0}
    result |= {"navigation_error_km": 10.0, "success_rate_within_10km": 50.0, "success_rate_within_25km": 90.0}
    result |= {"training_seconds": 60.0, "seconds_to_97_sr_88_spl": None}
    (tmp_path / "eval.json").write_text(json.dumps(result))
    lines = table.table((str(tmp_path),)).splitlines()
    assert table.table((f"mine={tmp_path}",)).splitlines()[3:] == [lines[3].replace("seed 3", "mine")]
    assert lines[3] == "| seed 3 | 99.5 | 98.00 | 400000 | 9.00 | 10.0 | 50.0 | 90.0 | 60 | — |"
    with pytest.raises(SystemExit, match=r"no eval\.json"):
        table.table((str(run),))
