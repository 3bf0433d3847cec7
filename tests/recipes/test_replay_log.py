"""The recipe that replays a log: estimates against truth, files, and errors that name the row."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
import replay_log as recipe
import torch
from matplotlib.figure import Figure

from magrl.field import IGRF, elements_at
from magrl.training import UsageError

ROOT = Path(__file__).parent.parent.parent
LOG = ROOT / "docs" / "examples" / "log.csv"
NOISE = ["--noise", "0.02", "0.02", "2"]


def test_the_example_is_what_its_command_writes(tmp_path: Path) -> None:
    runpy.run_path(str(ROOT / "docs" / "examples" / "make_log.py"))["write"](tmp_path / "log.csv")
    assert (tmp_path / "log.csv").read_text(encoding="utf-8") == LOG.read_text(encoding="utf-8")


def test_the_example_with_other_columns(tmp_path: Path, monkeypatch, capsys) -> None:
    """The estimate comes near the truth, the stated error holds, and no position enters: without them, the same."""
    recipe.main([str(LOG), *NOISE, "--out", str(tmp_path / "a")])
    table = pd.read_csv(tmp_path / "a" / "log.csv")
    assert len(table) == len(pd.read_csv(LOG))
    assert table["miss_km"].iloc[-1] < 6
    assert table["miss_km"].iloc[-5] < 0.4 * table["miss_km"].iloc[1]
    assert table["stop"].iloc[-1] == "arrived"
    said = capsys.readouterr().out
    assert (tmp_path / "a" / "log.md").read_text(encoding="utf-8") in said
    assert "Error of the estimated displacement at the end" in said
    assert (tmp_path / "a" / "log.png").stat().st_size > 10_000
    monkeypatch.setattr(recipe, "figure", lambda *_: Figure())
    blind = pd.read_csv(LOG).drop(columns=["time", "latitude", "longitude"]).rename(columns={"D": "dec"})
    blind.to_csv(tmp_path / "blind.csv", index=False)
    recipe.main([str(tmp_path / "blind.csv"), *NOISE, "--declination", "dec", "--out", str(tmp_path / "b")])
    other = pd.read_csv(tmp_path / "b" / "log.csv")
    assert "miss_km" not in other
    columns = ["leg_km", "steer_deg", "north_km", "error_km", "confidence"]
    pd.testing.assert_frame_equal(table[columns], other[columns])


@pytest.fixture
def said(tmp_path: Path, monkeypatch, capsys) -> Callable[..., str]:
    """Return a function that replays a log with options, without its figure, into a folder; it returns the text."""
    monkeypatch.setattr(recipe, "figure", lambda *_: Figure())

    def run(log: pd.DataFrame, *options: object) -> str:
        log.to_csv(tmp_path / "log.csv", index=False)
        recipe.main([str(tmp_path / "log.csv"), *NOISE, *map(str, options), "--out", str(tmp_path / "out")])
        return capsys.readouterr().out

    return run


def test_the_first_position_may_be_known(tmp_path: Path, said) -> None:
    """The displacement to the last position, or to another one, is then known from the first row on."""
    log, start, date = pd.read_csv(LOG)[:6], ("--start-km", 0.5), ("--date", "2025-01-01")
    for options in ((), ("--target-position", 62.5, 1.0)):
        said(log, *start, *date, *options)
        assert pd.read_csv(tmp_path / "out" / "log.csv")["miss_km"].max() < 3
    for changed, options, message in (
        (log, (), r"start_km 0\.5 needs positions in the log and a date"),
        (log.drop(columns=["latitude", "longitude"]), date, r"start_km 0\.5 needs positions in the log and a date"),
        (log, (*date, "--model", "WMM"), "model 'WMM' must be IGRF-13, IGRF-14"),
    ):
        with pytest.raises(UsageError, match=message):
            said(changed, *start, *options)


def test_repeated_rows_do_not_double_the_path_and_mistakes_are_named(said) -> None:
    log, date = pd.read_csv(LOG)[:4], ("--date", "2025-01-01")
    text = said(log.loc[log.index.repeat(2)], *date)
    assert "Warning: 4 rows with the time of the row before left out." in text
    assert "IGRF" not in text
    assert "Error of the estimated displacement halfway" in text
    assert "4 of 4 readings do not fit IGRF" in said(log.assign(I=-log["I"]), *date)
    assert "Average readings" not in text
    slow = log.assign(distance=log["distance"] / 10).drop(columns=["time", "latitude", "longitude"])
    assert "Warning: legs are 2 km long. Average readings over some 20 km" in said(slow)
    log["heading"] = [0, 1, 2, 1]  # no vehicle was to steer so, but no single row is impossible
    assert "If these are radians, convert them to degrees" in said(log)


def test_the_unit_that_ends_a_name_counts(tmp_path: Path) -> None:
    """And the altitude is found with its unit."""
    units = {"dec_rad": 57.29577951308232, "I_deg": 1.0, "H_uT": 1000.0, "distance_nmi": 1.852, "altitude_m": 0.001}
    log = pd.read_csv(LOG).assign(altitude=10.0)
    names = dict(zip(["D", "I", "B_H", "distance", "altitude"], units, strict=True))
    scaled = log.assign(**{name: log[name] / units[other] for name, other in names.items()}).rename(columns=names)
    log.to_csv(tmp_path / "log.csv", index=False)
    scaled.to_csv(tmp_path / "other.csv", index=False)
    options = dict(zip(["declination", "inclination", "horizontal"], units, strict=False))
    found = recipe.read_log(recipe.Config(tmp_path / "other.csv", **options))
    pd.testing.assert_frame_equal(found, recipe.read_log(recipe.Config(tmp_path / "log.csv")))


def test_the_altitude_counts(tmp_path: Path, said) -> None:
    """A log from 450 km fits IGRF there, also the direction of its north; one of 450 m does not."""
    log, options = pd.read_csv(LOG)[:4].assign(altitude_km=450.0), ("--date", "2025-01-01", "--north", "magnetic")
    place = torch.tensor(log[["latitude", "longitude"]].to_numpy())
    for km, more, warned in ((0.45, (), True), (450.0, ("--altitude", "none"), True), (450.0, (), False)):
        log[["D", "I", "B_H"]] = elements_at(IGRF("2025-01-01", altitude_km=km), place).numpy()
        assert ("4 of 4 readings do not fit IGRF" in said(log, *options, *more)) == warned
    table = pd.read_csv(tmp_path / "out" / "log.csv")
    assert table["north_deg"].tolist() == pytest.approx(log["D"].tolist(), abs=1e-4)


def test_errors_name_what_is_wrong(tmp_path: Path) -> None:
    path, lines = tmp_path / "log.csv", "\n".join(LOG.read_text(encoding="utf-8").splitlines()[:5])
    for change, arguments, message in (
        (("B_H", "H"), (), "is 'B_H': name the column of B_H, one of \\['time', 'D', 'I', 'H'"),
        (("1.310", "x"), (), r"cannot read .*: row 2, D: 'x' is not a number"),
        (("1.310", ""), (), r"cannot read .*: row 2, D: '' is not a number"),
        (("14271.7", "14.27"), (), r"row 2 of .*microtesla"),
        (("14271.7", "19000"), (), r"row 2 of .*B_H changed from 14293.5 to 19000 nT over 20 km"),
        (
            ("290.0,20.0", "290.0,70.0"),
            (),
            r"row 2: a leg of 70 km in 3000 s is 23.* m/s, the positions are 19.* km apart",
        ),
        (("3000", "9000"), (), "time runs backward from row 2 to 3, from 9000 to 6000: sort the rows"),
        (("B_H", "B_H"), ("--navigator", "dowsing"), "unknown navigator 'dowsing'"),
        (("B_H", "B_H"), ("--target", "-0.2", "1.3", "13000"), "the target: .*radians"),
        (("B_H", "B_H"), ("--target", "-5", "74.5", "14000", "--target-position", "95", "0"), "95"),
        (("62.06", "162.06"), (), "latitude 162.06.* is not from -90 to 90 deg"),
    ):
        path.write_text(lines.replace(*change, 1), encoding="utf-8")
        with pytest.raises(UsageError, match=message):
            recipe.main([str(path), *arguments, "--out", str(tmp_path / "out")])
