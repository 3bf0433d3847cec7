"""Every figure of docs/performance.md, measured side by side: `python -m benchmarks`, about nine minutes on two cores.

Prints a table of ratios, and writes it with the rest to runs/benchmarks.json, and as a table and a picture for the
documents where --publish is given.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # before torch: see recipes/td3_gradient_guided.py

import argparse
import json
import math
import platform
import statistics
import time
from dataclasses import asdict
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from tqdm import tqdm

from benchmarks import env, fields, imports, profile_training, training, update
from benchmarks.timing import Row

DOCS = Path(__file__).parent.parent / "docs"


def table(rows: list[Row]) -> str:
    """Ratios with their quartiles."""
    lines = ["| what | first ms | second ms | ratio | quartiles | goal |", "|---|---|---|---|---|---|"]
    for row in rows:
        cells = (f"{row.first_ms:.3g}", f"{row.second_ms:.3g}", f"{row.ratio:.2f}", f"{row.low:.2f}–{row.high:.2f}")
        lines.append(f"| {row.what} | {' | '.join(cells)} | {row.goal} |")
    return "\n".join(lines) + "\n"


def seconds_table(seconds: list[float]) -> str:
    """Times of single runs, and their median."""
    known = [value for value in seconds if math.isfinite(value)]
    cells = [f"{value:.1f}" for value in seconds] + [f"**{statistics.median(known):.1f}**" if known else "—"]
    heads = [f"seed {seed}" for seed in range(len(seconds))] + ["median"]
    return f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|\n| {' | '.join(cells)} |\n"


def cost_figure(costs: list[dict[str, float]]) -> plt.Figure:
    """Cost of a vehicle-step over the number of vehicles."""
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    numbers = [row["vehicles"] for row in costs]
    for key, name, colour in (("raw_us", "raw step", "#0072B2"), ("guided_us", "guided, in a collector", "#D55E00")):
        axes.loglog(numbers, [row[key] for row in costs], "o-", label=name, color=colour)
    axes.set_xticks(numbers, [str(number) for number in numbers])
    axes.minorticks_off()
    axes.set(xlabel="vehicles", ylabel="time for a vehicle-step [µs]")
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)
    return figure


def main() -> None:
    """Measures, prints, writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/benchmarks.json"))
    parser.add_argument("--publish", action="store_true", help="write docs/results/performance*.md and the picture")
    options = parser.parse_args()
    torch.manual_seed(0)
    began = time.perf_counter()
    rows: list[Row] = []
    parts = (
        fields.rows,
        env.rows,
        imports.rows,
        update.rows,
        lambda: [training.whole_training()],
        lambda: [training.first_attempt()],
    )
    for part in tqdm(parts, desc="ratios"):
        rows += part()
    per_second, costs, seconds = env.steps_per_second(), env.cost_by_number(), training.to_the_papers_figures()
    parts_of_time, memory = profile_training.table(profile_training.shares()), fields.peak_memory()
    speed = f"Raw step of {env.VEHICLES} vehicles: {per_second / 1e6:.2f} million vehicle-steps a second.\n\n"
    speed += f"Peak memory, value and gradient at 10 million points: {memory['igrf']:.2f} GiB with IGRF, "
    speed += f"{memory['regional']:.2f} GiB with RegionalField.\n\n"
    machine = f"{platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__.partition('+')[0]}"
    took = f"Measured in {time.perf_counter() - began:.0f} s on {machine}.\n"
    print(f"\n{table(rows)}\n{speed}From the start of the process to SR 97 %, SPL 88.4 % [s]:\n")
    print(f"{seconds_table(seconds)}\n{parts_of_time}\n{took}")
    content = {"rows": [asdict(row) for row in rows], "steps_per_second": per_second, "cost_by_number": costs}
    content |= {"peak_gib": memory}
    content |= {"seconds_to_the_papers_figures": seconds, "machine": machine}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(content, indent=2) + "\n")
    if options.publish:
        (DOCS / "results" / "performance.md").write_text(f"{table(rows)}\n{speed}{took}")
        (DOCS / "results" / "time_to_paper.md").write_text(seconds_table(seconds))
        (DOCS / "results" / "profile.md").write_text(parts_of_time)
        cost_figure(costs).savefig(DOCS / "figures" / "cost-by-vehicles.png", dpi=110)


if __name__ == "__main__":
    main()
