"""How recipes/evaluate.py flies trained agents: as they were trained, on named or random tasks, with sensor noise."""

import csv
import json
import math
from collections.abc import Callable
from pathlib import Path

import evaluate
import pytest
import torch

from magrl import paper
from magrl.agents import FieldPolicy, PolicyConfig, save_policy
from magrl.envs import GeomagneticNavEnv, Scenario, named_tasks
from magrl.envs.tasks import task_set
from magrl.evaluation.runs import TrainedRun, agreed, common_scenario, read_run, run_config, trained_runs
from magrl.evaluation.scenarios import FIRST_TASKS_SEED
from magrl.files import write_json
from magrl.training import RunConfig, UsageError
from magrl.training.collectors import worker_seed

NOISE = (0.05, 0.05, 5.0)
AZORES = (Path(__file__).parent.parent.parent / "docs" / "examples" / "azores.toml").read_text()
Trained = Callable[..., Path]


@pytest.fixture
def trained(tmp_path: Path) -> Trained:
    """Return a function that makes a finished run with some settings, whose agent has learned nothing."""

    def make(name: str, **settings: object) -> Path:
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        torch.manual_seed(len(name))
        scenario = Scenario()
        if settings.get("scenario"):
            (folder / "scenario.toml").write_text(AZORES)
            scenario = evaluate.load_scenario(folder / "scenario.toml").with_tasks(None)
        view = GeomagneticNavEnv(scenario, seed=0).observation_view()
        save_policy(folder / "policy.pt", FieldPolicy(PolicyConfig(view, (8,), layer_norm=False)))
        write_json(
            folder / "config.json", {"recipe": "td3_gradient_guided.py", "guided": True, "zeta": 0.01} | settings
        )
        (folder / "eval.json").write_text("{}")
        return folder

    return make


def flown(out: Path, *navigators: str, tasks: str | int | None = 3, **options: object) -> dict:
    """Return the settings of an evaluation as they were written."""
    evaluate.evaluate(evaluate.Config(navigators, tasks=tasks, out=out, wandb_mode="disabled", **options))
    return json.loads((out / "settings.json").read_text(), parse_constant=pytest.fail)


def rows(out: Path, name: str) -> list[dict[str, str]]:
    with (out / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


# Tasks


def test_random_tasks_are_those_of_their_seed(tmp_path: Path) -> None:
    one = evaluate.choose_tasks(None, 30, 7).tasks
    assert one.start.shape == (30, 2)
    assert torch.equal(one.start, evaluate.choose_tasks(None, 30, 7).tasks.start)
    assert torch.equal(one.start[:5], evaluate.choose_tasks(None, 5, 7).tasks.start)
    assert not torch.equal(one.start, evaluate.choose_tasks(None, 30, 8).tasks.start)
    assert torch.equal(evaluate.choose_tasks(None, 30).tasks.start, evaluate.choose_tasks(None, 30, 0).tasks.start)
    (tmp_path / "own.toml").write_text(AZORES)
    own = evaluate.choose_tasks(tmp_path / "own.toml", 4, 7)
    assert len(own.tasks.start) == 4
    assert own.region.contains(own.tasks.start).all()


def test_random_tasks_are_not_those_of_a_training_or_a_frozen_set() -> None:
    """A training of seed 7 starts with the first tasks of seed 7."""
    seeds = [7, worker_seed(7, 0), paper.TEST_SEED, paper.VALIDATION_SEED, paper.SWEEP_SEED, paper.PAPER_SEED]
    for seed in seeds:
        assert not torch.equal(task_set(3, seed).start, evaluate.choose_tasks(None, 3, 7).tasks.start)
    assert max(*seeds, paper.FIRST_RESERVED_SEED) < FIRST_TASKS_SEED
    assert torch.equal(evaluate.choose_tasks(None, "test-1000").tasks.start, named_tasks("test-1000").start)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tasks": 0}, "num_tasks must be a whole number from 1 on, got 0"),
        ({"tasks": 3, "tasks_seed": -1}, "tasks_seed .*-1"),
        ({"tasks": None, "tasks_seed": 7}, "--tasks-seed 7 needs a number of random tasks, such as --tasks 300"),
        ({"tasks": "paper-100", "tasks_seed": 0}, "--tasks-seed 0 needs a number of random tasks"),
        ({"noise": (0.05, -1.0, 5.0)}, "noise must be a finite number from 0 on, got -1.0"),
        ({"noise": (0.05, math.nan, 5.0)}, "noise .*nan"),
        ({"max_steps": 0}, "max_steps must be greater than or equal to 1, got 0"),
        ({"altitude_km": 5000.0}, "altitude_km must be a finite number from -15 up to 1000, got 5000"),
        ({"start_heading": "south"}, "start_heading must be 'north' or 'random', got 'south'"),
    ],
    ids=str,
)
def test_bad_conditions_are_refused_before_anything_is_written(tmp_path: Path, options: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        flown(tmp_path / "out", "secant", **options)
    assert not (tmp_path / "out").exists()


# Noise


def test_settings_say_what_was_flown(tmp_path: Path) -> None:
    noisy = flown(tmp_path / "noisy", "secant", "pso:flown", tasks=5, tasks_seed=7, noise=NOISE, seed=2)
    assert noisy == {
        "navigators": ["secant", "pso:flown"],
        "tasks": 5,
        "num_tasks": 5,
        "tasks_seed": 7,
        "scenario": None,
        "zeta": 0.01,
        "arrival": "objective",
        "arrival_radius_km": 25,
        "max_steps": 50,
        "max_move_km": 50,
        "max_turn_deg": 90,
        "altitude_km": 0,
        "margin_deg": 5,
        "noise": list(NOISE),
        "start_heading": "north",
        "mode": "look-ahead",
        "map_date": None,
        "conditions": None,
        "seed": 2,
    }
    lines = (tmp_path / "noisy" / "table.md").read_text().splitlines()
    assert lines[-1] == "Standard deviations of the noise on D, I and B_H: 0.05 deg, 0.05 deg, 5 nT."
    perfect = flown(tmp_path / "perfect", "secant", tasks="figure-4-1")
    assert (perfect["noise"], perfect["tasks_seed"], perfect["num_tasks"]) == ([0, 0, 0], None, 1)
    assert "noise" not in (tmp_path / "perfect" / "table.md").read_text()


def test_noise_costs_and_does_not_depend_on_the_other_navigators(tmp_path: Path) -> None:
    flown(tmp_path / "alone", "secant", tasks=20, noise=NOISE, start_heading="random")
    flown(tmp_path / "second", "parallel", "secant", tasks=20, noise=NOISE, start_heading="random")
    flown(tmp_path / "perfect", "secant", tasks=20, start_heading="random")
    alone, second, perfect = (
        [float(row["length_km"]) for row in rows(tmp_path / name, "episodes") if row["navigator"] == "secant"]
        for name in ("alone", "second", "perfect")
    )
    assert alone == second
    assert alone != perfect


def test_paths_show_the_true_field(tmp_path: Path) -> None:
    """At the start it is the field without noise, which the example task of the paper states."""
    flown(tmp_path / "noisy", "secant", noise=(1.0, 1.0, 500.0))
    first = rows(tmp_path / "noisy", "paths")[0]
    state = GeomagneticNavEnv(Scenario().with_tasks(named_tasks("figure-4-1")), seed=0).reset()
    assert [float(first[name]) for name in ("D", "I", "B_H")] == state["field"][0].tolist()


# How runs were trained


def test_runs_are_flown_as_they_were_trained(trained: Trained, tmp_path: Path) -> None:
    run = trained("noisy", noise=NOISE, start_heading="random", zeta=0.05, guided=False)
    said = flown(tmp_path / "out", f"td3={run}", "secant")
    assert said["navigators"] == ["td3=noisy", "secant"]
    assert (said["noise"], said["start_heading"], said["zeta"]) == (list(NOISE), "random", 0.05)
    assert "Warning" not in (tmp_path / "out" / "short.md").read_text()
    chosen = {"noise": (0.0, 0.0, 0.0), "start_heading": "north", "zeta": 0.01}
    said = flown(tmp_path / "other", f"td3={run}", **chosen)
    assert (said["noise"], said["start_heading"], said["zeta"]) == ([0, 0, 0], "north", 0.01)
    warnings = [line for line in (tmp_path / "other" / "short.md").read_text().splitlines() if "Warning" in line]
    assert [line.partition(f"{run} was trained with ")[2] for line in warnings] == [
        "zeta 0.05 and is evaluated with zeta 0.01.",
        "start heading random and is evaluated with north.",
        "sensor noise 0.05 0.05 5 and is evaluated with 0 0 0.",
    ]


def test_runs_are_flown_in_their_scenario(trained: Trained, tmp_path: Path) -> None:
    run = trained("azores", scenario="scenario.toml")
    said = flown(tmp_path / "out", f"gg_td3={run}", tasks=None)
    assert (said["scenario"], said["num_tasks"]) == ("scenario.toml", 3)
    copy = tmp_path / "azores.toml"
    copy.write_text(AZORES)
    assert common_scenario([read_run(run)], copy) == (copy, [])
    copy.write_text(AZORES.replace("2026", "2027"))
    flown(tmp_path / "later", f"gg_td3={run}", scenario=copy)
    assert (
        "was trained in the scenario scenario.toml of its folder, and is evaluated in that of azores.toml"
        in (tmp_path / "later" / "table.md").read_text()
    )


def test_runs_that_differ_need_a_choice(trained: Trained, tmp_path: Path) -> None:
    plain, noisy, turned, away = (
        f"gg_td3={trained(name, **settings)}"
        for name, settings in (
            ("plain", {}),
            ("noisy", {"noise": NOISE}),
            ("turned", {"start_heading": "random"}),
            ("away", {"scenario": "scenario.toml"}),
        )
    )
    for other, message, option in (
        (
            noisy,
            r"different sensor noise, 0 0 0 \(.*plain\), 0.05 0.05 5 \(.*noisy\): choose with --noise",
            {"noise": NOISE},
        ),
        (
            turned,
            r"different start heading, north \(.*plain\), random \(.*turned\): choose with --start-heading",
            {"start_heading": "random"},
        ),
    ):
        with pytest.raises(UsageError, match=message):
            flown(tmp_path / "out", plain, other)
        flown(tmp_path / other.rpartition("/")[2], plain, other, **option)
    with pytest.raises(
        UsageError, match=r"in different scenarios, .*plain in the paper's scenario, .*away in the scenar"
    ):
        flown(tmp_path / "out", plain, away)
    assert not (tmp_path / "out").exists()


def test_an_agent_trained_anywhere_fits_every_evaluation(trained: Trained, tmp_path: Path) -> None:
    """It has seen all headings and many levels of noise."""
    run = f"anywhere={trained('anywhere', recipe='td3_anywhere.py', guided=None)}"
    other = f"gg_td3={trained('noisy', noise=NOISE, start_heading='random')}"
    said = flown(tmp_path / "out", run, other)
    assert (said["start_heading"], tuple(said["noise"])) == ("random", NOISE)
    assert "was trained" not in (tmp_path / "out" / "table.md").read_text()


def test_an_agent_under_the_name_of_another_kind_is_refused(trained: Trained, tmp_path: Path) -> None:
    guided, plain = trained("guided"), trained("plain", guided=False)
    recurrent = trained("recurrent", recipe="td3_recurrent.py", guided=None)
    assert [read_run(run).kind for run in (guided, plain, recurrent)] == ["gg_td3", "td3", "recurrent"]
    for text, kind in ((f"td3={guided}", "gg_td3"), (f"gg_td3={plain}", "td3"), (f"td3={recurrent}", "recurrent")):
        folder = text.partition("=")[2]
        with pytest.raises(UsageError, match=rf"was trained as {kind}, not \w+: write {kind}={folder}"):
            flown(tmp_path / "out", text)
    assert len(trained_runs([f"gg_td3={guided}", f"recurrent={recurrent}", "secant", "td3=nowhere"])) == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[", "is not the configuration of a run"),
        ("[1]", "is not the configuration of a run"),
        ('{"noise": 5}', "is not the configuration of a run"),
        ('{"noise": [1, 2]}', "is not the configuration of a run"),
        ('{"guided": []}', "is not the configuration of a run"),
        ('{"scenario": 5}', "is not the configuration of a run"),
    ],
)
def test_damaged_settings_are_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "config.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_run(tmp_path)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no run at"):
        run_config(tmp_path)
    (tmp_path / "config.json").write_text('{"scenario": "scenario.toml"}')
    with pytest.raises(FileNotFoundError, match=r"was trained in its scenario file scenario\.toml, which is missing"):
        read_run(tmp_path)


def test_first_of_equal_runs_is_named() -> None:
    runs = [
        TrainedRun(Path(name), "td3", heading) for name, heading in (("a", "north"), ("b", "random"), ("c", "north"))
    ]
    options = {"name": "heading", "option": "--heading"}
    with pytest.raises(ValueError, match=r"different heading, north \(a\), random \(b\): choose with --heading"):
        agreed(runs, lambda run: run.start_heading, None, "north", **options)
    assert agreed(runs[:1], lambda run: run.start_heading, None, "random", **options) == ("north", [])
    assert agreed([], lambda run: run.start_heading, None, "random", **options) == ("random", [])


# Options of a scenario


OWN = """date = 2026-07-01
zeta = 0.02
max_steps = 70
arrival = "distance"
region = {latitude = [36, 46], longitude = [-32, -22]}
tasks = [{name = "far off", start = [37.74, -25.67], target = [53.5, -31.13]}]
"""


def test_options_are_those_of_the_command_line_then_of_the_scenario(tmp_path: Path) -> None:
    """Its destination, seven degrees north of the region, needs a wider margin than the five of the default."""
    (tmp_path / "own.toml").write_text(OWN)
    with pytest.raises(
        UsageError, match=r"own\.toml: tasks: .* lies outside .*: raise margin_deg from 5 to at least 7\.5$"
    ):
        flown(tmp_path / "out", "secant", tasks=None, scenario=tmp_path / "own.toml")
    options = {
        "margin_deg": 8.0,
        "max_steps": 90,
        "max_turn_deg": 120.0,
        "altitude_km": -2.0,
        "start_heading": "random",
    }
    said = flown(tmp_path / "out", "secant", "parallel", tasks=None, scenario=tmp_path / "own.toml", **options)
    assert said.items() >= (options | {"zeta": 0.02, "arrival": "distance", "num_tasks": 1}).items()
    for episode in rows(tmp_path / "out", "episodes"):
        assert episode["success"] == "True"
        assert float(episode["navigation_error_km"]) <= 25
    assert (tmp_path / "out" / "trajectories.png").stat().st_size > 10_000


def test_tables_lead_with_kilometers_where_arrival_is_a_distance_and_have_no_row_of_the_paper(tmp_path: Path) -> None:
    heads = []
    for name, options in (("a", {}), ("b", {"kilometers": True}), ("c", {"arrival": "declared"})):
        flown(tmp_path / name, "secant", "ga", **options)
        table, short = ((tmp_path / name / f"{kind}.md").read_text() for kind in ("table", "short"))
        assert "GA, paper" in table
        heads.append(short.splitlines()[0].split(" | ")[2:5])
    assert heads[0] == ["SR %", "SPL %", "worst run, SPL %"]
    assert heads[1] == ["within 25 km %", "final distance, median km", "SR %"]
    assert heads[2] == ["within 25 km %", "final distance, median km", "false arrivals %"]
    assert "Arrival: declared, within 25 km." in short
    assert {episode["false_arrival"] for episode in rows(tmp_path / "c", "episodes")} <= {"True", "False"}
    (tmp_path / "own.toml").write_text(AZORES)
    flown(tmp_path / "d", "ga", scenario=tmp_path / "own.toml")
    assert "paper" not in (tmp_path / "d" / "table.md").read_text()


def test_a_training_contradicts_no_scenario(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(OWN.replace("53.5", "40.5"))
    with pytest.raises(ValueError, match=r"the scenario says zeta = 0\.02, the training 0\.01: add --zeta 0\.02"):
        RunConfig(scenario=path)
    assert RunConfig(scenario=path, zeta=0.02).load_scenario().max_steps == 70
    path.write_text(OWN.replace("53.5", "40.5").replace("distance", "declared"))
    with pytest.raises(ValueError, match="the recipes train no agent that declares"):
        RunConfig(scenario=path, zeta=0.02)


def test_results_go_to_the_first_folder_that_is_free(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert evaluate.Config(("secant",)).out == Path("runs/evaluation")
    for name in ("evaluation", "evaluation-2"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    assert evaluate.Config(("secant",)).out == Path("runs/evaluation-3")
