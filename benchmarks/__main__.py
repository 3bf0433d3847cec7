"""Every figure of docs/results/performance.md, side by side: `python -m benchmarks`, about four minutes on two cores.

Prints each part as it is measured. `--only PART` measures one part. Results are written to runs/benchmarks.json, and
for the documents where --publish is given.
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import platform
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.timing import HEADER, Row
from magrl.files import write_json

import matplotlib.pyplot as plt
import torch

DOCS = Path(__file__).parent.parent / "docs"
COMPARISONS = ("fields", "env", "onboard", "update", "training")
"""Modules that give rows of the table; each is imported when it is measured."""
OTHERS = {"vehicles": ("env", "cost_by_number"), "profile": ("profile_training", "shares")}
"""Module and function of other figures: microseconds of a step by number of vehicles, and shares of a training."""


def measure(module: str, function: str = "rows") -> Any:
    """Return the result of a function of a module of the benchmarks."""
    return getattr(importlib.import_module(f"benchmarks.{module}"), function)()


def shares_table(shares: dict[str, float]) -> str:
    """Return shares in percent as a Markdown table."""
    lines = ["| part | % |", "|---|---|", *(f"| {part} | {100 * share:.0f} |" for part, share in shares.items())]
    return "\n".join(lines) + "\n"


def table(rows: Iterable[Row]) -> str:
    """Return the Markdown table of some rows."""
    return HEADER + "".join(f"{row}\n" for row in rows)


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
    """Results so far."""

    def __init__(self) -> None:
        self.began, self.rows, self.content = time.perf_counter(), list[Row](), dict[str, Any]()

    def take(self, part: str) -> None:
        """Measure a part and print it."""
        if part in COMPARISONS:
            rows = measure(part)
            self.rows += rows
            print(table(rows), flush=True)
        else:
            self.content[part] = measure(*OTHERS[part])
            print(f"{part}: {self.content[part]}\n", flush=True)

    def summary(self) -> str:
        """Return when, where and in how much time this was measured."""
        threads, version = torch.get_num_threads(), torch.__version__.partition("+")[0]
        return (
            f"Measured on {datetime.date.today()} in {time.perf_counter() - self.began:.0f} s on {platform.machine()}, "
            f"{threads} threads, torch {version}. Times vary between days and machines;\nratios are of calls in turn.\n"
        )

    def publish(self) -> None:
        """Write the tables and the figure of the documents; every part must have been measured."""
        if missing := OTHERS.keys() - self.content.keys():
            raise SystemExit(f"nothing is published: {', '.join(missing)} was not measured")
        results = DOCS / "results"
        page = results / "performance.md"
        _, heading, others = page.read_text(encoding="utf-8").partition("\n## ")  # tables of other measurements
        page.write_text(f"{table(self.rows)}\n{self.summary()}{heading}{others}", encoding="utf-8")
        (results / "profile.md").write_text(shares_table(self.content["profile"]), encoding="utf-8")
        source = {"Source": "python -m benchmarks --publish"}
        cost_figure(self.content["vehicles"]).savefig(results / "cost-by-vehicles.png", dpi=110, metadata=source)


def main(args: list[str] | None = None) -> None:
    """Measure, print and write."""
    parts = [*COMPARISONS, *OTHERS]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", choices=parts, action="append", help="one part, may be repeated; all by default")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmarks.json"), help="file of all figures")
    parser.add_argument("--publish", action="store_true", help="write docs/results/performance.md and its companions")
    options = parser.parse_args(args)
    torch.manual_seed(0)
    report = Report()
    for part in options.only or parts:
        report.take(part)
    print(report.summary())
    options.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [asdict(row) for row in report.rows]
    write_json(options.out, {"rows": rows, **report.content, "machine": report.summary()})
    if options.publish:
        report.publish()


if __name__ == "__main__":
    main()
