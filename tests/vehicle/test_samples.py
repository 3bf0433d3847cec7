"""CSV files with the columns that engineers write: units, times, blank cells, and errors that name the row."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import pytest

from magrl.vehicle.logs import read_log
from magrl.vehicle.logs.conventions import COLUMNS, UNITS, column_of, unit_of

HEADER = "time_s,mag_x_nT,mag_y_nT,mag_z_nT,heading_true_deg"
ROWS = ("0,15000,1000,48000,350", "1,15100,1100,48100,10", "2,15200,1200,48200,30")


def written(folder: Path, *rows: str, header: str = HEADER) -> Path:
    (folder / "log.csv").write_text("\n".join([header, *rows]), encoding="utf-8")
    return folder / "log.csv"


@pytest.mark.parametrize(
    ("header", "row", "column", "value"),
    [
        ("Time [us],Bx [G],By [G],Bz [G]", "1e6,0.15,0,0.48", "z", 48000.0),
        ("timestamp,mag_x_μT,mag_y_mG,mag_z_gauss", "1,15,10,0.48", "x", 15000.0),
        ("utc,magx,magy,magz,Yaw (rad)", "1,0,0,5e4,3.14159265358979", "heading", 180.0),
        ("time,x,y,z,distance_m", "1,0,0,5e4,500", "distance", 0.0),
        ("time,x,y,z,depth_m", "1,0,0,5e4,30", "altitude", -0.03),
        ("time,x,y,z", "2026-06-30T12:00:00+02:00,0,0,5e4", "time", 1782813600.0),
    ],
)
def test_columns_and_units(tmp_path: Path, header: str, row: str, column: str, value: float) -> None:
    assert read_log(written(tmp_path, row, header=header)).samples[column].iloc[0] == pytest.approx(value)


def test_each_unit_of_each_column() -> None:
    headers = ("{}_{}".format, "{} [{}]".format, lambda column, unit: f"{column} ({unit})".title())
    for column, (kind, *_) in COLUMNS.items():
        for unit, size in UNITS[kind].items():
            assert {column_of(header(column, unit)) for header in headers} == {(column, size)}
            assert {unit_of(header("any", unit), kind) for header in headers} == {size}


def test_the_north_of_a_column(tmp_path: Path) -> None:
    for name, north in {"heading_true_deg": "true", "mag_heading": "magnetic", "heading": None}.items():
        assert read_log(written(tmp_path, *ROWS, header=HEADER.replace("heading_true_deg", name))).north == north


def test_blank_cells_are_interpolated(tmp_path: Path) -> None:
    """Headings through north; positions that are slower than the magnetometer; rows without axes are left out."""
    rows = "0,0,0,5e4,350,10", "1,0,0,5e4,,", "1.5,,,,,", "1.7,0,0,0,,", "2,0,0,5e4,10,12", "3,0,0,5e4,20,"
    samples = read_log(written(tmp_path, *rows, header=HEADER + ",lat")).samples
    assert samples["time"].tolist() == [0, 1, 2, 3]
    assert samples["heading"].tolist() == pytest.approx([350, 0, 10, 20])
    assert samples["latitude"].tolist() == pytest.approx([10, 11, 12, 12])


def test_rows_that_are_left_out_keep_the_way(tmp_path: Path) -> None:
    """A row that repeats a time adds nothing; the distance of a row without axes, or of zeros, belongs to the next."""
    rows = "0,0,0,5e4,0,0", "1,0,0,5e4,0,5", "1,0,0,5e4,0,5", "2,0,0,0,0,7", "3,,,,0,1", "4,0,0,5e4,0,2"
    samples = read_log(written(tmp_path, *rows, header=HEADER + ",distance_km")).samples
    assert samples["distance"].tolist() == [0, 5, 10]


def test_notes(tmp_path: Path) -> None:
    for rows, note in (
        ([*ROWS, "3,15300"], "the last row is not complete, and is left out: the log"),
        ([*ROWS[:2], *ROWS[1:]], "1 of 4 samples left out: without a new time"),
        ([*ROWS, "3,0,0,0,40"], "1 of 4 samples left out"),
    ):
        assert any(re.match(note, text) for text in read_log(written(tmp_path, *rows)).notes)


WHOLE = HEADER + ",roll_deg,pitch_deg,speed_m_s,distance_km,lat_deg,lon_deg,alt_m"


def whole(*changes: tuple[int, str]) -> tuple[list[str], ...]:
    """Header and rows of a log with all columns, with other cells in the second row."""
    rows = [f"{row},15000,1000,48000,350,1,2,5,0.1,60,5,10".split(",") for row in range(3)]
    for column, cell in changes:
        rows[1][column] = cell
    return WHOLE.split(","), *rows


def message(folder: Path, table: Iterable[list[str]]) -> str:
    """What is wrong with a log; empty if nothing."""
    try:
        read_log(written(folder, *map(",".join, table), header=""))
    except ValueError as error:
        return str(error)
    return ""


def test_each_part_of_a_file(tmp_path: Path) -> None:
    """Dropped, doubled, retyped, beyond its range, and of a longer row."""
    assert message(tmp_path, whole()) == ""
    for place, header in enumerate(WHOLE.split(",")):
        needed = header.startswith(("time", "mag"))
        assert ("no " in message(tmp_path, [row[:place] + row[place + 1 :] for row in whole()])) == needed
        assert f"row 2, {header}: 'x' is not a number" in message(tmp_path, whole((place, "x")))
        wide = header.startswith(("mag", "heading"))
        assert (" is not from " in message(tmp_path, whole((place, "-1e13")))) != wide
    assert "more cells than the header" in message(tmp_path, whole((3, "48000,1")))


def test_two_files_of_one_vehicle(tmp_path: Path) -> None:
    """The magnetometer in one, the gyrocompass in the other, which decides the heading and its north."""
    path = written(tmp_path, *ROWS).rename(tmp_path / "mag.csv")
    gyro = written(tmp_path, "0,100", "2,200", header="time,heading_mag")
    log = read_log(path, gyro)
    assert log.samples["heading"].tolist() == pytest.approx([100, 150, 200])
    assert (log.north, log.source) == ("magnetic", "CSV, 3 rows; CSV, 2 rows")
