"""Make the table of a measured field: does the destination lie where a vehicle on a recorded track states it?

    python docs/tables/measured.py LOG.csv --out docs/results

The log is a CSV file with the columns time, D, I, B_H, heading, distance (on the ground), latitude, longitude and
altitude_km. That of the published table is of Swarm A on 1 January 2016, 00:13:40 to 00:30 UTC, a row every 6 s: ESA's
product SW_OPER_MAGA_LR_1B (B_NEC), from VirES for Swarm. Each piece of the track is a flight from its first row to its
last. The vehicle reads D, I, B_H of the log with white noise. The destination's elements, and those of a known start,
are of the log, as from a survey, or of IGRF at its altitude.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

from magrl.evaluation.tables import markdown_table
from magrl.field import IGRF
from magrl.field.elements import measured_elements
from magrl.files import write_text
from magrl.geodesy import geodesic
from magrl.onboard.mistakes import MODEL_STD
from magrl.pilot.belief import Belief, before, known, moved, read
from magrl.pilot.destination import destination, log_density, posterior
from magrl.sensor_std import SensorStd
from magrl.training import command

import pandas as pd
import torch
import tyro
from torch import Tensor

RECIPE = "measured.py"
NAMES = ("D", "I", "B_H", "heading", "distance", "latitude", "longitude", "altitude_km")
SLOW = (0.05, 0.03, 15.0)
"""Standard deviations of what varies along the path, crust and currents, on D, I [deg], B_H [nT]: 15 nT; chosen."""
RANGE_KM = {(300.0, 500.0): 400.0, (1200.0, 1800.0): 1000.0}
"""Prior standard deviation of the displacement [km] for pieces of a length."""
PROBABILITIES = (0.5, 0.9, 0.95)


@dataclass(frozen=True)
class Survey:
    """Rows of a log ``(T, ...)``: readings, IGRF there, headings [rad], legs [km], positions [deg]."""

    field: Tensor
    model: Tensor
    heading: Tensor
    distance: Tensor
    position: Tensor


def read_survey(path: Path, date: str | None = None) -> Survey:
    """Return the rows of a log, and IGRF at the altitude of each."""
    log = pd.read_csv(path)
    values = torch.tensor(log[list(NAMES)].to_numpy(float))
    model = measured_elements(IGRF(date or log["time"][0][:10])(*values[:, 5:].unbind(-1)))
    return Survey(values[:, :3], model, torch.deg2rad(values[:, 3]), values[:, 4], values[:, 5:7])


def pieces(survey: Survey, low_km: float, high_km: float) -> Tensor:
    """Return the rows of all pieces of about the mean length, ``(P, T)``."""
    rows = round((low_km + high_km) / 2 / survey.distance[1:].mean().item()) + 1
    return torch.arange(len(survey.distance)).unfold(0, rows, 1)


def flown(survey: Survey, rows: Tensor, noise: Tensor, target: Tensor, start: Tensor | None, range_km: float) -> Tensor:
    """Return for each reading ``(P, T - 1)`` the stated probability of the region whose border is at the destination,
    and the error of the estimated displacement [km], ``(P, T - 1, 2)``.

    A region holds all places that are more probable than those on its border, so that it is right if the first is
    uniform from 0 to 1.

    Args:
        survey: the log.
        rows: pieces.
        noise: standard deviations of the white noise.
        target: elements of the destinations ``(P, 3)``.
        start: known elements at the start ``(P, 3)``; None where they are not known.
        range_km: prior standard deviation of the displacement.
    """
    generator = torch.Generator().manual_seed(0)
    reading = survey.field[rows] + noise * torch.randn(*rows.shape, 3, generator=generator).double()
    std = noise.expand(len(rows), 3)
    errors = SensorStd(std, *(torch.tensor(x).double().expand_as(std) for x in (MODEL_STD, SLOW, (0.0,) * 3)))
    near = reading[:, 0] if start is None else start
    belief: Belief = before(near, errors)
    belief = belief if start is None else known(belief, start, torch.full_like(start, 1e-3))
    found = []
    for step in range(rows.shape[1] - 1):
        if step:
            belief = moved(belief, survey.distance[rows[:, step]], survey.heading[rows[:, step]], errors)
        belief = read(belief, reading[:, step], std)
        goal = destination(belief, target, range_km)
        places = posterior(goal, 1024)
        here, there = (survey.position[rows[:, index]].unbind(-1) for index in (step, -1))
        left, bearing = geodesic(*here, *there)
        true = left.unsqueeze(-1) * torch.stack((torch.cos(bearing), torch.sin(bearing)), -1)
        density = [log_density(goal, points.double()) for points in (places.points, true.unsqueeze(-2))]
        inside = (places.weights * (density[0] > density[1])).sum(-1)
        found.append(torch.stack((inside.double(), (places.displacement().mean - true).norm(dim=-1)), -1))
    return torch.stack(found, 1)


def cells(survey: Survey, length: tuple[float, float], noise: Tensor, source: str, start: bool) -> list[str]:
    """Return coverage and errors of all pieces of a length as text."""
    rows, elements = pieces(survey, *length), survey.field if source == "measured" else survey.model
    first = elements[rows[:, 0]] if start else None
    result = flown(survey, rows, noise, elements[rows[:, -1]], first, RANGE_KM[length])
    inside, error = result.unbind(-1)
    covered = [f"{100 * (inside <= p).double().mean():.0f}" for p in PROBABILITIES]
    halfway = error[:, rows.shape[1] // 2].median()
    return [*covered, f"{halfway:.0f}", f"{error[:, -1].median():.0f}"]


def make(
    log: tyro.conf.Positional[Path],
    *,
    noise: tuple[float, float, float] = (0.05, 0.05, 5.0),
    date: str | None = None,
    out: Path | None = None,
) -> None:
    """Print the table, or write it.

    Args:
        log: Log with positions and altitudes.
        noise: White noise that is added to D [deg], I [deg], B_H [nT].
        date: Date of IGRF; by default from the log.
        out: Folder of measured.md.
    """
    survey, std, table = read_survey(log, date), torch.tensor(noise).double(), []
    for length, source, start in itertools.product(RANGE_KM, ("measured", "IGRF"), (False, True)):
        texts = cells(survey, length, std, source, start)
        table.append(["{:g}–{:g} km".format(*length), source, "known" if start else "not known", *texts])
    heads = [*(f"in the {100 * p:.0f} % region, %" for p in PROBABILITIES), "error halfway, km", "error at the end, km"]
    text = markdown_table(["distance", "destination", "start", *heads], table)
    if out is None:
        print(text)
        return
    write_text(out / "measured.md", text.rstrip() + "\n")


if __name__ == "__main__":
    command(RECIPE, lambda: tyro.cli(make, prog=RECIPE, description=__doc__))
