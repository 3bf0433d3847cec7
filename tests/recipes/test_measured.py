"""The table of a measured field, on a synthetic log of the same form."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import torch
from support.recipes import load

from magrl.field import IGRF
from magrl.field.elements import measured_elements
from magrl.geodesy import move

recipe = load("docs/tables/measured")
SHIFT = torch.tensor([0.1, 0.05, -120.0], dtype=torch.float64)
"""Constant difference of the measured field from IGRF."""


def write_log(path: Path) -> None:
    """A track of 1700 km southward from 450 to 470 km of altitude, a row every 57 km."""
    along = 56.7 * torch.arange(31, dtype=torch.float64)
    start = torch.full_like(along, -10.0), torch.full_like(along, -30.0)
    place = torch.stack(move(*start, torch.full_like(along, 3.0), along), -1)
    altitude = torch.linspace(450, 470, len(along), dtype=torch.float64)
    elements = measured_elements(IGRF("2016-01-01")(*place.unbind(-1), altitude)) + SHIFT
    rows = torch.cat((place, altitude.unsqueeze(-1), elements), -1)
    table = pd.DataFrame(rows.numpy(), columns=["latitude", "longitude", "altitude_km", "D", "I", "B_H"])
    table = table.assign(heading=torch.rad2deg(torch.tensor(3.0)).item(), distance=56.7, time="2016-01-01 00:00:00")
    table["time"] = pd.to_datetime(table["time"]) + pd.to_timedelta(6 * table.index, unit="s")
    table.loc[0, "distance"] = 0.0
    table.to_csv(path, index=False)


def test_a_known_start_removes_what_is_constant(tmp_path: Path) -> None:
    """The regions hold the destination, and errors are small where target and readings have the same difference."""
    write_log(tmp_path / "log.csv")
    survey = recipe.read_survey(tmp_path / "log.csv")
    torch.testing.assert_close(survey.field - survey.model, SHIFT.expand_as(survey.field), atol=1e-6, rtol=0)
    noise, found = torch.tensor([0.02, 0.02, 2.0]).double(), {}
    for source, start in (("measured", True), ("IGRF", False), ("IGRF", True)):
        texts = recipe.cells(survey, (300.0, 500.0), noise, source, start)
        found[source, start] = int(texts[-1])
        assert min(map(int, texts[:3])) > 60
    assert found["IGRF", False] > 3 * found["IGRF", True]
    assert found["IGRF", True] < 10
    assert found["measured", True] < 10
