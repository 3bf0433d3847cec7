"""The command that compares navigators: its files, its settings, and what it refuses."""

import csv
import json
from pathlib import Path

import evaluate
import fly
import pytest
import torch

from magrl.envs import GeomagneticNavEnv, Scenario, load_scenario, named_trips
from magrl.errors import CONDITIONS
from magrl.evaluation import Sheet
from magrl.navigators import NAVIGATORS, FieldPolicy, PolicyConfig, save_policy
from magrl.navigators.names import PRETRAINED
from magrl.training import UsageError

NOISE = (0.05, 0.05, 5.0)
TARGET = ("--target-std", "0.01", "0.02", "3")


def make_run(folder: Path, env: GeomagneticNavEnv, **settings: object) -> Path:
    """Return the folder of a run whose agent has learned nothing."""
    folder.mkdir()
    torch.manual_seed(0)
    policy = FieldPolicy(PolicyConfig(env.observation_view(), (8,), layer_norm=False))
    policy.training = {"guided": True} | settings
    save_policy(folder / "policy.safetensors", policy)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "noisy"
    return make_run(folder, GeomagneticNavEnv(seed=0), zeta=0.02, noise=NOISE, start_heading="random")


@pytest.fixture(scope="module")
def results(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results") / "comparison"
    evaluate.main([f"{run}", "secant", "pso", "--trips", "4", "--max-steps", "3", "--out", str(out), *TARGET])
    return out


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_summary_is_that_of_the_episodes_of_the_same_trips(results: Path) -> None:
    summary = json.loads((results / "summary.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)
    episodes = rows(results / "episodes.csv")
    assert len(episodes) == 3 * 4
    ahead, secant = ([r for r in episodes if r["navigator"] == name] for name in ("pso", "secant"))
    assert [r["shortest_km"] for r in ahead] == [r["shortest_km"] for r in secant]
    assert summary["secant"][0]["spl"] == pytest.approx(25 * sum(float(r["spl"]) for r in secant))
    assert summary["secant"][0]["field_readings"] == 0 < summary["pso"][0]["field_readings"]
    assert summary["gg_td3_noise"][0]["steps"] is None  # no success
    assert [r["source"] for r in rows(results / "runs.csv")][:2] == ["noisy", ""]


def test_tables_have_the_papers_row_and_notes(results: Path) -> None:
    lines = (results / "table.md").read_text(encoding="utf-8").splitlines()
    first, *_, published, _ = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:6]]
    assert first[:3] == ["Gradient-Guided TD3, trained with noise", "the region", "nothing"]
    assert [published[0], *published[4:8]] == ["PSO, paper", "29.0", "442495", "27.09", "21.03"]
    assert "Errors of the readings: 0.05 deg, 0.05 deg, 5 nT." in lines
    assert "Errors of the elements at the destination: 0.01 deg, 0.02 deg, 3 nT." in lines
    assert (results / "trajectories.png").stat().st_size > 10_000


def test_paths_and_settings_state_what_was_flown(results: Path) -> None:
    """The paper's example with the true field; a run is flown as it was trained."""
    starts = [r for r in rows(results / "paths.csv") if r["step"] == "0"]
    state = GeomagneticNavEnv(Scenario().with_trips(named_trips("paper-example")), seed=0).reset()
    assert len(starts) == 3
    for row in starts:
        assert (float(row["latitude"]), float(row["longitude"])) == (-2.0, 162.0)
        assert [float(row[name]) for name in ("D", "I", "B_H")] == state["field"][0].tolist()
    settings = json.loads((results / "settings.json").read_text(encoding="utf-8"))
    assert settings["navigators"] == ["gg_td3_noise=noisy", "secant", "pso"]
    expected = {"zeta": 0.02, "errors": list(NOISE), "start_heading": "random", "scenario": None, "trips_seed": 0}
    expected |= {"target_std": [0.01, 0.02, 3.0]}
    assert settings.items() >= expected.items()


OWN = """date = 2026-07-01
zeta = 0.02
arrival = "distance"
region = {latitude = [36, 46], longitude = [-32, -22]}
trips = [
    {name = "far off", start = [37.74, -25.67], target = [53.5, -31.13]},
    {start = [40, -30], target = [42, 332]},
]
"""


def test_options_are_those_of_the_command_line_then_of_the_scenario(tmp_path: Path) -> None:
    """The destination, seven degrees north of the region, needs a wider margin than the five of the default."""
    path, out = tmp_path / "own.toml", tmp_path / "out"
    path.write_text(OWN, encoding="utf-8")
    config = {"scenario": path, "out": out}
    with pytest.raises(UsageError, match=r"own\.toml: trips: .*: raise margin_deg from 5 to at least 7\.5$"):
        evaluate.evaluate(evaluate.Config(("secant",), **config))
    options = {"margin_deg": 8.0, "max_steps": 8, "max_turn_deg": 120.0, "start_heading": "random"}
    own = load_scenario(path, margin_deg=8.0)
    run = make_run(
        tmp_path / "run", GeomagneticNavEnv(own), scenario="scenario.toml", zeta=0.02, start_heading="random"
    )
    (run / "scenario.toml").write_text(OWN, encoding="utf-8")
    names = (f"{run}", "secant")
    config["rules"] = evaluate.ScenarioOptions(**options)
    evaluate.evaluate(evaluate.Config(names, **config))
    settings = json.loads((out / "settings.json").read_text(encoding="utf-8"))
    assert settings.items() >= (options | {"zeta": 0.02, "arrival": "distance", "num_trips": 2}).items()
    arrived = [row for row in rows(out / "episodes.csv") if row["success"] == "True"]
    assert max(float(row["navigation_error_km"]) for row in arrived) <= 25
    text = (out / "table.md").read_text(encoding="utf-8")
    assert "paper" not in text
    assert "Arrival: distance, within 25 km." in text
    for message, change in (
        (r"run: .*trained where D is", {"trips": "paper-example", "scenario": None}),
        ("--trips paper-example lies in the paper's region", {"trips": "paper-example"}),
    ):
        with pytest.raises(UsageError, match=message):
            evaluate.evaluate(evaluate.Config(names[:1], **(config | change | {"out": tmp_path / "other"})))
    assert not (tmp_path / "other").exists()


def test_bad_usage_is_refused_before_anything_is_flown(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(evaluate.Flight, "fly", lambda *_: pytest.fail("something was flown"))
    for navigators, options, message in (
        ((), {}, "at least one navigator"),
        (("dowsing",), {}, "unknown navigator 'dowsing'"),
        (("secant",), {"trips": 0}, "num_trips must be a whole number from 1 on, got 0"),
        (("secant",), {"trips_seed": 7}, "--trips-seed 7 needs a number of random trips, such as --trips 300"),
        (("ga",), {"seed": -1}, "seed"),
        (("secant",), {"device": "tpu"}, "device 'tpu' cannot be used here .*: choose another, such as cpu"),
        (("secant",), {"scenario": Path("missing.toml")}, "no scenario file at"),
    ):
        given = {"trips": None if "scenario" in options else "paper-example", "out": tmp_path / "out"} | options
        with pytest.raises(UsageError, match=message):
            evaluate.evaluate(evaluate.Config(navigators, **given))
    assert not (tmp_path / "out").exists()


def test_options_come_from_the_records_and_registries(capsys) -> None:
    """Names of navigators and vehicles, and an error that says which there are, before anything is flown."""
    for command, places in ((evaluate, ["secant"]), (fly, ["60.4N 5.3E", "60.4N 3.3E"])):
        with pytest.raises(SystemExit):
            command.main(["--help"])
        words = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert ", ".join((*NAVIGATORS, *PRETRAINED)) in words
        assert ", ".join(CONDITIONS) in words
        for name in Sheet.model_fields:
            assert f"--{name.replace('_', '-')} " in words
        with pytest.raises(SystemExit):
            command.main([*places, "--errors", "yacht"])
        assert "must be one of 'laboratory'" in capsys.readouterr().err


def test_results_go_to_the_first_folder_that_is_free(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert evaluate.Config(("secant",)).out == Path("runs/evaluation")
    for name in ("evaluation", "evaluation-2"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    assert evaluate.Config(("secant",)).out == Path("runs/evaluation-3")
