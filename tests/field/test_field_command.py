"""The command ``python -m magrl.field``: a table of points in, the field at each of them out."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas
import pytest
import torch

from magrl.field import IGRF, elements_at, elements_gradient_at
from magrl.field.__main__ import main
from magrl.vehicle.logs.__main__ import main as log_main

POINTS = """id,latitude,longitude,altitude,date
007,-2.0,162.0,0.5,2022-01-01
008,60.4,5.3,-3,1999.5
009,78.0,-30,400,2026-07-01T12:00:00
"""


@pytest.fixture
def points(tmp_path: Path) -> Path:
    path = tmp_path / "points.csv"
    path.write_text(POINTS)
    return path


def test_the_field_of_each_row_is_that_of_its_date_and_altitude(points) -> None:
    main([str(points)])
    table = pandas.read_csv(points.with_name("points_field.csv"), dtype={"id": str, "date": str, "altitude": str})
    given = pandas.read_csv(points, dtype=str)
    assert [table[name].tolist() for name in ("id", "date", "altitude")] == [
        given[name].tolist() for name in ("id", "date", "altitude")
    ]
    dates = ("2022-01-01", 1999.5, "2026-07-01T12:00:00")
    for (_, row), date in zip(table.iterrows(), dates, strict=True):
        field = IGRF(date, altitude_km=float(row["altitude"]))
        place = torch.tensor([row["latitude"], row["longitude"]], dtype=torch.float64)
        vector = field(*place)
        np.testing.assert_allclose([row[f"{name}_nT"] for name in "XYZ"], vector, rtol=0, atol=1e-3)
        assert row["F_nT"] == pytest.approx(vector.norm().item(), abs=1e-3)
        found = [row[name] for name in ("D_deg", "I_deg", "B_H_nT")]
        np.testing.assert_allclose(found, elements_at(field, place), rtol=0, atol=1e-3)
        units = {"D": "deg", "I": "deg", "B_H": "nT"}
        names = [f"d{x}_{side}_{unit}_per_km" for x, unit in units.items() for side in ("north", "east")]
        np.testing.assert_allclose(row[names].tolist(), elements_gradient_at(field, place).flatten(), rtol=0, atol=1e-8)


def test_options_name_columns_depth_unit_and_one_date(points, tmp_path) -> None:
    points.write_text("lat,lon,down\n-2,162,500\n60,5,11000\n")
    out = tmp_path / "new" / "out.csv"
    options = "--latitude lat --longitude lon --depth down --unit m --date 2022-01-01 --generation 13"
    main([str(points), *options.split(), "--out", str(out)])
    found = pandas.read_csv(out)[["X_nT", "Y_nT", "Z_nT"]].to_numpy()
    place = torch.tensor([[-2.0, 60.0], [162.0, 5.0]], dtype=torch.float64)
    expected = IGRF("2022-01-01", 13)(*place, torch.tensor([-0.5, -11.0]))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("header", "altitude"),
    [
        ("lat,lon,alt_m,time", "500"),
        ("Latitude,LONGITUDE,altitude_km,DateTime", "0.5"),
        ("lat,long,depth_m,date", "-500"),
        ("lat,lng,alt,date", "0.5"),
    ],
)
def test_usual_names_of_columns_are_found(points, header: str, altitude: str) -> None:
    points.write_text(f"{header}\n-2,162,{altitude},2022-01-01\n")
    main([str(points)])
    found = pandas.read_csv(points.with_name("points_field.csv"))[["X_nT", "Y_nT", "Z_nT"]].to_numpy()
    expected = IGRF("2022-01-01", altitude_km=0.5)(*torch.tensor([-2.0, 162.0], dtype=torch.float64))
    np.testing.assert_allclose(found[0], expected, rtol=0, atol=1e-3)


def test_angles_that_may_be_radians_are_named(points, capsys) -> None:
    for rows, warned in (("1.05,0.09", True), ("1.05,0.09\n60.4,5.3", False)):
        points.write_text(f"lat,lon\n{rows}\n")
        main([str(points), "--altitude", "0", "--date", "2026-07-01"])
        assert ("are they radians?" in capsys.readouterr().err) is warned


def test_a_row_with_a_blank_cell_has_no_field_and_is_named(points, capsys) -> None:
    """Whichever is blank; the other rows, and what is read of them, do not change."""
    main([str(points)])
    whole = pandas.read_csv(points.with_name("points_field.csv"), dtype=str)
    header, first, *rows = POINTS.splitlines()
    _, *cells = first.split(",")
    blank = [",".join(["007", *cells[:place], "", *cells[place + 1 :]]) for place in range(len(cells))]
    points.write_text("\n".join([header, *blank, "007,-2.0", *rows, first]))
    main([str(points)])
    assert "5 rows, first row 1, lack a position, an altitude or a date" in capsys.readouterr().err
    table = pandas.read_csv(points.with_name("points_field.csv"), dtype=str)
    assert table.filter(regex="_nT|_deg").iloc[:5].isna().all(axis=None)
    assert table.iloc[5:].values.tolist() == whole.iloc[[1, 2, 0]].values.tolist()
    points.write_text("\n".join([header, *blank, rows[0].replace("60.4", "91")]))
    with pytest.raises(SystemExit):
        main([str(points)])
    assert "row 5, latitude: 91 is not from" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "options", "message"),
    [
        (POINTS.partition("\n")[2], "007,,,,", "", "no row has a position, an altitude and a date"),
        ("date", "latitude", "", "the table has 2 columns 'latitude': keep one of them, or rename it"),
        ("007,", "007,7,", "", "row 1 or a later one has more cells than the header"),
        ("007", '"007', "", "a quoted text that is not closed"),
        ("0.5", "5000", "", "row 1, altitude: 5000 is not from -15 to 1000 km: is it in meters? Then add --unit m"),
        ("60.4", "north", "", "row 2, latitude: 'north' is not a number"),
        ("60.4", "91", "", "row 2, latitude: 91 is not from -90 to 90 degrees"),
        ("162.0", "1620", "", "row 1, longitude: 1620 is not from -360 to 360 degrees"),
        ("1999.5", "May", "", "row 2, date: date 'May' is not an ISO date"),
        ("1999.5", "1850-01-01", "", "1850-01-01T00:00:00 is outside IGRF-14, which is valid from 1900-01-01"),
        ("altitude", "height", "", "neither altitude nor depth among id, latitude, longitude, height, date"),
        ("id", "depth", "", "both columns altitude and depth: choose with --altitude or --depth"),
        ("latitude", "phi", "", "no column is 'latitude': choose among id, phi"),
        ("id,latitude", "Lat,lat", "", "the table has columns Lat and lat: choose with --latitude"),
        ("60.4", "162", "", "row 2, latitude: 162 is not from -90 to 90 degrees: are latitude and longitude swapped?"),
        ("", "", "--latitude longitude", "--latitude longitude --longitude longitude: they are swapped"),
        ("id", "D_deg", "", "the table has columns D_deg already"),
        (POINTS.partition("\n")[2], "", "", "the table has no row"),
        ("", "", "--altitude inf", "row 1, altitude: 'inf' is not a number"),
        ("", "", "--altitude 5000", "5000 is not from -15 to 1000 km"),
        ("", "", "--out points.xlsx", "--out must be another file that ends in .csv, got 'points.xlsx'"),
        ("", "", "--out points.csv", "--out must be another file"),
    ],
)
def test_errors_name_the_row_and_the_value(points, monkeypatch, capsys, old, new, options, message) -> None:
    monkeypatch.chdir(points.parent)
    points.write_text(POINTS.replace(old, new, 1) if old else POINTS)
    with pytest.raises(SystemExit) as exit_:
        main(["points.csv", *options.split()])
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not points.with_name("points_field.csv").exists()


@pytest.mark.parametrize("program", [main, log_main])
def test_a_path_that_is_no_table_is_one_line(program, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("folder.csv").mkdir()
    Path("empty.csv").touch()
    Path("binary.csv").write_bytes(bytes(range(256)))
    Path("full_field.csv").symlink_to("/dev/full")
    Path("full.csv").write_text(POINTS)
    for path in (
        "",
        ".",
        "..",
        "/",
        "nowhere.csv",
        "nowhere/points.csv",
        "folder.csv",
        "empty.csv",
        "binary.csv",
        "full.csv",
    ):
        with pytest.raises(SystemExit) as stop:
            program([path])
        lines = capsys.readouterr().err.splitlines()
        assert (stop.value.code, len(lines)) == (2, 1), path
        assert lines[0].startswith("python -m magrl."), path


def test_no_direction_is_east_at_a_pole(points) -> None:
    """There D turns with the longitude, by 57 degrees per radian of it: its eastward gradient has no limit."""
    points.write_text("lat,lon,alt,date\n90,10,0,2025-01-01\n-90,10,0,2025-01-01\n89.9,10,0,2025-01-01\n")
    main([str(points)])
    table = pandas.read_csv(points.with_name("points_field.csv"))
    eastward = table[[name for name in table if "_east_" in name]]
    assert eastward.isna().all(axis=1).tolist() == [True, True, False]
    assert table.drop(columns=eastward.columns).notna().all(axis=None)
    assert table["dD_east_deg_per_km"][2] == pytest.approx(180 / math.pi / 11.16, rel=0.01)


@pytest.mark.slow  # another process imports PyTorch
def test_help_ends_without_a_traceback_when_the_pipe_is_closed() -> None:
    done = subprocess.run(
        f"{sys.executable} -W ignore -m magrl.field points.csv --help | head -n 1",
        shell=True,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.startswith("usage: python -m magrl.field")
    assert done.stderr == ""
