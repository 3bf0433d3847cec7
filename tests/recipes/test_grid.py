"""Tables and figures from their declarative files: flights and cells by hand, and files that are named."""

import tempfile
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import figures
import flights
import grid
import publish
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image
from tensordict import TensorDict

from magrl.evaluation import tracks
from magrl.evaluation.tracks import COLUMNS, LEVELS, read_episodes
from magrl.jobs import mapped
from magrl.training import UsageError


def rows(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


# The files


def test_tables_and_errors_declare_options_that_exist() -> None:
    for options in grid.declared().values():
        if options.pop("kind") == "flights":
            del options["navigators"]
            options.pop("against", None)
            options.pop("measures", None)
            made = flights.Flights.of(**options)
            assert len(made.errors) == (len(made.conditions) + len(made.levels) or len(LEVELS))
    for error in grid.declared(figures.FILE)["errors"].values():
        for size in error["sizes"]:
            assert len(figures.one_error(error["lines"], size).errors) in (1, 2)


def test_bad_usage(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for tables, changes, message in (
        (("mars",), {}, "declares no table mars: choose from"),
        (("earth",), {"navigators": ("dowsing",), "trips": 2}, "earth: unknown navigator 'dowsing'"),
        (("comparison",), {"navigators": ("secant",), "jobs": 2}, "comparison: .* unexpected keyword argument 'jobs'"),
        (("noise",), {}, "there is no runs/.*: train it by make tables"),
    ):
        with pytest.raises(UsageError, match=message):
            grid.make(tables, **changes)
    for figure, message in (("mars", "unknown figure"), ("section-4", "No such file"), ("learning", "no runs/")):
        with pytest.raises(UsageError, match=message):
            figures.draw((figure,))


def test_documents_are_filled_or_none_is(tmp_path: Path) -> None:
    page, other = tmp_path / "page.md", tmp_path / "other.md"
    (tmp_path / "a.md").write_text("| a | b |\n|---|---|\n| 1 | 2 |\n", encoding="utf-8")
    page.write_text("x\n<!-- table: a.md | b -->\nold\n<!-- end -->\ny", encoding="utf-8")
    other.write_text("<!-- table: b.md -->\n<!-- end -->", encoding="utf-8")
    with pytest.raises(UsageError, match=r"No such file .*b\.md"):
        publish.publish((page, other), tmp_path)
    assert "old" in page.read_text(encoding="utf-8")
    publish.publish((page,), tmp_path)
    text = "x\n<!-- table: a.md | b -->\n\n| b |\n|---|\n| 2 |\n\n<!-- end -->\ny"
    assert page.read_text(encoding="utf-8") == text


def test_a_document_may_show_some_columns_and_rows() -> None:
    table = "| name | SPL % |\n|---|---|\n| secant | 99.0 |\n| kalman | 98.0 |\n| geodesic | 100.0 |"
    shown = publish.selected(table, "SPL % | name = kalman or geodesic").splitlines()
    assert shown == ["| SPL % | name |", "|---|---|", "| 98.0 | kalman |", "| 100.0 | geodesic |"]
    assert publish.selected(table, "name = kalman | SPL %").splitlines() == ["| SPL % |", "|---|", "| 98.0 |"]
    ends = "| a |\n|---|\n| 9.0 ± 0.1 / 8.0 ± 0.1 |\n| +1.0 (-0.5 to +2.5) |"
    assert publish.selected(ends, "a").splitlines()[2:] == [
        "| 9.0\xa0±\xa00.1\xa0/ 8.0\xa0±\xa00.1 |",
        "| +1.0\xa0(-0.5\xa0to\xa0+2.5) |",
    ]
    for columns, message in (("SR %", "no column SR %: choose from name, SPL %"), ("name = mars or x", "no row mars")):
        with pytest.raises(UsageError, match=message):
            publish.selected(table, columns)


# Flights


@pytest.fixture(autouse=True)
def few_regions(monkeypatch) -> None:
    earth = tracks.earth_scenario
    monkeypatch.setattr(
        tracks, "earth_scenario", lambda count, *rest, **options: earth(min(count, 4), *rest, **options)
    )


NEAR = {"trips": 4, "distance_km": (100, 150), "max_steps": 4}
"""Trips of three legs."""


def test_a_table_has_a_row_for_each_navigator_and_difference() -> None:
    oracle, old = "geodesic", {"name": "kalman", "step_price": 30.0}
    table = rows(grid.flights([oracle, old], against=[(0, 1), (0, 2)], levels=[(0, 0, 0), (0.5, 0.1, 20)], **NEAR).text)
    assert table[0] == [*flights.ABOUT, "0, 0, 0", "0.5, 0.1, 20"]
    assert len(table) == 5  # a pair of a navigator that is not flown is left out
    assert table[2][5] == "100.0 / 100.0"
    assert table[3][0] == "Kalman (dual control), step price 30.0"
    assert table[4][0] == f"{table[2][0]} − {table[3][0]}, SPL"
    assert table[4][5].strip("*").startswith("+")
    options = {"levels": [(0, 0, 0)], "trips": 2}
    assert rows(grid.flights([oracle], **options, max_steps=1).text)[2][5] == "0.0 / 0.0"
    far = rows(grid.flights([oracle], **options, distance_km=(1200, 1300), max_steps=30).text)
    assert far[2][5] == "100.0 / 100.0"


@pytest.mark.slow
def test_a_table_of_a_cluster_is_that_of_processes(monkeypatch) -> None:
    """On two nodes of one processor each."""
    folder = tempfile.TemporaryDirectory(dir="/tmp", ignore_cleanup_errors=True)  # names of sockets must be short
    monkeypatch.setenv("RAY_TMPDIR", folder.name)
    cluster = pytest.importorskip("ray.cluster_utils").Cluster(True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    options = {"levels": [(0, 0, 0), (0.5, 0.1, 20)], "jobs": 2} | NEAR
    try:
        assert len(set(mapped(node, range(4), 2, "ray", cluster.address))) == 2
        far = grid.flights(["secant", "kalman"], **options, backend="ray", address=cluster.address)
    finally:
        cluster.shutdown()
        folder.cleanup()
    near = grid.flights(["secant", "kalman"], **options)
    assert far.text == near.text
    for one, other in zip(far.episodes, near.episodes, strict=True):
        assert one.equals(other)


def node(_: int) -> str:
    time.sleep(1)  # so that one node does not do all
    return import_module("ray").get_runtime_context().get_node_id()


def test_confidence_of_the_command_line_decides_declarations(tmp_path: Path, monkeypatch) -> None:
    few = replace(tracks.TRACKS["vehicles-v4"], **NEAR, conditions=["ship"])
    monkeypatch.setitem(tracks.TRACKS, "vehicles-v4", few)
    for confidence, ends in ((0.0, "100.0 ± 0.0 / 0.0 ± 0.0"), (1.0, "0.0 ± 0.0 / 0.0 ± 0.0")):
        grid.make(("confidence",), navigators=("geodesic",), trips=2, confidence=confidence, out=tmp_path / "new")
        head, _, row = rows((tmp_path / "new" / "confidence.md").read_text(encoding="utf-8"))
        assert head == [*flights.ABOUT, "ship"]
        assert row[5] == ends
        assert set(read_episodes(tmp_path / "new" / "confidence.csv.gz")["track"]) == {"confidence"}


def test_columns_say_what_a_navigator_knows(monkeypatch) -> None:
    """Elements of the vehicle's own model tell it nothing of its destination, and do not count as measured."""
    std = (0.1, 0.05, 30.0)
    told, made = {"model": "IGRF-13", "start_km": 5.0}, flights.Flights.of(trips=2, max_steps=2, target_std=std)
    measured, own = {"name": "secant", **told}, {"name": "secant", **told, "target_std": flights.OWN_MODEL}
    exact, mine = measured | {"target_std": [0, 0, 0]}, {"name": "kalman", "model": "IGRF-13"}
    assert [flights.names(spec, made.sheet)[2:] for spec in (measured, own, exact, mine, "kalman", "geodesic")] == [
        ["± 5 km", "IGRF-13", "± 0.1°, 0.05°, 30 nT"],
        ["± 5 km", "IGRF-13", "no"],
        ["± 5 km", "IGRF-13", "exact"],
        ["no", "IGRF-13", "± 0.1°, 0.05°, 30 nT"],
        ["no", "the field's spectrum", "± 0.1°, 0.05°, 30 nT"],
        ["—", "the position", "—"],
    ]
    labels = [flights.names({"name": "kalman", "confidence": value})[0] for value in (0.8, 0)]
    assert labels == ["Kalman (dual control), declares at 0.8", "Kalman (dual control), declares at once"]
    rows = [["a", "", "no", "x", "exact"], ["a", "", "no", "y", "exact"], ["b", "", "no", "y", "exact"]]
    assert flights.titles_of(flights.ABOUT, rows)[1:] == [
        "a (start: no; map: y; elements at the destination: exact)",
        "b",
    ]
    monkeypatch.setattr(flights, "flown", lambda flight, _: flight.rules["target_std"])
    assert [made.fly(spec, LEVELS[0]) for spec in (measured, own, exact)] == [std, None, (0, 0, 0)]


def test_differences_are_of_correct_arrivals_where_cells_are() -> None:
    """Of vehicles that declare with any confidence, all are right or wrong, but those that never came near."""
    options = {**NEAR, "within_km": 25, "conditions": ["ship"], "against": [(0, 1)]}
    measures = ("success_rate", "false_arrival_rate")
    table = rows(grid.flights(["geodesic", "secant"], measures=measures, **options).text)
    assert table[4][0].endswith("secant (quasi-Newton), correct arrivals")
    shares = [[float(share.split(" ± ")[0]) for share in row[5].split(" / ")] for row in table[2:4]]
    assert float(table[4][5].strip("*").split(" ")[0]) == shares[0][0] - shares[1][0]
    assert sum(shares[0]) == 100 > sum(shares[1])
    assert shares[0] != shares[1]


def test_episodes_beside_a_table_give_its_numbers(tmp_path: Path, monkeypatch) -> None:
    few = replace(tracks.TRACKS["north-v1"], **NEAR, levels=[(0, 0, 0), (0.05, 0.05, 5.0)])
    monkeypatch.setitem(tracks.TRACKS, "north-v1", few)
    grid.make(("north-declared",), navigators=("secant", "geodesic"), trips=3, out=tmp_path)
    table = rows((tmp_path / "north-declared.md").read_text(encoding="utf-8"))
    episodes = read_episodes(tmp_path / "north-declared.csv.gz")
    assert set(episodes["track"]) == {"north-v1"}
    assert episodes["trip"].tolist() == 4 * [0, 1, 2]
    ends = episodes.groupby(["navigator", "level"])[["success", "spl"]].mean() * 100
    for name, _, _, _, _, *cells in table[2:4]:
        for level, cell in zip(table[0][5:], cells, strict=True):
            assert cell == "{:.1f} / {:.1f}".format(*ends.loc[(name, level)])
    assert episodes["final_distance_km"].between(0, 25)[episodes["success"]].all()
    assert 0 < episodes["success"].sum() < 12


def test_several_runs_have_the_range_of_their_spl(tmp_path: Path) -> None:
    for seed in (10, 2):
        (tmp_path / f"a-seed{seed}").mkdir()
    assert flights.runs_of(f"A={tmp_path}/a-seed*") == [f"A={tmp_path}/a-seed{seed}" for seed in (2, 10)]
    ends = {"success": torch.tensor([True]), "steps": torch.tensor([10]), "path_efficiency": torch.ones(1)}
    ends |= {"length_km": torch.ones(1), "navigation_error_km": torch.ones(1)}
    ends |= dict.fromkeys(("smoothness_deg", "heading_mae_deg", "heading_rmse_deg"), torch.zeros(1))
    runs = [ends | {"spl": torch.tensor([spl])} for spl in (0.9, 0.8)]
    assert flights.cell(runs, ("success_rate", "spl", "steps")) == "100.0 / 85.0 [80.0–90.0] / 10.0"
    assert flights.cell(runs[:1], ("spl", "steps")) == "90.0 / 10.0"


def test_arrivals_have_intervals_that_are_clustered_by_region() -> None:
    """By hand: in four regions of two trips each, all or none of which succeed, the variance is 1 / 3 / 4."""
    success, region = torch.tensor([1, 1, 0, 0, 1, 1, 0, 0]).bool(), torch.tensor([0, 0, 1, 1, 2, 2, 3, 3])
    assert flights.shown(50.0, success, region) == f"50.0 ± {196 * (1 / 12) ** 0.5:.1f}"


def test_the_interval_of_a_difference_is_clustered_by_region() -> None:
    """Four regions of two equal trips each are four observations, whose mean has a variance of 20 / 3 / 4."""
    first = torch.tensor([1.0, 1.0, 3.0, 3.0, 5.0, 5.0, 7.0, 7.0]) / 100
    region = torch.tensor([0, 0, 1, 1, 2, 2, 3, 3])
    assert flights.paired_difference(first, 0 * first, region) == "**+4.0 (+1.5 to +6.5)**"
    assert flights.paired_difference(first, 0 * first + 0.02, region) == "+2.0 (-0.5 to +4.5)"


def test_reliability_counts_readings_by_their_probability() -> None:
    """By hand: vehicles of one region are 24 km off, the others 26 km; second readings are after the end."""
    near = torch.arange(200) < 120
    target = torch.zeros(200, 2, 2, dtype=torch.float64)
    target[..., 0] = torch.where(near, 24, 26).unsqueeze(-1) / 110.574  # km in a degree of latitude
    probability = torch.tensor([[0.55], [0.15]]).expand(200, 2, 1)
    content = {"arrival_probability": probability, "position": 0 * target, "target_position": target}
    flight = TensorDict(content | {"next": {"done": torch.ones(200, 2, 1, dtype=torch.bool)}}, (200, 2))
    ((stated, share, half),) = flights.reliability(flight, near.long(), 25.0)
    assert stated == pytest.approx(55)
    assert share == pytest.approx(60)
    assert half == pytest.approx(1.96 * 2 * 100 * 200 * 0.6 * 0.4 / 200)  # two equal sums, times (2 / (2 - 1)) ** 0.5


# Figures


def test_each_error_has_a_line_for_each_navigator(monkeypatch) -> None:
    monkeypatch.setattr(figures, "mean_spl", lambda *_: (90.0, 2.0))
    *panels, last = figures.conditions(2)["figures/conditions"].axes
    sizes = [len(error["sizes"]) + 1 for error in grid.declared(figures.FILE)["errors"].values()]
    lines = [[container.lines[0] for container in axes.containers] for axes in panels]
    assert [[len(line.get_xdata()) for line in some] for some in lines] == [[size] * 4 for size in sizes]
    assert lines[0][0].get_ydata()[0] == 90
    assert [text.get_text() for text in last.get_legend().texts][:2] == ["anywhere", "Kalman"]


def test_the_mean_of_a_cell_has_an_interval_clustered_by_region() -> None:
    flown = SimpleNamespace(episodes=lambda *_: [{"spl": torch.tensor([1.0, 0.8, 0.9])}])
    flown.scenario = SimpleNamespace(trips=SimpleNamespace(region=torch.tensor([0, 1, 1])))
    mean, half = figures.mean_spl(flown, "secant", None)
    assert mean == pytest.approx(90)
    assert half == pytest.approx(1.96 * 20 / 3)


def test_the_reliability_diagram_has_a_panel_for_noise_and_one_for_vehicles(monkeypatch) -> None:
    monkeypatch.setattr(flights.Flights, "fly", lambda *_: None)
    monkeypatch.setattr(figures, "reliability", lambda *_: [(10.0, 12.0, 3.0), (90.0, 80.0, 2.0)])
    noise, vehicles = figures.reliability_diagram(2)["figures/reliability"].axes
    assert [len(axes.containers) for axes in (noise, vehicles)] == [3, 4]
    assert vehicles.containers[0].lines[0].get_xydata().tolist() == [[10, 12], [90, 80]]


def test_learning_curves_are_columns_of_the_runs(tmp_path: Path, monkeypatch) -> None:
    """They are of training episodes, at the first row of each 50th."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(figures, "declared", lambda _: {"learning": {"gg_td3": "runs/guided*", "td3": "runs/plain*"}})
    for run, last in (("guided", 90), ("plain-seed0", 80), ("plain-seed1", 60)):
        (tmp_path / "runs" / run).mkdir(parents=True)
        rows = ["episodes,return,eval_return,success_rate", "0,nan,,nan", "50,9,1,40", "50,8,,30", "77,7,,20"]
        rows += [f"100,{last + 100},2,{last}"]
        (tmp_path / "runs" / run / "train.csv").write_text("\n".join(rows), encoding="utf-8")
    data, reward, success = figures.learning().values()
    assert len(data) == 6
    assert data.groupby("navigator")["run"].nunique().to_dict() == {"gg_td3": 1, "td3": 2}
    for figure, first, last in ((reward, 9, [190, 170]), (success, 40, [90, 70])):
        means = [line for line in figure.axes[0].lines if "seed" in line.get_label()]
        assert [line.get_xydata()[0].tolist() for line in means] == [[50, first]] * 2
        assert [line.get_ydata()[-1] for line in means] == last
    figures.draw(("learning",), out=tmp_path)
    with Image.open(tmp_path / "results" / "fig-6-return.png") as picture:
        assert picture.info["Source"] == "python docs/tables/figures.py learning"
        assert picture.info["Description"] == f"learning.csv {flights.digest(tmp_path / 'results' / 'learning.csv')}"


def test_evaluations_are_tables_and_figures_of_section_4(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("evaluate.trajectories_figure", lambda *_, **__: Figure())
    navigators = ["secant", "parallel"]
    table = grid.evaluation(navigators, folder=Path("runs/paper-run"), trips=3)
    assert [list(episodes) for episodes in table.episodes] == [list(COLUMNS)]
    assert len(table.episodes[0]) == 6
    assert [row[0] for row in rows(table.text)[2:4]] == ["secant (quasi-Newton)", "parallel (true gradient, an oracle)"]
    made = figures.section_4()
    assert [label.get_text() for label in made["results/fig-10-boxes"].axes[0].get_xticklabels()] == navigators
