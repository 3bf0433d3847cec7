"""Every figure of docs/performance.md, measured side by side: `python -m benchmarks`, about nine minutes on two cores.

Prints each row as it is measured. `--only PART` measures one part. A part that would start after the time limit is
skipped, and named. Results are written to runs/benchmarks.json, and for the documents where --publish is given.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # read when torch is imported: see recipes/td3_gradient_guided.py

import argparse
import importlib
import math
import platform
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch

from benchmarks.timing import HEADER, Row
from magrl.files import write_json

DOCS = Path(__file__).parent.parent / "docs"
COMPARISONS = {
    "fields": ("fields", "rows"),
    "env": ("env", "rows"),
    "imports": ("imports", "rows"),
    "onboard": ("onboard", "rows"),
    "update": ("update", "rows"),
    "training": ("training", "whole_training"),
    "first-attempt": ("training", "first_attempt"),
}
"""Parts that give rows of the table: module and function."""
OTHERS = ("speed", "time-to-paper", "profile", "memory")
"""Parts that give other figures."""


def measure(part: str) -> Any:
    """Return the rows of a comparison; its module is imported now, so that one part does not load the others'."""
    module, function = COMPARISONS[part]
    found = getattr(importlib.import_module(f"benchmarks.{module}"), function)()
    return [found] if isinstance(found, Row) else found


def table(rows: Iterable[Row]) -> str:
    """Return the Markdown table of some rows."""
    return HEADER + "".join(f"{row}\n" for row in rows)


def seconds_table(seconds: list[float]) -> str:
    """Return a table of the times of single runs and their median."""
    known = [value for value in seconds if math.isfinite(value)]
    cells = [f"{value:.1f}" for value in seconds] + [f"**{statistics.median(known):.1f}**" if known else "—"]
    heads = [f"seed {seed}" for seed in range(len(seconds))] + ["median"]
    return f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|\n| {' | '.join(cells)} |\n"


def cost_figure(costs: list[dict[str, float]]) -> plt.Figure:
    """Return a figure of the cost of a vehicle-step over the number of vehicles."""
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    numbers = [row["vehicles"] for row in costs]
    for key, name, color in (("raw_us", "raw step", "#0072B2"), ("guided_us", "guided, in a collector", "#D55E00")):
        axes.loglog(numbers, [row[key] for row in costs], "o-", label=name, color=color)
    axes.set_xticks(numbers, [str(number) for number in numbers])
    axes.minorticks_off()
    axes.set(xlabel="vehicles", ylabel="time per vehicle-step [µs]")
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)
    return figure


class Report:
    """What was measured so far.

    Args:
        limit_s: time after which no further part is started [s].
    """

    def __init__(self, limit_s: float) -> None:
        self.limit_s, self.began = limit_s, time.perf_counter()
        self.rows: list[Row] = []
        self.content: dict[str, Any] = {}
        self.skipped: list[str] = []

    def take(self, part: str) -> None:
        """Measure a part and print it, or skip it if the time is over."""
        if time.perf_counter() - self.began > self.limit_s:
            self.skipped.append(part)
            print(f"skipped, the time limit of {self.limit_s:.0f} s is over: --only {part}", flush=True)
        elif part in COMPARISONS:
            if not self.rows:
                print(HEADER, end="", flush=True)
            for row in measure(part):
                self.rows.append(row)
                print(row, flush=True)
        else:
            getattr(self, f"_{part.replace('-', '_')}")()

    def _speed(self) -> None:
        env = importlib.import_module("benchmarks.env")
        self.content |= {"steps_per_second": env.steps_per_second(), "cost_by_number": env.cost_by_number()}
        print(f"\nRaw step of {env.VEHICLES} vehicles: {self.content['steps_per_second'] / 1e6:.2f} million steps/s")

    def _time_to_paper(self) -> None:
        seconds = importlib.import_module("benchmarks.training").to_the_papers_figures()
        self.content["seconds_to_the_papers_figures"] = seconds
        print(f"\nFrom process start to SR 97 %, SPL 88.4 % [s]:\n\n{seconds_table(seconds)}", flush=True)

    def _profile(self) -> None:
        profile = importlib.import_module("benchmarks.profile_training")
        self.content["profile"] = profile.table(profile.shares())
        print(f"\n{self.content['profile']}", flush=True)

    def _memory(self) -> None:
        self.content["peak_gib"] = importlib.import_module("benchmarks.fields").peak_memory()
        print(f"\nPeak memory, value and gradient at 10 million points [GiB]: {self.content['peak_gib']}", flush=True)

    def summary(self) -> str:
        """Return where and in how much time this was measured."""
        machine = (
            f"{platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__.partition('+')[0]}"
        )
        return f"Measured in {time.perf_counter() - self.began:.0f} s on {machine}.\n"

    def write(self, path: Path) -> None:
        """Write all figures as JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {"rows": [asdict(row) for row in self.rows], **self.content, "machine": self.summary()})

    def publish(self) -> None:
        """Write the tables and the figure of the documents; every part must have been measured."""
        missing = {"steps_per_second", "seconds_to_the_papers_figures", "profile", "peak_gib"} - self.content.keys()
        if missing or self.skipped:
            raise SystemExit(f"nothing is published: {sorted(missing) or self.skipped} was not measured")
        millions, peak = self.content["steps_per_second"] / 1e6, self.content["peak_gib"]
        speed = f"Raw step of 1024 vehicles: {millions:.2f} million vehicle-steps per second.\n\n"
        speed += f"Peak memory, value and gradient at 10 million points: {peak['igrf']:.2f} GiB with IGRF, "
        speed += f"{peak['regional']:.2f} GiB with RegionalField.\n\n"
        results = DOCS / "results"
        (results / "performance.md").write_text(f"{table(self.rows)}\n{speed}{self.summary()}")
        (results / "time_to_paper.md").write_text(seconds_table(self.content["seconds_to_the_papers_figures"]))
        (results / "profile.md").write_text(self.content["profile"])
        cost_figure(self.content["cost_by_number"]).savefig(DOCS / "figures" / "cost-by-vehicles.png", dpi=110)


def main(args: list[str] | None = None, take: Callable[[Report, str], None] = Report.take) -> None:
    """Measure, print and write."""
    parts = [*COMPARISONS, *OTHERS]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", choices=parts, action="append", help="one part, may be repeated; all by default")
    parser.add_argument("--limit-s", type=float, default=840.0, help="time after which no further part starts [s]")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmarks.json"), help="file of all figures")
    parser.add_argument("--publish", action="store_true", help="write docs/results/performance.md and its companions")
    options = parser.parse_args(args)
    torch.manual_seed(0)
    report = Report(options.limit_s)
    for part in options.only or parts:
        take(report, part)
    print(f"\n{report.summary()}")
    report.write(options.out)
    if options.publish:
        report.publish()


if __name__ == "__main__":
    main()
