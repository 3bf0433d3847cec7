"""Mistakes of recorded readings beside IGRF and positions."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import numpy as np
import pandas
import pytest
import torch

from magrl.field import IGRF, elements_at
from magrl.field.elements import axes_of_elements, elements_of_axes
from magrl.geodesy import move
from magrl.sensor_std import OUTAGE_STD
from magrl.vehicle.logs import check_speeds, difference_from_igrf, mistakes, read_readings

DATE = "2026-06-30"


@cache  # a frame that is not changed
def log() -> pandas.DataFrame:
    """Fifteen readings from Newfoundland, where D is -16 degrees, with the noise of sensors and of the crust."""
    place, rows, field = torch.tensor([48.0, -50.0], dtype=torch.float64), [], IGRF(DATE)
    noise = np.random.default_rng(0).normal(0, (0.1, 0.05, 50.0), (15, 3))
    for row in range(15):
        heading, distance = 70.0 + 10 * row, 20.0 if row else 0.0
        turn = torch.deg2rad(torch.tensor(heading)).double()
        place = torch.stack(move(*place, turn, torch.tensor(distance).double()))
        d, i, b = (elements_at(field, place).numpy() + noise[row]).tolist()
        latitude, longitude = place.tolist()
        rows.append({"D": d, "I": i, "B_H": b, "heading": heading, "distance": distance})
        rows[-1] |= {"latitude": latitude, "longitude": longitude}
    return pandas.DataFrame(rows)


def test_only_columns_with_other_names_are_named(tmp_path: Path) -> None:
    """Nor distances, if it has times and speeds."""
    table = log().assign(time=1000.0 * log().index, speed=log()["distance"]).drop(columns="distance")
    table.rename(columns={"D": "dec"}).to_csv(tmp_path / "log.csv", index=False)
    found = read_readings(tmp_path / "log.csv", {"D": "dec"})
    pandas.testing.assert_frame_equal(found[["D", "heading", "latitude"]], log()[["D", "heading", "latitude"]])
    assert found["distance"].tolist() == log()["distance"].tolist()


def test_a_log_without_mistake() -> None:
    assert mistakes(log(), DATE) == []
    assert mistakes(log().drop(columns="latitude"), DATE) == []
    compass = log().assign(D=0.0, D_std=OUTAGE_STD, heading=log()["heading"] - log()["D"])
    assert mistakes(compass, DATE) == []
    drift = np.random.default_rng(0).normal(15, 8, 15)  # of currents, about as D
    assert mistakes(log().assign(heading=log()["heading"] + drift), DATE) == []
    assert difference_from_igrf(log(), DATE).mean(0).abs().lt(torch.tensor([0.1, 0.05, 40.0])).all()


RADIANS, T = np.pi / 180, log()
D, H = T["D"], T["heading"]


@pytest.mark.parametrize(
    ("table", "texts"),
    [
        (T.assign(D=-D), ["15 of 15 readings do not fit IGRF, from row 1 on .*fits with -D"]),
        (T.assign(I=-T["I"]), ["fits with -I: the vertical axis points up"]),
        (T.assign(D=D * RADIANS), ["D fits in radians"]),
        (T.assign(D=D * RADIANS, I=T["I"] * RADIANS), ["fits in radians"]),
        (T.assign(D=D + H * (RADIANS - 1), heading=H * RADIANS), ["the heading fits in radians", "course"]),
        (T.assign(heading=H * RADIANS), ["the heading fits the courses between positions in radians"]),
        (T.assign(B_H=T["B_H"] / 1000), ["looks like microtesla"]),
        (T.assign(B_H=T["B_H"] / 1e5), ["looks like gauss"]),
        (T.assign(D=D * 0), ["D is 0: the heading is from magnetic north"]),
        (T.assign(heading=H - D), ["as D is -16 deg: the heading is from magnetic north"]),
        (T.assign(heading=H + 180), ["the heading is reciprocal, or the vehicle goes astern"]),
        (T.assign(heading=H + 70), ["the course .* is -70 deg to the right.*check the compass"]),
        (
            T.assign(D=D - 30, heading=H - 30, D_std=OUTAGE_STD),
            ["D is -45 deg from the heading, IGRF's -16: the compass is about -30 deg off; check its axes"],
        ),
        (T.assign(D=25.0, heading=H - D + 25, D_std=OUTAGE_STD), ["the compass is about 25 deg off; check its axes"]),
        (T.assign(distance=T["distance"] * 3), ["0.333 times as far apart .*check the log and its unit"]),
        (T.assign(D=D.where(T.index != 3, 40.0)), ["1 of 15 .*, from row 4 on .D deviates .*: spikes, or iron"]),
        (T.assign(B_H=T["B_H"] + 5000), ["no calibration, iron near the sensor, or a heading that is wrong"]),
        (T.assign(I=T["I"].where(T.index != 0, 0), B_H=T["B_H"].where(T.index != 0, 0)), ["1 of 15"]),
    ],
)
def test_mistakes_are_named(table, texts: list[str]) -> None:
    found = mistakes(table, DATE)
    assert len(found) == len(texts)
    assert all(re.search(*pair) for pair in zip(texts, found, strict=True)), found


@pytest.mark.parametrize("seed", range(4))
def test_iron_is_taken_for_no_mistake(seed: int) -> None:
    """Hard iron of about 800 nT and soft iron of 2 % where D is 3 degrees, on few courses: -D would nearly fit."""
    random, turn = np.random.default_rng(seed), torch.deg2rad(torch.tensor([290.0] * 3 + [335.0] * 3 + [310.0] * 4))
    place = torch.stack((62.5 + 0.1 * torch.arange(10), 6.0 - 0.3 * torch.arange(10)), -1).double()
    attitude = torch.nn.functional.pad(torch.rad2deg(turn)[:, None], (2, 0)).double()
    axes = axes_of_elements(elements_at(IGRF(DATE), place), attitude)
    axes = axes @ (torch.eye(3) + 0.02 * torch.tensor(random.normal(size=(3, 3)))) + torch.tensor(
        random.normal(0, 800, 3)
    )
    table = pandas.DataFrame(elements_of_axes(axes, attitude).numpy(), columns=["D", "I", "B_H"])
    table[["latitude", "longitude"]], table["heading"], table["distance"] = place.numpy(), attitude[:, 2].numpy(), 0.0
    assert all(
        text.endswith(("or a heading that is wrong", "iron near the vehicle there")) for text in mistakes(table, DATE)
    )


def test_the_altitude_counts() -> None:
    """The field of a dipole falls by a sixth over 400 km."""
    low, high = (difference_from_igrf(log().assign(altitude=km), DATE)[:, 2] for km in (0.0, 400.0))
    assert (high - low).mean() == pytest.approx(log()["B_H"].mean() / 6, rel=0.1)


def test_legs_are_compared_without_a_date() -> None:
    (text,) = mistakes(log().assign(D=0.0, heading=log()["heading"] + 180))
    assert text.endswith(": the heading is reciprocal, or the vehicle goes astern")


STEP_S = 3000.0
TIMED = T.assign(row=T.index + 1)
LATITUDE, LONGITUDE = (T[name].where(T.index != 4, 0.0) for name in ("latitude", "longitude"))


@pytest.mark.parametrize(
    ("table", "step_s", "text"),
    [
        (
            TIMED,
            STEP_S / 86400,
            r"row 2: a leg of 20 km in 0\.03.* s is 576000 m/s.*: times must be in seconds",
        ),  # days
        (TIMED.assign(distance=TIMED["distance"].cumsum()), STEP_S, r"row [34]: .* those since the start"),
        (TIMED.assign(latitude=LATITUDE, longitude=LONGITUDE), STEP_S, "row 5: .*: a position of 0, 0 stands for none"),
        (TIMED.assign(distance=TIMED["distance"].where(T.index != 5, 44.0)), 6600, "row 6: .*: the clock jumps there"),
        (TIMED.assign(distance=TIMED["distance"] * 3.28), 600, "row 2: .*: check the units of times, speeds"),
    ],
)
def test_impossible_speeds_are_refused_with_their_cause(table, step_s: float, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        check_speeds(table, np.full(15, step_s))


def test_currents_and_satellites_are_possible() -> None:
    """A ship in a current of 3 m/s, a glider that an eddy carries, an aircraft in the jet stream, a satellite."""
    for factor, step_s in ((1.45, 3000.0), (5.0, 70_000.0), (0.67, 80.0)):
        check_speeds(TIMED.assign(distance=TIMED["distance"] / factor), np.full(15, step_s))
    check_speeds(TIMED.assign(altitude=450.0), np.full(15, 20 / 7.6))


def test_longitudes_to_the_west_are_named() -> None:
    assert mistakes(T.assign(longitude=-T["longitude"]))[0].endswith("longitudes are positive to the west")
