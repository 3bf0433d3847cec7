"""The recipe that flies between two places."""

import json
import math
from pathlib import Path

import fly as recipe
import pytest
import torch
from matplotlib.figure import Figure

from magrl.field import IGRF, elements_at
from magrl.training import UsageError

SURE = recipe.Sheet(confidence=0.9)


def test_a_flight_writes_its_files(tmp_path: Path, capsys) -> None:
    options = ("--navigator", "secant", "--out", str(tmp_path), "--start-heading", "270", "--max-steps", "7")
    recipe.main(["-33.9 18.4", "-33.8, 18.6", *options, "--target-std", "0.001", "0.001", "0.1"])
    assert "outcome         arrived\n" in capsys.readouterr().out
    result = json.loads((tmp_path / "flight.json").read_text(encoding="utf-8"))
    assert result["start_position"] == pytest.approx([-33.9, 18.4])
    true = elements_at(IGRF("2025-01-01"), torch.tensor([-33.8, 18.6], dtype=torch.float64)).tolist()
    assert result["target_field"] == pytest.approx(true, rel=1e-6)
    assert result["target_std"] == [0.001, 0.001, 0.1]
    assert (result["zeta"], result["needs"]) == (0.01, "nothing")
    assert result["shortest_km"] <= result["length_km"] * 1.1 < 400
    assert result["navigation_error_km"] < 30
    assert (tmp_path / "flight.png").stat().st_size > 10_000


def test_the_pretrained_agent_arrives_and_declares_its_arrival(tmp_path: Path, monkeypatch) -> None:
    """Within as many kilometers at every distance; the map has both flights."""
    drawn: list[dict] = []
    monkeypatch.setattr(recipe, "trajectories_figure", lambda steps, *_: drawn.append(steps) or Figure())
    sheet = recipe.Sheet(errors=(0.05, 0.05, 5.0), confidence=0.5)
    config = recipe.Config("60.4N 5.3E", "60.4N 3.3E", sheet=sheet, title="Out to sea", out=tmp_path)
    result = recipe.fly(config)
    assert result["outcome"] == "arrived"
    assert result["max_steps"] == round(3 * result["shortest_km"] / 50) + 20
    far = recipe.prepare(config.__class__("60N 5E", "70N 5E"))["with_signal"][0]
    assert (result["zeta"], far.base.zeta) == (0.01, pytest.approx(0.01 * (400 / 1115) ** 2, rel=1e-3))
    ((first, _), (_, flight)), alone = zip(*drawn[0].items(), strict=True), result["without_signal"]
    assert flight["next", "declared"][0, -1]
    assert first.startswith("Out to sea: anywhere with an arrival signal")
    right = alone["navigation_error_km"] <= 25
    assert alone["outcome"] == "declared its arrival" + ("" if right else ", falsely")


def test_a_flight_that_runs_out_of_steps_is_not_declared(tmp_path: Path) -> None:
    """With the confidence of the option; an arrival signal has another outcome."""
    config = recipe.Config("60.4N 5.3E", "60.4N 0.3E", navigator="kalman", max_steps=2, out=tmp_path)
    result = recipe.fly(config)
    assert (result["outcome"], result["without_signal"]["outcome"]) == ("reached the step limit", "not declared")
    _, env, _ = recipe.prepare(recipe.Config("60.4N 5.3E", "60.4N 0.3E", navigator="kalman", sheet=SURE))[
        "without_signal"
    ]
    assert env.transform[-1].rules.confidence == 0.9
    assert "km flown, " in recipe.summary(result)


def test_wrong_settings(tmp_path: Path) -> None:
    options = {"start": "60.4N 5.3E", "destination": "60.2N 1.1W", "navigator": "secant", "out": tmp_path / "out"}
    for change, message in (
        ({"start": "Bergen"}, "a place must be written such as '60.4N 5.3E'"),
        ({"destination": "60.4N 5.3E"}, "are the same place"),
        ({"destination": "60.4S 174.7W"}, "is the antipode of the start"),
        ({"destination": "86N 140E"}, "the declination is hardly defined at '86N 140E', where BH is"),
        ({"start_heading": math.inf}, "start_heading"),
    ):
        with pytest.raises(UsageError, match=message):
            recipe.prepare(recipe.Config(**(options | change)))
    assert not (tmp_path / "out").exists()


def test_the_distance_left_is_beside_the_path() -> None:
    """A flight that ends before the destination is shorter than the shortest path to it."""
    ends = {"start_position": [60.0, 5.0], "target_position": [60.0, 11.0], "target_field": [1.0, 70.0, 15000.0]}
    result = {
        **ends,
        "errors": "boat",
        "outcome": "arrived",
        "navigator": "kalman",
        "needs": "nothing",
        "north": "magnetic",
    }
    result |= {"steps": 9, "max_steps": 50, "length_km": 343.2, "shortest_km": 354.4, "navigation_error_km": 23.6}
    result |= {"path_efficiency": 0.966, "without_signal": result | {"ellipse": "here"}}
    assert "data sheet      Errors of the readings: boat; North: magnetic\n" in recipe.summary(result)
    assert "path            343 km flown, 23.6 km left of 354\n" in recipe.summary(result)
