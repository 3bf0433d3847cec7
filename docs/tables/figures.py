"""Draw the figures of the documentation.

    python docs/tables/figures.py section-4 learning    # from table paper-run and its trainings
    python docs/tables/figures.py conditions --out runs # from new flights; five minutes

From new flights: place-error (dead reckoning against the belief of the place), conditions (the cost of each error
alone), reliability (of stated probabilities). From runs: section-4 (Fig. 5, field contours; Fig. 8,
trajectories; Fig. 9, convergence; Fig. 10, box plots), and learning (Fig. 6, return; Fig. 7, success rate; their data).
"""

from __future__ import annotations

import csv
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from magrl.envs import PAPER_REGION, Region, Scenario, named_trips
from magrl.envs.rendering import draw_tracks
from magrl.errors import Conditions, load_conditions
from magrl.evaluation import Flight, evaluation_rollout
from magrl.evaluation.maps import coastlines
from magrl.field import IGRF, elements_gradient_at
from magrl.files import check_writable, read_text, write_text, write_with
from magrl.navigators.names import KINDS
from magrl.training import UsageError, command

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from pandas import DataFrame, concat, read_csv
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parent))
import plots
from flights import Flights, clustered, matching, place_errors, reliability, write_picture
from grid import RUNS, declared

RECIPE = "figures.py"
FILE = Path(__file__).parent / "figures.toml"
Figures = Mapping[str, Figure | DataFrame]
"""Figures by file, from the folder of the documentation, after the data that they are drawn from."""
CURVES = {
    "results/fig-6-return": ("return", "return, mean of the last 200 episodes"),
    "results/fig-7-success": ("success_rate", "success rate of the last 200 episodes [%]"),
}
"""Column and label of learning curves."""
DATA = dict.fromkeys(CURVES, "results/learning.csv")
DATA |= dict.fromkeys(("figures/fig-8-trajectories", "results/fig-9-convergence"), "results/comparison.md")
DATA |= {"results/fig-10-boxes": "results/comparison.md", "figures/conditions": "results/conditions.csv"}
DATA |= {f"figures/{name}": f"results/{name}.csv" for name in ("reliability", "place-error")}
"""Data of figures: the table is of the same evaluation."""
MARKERS = {"anywhere": "o", "kalman": "s", "secant": "v", "parallel": "x"}
"""Navigators in panels, and their markers."""


# From runs


def columns_by_navigator(path: Path) -> dict[str, dict[str, list[float]]]:
    """Return the columns of a file of recipes/evaluate.py for each navigator, without failures."""
    columns: dict[str, dict[str, list[float]]] = {}
    for row in csv.DictReader(read_text(path).splitlines()):
        name = row.pop("navigator")
        if row.pop("success", "True") == "True":
            for key, value in row.items():
                columns.setdefault(name, {}).setdefault(key, []).append(float(value or "nan"))
    return columns


def section_4() -> Figures:
    """Return the field over the region, the example trip of each navigator, and box plots."""
    contours = Figure(figsize=(7, 7.4), layout="constrained")
    field, trip = Scenario().build_field(), named_trips("paper-example")
    draw_tracks(contours.subplots(), field, PAPER_REGION, [trip.start], trip.target)
    paths, episodes = (columns_by_navigator(RUNS / "paper-run" / f"{name}.csv") for name in ("paths", "episodes"))
    tracks = {name: (columns["latitude"], columns["longitude"]) for name, columns in paths.items()}
    return {
        "figures/fig-5-contours": contours,
        "figures/fig-8-trajectories": plots.compared_trajectories(tracks, field, trip),
        "results/fig-9-convergence": plots.convergence(paths, field, trip),
        "results/fig-10-boxes": plots.box_plots(episodes),
    }


def learning() -> Figures:
    """Return the learning curves of the runs in figures.toml, as the paper draws them, and their data.

    They are of training episodes, with exploration; the return of a guided agent has the alignment term.
    """
    runs = [
        read_csv(Path(run) / "train.csv").assign(navigator=name, run=number)
        for name, pattern in declared(FILE)["learning"].items()
        for number, run in enumerate(matching(pattern))
    ]
    data = concat(runs)[["navigator", "run", "episodes", "return", "success_rate"]].dropna().round(2)
    data = data[data["episodes"] % 50 == 0].drop_duplicates(["navigator", "run", "episodes"])
    return {"results/learning": data} | {file: plots.learning_curves(data, *shown) for file, shown in CURVES.items()}


# From new flights


def look(navigator: str) -> dict[str, Any]:
    """Return color, marker and label of a navigator in panels."""
    label = KINDS[navigator].description.partition(" (")[0] + ", an oracle" * getattr(KINDS[navigator], "oracle", False)
    color = plots.NAVIGATOR_COLORS[navigator]
    return {"color": color, "marker": MARKERS[navigator], "label": label, "ms": 4, "lw": 1.3, "capsize": 2}


def one_error(lines: str, size: object = "") -> Conditions:
    """Return a size of an error in figures.toml, beside noise of the sensors of a ship."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "error.toml"
        write_text(path, f"speed_km_h = 24.0\nsensors.noise = [0.05, 0.05, 5.0]\n{lines.replace('SIZE', str(size))}")
        return load_conditions(path)


def conditions(trips: int = 300) -> Figures:
    """Return a panel for each error, SPL over its size for each navigator, and their data.

    Everything else is as at the noise alone, which is the first point of each panel.
    """
    flights, rows = Flights(["ship"], trips=trips), []  # its environment lets errors move vehicles
    for navigator in tqdm(MARKERS, unit="navigator"):
        alone = mean_spl(flights, navigator, one_error(""))
        for title, error in declared(FILE)["errors"].items():
            rows.append((title, "0", navigator, *alone))
            for size in error["sizes"]:
                spl = mean_spl(flights, navigator, one_error(error["lines"], size))
                rows.append((title, f"{size}".removesuffix(".0"), navigator, *spl))
    data = DataFrame(rows, columns=["error", "size", "navigator", "spl", "half_interval"]).round(2)
    return {"results/conditions": data, "figures/conditions": error_panels(data)}


def mean_spl(flights: Flights, navigator: str, errors: Conditions) -> tuple[float, float]:
    """Return the mean SPL [%] and the half-width of its 95 % interval, clustered by region."""
    (episodes,) = flights.episodes(navigator, errors)
    return clustered(100 * episodes["spl"].double(), flights.scenario.trips.region)


def error_panels(data: DataFrame) -> Figure:
    """Return the panels of :func:`conditions`."""
    figure = Figure(figsize=(9, 10), layout="constrained")
    *panels, last = figure.subplots(4, 3, sharey=True).flat
    for axes, (title, rows) in zip(panels, data.groupby("error", sort=False), strict=True):
        for navigator, points in rows.groupby("navigator", sort=False):
            axes.errorbar(points["size"], points["spl"], points["half_interval"], **look(navigator))
        axes.tick_params("x", labelsize=8)
        axes.set_xlabel(title)
        axes.grid(alpha=0.3)
    figure.supylabel("SPL [%]")
    last.axis("off")
    last.legend(*panels[0].get_legend_handles_labels(), loc="center")
    return figure


def reliability_diagram(trips: int = 2000) -> Figures:
    """Return the share of readings at which `anywhere` is within 25 km, over the probability that it states.

    One panel is for white noise, one for the errors of vehicles; bars are intervals of 95 %, clustered by region.
    """
    rows = []
    for names in ((), ("aircraft", "ship", "underwater", "low-cost")):
        flights = Flights(names, trips=trips, regions=min(trips, 512), max_steps=80, within_km=25.0)
        for name, errors in flights.errors.items():
            bins = reliability(flights.fly("anywhere", errors), flights.scenario.trips.region, 25.0)
            rows += [(name, *one) for one in bins]
    data = DataFrame(rows, columns=["errors", "stated", "observed", "half_interval"]).round(1)
    return {"results/reliability": data, "figures/reliability": reliability_panels(data)}


def reliability_panels(data: DataFrame) -> Figure:
    """Return the panels of :func:`reliability_diagram`."""
    figure, noise = Figure(figsize=(9, 4.6), layout="constrained"), data["errors"].str.contains(",")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, rows, title in zip(panels, (data[noise], data[~noise]), ("noise [°, °, nT]", "vehicle"), strict=True):
        axes.axline((0, 0), (100, 100), color="#808080", lw=1, ls="--")
        for (name, bins), like in zip(rows.groupby("errors", sort=False), MARKERS, strict=False):
            axes.errorbar(bins["stated"], bins["observed"], bins["half_interval"], **look(like) | {"label": name})
        axes.set_xlabel("stated probability [%]")
        axes.legend(title=title)
    panels[0].set_ylabel("share of readings within 25 km [%]")
    return figure


def place_error(trips: int = 64) -> Figures:
    """Return the median error of the place over 3000 km: of dead reckoning, and of a belief with IGRF-13 beside it.

    Bands hold the middle half of the flights. Vehicles follow their dead reckoning; the start is known to 5 km.
    """
    figure, rows = Figure(figsize=(9, 3.2), layout="constrained"), list[DataFrame]()
    told = {"model": "IGRF-13", "start_km": 5.0}
    box = {"region": Region((-40, 60), (-50, 50)), "margin_deg": 10, "distance_range_km": (2950.0, 3050.0)}
    sea = Scenario(**box, field=IGRF("2025-01-01"), date="2025-01-01", start_heading="random", max_steps=80)
    sea = sea.with_trips(sea.random_trips(trips, 5))
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    for axes, name in zip(panels, ("ship", "underwater", "low-cost"), strict=True):
        flight = Flight(sea, errors=name, arrival="declared", **told)
        reckoning = flight.navigator("dead_reckoning")
        flown = evaluation_rollout(flight.env_of(reckoning, track=True), reckoning)["next"]
        for (given, error), color in zip(place_errors(flown).items(), ("#000000", "#0072B2"), strict=True):
            low, middle, high = error.nanquantile(torch.tensor([0.25, 0.5, 0.75]).double(), 0)
            path = flown["leg"][..., 0].cumsum(1).nanmean(0)
            axes.plot(path, middle, color=color, label=given)
            axes.fill_between(path, low, high, color=color, alpha=0.2, lw=0)
            quartiles = {"distance_km": path, "lower_quartile_km": low, "median_km": middle, "upper_quartile_km": high}
            rows.append(DataFrame(quartiles).assign(vehicle=name, by=given))
        axes.set(title=name, xlabel="distance flown [km]", xlim=(0, 2900))
        axes.grid(alpha=0.3)
    figure.axes[0].set(ylabel="error of the place [km]", ylim=(0, None))
    figure.axes[0].legend()
    return {"results/place-error": concat(rows).round(2), "figures/place-error": figure}


def two_elements() -> Figures:
    """Return the map of the angle between the gradients of I and B_H: where it is small, two elements give a line and
    not a place."""
    figure = Figure(figsize=(9, 4.6), layout="constrained")
    axes = figure.add_subplot(projection="mollweide")
    latitude, longitude = torch.arange(-89.5, 90.0).double(), torch.arange(-180.0, 181.0).double()
    places = torch.stack(torch.meshgrid(latitude, longitude, indexing="ij"), -1)
    north, east = elements_gradient_at(IGRF("2025-01-01"), places)[..., 1:, :].unbind(-1)
    bearing = torch.rad2deg(torch.atan2(east, north))
    angle = 90 - (bearing.diff(dim=-1).squeeze(-1).remainder(180) - 90).abs()
    where = np.radians(longitude.numpy()), np.radians(latitude.numpy())
    filled = axes.contourf(*where, angle, [0, 5, 10, 20, 45, 90], cmap="viridis")
    axes.plot(*np.radians(coastlines()).T[::-1], color="white", lw=0.6)
    weight = torch.cos(torch.deg2rad(latitude)) * (latitude.abs() < 60)
    share = (weight @ (angle < 5).double().mean(-1)) / weight.sum()
    axes.set(xticklabels=[], yticklabels=[], title=f"below 5° at {100 * share:.0f} % of places between 60° S and 60° N")
    figure.colorbar(filled, shrink=0.7, pad=0.02, label="angle between the gradients of I and $B_H$ [°]")
    return {"figures/two-elements": figure}


FIGURES: Mapping[str, Callable[..., Figures]] = {
    "place-error": place_error,
    "section-4": section_4,
    "learning": learning,
    "conditions": conditions,
    "two-elements": two_elements,
    "reliability": reliability_diagram,
}


def draw(figures: tyro.conf.Positional[tuple[str, ...]], trips: int | None = None, out: Path = Path("docs")) -> None:
    """Draw figures.

    Args:
        figures: Names of figures.
        trips: Number of trips of new flights; by default 64 to 2000, by figure.
        out: Folder of the folders figures and results; files of the same name are replaced.

    Raises:
        UsageError: for an unknown figure, or a missing file.
    """
    if unknown := [name for name in figures if name not in FIGURES] or not figures:
        raise UsageError(f"unknown figure {unknown}: choose from {', '.join(FIGURES)}")
    options = {"trips": trips} if trips else {}
    try:
        for name in figures:
            source = f"python docs/tables/figures.py {name}" + (f" --trips {trips}" if trips else "")
            for file, made in FIGURES[name](**options).items():
                if isinstance(made, DataFrame):
                    check_writable(out / f"{file}.csv")
                    write_with(out / f"{file}.csv", made.to_csv, index=False)
                else:
                    write_picture(out / f"{file}.png", made, source, out / DATA[file] if file in DATA else None)
                print(out / file)
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error


if __name__ == "__main__":
    command(RECIPE, lambda: tyro.cli(draw, prog=RECIPE, description=__doc__))
