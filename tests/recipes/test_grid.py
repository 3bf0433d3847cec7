"""Tables from the declarative file, and the figures: flights by hand, cells by hand, and files that are named."""

import functools
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from support.recipes import RECIPES
from tensordict import TensorDict

from magrl.envs import GeomagneticNavEnv, Scenario, Tasks
from magrl.field import IGRF
from magrl.field.model import elements_gradient_at
from magrl.tracking import decision
from magrl.training import UsageError
from magrl.transforms import CONDITIONS

sys.path.insert(0, str(RECIPES / "tables"))
import declarations
import figures
import flights
import globe
import grid
import publish
import trainings


def rows(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


# The file


def test_every_table_declares_options_of_its_kind() -> None:
    known = grid.declared_tables()
    assert {"earth", "conditions", "globe", "readme", "learning", "alone", "paper-run"} <= known.keys()
    for name, options in known.items():
        grid.inspect.signature(grid.KINDS[options.pop("kind")]).bind(**options)
        assert not set(options.get("of", ())) - known.keys(), name


@pytest.mark.parametrize(
    ("tables", "changes", "message"),
    [
        (("mars",), {}, "declares no table mars: choose from"),
        (("earth",), {"navigators": ("dowsing",), "tasks": 2}, "earth: unknown navigator 'dowsing'"),
        (("learning",), {"tasks": 3}, "learning: got an unexpected keyword argument 'tasks'"),
        (("learning",), {}, "there is no runs/.*: train it by make tables"),
    ],
)
def test_bad_usage(tables, changes: dict, message: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=message):
        grid.make(grid.Config(tables, **changes))
    with pytest.raises(UsageError, match="unknown figure"):
        figures.draw(figures.Config(("mars",)))
    with pytest.raises(UsageError, match="No such file"):
        figures.draw(figures.Config(("noise",)))


def test_documents_are_filled_or_none_is(tmp_path: Path) -> None:
    page, other = tmp_path / "page.md", tmp_path / "other.md"
    (tmp_path / "a.md").write_text("| 1 |\n")
    page.write_text("x\n<!-- table: a.md -->\nold\n<!-- end -->\ny")
    other.write_text("<!-- table: b.md -->\n<!-- end -->")
    with pytest.raises(UsageError, match=r"there is no table .*b\.md"):
        publish.publish(publish.Config((page, other), tmp_path))
    assert "old" in page.read_text()
    publish.publish(publish.Config((page,), tmp_path))
    assert page.read_text() == "x\n<!-- table: a.md -->\n\n| 1 |\n\n<!-- end -->\ny"


# Flights


@pytest.fixture(autouse=True)
def few_regions_and_levels(monkeypatch) -> None:
    monkeypatch.setattr(flights, "LEVELS", flights.LEVELS[::4])
    for module in (grid, declarations):
        monkeypatch.setattr(module, "earth_env", functools.partial(flights.earth_env, regions=4))


def test_earth_has_a_row_for_each_date_and_navigator(tmp_path: Path) -> None:
    dates = ["1900-01-01", "2025-01-01"]
    found = rows(grid.earth(["geodesic", {"name": "map_matching", "map_date": "2015-01-01"}], tasks=2, dates=dates))
    assert found[0] == ["date", "navigator", "needs", "runs", "0, 0, 0", "0.5, 0.1, 20"]
    assert [row[0] for row in found[2:]] == [dates[0]] * 2 + [dates[1]] * 2
    assert found[2][4].startswith("100.0 / 100.0 / ")
    assert found[3][1] == "map matching (Kalman filter), map of 2015-01-01"
    assert rows(grid.earth(["geodesic"], tasks=2, max_steps=1))[2][3] == "0.0 / 0.0 / —"
    far = rows(grid.earth(["geodesic"], tasks=2, distance_km=(1200, 1300), max_steps=60))
    assert far[2][3].count("/") == 3, "beyond 500 km, kilometers come first"
    grid.make(grid.Config(("conditions",), navigators=("geodesic",), tasks=2, out=tmp_path / "new"))
    head, _, row = rows((tmp_path / "new" / "conditions.md").read_text())
    assert head == ["navigator", "needs", "laboratory", "aircraft", "ship", "underwater", "low-cost"]
    assert row[2].startswith("100.0 / 100.0 / ")


def test_boxes_follow_the_seed() -> None:
    first, second = (scenario.region for scenario in grid.random_boxes(2, seed=1))
    assert grid.place(Scenario(region=first, objective_floors=None)) == "51°S to 41°S, 99°W to 89°W"
    assert grid.random_boxes(2, seed=1)[1].region == second


def test_boxes_have_mean_and_lowest_rows() -> None:
    found = rows(grid.boxes(["geodesic", {"name": "secant", "elements": ["D", "I"]}], boxes=2, tasks=4))
    assert found[0] == ["box", "geodesic, SR / SPL", "secant, D and I, SR / SPL"]
    assert [row[0] for row in found[4:]] == ["**mean**", "**lowest**", "10°S to 0°, 175°E to 185°E"]
    values = np.array([[float(x) for x in row[2].split("/")] for row in found[2:6]])
    assert values[2] == pytest.approx(values[:2].mean(0), abs=0.051)
    assert values[3] == pytest.approx(values[:2].min(0))


def test_vehicles_that_declare_have_a_row_for_each_confidence() -> None:
    options = {"conditions": ["ship"], "tasks": 4, "within_km": 25, "max_steps": 20}
    options |= {"arrivals": ["distance", 1.0, 0.0], "differences": [("secant", "secant")]}
    told, sure, bold, bound, difference = rows(grid.earth(["secant"], **options))[2:]
    assert difference[1:] == ["—", "declared", "+0.0 (+0.0 to +0.0)"]  # each column has a cell
    assert [told[2], sure[2], bold[2]] == ["told", "declared at 1", "declared"]
    assert sure[3].split(" / ")[:3] == ["0.0", "0.0", "0.0"]
    right, _, false, _, _ = map(float, bold[3].split(" / "))
    assert right + false == 100
    assert float(told[3].split(" / ")[2]) == 0
    assert 50 < float(bound[3]) < 100


def test_the_interval_of_a_difference_is_clustered_by_region() -> None:
    """Four regions of two equal tasks each are four observations, whose mean has a variance of 20 / 3 / 4."""
    first = torch.tensor([1.0, 1.0, 3.0, 3.0, 5.0, 5.0, 7.0, 7.0]) / 100
    region = torch.tensor([0, 0, 1, 1, 2, 2, 3, 3])
    assert flights.paired_difference(first, 0 * first, region) == "**+4.0 (+1.5 to +6.5)**"
    assert flights.paired_difference(first, 0 * first + 0.02, region) == "+2.0 (-0.5 to +4.5)"
    table = rows(grid.earth(["secant", "geodesic"], tasks=8, differences=[("secant", "geodesic")]))
    assert table[-1][0] == "secant (quasi-Newton) − geodesic (both positions, an oracle), SPL"
    assert table[-1][3].startswith(("**-", "-"))


def test_the_bound_is_that_of_readings_at_the_destination() -> None:
    base = flights.earth_env(40, regions=4, reach_km=flights.DRIFT_KM, drift_km=flights.DRIFT_KM)
    exact, noisy, more = (flights.estimate_within(25.0, base, (std, std, 100 * std)) for std in (0.0, 0.3, 0.6))
    assert exact == pytest.approx(100)
    assert exact > noisy > more
    jacobian = elements_gradient_at(base.field, base.scenario.tasks.target, base.scenario.tasks.region)
    readings = 0.3 / 8**0.5 * torch.randn(4000, 40, 3, dtype=torch.float64) * torch.tensor([1.0, 1.0, 100.0])
    scale = torch.tensor([1.0, 1.0, 0.01])
    places = torch.linalg.lstsq((scale[:, None] * jacobian).expand(4000, 40, 3, 2), (scale * readings)[..., None])[0]
    assert noisy == pytest.approx(100 * (places.squeeze(-1).norm(dim=-1) < 25).double().mean().item(), abs=1)
    ship = CONDITIONS["ship"]
    assert flights.estimate_within(25.0, base, ship, (0.0, 0.0, 0.0)) > flights.estimate_within(25.0, base, ship)


def test_reliability_counts_readings_by_their_probability(monkeypatch) -> None:
    """By hand: vehicles of one region are 24 km off, the others 26 km; second readings are after the end."""
    options = {"conditions": ["ship"], "tasks": 200, "regions": 2}
    found: list[float] = []

    def flight(_: object, base: GeomagneticNavEnv, __: object) -> TensorDict:
        near = base.scenario.tasks.region == 0
        count, share = len(near), near.double().mean().item()
        found[:] = 100 * share, 196 * 2**0.5 * share * (1 - share)  # both regions deviate by as much, in sum
        target = torch.zeros(count, 2, 2, dtype=torch.float64)
        target[..., 0] = torch.where(near, 24, 26).unsqueeze(-1) / 110.574  # km in a degree of latitude
        probability = torch.tensor([[0.55], [0.15]]).expand(count, 2, 1)
        content = {"arrival_probability": probability, "position": 0 * target, "target_position": target}
        return TensorDict(content | {"next": {"done": torch.ones(count, 2, 1, dtype=torch.bool)}}, (count, 2))

    with monkeypatch.context() as patch:
        patch.setattr(declarations, "rollout", flight)
        cells = rows(declarations.reliability(["secant"], **options))[-1][2:]
    share, half = found
    assert cells == [*["—"] * 5, f"{share:.0f} ± {half:.0f}", *["—"] * 4]
    table = rows(declarations.reliability(["secant"], conditions=["ship"], tasks=30, max_steps=12))[2:]
    assert [row[1] for row in table][-1] == "ship"
    assert len(table) == len(flights.LEVELS) + 1
    assert all(float(row[2].split(" ± ")[0]) < 20 for row in table)


def test_the_rule_of_declared_arrivals_is_changed_for_its_row_alone(monkeypatch) -> None:
    """Vehicles to which a kilometer costs much declare at once: fewer of them are right, after fewer steps."""
    monkeypatch.setattr(flights, "LEVELS", [(0.05, 0.05, 5.0)])
    rules = [{"TRIP_KM": 1}, {"TRIP_KM": decision.TRIP_KM}]
    table = rows(declarations.decisions(["kalman"], rules=rules, conditions=[], tasks=10, max_steps=20))[2:]
    assert [row[0] for row in table] == ["Kalman (dual control), TRIP_KM 1", "Kalman (dual control), TRIP_KM 800.0"]
    hasty, usual = ([float(number) for number in row[1].split(" / ")] for row in table)
    assert hasty[0] < usual[0]
    assert hasty[2] < usual[2]
    assert decision.TRIP_KM == 800


# The globe


class Slopes:
    """A field of 30 000 nT to the north, in which D and I change by some floors of the objective over 25 km."""

    def __init__(self, declination: tuple[float, float], inclination: tuple[float, float]) -> None:
        self.gradient = torch.zeros(3, 2, dtype=torch.float64)
        for row, floor, slope in ((1, 0.05, declination), (2, 0.4, inclination)):
            self.gradient[row] = 30_000 * torch.tensor(slope).double() * math.radians(floor) / 25

    def value_and_gradient(self, latitude: torch.Tensor, longitude: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        shape = torch.broadcast_shapes(latitude.shape, longitude.shape)
        return torch.tensor([30_000.0, 0, 0]).double().expand(*shape, 3), self.gradient.expand(*shape, 3, 2)


def test_weakest_change_is_in_floors_of_the_objective() -> None:
    here = torch.zeros(1, 2, dtype=torch.float64)
    assert globe.weakest_change(Slopes((2, 0), (0, 3)), here).item() == pytest.approx(2)
    assert globe.weakest_change(Slopes((3, 3), (1, -1)), here).item() == pytest.approx(math.sqrt(2))
    assert globe.weakest_change(Slopes((2, 4), (1, 2)), here).item() == pytest.approx(0, abs=1e-9)


def test_vehicles_cross_the_pole_and_are_not_lost() -> None:
    start, target = torch.tensor([[89.9, 20.0]]).double(), torch.tensor([[86.0, -160.0]]).double()
    scenario = Scenario(region=globe.EARTH, margin_deg=0, field=IGRF("2025-01-01"), tasks=Tasks(start, target))
    env = globe.GlobeEnv(scenario, num_envs=1, seed=0)
    after = env.step(env.reset().set("action", torch.tensor([[50.0, 0.0]])))["next"]
    assert after["position"][0].tolist() == pytest.approx([89.652, -160.0], abs=1e-3)  # a degree is 111.7 km there
    assert not after["terminated"].item()
    assert env.observation_spec.is_in(env.reset())


def test_table_has_every_task_once_in_each_group(monkeypatch) -> None:
    success = torch.tensor([True, False, True, True])
    measures = {"success": success, "spl": torch.tensor([1.0, 0.0, 0.9, 0.7]), "steps": torch.tensor([8, 50, 10, 12])}
    known = {
        "latitude": torch.tensor([0.0, 90.0, 30.0, 74.0]),
        "intensity_nt": torch.tensor([30e3, 0.0, 8e3, 7e3]),
        "weakest": torch.tensor([2.0, 0.01, 0.5, 0.05]),
    }
    found = rows(globe.table({"perfect sensors": measures}, known))[2:]
    assert found[0] == ["all", "4", "75.0 / 65.0 / 10.0"]
    assert found[1] == ["latitude of the start up to 30°", "1", "100.0 / 100.0 / 8.0"]
    for group, size in (("latitude", 4), ("smallest", 3), ("weakest", 3)):
        band = [row for row in found[1:] if row[0].startswith(group)]
        assert (len(band), sum(int(row[1]) for row in band)) == (size, 4), band
    assert found[-3] == ["weakest change on the way below 0.05", "1", "0.0 / 0.0 / —"]
    monkeypatch.setattr(globe, "CHUNK", 3)  # flown in parts
    assert "| all | 4 | 100.0 / 100.0 /" in globe.globe("geodesic", tasks=4)


def test_map_shows_the_dip_poles_and_the_failures() -> None:
    tasks = Tasks(torch.tensor([[10.0, 20.0], [50.0, -60.0]]), torch.tensor([[10.0, 24.0], [50.0, -64.0]]))
    measures = {"success": torch.tensor([True, False]), "spl": torch.tensor([0.9, 0.0])}
    axes = figures.globe_map(IGRF("2025-01-01"), tasks, measures).axes[0]
    lines = {line.get_label(): np.degrees(np.stack(line.get_data(), -1)) for line in axes.lines}
    (south_east, south), (north_east, north) = lines["dip pole"]  # NOAA, 2025: 63.85 S 135.08 E, 85.76 N 139.30 E
    assert (south, south_east) == pytest.approx((-63.85, 135.08), abs=1)
    assert (north, north_east) == pytest.approx((85.76, 139.3), abs=6)
    assert lines["not arrived"] == pytest.approx(np.array([[-60.0, 50.0]]))
    assert axes.collections[-1].get_array() == pytest.approx(np.array([90.0]))


def test_each_error_has_a_line_for_each_navigator(monkeypatch) -> None:
    monkeypatch.setattr(figures, "flown", lambda navigator, *_: navigator)
    monkeypatch.setattr(figures, "summarize", lambda navigator: {"spl": float(len(navigator))})
    *panels, last = figures.conditions(2)["conditions"].axes
    assert [[len(line.get_xdata()) for line in axes.lines] for axes in panels] == [[5] * 5] * len(figures.PANELS)
    assert [text.get_text() for text in last.get_legend().texts][:2] == ["anywhere", "Kalman"]


# Trainings


@pytest.fixture
def runs(tmp_path: Path) -> str:
    """Return the pattern of two runs, the second of which learns twice as fast."""
    for seed in range(2):
        folder = tmp_path / f"a-seed{seed}"
        folder.mkdir()
        result = {"seed": seed, "success_rate": 99.0 + seed, "spl": 90.0 + seed, "steps": 9.5, "training_seconds": None}
        (folder / "eval.json").write_text(json.dumps(result))
        head = "frames,episodes,seconds,return,success_rate,eval_success_rate,eval_spl,eval_steps\n"
        half = f"{100 if seed else 200},10,1,0,50,90,80,12\n"
        (folder / "train.csv").write_text(f"{head}{half}400,20,2,5,99,98,95,10\n")
    return str(tmp_path / "a-seed*")


def test_results_of_runs(runs: str) -> None:
    head, _, published, group, together = rows(trainings.results({"mine": runs}, together=True))
    assert head[:5] == ["", "runs", "SR %", "SPL %", "SPL, smallest–largest %"]
    assert published[:4] == ["paper", "1", "97.0", "88.41"]
    assert group[:5] == ["mine", "2", "99.5 [99.0–100.0]", "90.50 [90.00–91.00]", "90.00–91.00"]
    assert group[-2:] == ["—", "—"]
    assert together[1:] == group[1:]


def test_learning_of_runs(runs: str) -> None:
    (row,) = rows(trainings.learning({"mine": runs}))[2:]
    assert row[:4] == ["mine", "2", "150 [100–200]", "400 [400–400]"]
    # areas: (200 * 45 + 200 * 94) / 400 = 69.5 and (100 * 45 + 300 * 94) / 400 = 81.75
    assert row[4:] == ["75.6 [69.5–81.8]", "95.00 [95.00–95.00]"]


def test_evaluations_and_the_rows_of_other_tables(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("evaluate.trajectories_figure", lambda *_, **__: Figure())
    options = {"navigators": ["secant", "geodesic"], "tasks": 3}
    text = trainings.evaluation(folder="runs/a", wandb_mode="disabled", **options)
    assert [row[0] for row in rows(text)[2:4]] == ["secant (quasi-Newton)", "geodesic (both positions, an oracle)"]
    assert trainings.short("runs/a").startswith("| navigator | needs | SR % |")
    head, _, secant, geodesic = rows(
        trainings.noise_levels(levels=[(0, 0, 0), (0.1, 0.1, 10)], folder="runs/n", **options)
    )
    assert head == ["navigator", "needs", "runs", "no noise", "0.1°, 0.1°, 10 nT"]
    assert geodesic[3:] == ["100.0 / 100.0"] * 2
    assert secant[3].startswith("100.0 / 9")
    monkeypatch.setattr(grid, "RESULTS", tmp_path)
    (tmp_path / "earth.md").write_text(text)
    assert rows(grid.rows_of(["earth"], ["geodesic"]))[2] == rows(text)[3]
