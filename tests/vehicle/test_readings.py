"""Readings as means of samples, the standard deviation of a mean of correlated noise, and mistakes beside IGRF."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pandas
import pytest
import torch

from magrl.field import IGRF, elements_at
from magrl.geodesy import move
from magrl.sensor_std import OUTAGE_STD
from magrl.vehicle.logs import (
    Calibration,
    Log,
    axes_of_elements,
    difference_from_igrf,
    elements_of_axes,
    mistakes,
    readings_of,
)


def sailed(count: int = 6000, noise: np.ndarray | None = None, **columns) -> Log:
    """A vehicle that goes at 30 degrees at 60 km/h, one sample a second, through a field that changes by 1 nT/km."""
    time = np.arange(count, dtype=float)
    elements = torch.tensor([[10.0, 60.0, 20000.0]]).double().repeat(count, 1)
    elements[:, 2] += torch.tensor(time / 60)
    attitude = torch.tensor([[5.0, -3.0, 30.0]]).double().expand(count, 3)
    axes = axes_of_elements(elements, attitude).numpy() + (0 if noise is None else noise)
    table = dict(zip(("x", "y", "z", "roll", "pitch", "heading"), (*axes.T, *attitude.T.numpy()), strict=True))
    return Log(pandas.DataFrame({"time": time, **table} | (columns or {"speed": 60 / 3.6})), "by hand", "true")


def test_a_reading_is_that_at_its_place() -> None:
    table = readings_of(sailed(), every_km=20.0)
    assert table["distance"].tolist() == pytest.approx([0, 20, 20, 20, 20], abs=0.05)
    assert table["heading"].tolist() == pytest.approx([30] * 5)
    middle = (table["time"] / 60 + 1 / 60).to_numpy()  # km from the start
    assert table["B_H"].to_numpy() - 20000 == pytest.approx(middle, abs=0.05)
    assert table[["D", "I"]].to_numpy() == pytest.approx(np.tile((10.0, 60.0), (5, 1)), abs=1e-6)
    assert table["samples"].sum() == 6000
    assert len(readings_of(sailed(6540), every_km=20.0)) == 5  # a short last part is joined to the one before


@pytest.mark.parametrize("motion", ["distance", "speed", "positions"])
def test_distances_speeds_or_positions(motion: str) -> None:
    way = np.arange(6000)[:, None] / 60 * np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)]) / (110.57, 111.32)
    known = {"distance": np.r_[0, np.full(5999, 1 / 60)]}
    known = known if motion == "distance" else {"speed": 60 / 3.6}
    if motion == "positions":
        known = {"latitude": way[:, 0], "longitude": 179.9 + way[:, 1]}
    table = readings_of(sailed(**known), every_km=20.0)
    assert table["distance"][1:].tolist() == pytest.approx([20] * 4, abs=0.15)
    assert table["heading"].tolist() == pytest.approx([30] * 5, abs=0.3)
    if motion == "positions":
        assert table["longitude"].iloc[[0, -1]].tolist() == pytest.approx([179.94, -179.7], abs=0.01)


def test_the_altitude_is_a_mean_and_not_an_angle() -> None:
    table = readings_of(sailed(speed=60 / 3.6, altitude=np.repeat([0.0, 400.0], 3000)), every_km=25.0)
    assert table["altitude"].tolist() == pytest.approx([0, 0, 400, 400], abs=1)


def test_spikes_do_not_count() -> None:
    noise = np.random.default_rng(0).normal(0, 30, (6000, 3))
    noise[::100] = 30000
    table = readings_of(sailed(noise=noise), every_km=20.0)
    assert table["spikes"].sum() == 60
    assert abs(table["B_H"] - 20000 - table["time"] / 60).max() < 5


def test_the_standard_deviation_of_correlated_noise() -> None:
    """Noise that lasts 10 s: that of independent noise would be too small by a factor of 4.5."""
    squares, white = [], []
    for seed in range(10):
        normal = np.random.default_rng(seed).normal(0, 30 * np.sqrt(1 - 0.905**2), (6000, 3))
        noise = np.zeros((6000, 3))
        for row in range(1, 6000):
            noise[row] = 0.905 * noise[row - 1] + normal[row]
        table = readings_of(sailed(noise=noise), every_km=20.0)
        error = table["B_H"] - 20000 - (table["time"] + 1) / 60
        squares.append((error / table["B_H_std"]) ** 2)
        white.append((error / (30 / np.sqrt(1200))) ** 2)
    assert 0.8 < np.mean(squares) < 1.25
    assert np.mean(white) > 10


def test_the_standard_deviation_of_few_samples() -> None:
    """That of white noise, 30 / sqrt(n), and unknown below three samples."""
    for count in (3, 5, 19, 20):
        noise = np.random.default_rng(count).normal(0, 30, (200 * count, 3))
        std = readings_of(sailed(200 * count, noise), every_km=count / 60 - 1e-6)["B_H_std"]
        assert np.sqrt((std**2).mean()) == pytest.approx(30 / np.sqrt(count), rel=0.2)
    assert readings_of(sailed(200, noise[:200]), every_km=2 / 60 - 1e-6)["B_H_std"].isna().all()


def test_a_magnetic_heading_and_a_calibration() -> None:
    one, options = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), {"noise_nt": 0.0, "samples": 9, "outliers": 0.0}
    options |= {"method": "vector", "std": (0.1, 0.1, 9.0), "here": (0.0, 0.0)}
    iron = Calibration(matrix=one, offset_nt=(300.0, 0.0, 0.0), **options)
    corrected = readings_of(sailed(noise=np.array([[300.0, 0.0, 0.0]])), calibration=iron)
    assert corrected["D"].tolist() == pytest.approx([10] * 5, abs=1e-6)
    for north in ("magnetic", "model"):
        assert (readings_of(sailed(), north=north)["D_std"] == OUTAGE_STD).all()


def test_a_log_without_a_heading_has_that_of_its_compass() -> None:
    """The field's own direction, leveled: the heading from true north less D, which then reads 0."""
    whole = readings_of(sailed(), north="true")
    alone = readings_of(Log(sailed().samples.drop(columns="heading"), "by hand"))
    assert (alone["D_std"] == OUTAGE_STD).all()
    assert alone["D"].abs().max() < 1e-6
    turned = (whole["heading"] - whole["D"] - alone["heading"] + 180) % 360 - 180
    assert turned[1:].abs().max() < 0.05
    assert alone["I"].tolist() == pytest.approx(whole["I"].tolist())


def test_a_log_that_lacks_something_is_refused() -> None:
    """Each column and the north, as far as they are needed, and a wrong option."""
    whole = sailed(100).samples
    cases = {"the log has no heading": "heading", "neither distances nor speeds": "speed", "no x": "x"}
    for message, column in cases.items():
        with pytest.raises(ValueError, match=message):
            readings_of(Log(whole.drop(columns=column), "by hand", "true"), north="true")
    wrong = {"the north of": {}, "grid": {"north": "grid"}, "every_km": {"north": "true", "every_km": 0.0}}
    for message, options in wrong.items():
        with pytest.raises(ValueError, match=message):
            readings_of(Log(whole, "by hand"), **options)


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


def test_moves_are_compared_without_a_date() -> None:
    (text,) = mistakes(log().assign(D=0.0, heading=log()["heading"] + 180))
    assert text.endswith(": the heading is reciprocal, or the vehicle goes astern")
