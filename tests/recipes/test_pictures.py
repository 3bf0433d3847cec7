"""The pictures of the README, and the data that pictures of the documentation are drawn from."""

from __future__ import annotations

import re
from pathlib import Path

import figures
import flights
import numpy as np
import pictures
import pytest
import torch
from matplotlib.figure import Figure
from pandas import read_csv
from PIL import Image, ImageSequence
from support.recipes import ROOT

from magrl.transforms.areas import NUMBER

DOCS = ROOT / "docs"
DRAWN = figures.DATA | {"results/scores": "results/scores.csv"}


@pytest.mark.parametrize("path", sorted(DOCS.glob("*/*.[pg][ni][gf]")), ids=lambda path: path.stem)
def test_pictures_name_their_source_and_show_the_published_data(path) -> None:
    with Image.open(path) as picture:
        source, about = picture.info.get("Source") or picture.info["comment"].decode(), picture.info.get("Description")
    (script,) = re.findall(r"docs/tables/\w+\.py|-m benchmarks", source)
    assert (ROOT / script.removeprefix("-m ")).exists()
    data = DRAWN.get(f"{path.parent.name}/{path.stem}")
    assert about == (f"{Path(data).name} {flights.digest(DOCS / data)}" if data else None)


def test_a_picture_keeps_the_colors_of_short_lines(tmp_path: Path) -> None:
    figure = Figure(figsize=(3, 3))
    axes = figure.subplots()
    axes.imshow(np.random.default_rng(0).random((99, 99)), cmap="viridis")
    axes.plot([40, 44], [40, 40], color="#CC79A7", lw=3)
    flights.write_picture(tmp_path / "line.png", figure, "a test")
    with Image.open(tmp_path / "line.png") as picture:
        assert picture.mode == "P"
        assert (np.abs(np.asarray(picture.convert("RGB")) - np.array([0xCC, 0x79, 0xA7])).max(-1) < 16).sum() > 9


def test_the_episode_of_eddies_is_typical() -> None:
    """Of the first vehicles, its scores of the agent and of the true bearing are nearest to the medians of all."""
    known = read_csv(DOCS / "results" / "scores.csv.gz").query("task == 'eddies'")
    agents = known[known["algorithm"] == "TD3"].pivot(index="seed", columns="episode", values="score")
    shipped = agents.loc[agents.mean(axis=1).rank(method="first").sub((len(agents) + 1) // 2).abs().idxmin()]
    bearing = known[known["algorithm"] == "geodesic"].set_index("episode")["score"]
    apart = sum((scores - scores.median()).abs()[: pictures.VEHICLES] for scores in (shipped, bearing))
    assert apart.idxmin() == pictures.TASKS["eddies"].picture[1]


def voyage(*believed: float) -> pictures.Voyage:
    """Three places on a meridian, a degree apart, and what the vehicle believes instead."""
    true = torch.tensor([[0.0, 50.0], [1.0, 50.0], [2.0, 50.0]]).double()
    places = torch.tensor([[place, 50.0] for place in believed]).double()
    return pictures.Voyage(true, places, 25.0 * torch.eye(2).double().expand(3, 2, 2))


def test_a_trip_moves_between_its_steps_and_stays_at_its_end() -> None:
    flown = voyage(0.0, 1.5, 2.5)
    assert flown.at(1.5).true[:, 0].tolist() == [0, 1, 1.5]
    assert flown.at(1.5).believed[-1].tolist() == [2, 50]
    assert flown.at(9) is flown
    assert flown.error_km == pytest.approx(55.3, abs=0.1)


def test_the_counter_shows_the_step_before(monkeypatch) -> None:
    monkeypatch.setattr(pictures, "PIECE_KM", 60.0)
    shown = pictures.Animation(torch.tensor([3.0, 50.0]).double(), voyage(0.0, 1.5, 2.5), voyage(0.0, 1.1, 2.0))
    frames = list(shown.frames("98 of 100"))
    assert len(frames) == 2 * 2 + 2
    assert (np.asarray(frames[-1]) != np.asarray(frames[-2])).any()
    shown.image(1.5)
    assert [text.get_text() for text in shown.texts] == ["step 1 · 221 km to go · error", "55 km", "/", "11 km"]
    assert shown.lines[2].get_ydata().tolist() == [0, 1, 1.5]


def test_the_map_of_nogo_has_its_areas_and_ends_at_the_destination(monkeypatch) -> None:
    monkeypatch.setattr(pictures, "VEHICLES", 8)
    axes = pictures.task_picture("nogo").axes[0]
    track, start, end = axes.lines[-3:]
    assert len(axes.patches) == NUMBER
    assert track.get_xydata()[0].tolist() == start.get_xydata()[0].tolist()
    assert np.abs(track.get_xydata()[-1] - end.get_xydata()[0]).max() < 0.5


def test_pictures_of_tasks_show_a_region_four_fields_and_readings_that_near_the_destination(monkeypatch) -> None:
    monkeypatch.setattr(pictures, "VEHICLES", 8)
    (region,) = pictures.task_picture("box").axes
    assert (*region.get_xlim(), *region.get_ylim()) == (160, 170, -10, 0)
    fields = {round(axes.get_xlim()[0], 3) for axes in pictures.task_picture("anywhere").axes}
    assert len(fields) == 4
    for axes in pictures.task_picture("readings").axes:
        values = axes.lines[1].get_ydata()
        assert abs(values[-1]) < abs(values[0]) / 4


def test_pictures_are_small_enough_for_a_first_screen() -> None:
    animation = DOCS / "figures" / "underwater.gif"
    with Image.open(animation) as picture:
        seconds = sum(frame.info["duration"] for frame in ImageSequence.Iterator(picture)) / 1000
        assert picture.width == 720
    assert 10 < seconds < 14
    assert animation.stat().st_size < 1_500_000
    for task in pictures.NAMED_TASKS:
        assert (DOCS / "figures" / f"task-{task}.png").stat().st_size < 40_000
