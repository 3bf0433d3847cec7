"""Recipes in a scenario of the user: training, resuming and evaluation with the same file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.recipes import load

from magrl.agents import FieldPolicy, PolicyConfig
from magrl.envs import GeomagneticNavEnv, Region, Scenario
from magrl.training import parse_config

AZORES = Region((36, 46), (-32, -22))
TOML = """
date = 2026-07-01
generation = 14
altitude_km = 10.0
margin_deg = 4
distance_range_km = [200, 400]
objective_floors = [0.1, 0.3, 100]

[region]
latitude = [36, 46]
longitude = [-32, -22]

[[tasks]]
name = "Ponta Delgada to Flores"
start = [37.74, -25.67]
target = [39.45, -31.13]

[[tasks]]
start = [40, -30]
target = [42, 332]
"""


def test_policy_is_refused_where_it_was_not_trained() -> None:
    here = GeomagneticNavEnv(seed=0)
    policy = FieldPolicy(PolicyConfig(here.observation_view(), (8,), layer_norm=False))
    policy.check_fits(here)
    later = Scenario(date="2026-07-01", generation=14)
    policy.check_fits(GeomagneticNavEnv(later, seed=0))
    azores = later.replace(region=AZORES)
    with pytest.raises(ValueError, match=r"trained where D is 7\.3 to 10\.4°; here it is -10\.0 to -5\.4°"):
        policy.check_fits(GeomagneticNavEnv(azores, seed=0))


def test_training_and_evaluation_take_the_same_file(tmp_path: Path) -> None:
    """Trained in the user's scenario, evaluated on its tasks; the file may be gone before the evaluation."""
    path, away = tmp_path / "azores.toml", {"wandb_mode": "disabled"}
    path.write_text(TOML)
    recipe, evaluate = load("td3_gradient_guided"), load("evaluate")
    small = {"num_envs": 8, "total_frames": 64, "num_cells": (8,), "batch_size": 16, "eval_every": 4}
    small |= {"eval_tasks_small": 3, "eval_tasks": 4, "init_random_frames": 8}
    run = tmp_path / "run"
    recipe.train(recipe.Config(scenario=path, out=run, **small, **away))
    assert (run / "scenario.toml").read_text() == TOML
    assert json.loads((run / "config.json").read_text())["scenario"] == "scenario.toml"
    (run / "eval.json").unlink()
    arguments = (recipe.Config, recipe.PRESETS, recipe.RECIPE, recipe.__doc__, ["--resume", str(run)])
    assert parse_config(*arguments).scenario == run / "scenario.toml"

    out, names = tmp_path / "out", (f"gg_td3={run}", "parallel")
    exported = tmp_path / "maps" / "flights.geojson"
    summaries = evaluate.evaluate(evaluate.Config(names, scenario=path, out=out, export=exported, **away))
    assert summaries["parallel"][0]["num_tasks"] == 2
    assert summaries["parallel"][0]["success_rate"] == 100
    features = json.loads(exported.read_text())["features"]
    assert [feature["properties"]["name"] for feature in features] == ["Ponta Delgada to Flores", "task 2"] * 2
    assert {feature["properties"]["navigator"] for feature in features} == {"gg_td3", "parallel"}
    random = evaluate.evaluate(
        evaluate.Config(("parallel",), tasks="paper-100", scenario=path, out=tmp_path / "random", **away)
    )
    assert random["parallel"][0]["num_tasks"] == 100
    other = {"out": tmp_path / "other", **away}
    for message, options in (
        (r"gg_td3=.*trained where D is", {"navigators": names[:1], "tasks": "figure-4-1"}),
        (
            "--tasks figure-4-1 lies in the paper's region",
            {"navigators": names, "tasks": "figure-4-1", "scenario": path},
        ),
        (r"\.geojson, \.gpx, \.kml", {"navigators": names, "scenario": path, "export": tmp_path / "a.shp"}),
    ):
        with pytest.raises(ValueError, match=message):
            evaluate.evaluate(evaluate.Config(**options, **other))
    assert not (tmp_path / "other").exists()


def test_a_region_too_large_for_a_field_leaves_no_run_folder(tmp_path: Path) -> None:
    recipe, path = load("td3_gradient_guided"), tmp_path / "big.json"
    path.write_text(json.dumps({"region": {"latitude": [-60, 60], "longitude": [0, 90]}, "date": 2026.5}))
    with pytest.raises(ValueError, match=r"big\.json: region.*misses the field by .* nT.*: choose a smaller region"):
        recipe.train(recipe.Config(scenario=path, out=tmp_path / "run", wandb_mode="disabled"))
    assert not (tmp_path / "run").exists()
