"""The commands that compare navigators and draw the paper's figures."""

import csv
import json
import math
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from support.episodes import episode, point
from support.recipes import load
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor, TanhNormal

from magrl.agents import ExportedPolicy, FieldPolicy, save_policy
from magrl.agents.policy import PolicyConfig
from magrl.agents.program import TensorProgram
from magrl.envs import GeomagneticNavEnv, Scenario, named_tasks
from magrl.evaluation import evaluate as evaluate_policy
from magrl.evaluation import evaluation_rollout, summarize
from magrl.evaluation.navigators import (
    NAVIGATOR_NAMES,
    PRETRAINED,
    TRAINED,
    arrival_threshold,
    label,
    make_navigator,
)
from magrl.evaluation.tables import comparison_table
from magrl.training import UsageError

RECIPES = Path(__file__).parent.parent.parent / "recipes"


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
    policy = FieldPolicy(PolicyConfig(env.observation_view(), (8,), layer_norm=False))
    save_policy(folder / "policy.pt", policy)
    columns = ("frames", "return", "success_rate", "eval_success_rate", "eval_spl")
    rows = [(100, "nan", "nan", 0, 0), (200, 10, 50, 92, 80), (300, 20, 100, 98, 90)]
    with (folder / "train.csv").open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])
    return folder


@pytest.fixture(scope="module")
def results(evaluate, run: Path, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("results") / "comparison"
    runs = [shutil.copytree(run, out.parent / name) for name in ("agent", "other")]
    for folder in runs:
        (folder / "eval.json").write_text("{}")
    names = (*(f"gg_td3={folder}" for folder in runs), "parallel", "secant", "pso", "afsa:flown")
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
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    summary = json.loads((results / "summary.json").read_text(), parse_constant=refuse)
    episodes = [r for r in rows(results / "episodes.csv") if r["navigator"] == "secant"]
    assert summary["secant"][0]["spl"] == pytest.approx(sum(float(r["spl"]) for r in episodes))
    assert summary["parallel"][0]["success_rate"] == 100
    assert summary["secant"][0]["success_rate"] > 98
    assert summary["secant"][0]["field_readings"] == 0 < summary["pso"][0]["field_readings"]
    assert summary["gg_td3"][0]["success_rate"] == 0
    assert summary["gg_td3"][0]["steps"] is None


def test_table_has_the_papers_row_beside_ours(results: Path) -> None:
    lines = (results / "table.md").read_text().splitlines()
    assert len({line.count("|") for line in lines}) == 1
    labels = [line.split("|")[1].strip() for line in lines[2:]]
    assert labels[:2] == ["Gradient-Guided TD3, paper", "Gradient-Guided TD3"]
    assert "AFSA, flown" in labels
    assert "PSO, look-ahead (an oracle)" in labels
    assert lines[2].split("|")[4:8] == [" 97.0 ", " 445564 ", " 88.41 ", " 21.76 "]
    assert lines[3].split("|")[2:5] == [" training in the region ", " 2 ", " 0.0 [0.0–0.0] "]  # copies of one run
    assert " — " in lines[3]  # without any success
    short = (results / "short.md").read_text().splitlines()
    assert [line.split("|")[1] for line in short[2:]] == [f" {name} " for name in labels if ", paper" not in name]


def test_papers_row_stands_once_for_both_modes_of_an_algorithm() -> None:
    lines = comparison_table({"ga": [{"spl": 1.0}], "ga:flown": [{"spl": 1.0}]}, "look-ahead").splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == [
        "| GA, paper",
        "| GA, look-ahead (an oracle)",
        "| GA, flown",
    ]


def test_paths_are_those_of_the_papers_example(results: Path) -> None:
    paths = rows(results / "paths.csv")
    starts = [r for r in paths if r["step"] == "0"]
    assert {(float(r["latitude"]), float(r["longitude"])) for r in starts} == {(-2.0, 162.0)}
    assert len(starts) == 5
    last = [r for r in paths if r["navigator"] == "parallel"][-1]
    assert float(last["I"]) == pytest.approx(-26.92, abs=0.1)


def test_every_navigator_has_a_label_and_can_be_made(run: Path) -> None:
    env = GeomagneticNavEnv(num_envs=1, seed=0)
    for name in NAVIGATOR_NAMES:
        trained = name in TRAINED and name not in PRETRAINED
        navigator = make_navigator(f"{name}={run}" if trained else name, env)
        assert navigator(env.reset())["action"].shape == (1, 2)
        assert NAVIGATOR_NAMES[name] in label(name)
    assert (label("ga"), label("ga", "flown"), label("ga:look-ahead", "flown")) == (
        "GA, look-ahead (an oracle)",
        "GA, flown",
        "GA, look-ahead (an oracle)",
    )
    with pytest.raises(ValueError, match="unknown navigator 'dowsing'"):
        label("dowsing")


@pytest.fixture(scope="module")
def halves(tmp_path_factory) -> Path:
    """The file of a policy that is not of the library's networks: it moves by 25 km, straight on."""
    path = tmp_path_factory.mktemp("own") / "halves.pt"
    steps = [["mul.Tensor", [{"value": 0}, 0.0], {}], ["add.Tensor", [{"value": 2}, {"value": 1}], {}]]
    save_policy(path, ExportedPolicy(["move"], TensorProgram(1, steps, [torch.tensor([25.0, 0.0])], [3])))
    return path


def test_a_policy_of_any_algorithm_is_in_the_table(evaluate, halves: Path, tmp_path: Path) -> None:
    """Beside the others, by its label; two files are two runs of one navigator."""
    copy, third = (shutil.copy(halves, tmp_path / name) for name in ("copy.pt", "third.pt"))
    names = (f"policy:SAC={halves}", f"policy:SAC={copy}", f"policy={third}", "secant")
    out = tmp_path / "out"
    evaluate.evaluate(evaluate.Config(names, tasks=3, out=out, wandb_mode="disabled"))
    cells = [[cell.strip() for cell in line.split("|")[1:4]] for line in (out / "table.md").read_text().splitlines()]
    assert cells[2:4] == [["SAC", "training", "2"], ["own policy", "training", "1"]]
    assert "Warning" not in (out / "table.md").read_text()
    lengths = {row["length_km"] for row in rows(out / "episodes.csv") if row["navigator"] == "policy:SAC"}
    assert {round(float(length)) for length in lengths} <= {25 * steps for steps in range(51)}
    env = GeomagneticNavEnv(seed=0)
    with pytest.raises(ValueError, match="policy needs the folder of a finished run or the file of a policy"):
        make_navigator("policy:SAC", env)
    with pytest.raises(FileNotFoundError, match=r"there is no policy file at .*nowhere\.pt"):
        make_navigator("policy=nowhere.pt", env)


def test_a_mode_behind_the_name_overrides_the_default() -> None:
    env = GeomagneticNavEnv(num_envs=1, seed=0)
    oracles = [
        make_navigator(text, env, mode).oracle for text in ("pso", "pso:flown") for mode in ("look-ahead", "flown")
    ]
    assert oracles == [True, False, False, False]


def test_bad_usage_is_refused_before_anything_is_written_or_flown(
    evaluate, run, results, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(evaluate, "evaluation_rollout", lambda *_: pytest.fail("something was flown"))
    (tmp_path / "file").touch()
    (tmp_path / "broken.toml").write_text("region =")
    cases = [
        (("gg_td3",), {}, "needs the folder"),
        (("dowsing",), {}, "unknown navigator 'dowsing'"),
        (("secant=runs/a",), {}, "unknown navigator"),
        (("secant:flown",), {}, "unknown navigator"),
        ((f"td3:flown={run}",), {}, "unknown navigator"),
        (("ga:dreamt",), {}, "dreamt"),
        ((), {}, "at least one navigator"),
        ((f"td3={tmp_path}",), {}, "there is no policy file at"),
        (("secant",), {"zeta": 0.0}, "zeta must be .* got 0.0"),
        (("secant",), {"zeta": 3.0}, "zeta must be below 3, got 3.0: the objective F is at most 3 at the start"),
        (("secant", "ga", "secant"), {}, "^secant is given twice: the same episodes again are no spread over runs"),
        (("ga", "pso", "ga:look-ahead"), {}, "^ga:look-ahead is given twice"),
        (("ga:flown", "ga"), {"mode": "flown"}, "^ga is given twice"),
        ((f"gg_td3={run}", f"gg_td3={run.parent / 'x' / '..' / run.name}"), {}, "is given twice"),
        ((f"gg_td3={run}", f"td3={run}"), {}, "^td3=.* is given twice"),
        (("anywhere", f"anywhere={run}"), {}, "has the name of the pretrained anywhere: write policy:LABEL="),
        (("ga",), {"seed": -1}, "seed"),
        (("secant",), {"wandb_mode": "sometimes"}, "wandb_mode"),
        (("secant",), {"scenario": tmp_path / "missing.toml"}, "no scenario file at"),
        (("secant",), {"scenario": tmp_path / "broken.toml"}, "broken.toml"),
        (("secant",), {"export": tmp_path / "tracks.shp"}, r"\.geojson, \.gpx, \.kml"),
        (("secant",), {"export": tmp_path / "file" / "tracks.kml"}, "cannot write .*tracks.kml"),
        (("secant",), {"out": tmp_path / "file" / "out"}, "file"),
        (("secant",), {"out": results}, "is not empty"),
    ]
    before = {path.name for path in results.iterdir()}
    for navigators, options, message in cases:
        given = {"tasks": None if "scenario" in options else "figure-4-1", "out": tmp_path / "out"} | options
        with pytest.raises(UsageError, match=message):
            evaluate.evaluate(evaluate.Config(navigators, **{"wandb_mode": "disabled", **given}))
        assert not (tmp_path / "out").exists(), message
    assert {path.name for path in results.iterdir()} == before


@pytest.fixture
def trained(run: Path, tmp_path: Path):
    """Return a function that copies the run, as one trained with a threshold; finished unless said otherwise."""

    def copy(name: str, zeta: float, finished: bool = True) -> Path:
        folder = shutil.copytree(run, tmp_path / name)
        (folder / "config.json").write_text(json.dumps({"zeta": zeta}))
        if finished:
            (folder / "eval.json").write_text("{}")
        return folder

    return copy


def test_the_threshold_is_that_of_the_runs(trained) -> None:
    """Unless one is chosen; runs that disagree leave no default."""
    one, same, other = (f"td3={trained(*arguments)}" for arguments in (("a", 0.001), ("b", 0.001), ("c", 0.02)))
    assert arrival_threshold(["secant"]) == (0.01, [])
    assert arrival_threshold(["secant", one, same]) == (0.001, [])
    with pytest.raises(
        ValueError, match=r"different arrival thresholds, 0\.001 \(.*\), 0\.02 \(.*/c\): choose with --zeta"
    ):
        arrival_threshold([one, same, other])
    zeta, warnings = arrival_threshold([one, other], 0.001)
    assert zeta == 0.001
    assert [text.rpartition("/")[2] for text in warnings] == [
        "c was trained with zeta 0.02 and is evaluated with zeta 0.001"
    ]
    Path(one.partition("=")[2], "config.json").write_text("[")
    with pytest.raises(ValueError, match=r"config\.json is not the configuration of a run"):
        arrival_threshold([one])


def test_what_a_reader_must_know_stands_below_the_table(evaluate, trained, tmp_path: Path, capsys) -> None:
    names = f"td3={trained('a', 0.02)}", f"td3={trained('b', 0.001, finished=False)}"
    arguments = ["--tasks", "figure-4-1", "--wandb-mode", "disabled", "--out"]
    evaluate.main([names[0], *arguments, str(tmp_path / "alone")])
    assert "Warning" not in capsys.readouterr().out
    out = tmp_path / "out"
    with pytest.raises(UsageError, match="different arrival thresholds"):
        evaluate.main([*names, *arguments, str(out)])
    evaluate.main([*names, "--zeta", "0.02", *arguments, str(out)])
    said = capsys.readouterr().out
    for text in (said, (out / "table.md").read_text(), (out / "short.md").read_text()):
        warnings = [line for line in text.splitlines() if line.startswith("Warning: ")]
        assert len(warnings) == 2
        assert warnings[0].endswith("b was trained with zeta 0.001 and is evaluated with zeta 0.02.")
        assert warnings[1].endswith("b is not a finished training: it holds no eval.json.")


def test_only_bad_usage_is_shown_in_one_line(evaluate, tmp_path: Path, monkeypatch) -> None:
    """A command exits with status 2 and one line; an error while it flies keeps its traceback."""
    command = [sys.executable, RECIPES / "evaluate.py", f"td3={tmp_path}", "--out", tmp_path / "out"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("evaluate.py: there is no policy file at")
    assert done.stderr.count("\n") == 1

    def fail(*_: object) -> None:
        raise ValueError("a fault of the program")

    monkeypatch.setattr(evaluate, "evaluation_rollout", fail)
    arguments = ["secant", "--tasks", "figure-4-1", "--out", str(tmp_path / "out"), "--wandb-mode", "disabled"]
    with pytest.raises(ValueError, match="a fault of the program") as error:
        evaluate.command(evaluate.RECIPE, lambda: evaluate.main(arguments))
    assert not isinstance(error.value, UsageError)


def test_the_scripts_of_tables_run_as_commands(tmp_path: Path, monkeypatch, capsys) -> None:
    cases = {
        "conditions_table": (["dowsing"], "unknown navigator 'dowsing'"),
        "earth_table": ([], "name at least one navigator"),
        "globe": (
            ["--tasks", "0", "--table", str(tmp_path / "a"), "--figure", str(tmp_path / "b")],
            "num_tasks must be",
        ),
        "figures": (["--results", str(tmp_path), "--out", str(tmp_path)], "there is no"),
        "learning_table": (["runs/A"], "a run must be given as NAME=RUN, such as gg_td3=runs/A, got 'runs/A'"),
        "onboard_table": (["dowsing"], "unknown navigator 'dowsing'"),
        "paper_run": (["runs/A"], "a run must be given as LABEL=RUN, such as TD3=runs/A, got 'runs/A'"),
        "path_loss": (["dowsing"], "unknown navigator 'dowsing'"),
        "probe_sweep": (["--zeta", "5"], "zeta must be below 3, got 5"),
        "publish": ([str(tmp_path / "missing.md")], "there is no document"),
        "noise_table": ([str(tmp_path)], "there is no"),
        "random_boxes": (["--boxes", "0"], "count must be a whole number from 1 on, got 0"),
        "results_table": ([str(tmp_path)], "no eval.json"),
        "sweep_table": ([str(tmp_path)], f"there is no run at {tmp_path}: a run folder holds config.json"),
        "sweep_metaheuristics": (["--tasks", "0"], "num_tasks must be a whole number from 1 on, got 0"),
    }
    twice = ["anywhere=runs/A", "anywhere=runs/B", "--figure", str(tmp_path / "figure.png")]
    assert cases.keys() == {path.stem for path in (RECIPES / "tables").glob("*.py")}
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(RECIPES)])
    commands = [*cases.items(), ("conditions_table", (twice, "anywhere is given twice: a figure has one line"))]
    for name, (arguments, message) in commands:
        script = RECIPES / "tables" / f"{name}.py"
        monkeypatch.setattr(sys, "argv", [str(script), *arguments])
        with pytest.raises(SystemExit) as error:
            runpy.run_path(str(script), run_name="__main__")
        said = capsys.readouterr()
        assert error.value.code == 2
        assert said.err.startswith(f"{name}.py: {message}"), said.err
        assert said.out == ""


def test_figures_are_drawn_from_the_files(results: Path, run: Path, tmp_path: Path) -> None:
    figures = load("tables/figures")
    figures.draw(figures.Config(results=results, gg_td3=(run, run), out=tmp_path))
    names = {path.name for path in tmp_path.iterdir()}
    assert {name[:7] for name in names} == {"fig-4-1", "fig-4-2", "fig-4-3", "fig-4-4", "fig-4-5", "fig-4-6", "learnin"}
    with pytest.raises(UsageError, match=r"no .*paths\.csv"):
        figures.draw(figures.Config(results=tmp_path, out=tmp_path))
    with pytest.raises(UsageError, match="no column 'reward'"):
        figures.column([{"return": "1"}], "reward")


def test_path_loss_is_what_a_detour_costs() -> None:
    """A square corner of 30 and 40 km for 50 km of way, then straight on: 20 km lost, all of it at the start."""
    loss = load("tables/path_loss")
    heading = math.degrees(math.atan2(40, 30))
    legs = [(30.0, 0.0), (40.0, 90.0), *[(50.0, heading)] * 3]
    got = loss.losses(episode(legs, point(200.0, heading), True, 6))
    assert got["first two moves"] == pytest.approx(20, abs=0.5)  # the course holds while the bearing turns a little
    assert got["between"] == pytest.approx(0, abs=0.5)
    assert got["last two moves"] == pytest.approx(0, abs=0.5)


def test_path_loss_takes_every_navigator_once(monkeypatch) -> None:
    """Metaheuristics too, in both modes, each with its own row."""
    loss = load("tables/path_loss")
    monkeypatch.setattr(loss, "named_tasks", lambda _: named_tasks("figure-4-1"))
    lines = loss.table(["pso:flown", "pso", "secant"]).splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == [
        "| PSO, flown",
        "| PSO, look-ahead (an oracle)",
        "| secant (quasi-Newton)",
    ]
    for texts, message in (([], "name at least one navigator"), (["secant", "secant"], "secant is given twice")):
        with pytest.raises(UsageError, match=message):
            loss.table(texts)


def test_paper_run_shows_trainings_that_are_not_complete(tmp_path: Path, monkeypatch, capsys) -> None:
    """Means over the last five evaluations, the first with 90 %, and a figure."""
    names = ("return", "success_rate", "seconds", "eval_spl", "eval_steps", "eval_success_rate")
    rows = [",".join(("frames", "episodes", *names))]
    rows += [f"{1000 * k},{20 * k},1,2,{30 * k},50,{'nan' if k < 3 else 20},{10 * k}" for k in range(1, 11)]
    (tmp_path / "train.csv").write_text("\n".join(rows))
    arguments = [f"ζ = 0.01={tmp_path}", "--figure", str(tmp_path / "curves.png")]
    monkeypatch.setattr(sys, "argv", ["paper_run.py", *arguments])
    load("tables/paper_run").main()
    cells = [cell.strip() for cell in capsys.readouterr().out.splitlines()[2].strip("|").split("|")]
    assert cells == ["ζ = 0.01", "10000", "200", "9000", "100.0", "80.0", "50.0", "20.0", "300"]
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr(sys, "argv", ["paper_run.py", *arguments[:1], "--moves", "4500"])
    load("tables/paper_run").main()
    assert "| 4000 | 80 | never | 40.0 | 25.0 |" in capsys.readouterr().out


def test_learning_table(run: Path) -> None:
    learning = load("tables/learning_table")
    lines = learning.table({"agent": [run, run]}).splitlines()
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    # frames 0 to 100 at 0, then the mean of 0 and 92, then of 92 and 98, over 300 frames
    assert cells == ["agent", "2", "200 [200–200]", "300 [300–300]", "47.0 [47.0–47.0]", "90.00 [90.00–90.00]"]
    assert learning.reached([1.0, float("nan")], ".0f") == "1, 1 of 2 never"


def test_learning_table_names_what_is_wrong_with_a_run(run: Path, tmp_path: Path) -> None:
    learning = load("tables/learning_table")
    assert learning.by_name(["a=x", "b=y", "a=z"]) == {"a": [Path("x"), Path("z")], "b": [Path("y")]}
    for texts, message in (
        (["runs/A"], "a run must be given as NAME=RUN, such as gg_td3=runs/A, got 'runs/A'"),
        (["=runs/A"], "a run must be given as NAME=RUN, such as gg_td3=runs/A, got '=runs/A'"),
        (["a="], "a run must be given as NAME=RUN"),
        ([], "name at least one run, such as gg_td3=runs/A"),
    ):
        with pytest.raises(UsageError, match=message):
            learning.by_name(texts)
    (tmp_path / "train.csv").write_text((run / "train.csv").read_text().splitlines()[0])
    with pytest.raises(UsageError, match=r"train\.csv has no rows: the training ended before its first evaluation"):
        learning.table({"a": [tmp_path]})


def test_publish_fills_every_document_or_none(tmp_path: Path) -> None:
    publish = load("tables/publish")
    (tmp_path / "table.md").write_text("| a |\n")
    good, bad = tmp_path / "good.md", tmp_path / "bad.md"
    good.write_text("before\n<!-- table: table.md -->\nold\n<!-- end -->\nafter\n")
    bad.write_text("<!-- table: missing.md -->\n<!-- end -->\n")
    kept = good.read_text()
    with pytest.raises(UsageError, match=r"no table .*missing\.md"):
        publish.publish(publish.Config((good, bad), root=tmp_path))
    assert good.read_text() == kept
    publish.publish(publish.Config((good,), root=tmp_path))
    assert good.read_text() == "before\n<!-- table: table.md -->\n\n| a |\n\n<!-- end -->\nafter\n"


def test_earth_table_flies_each_navigator_at_each_level() -> None:
    earth = load("tables/earth_table")
    config = earth.Config(("geodesic", "secant"), tasks=8, regions=2)
    lines = earth.table(config).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[0][3:] == ["0, 0, 0", "0.02, 0.02, 2", "0.05, 0.05, 5", "0.1, 0.1, 10", "0.5, 0.1, 20"]
    assert all(cell.startswith("100.0 / 100.0 / ") for cell in cells[2][3:])  # noise does not reach who knows positions
    assert cells[3][:3] == ["secant (quasi-Newton)", "nothing", "1"]
    assert len(set(cells[3][3:])) == 5
    assert earth.cell([(90.0, 80.0, 10.0), (100.0, 90.0, 12.0)]) == "95.0 / 85.0 [80.0] / 11.0"
    with pytest.raises(UsageError, match="unknown navigator 'dowsing'"):
        earth.table(earth.Config(("dowsing",), tasks=2, regions=1))


def test_the_table_of_long_ways_begins_with_kilometers() -> None:
    """A vehicle that knows its position arrives in the ellipse, but seldom within 25 km when that is long."""
    earth = load("tables/earth_table")
    options = {"tasks": 20, "regions": 2, "max_steps": 120, "distance_km": (1200.0, 1800.0)}
    lines = earth.table(earth.Config(("geodesic",), **options)).splitlines()
    near, *rest = (float(value) for value in lines[2].split("|")[4].split("/"))
    assert near < 90
    assert rest[:2] == [100.0, 100.0]
    assert earth.cell([(50.0, 90.0, 80.0, 10.0), (60.0, 100.0, 90.0, 12.0)]) == "55.0 / 95.0 / 85.0 [80.0] / 11.0"


def test_earth_table_has_a_row_for_each_date() -> None:
    earth = load("tables/earth_table")
    lines = earth.table(earth.Config(("secant",), tasks=4, regions=2, date=("1900-01-01", "2030-01-01"))).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[0][:3] == ["date", "navigator", "needs"]
    assert [row[0] for row in cells[2:]] == ["1900-01-01", "2030-01-01"]
    assert cells[2][4:] != cells[3][4:]  # another field
    for dates, message in ((("2031-01-01",), "outside IGRF-14"), ((), "at least one date")):
        with pytest.raises(UsageError, match=message):
            earth.table(earth.Config(("secant",), tasks=2, regions=1, date=dates))


# magrl.evaluation.evaluate


def test_every_task_is_flown_once_however_many_vehicles_fly() -> None:
    tasks = named_tasks("paper-100")
    together, batches = (evaluate_policy("secant", tasks, num_envs=number) for number in (None, 30))
    assert together.shape == batches.shape == (100,)
    for key in ("shortest_km", "length_km", "spl"):
        torch.testing.assert_close(together[key], batches[key])
    assert torch.equal(together["steps"], batches["steps"])
    assert together["shortest_km"].unique().numel() == 100
    recipe = summarize(together)
    assert recipe["num_tasks"] == 100
    assert recipe["success_rate"] > 98


def test_batches_have_errors_of_their_own_that_repeat() -> None:
    """The same task in three batches has other noise and another start heading; the same call has the same."""
    tasks = named_tasks("figure-4-1")
    thrice = Scenario().with_tasks(type(tasks)(*(values.repeat(3, 1) for values in tasks)))
    for errors in ({"noise": (0.05, 0.05, 5.0)}, {"start_heading": "random"}):
        one, again = (evaluate_policy("secant", thrice, num_envs=1, **errors)["smoothness_deg"] for _ in range(2))
        assert torch.equal(one, again)
        assert one.unique().numel() == 3
    perfect = evaluate_policy("secant", thrice, num_envs=1)
    torch.testing.assert_close(perfect["length_km"], perfect["length_km"][:1].expand(3))
    ship = evaluate_policy("secant", thrice, conditions="ship", max_steps=5)
    assert (ship["steps"] <= 5).all()


def test_navigators_declare_their_arrival_where_it_must_be_declared() -> None:
    episodes = evaluate_policy("secant", "paper-100", arrival="declared", arrival_radius_km=40.0)
    assert summarize(episodes)["success_rate"] > 80


def test_a_stochastic_policy_is_evaluated_without_exploration() -> None:
    """Twice with the same actions, those of the mode of its distribution."""
    network = TensorDictModule(lambda move: (0 * move, 0 * move + 2.0), ["move"], ["loc", "scale"])
    policy = ProbabilisticActor(
        network,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        default_interaction_type=ExplorationType.RANDOM,
        distribution_kwargs={"low": torch.tensor([0.0, -1.0]), "high": torch.tensor([50.0, 1.0])},
    )
    env = GeomagneticNavEnv(num_envs=3, seed=0, max_steps=4)
    assert env.rollout(4, policy)["action"].unique().numel() > 4
    actions = evaluation_rollout(env, policy)["action"]
    assert torch.equal(actions, torch.tensor([25.0, 0.0]).expand_as(actions))
    episodes = [evaluate_policy(policy, "figure-4-1", max_steps=4)["length_km"] for _ in range(2)]
    assert torch.equal(*episodes)


def test_episodes_are_a_data_frame() -> None:
    pandas = pytest.importorskip("pandas")
    episodes = evaluate_policy("geodesic", "figure-4-1")
    frame = pandas.DataFrame(episodes.to_dict(convert_tensors="numpy"))
    assert len(frame) == 1
    assert frame["success"].dtype == bool
    assert set(frame) == set(episodes.keys()) > {"spl", "spl_to_arrival", "navigation_error_km"}
