"""Replay the log of a vehicle: what a navigator would have commanded at each point, and what it estimated.

    python recipes/replay_log.py docs/examples/log.csv --noise 0.02 0.02 2
    python recipes/replay_log.py track.csv --target -11.6 75.4 13240 --navigator kalman
    python recipes/replay_log.py track.csv --declination dec_deg --horizontal H_nT
    python recipes/replay_log.py track.csv --north magnetic --noise 0 0.1 20     # as a vehicle without true north

Each row of the log holds a reading of D [deg], I [deg], B_H [nT], and the heading [deg] and the length [km] of the leg
since the row before; in the first row, the length is 0. The destination is the last row, unless --target gives
its elements. With --north magnetic, D only converts the headings: the navigator gets I, B_H and headings from
magnetic north, whatever the north of the log is. Where the log has positions, the estimates are compared with them; the
navigator does not read them, but for the first one with --start-km.
Writes log.csv, log.md and log.png.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import magrl.interrupts  # noqa: F401 - before what takes seconds
from magrl.agents import load_policy
from magrl.evaluation.tables import markdown_table
from magrl.field.elements import NAMES
from magrl.files import check_writable, write_text, write_with
from magrl.geodesy import check_positions, geodesic
from magrl.sensor_std import OUTAGE_STD, SensorStd
from magrl.tracking.displacement import Displacement
from magrl.training import UsageError, command, parse
from magrl.vehicle.logs import difference_from_igrf, mistakes, read_readings
from magrl.vehicle.onboard import Onboard

import numpy as np
import pandas as pd
import torch
import tyro
from matplotlib.figure import Figure

RECIPE = "replay_log.py"
ELEMENTS, PLACE = [*NAMES], ("latitude", "longitude")
OPTIONS = {"D": "declination", "I": "inclination", "B_H": "horizontal"}
"""Options that name the columns of the elements."""
COMMANDED = ["leg_km", "turn_deg", "steer_deg", "north_km", "east_km", "error_km", "confidence", "stop", "covariance"]
"""Columns of what the navigator would have commanded and estimated."""
SHORT_KM = 5.0
"""Median length of the legs below which readings should be averaged [km]."""
FORMATS = {"confidence": "{:.2f}", "row": "{:.0f}", "time": "{}", "stop": "{}"}
"""Formats of the columns of log.md that do not have one decimal."""


@dataclass(frozen=True)
class Config:
    """Log, names of its columns, navigator and destination."""

    log: tyro.conf.Positional[Path]
    """Log of the vehicle: a CSV file with a header."""
    navigator: str = "anywhere"
    """Navigator: anywhere (the pretrained agent), secant, kalman, or a policy file (.safetensors, .onnx)."""
    target: tuple[float, float, float] | None = None
    """Elements at the destination, D [deg], I [deg], B_H [nT]; by default from the last row."""
    target_position: tuple[float, float] | None = None
    """Latitude, longitude of the destination [deg], for comparison and --start-km; without --target the last ones."""
    north: Literal["true", "magnetic"] = "true"
    """North of the vehicle: true (D is measured), or magnetic (it has a compass, and D is not used)."""
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviations of the noise on D [deg], I [deg], B_H [nT]."""
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviations of constant and slow errors of D [deg], I [deg], B_H [nT]."""
    radius_km: float = 25.0
    """Arrival radius around the destination [km]."""
    date: str | None = None
    """Date of the log, for IGRF; by default from the column of the time, if it has dates."""
    start_km: float | None = None
    """Accuracy of the first position [km]: the navigator then knows this one, and the destination's."""
    model: str = "IGRF-14"
    """Model of the Earth that it then carries."""
    time: str = "time"
    """Column of the time, seconds or ISO 8601; optional."""
    declination: str = "D"
    """Column of the declination [deg]."""
    inclination: str = "I"
    """Column of the inclination [deg]."""
    horizontal: str = "B_H"
    """Column of the horizontal intensity [nT]."""
    heading: str = "heading"
    """Column of the heading of the leg from the previous row [deg]."""
    distance: str = "distance"
    """Column of the length of the leg from the previous row [km]; without it, the speed counts."""
    speed: str = "speed"
    """Column of the mean speed since the previous row [m/s]."""
    latitude: str = "latitude"
    """Column of the true latitude [deg]; optional, together with the longitude."""
    longitude: str = "longitude"
    """Column of the true longitude [deg]."""
    altitude: str = "altitude"
    """Column of the altitude [km], at which readings are compared with IGRF; optional, by default sea level."""
    out: Path = Path("runs/replay_log")
    """Folder of log.csv, log.md and log.png, which are replaced."""


def read_log(config: Config) -> pd.DataFrame:
    """Return the columns of the log, see :func:`magrl.vehicle.logs.read_readings`."""
    keys = (*ELEMENTS, "heading", "distance", "speed", *PLACE, "altitude")
    names = {key: getattr(config, OPTIONS.get(key, key)) for key in keys}
    log = read_readings(config.log, names, config.time)
    log.attrs["date"] = config.date or log.attrs["date"]
    return log


def started(config: Config, log: pd.DataFrame, date: str | None) -> Onboard:
    """Return the navigator at its start, with what it knows.

    Raises:
        ValueError: for a known start without positions or without a date.
    """
    own = Path(config.navigator).suffix == ".onnx"
    navigator = load_policy(config.navigator) if own else config.navigator
    options = {"north": config.north, "max_steps": len(log) + 1, "radius_km": config.radius_km}
    board = Onboard(navigator, sensor_std=SensorStd(config.noise, config.bias), **options)
    target, told = config.target or log[ELEMENTS].iloc[-1].tolist(), {}
    if config.start_km is not None:
        if "latitude" not in log or date is None:
            raise ValueError(f"start_km {config.start_km:g} needs positions in the log and a date: give --date")
        first, *_, last = log[[*PLACE]].to_numpy(dtype=float).tolist()
        target = config.target or config.target_position or last
        told = {"start": first, "start_km": config.start_km, "date": date, "model": config.model}
        told["altitude_km"] = log["altitude"][0] if "altitude" in log else 0.0
    board.start(target, **told)
    return board


def replay(config: Config, log: pd.DataFrame, date: str | None = None) -> pd.DataFrame:
    """Return what the navigator would have commanded and estimated after each row, beside the row itself, and the
    direction of its north from true north, ``north_deg``.

    Raises:
        UsageError: for a row that no vehicle can have recorded, with its number.
    """
    board, magnetic = started(config, log, date), config.north == "magnetic"
    commands, north = [], log["D"].shift(1, fill_value=log["D"][0]) * magnetic  # of headings, from the log's
    for (_, row), east in zip(log.iterrows(), north, strict=True):
        heading = math.remainder(row["heading"] - east, 360)
        try:
            declination = None if magnetic else row["D"]
            order = board.step(declination, row["I"], row["B_H"], heading, row["distance"])
        except ValueError as error:
            raise UsageError(f"row {row['row']:.0f} of {config.log}: {error}") from error
        row = (order.distance_km, order.turn_deg, order.heading_deg, *order.displacement_km)
        estimated = order.error_km, order.confidence
        commands.append((*row, *estimated, order.stop or "", order.displacement_covariance_km2))
    table = pd.concat((log.reset_index(drop=True), pd.DataFrame(commands, columns=COMMANDED)), axis=1)
    return table.assign(north_deg=vehicle_north(log, date).numpy() * magnetic)


def with_truth(config: Config, table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with the true displacement and the error of the estimate, where both are known."""
    if "latitude" not in table or (config.target is not None and config.target_position is None):
        return table
    place = torch.tensor(table[["latitude", "longitude"]].to_numpy(dtype=float))
    target = place[-1] if config.target_position is None else torch.tensor(config.target_position, dtype=torch.float64)
    check_positions(*place.unbind(-1))
    check_positions(*target)
    distance, bearing = geodesic(*place.unbind(-1), *target.expand_as(place).unbind(-1))
    bearing = bearing - torch.deg2rad(torch.tensor(table["north_deg"].to_numpy(dtype=float)))
    north, east = ((distance * wave(bearing)).numpy() for wave in (torch.cos, torch.sin))
    miss = np.hypot(table["north_km"] - north, table["east_km"] - east)
    return table.assign(true_north_km=north, true_east_km=east, miss_km=miss)


def vehicle_north(log: pd.DataFrame, date: str | None) -> torch.Tensor:
    """Return the direction of magnetic north ``(T,)`` [deg]: of IGRF, or without positions and date as logged."""
    if date is None or "latitude" not in log:
        return torch.tensor(log["D"].to_numpy(dtype=float))
    return torch.tensor(log["D"].to_numpy(dtype=float)) - difference_from_igrf(log, date)[:, 0]


def last_displacement(table: pd.DataFrame) -> Displacement:
    """Return the estimate after the last row."""
    last = table.iloc[-1]
    return Displacement(torch.tensor([last["north_km"], last["east_km"]]), torch.tensor(last["covariance"]))


def figure(table: pd.DataFrame, title: str) -> Figure:
    """Return a figure of the estimated and the true distance to the destination."""
    drawn = Figure(layout="constrained")
    axes = drawn.subplots()
    travelled, error = table["distance"].cumsum(), table["error_km"].to_numpy(dtype=float)
    distance = np.hypot(table["north_km"], table["east_km"])
    axes.plot(travelled, distance, "o-", color="#0072B2", markersize=3, label="estimated")
    axes.fill_between(travelled, np.maximum(distance - error, 0), distance + error, alpha=0.2, label="± error")
    if "miss_km" in table:
        axes.plot(travelled, np.hypot(table["true_north_km"], table["true_east_km"]), "k--", label="true")
        axes.plot(travelled, table["miss_km"], color="#D55E00", label="error of the estimate")
    limits = {"ylim": (0, 1.3 * distance.max()), "title": title}
    axes.set(xlabel="distance moved [km]", ylabel="distance to the destination [km]", **limits)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return drawn


def markdown(table: pd.DataFrame) -> str:
    """Return the table with rounded numbers."""
    hidden = [*ELEMENTS, *PLACE, "altitude", "covariance", "north_deg"]
    shown = table.drop(columns=hidden, errors="ignore")
    text = shown.apply(lambda column: column.map(FORMATS.get(column.name, "{:.1f}").format))
    return markdown_table(list(shown), text.to_numpy())


def notes(table: pd.DataFrame) -> list[str]:
    """Return notes on the table: warnings, the first stop, and errors of the estimate."""
    lines = []
    heading = table["heading"]
    if heading.abs().max() <= 2 * math.pi and heading.max() - heading.min() > 0.5:
        span = f"{heading.min():g} to {heading.max():g}"
        lines.append(f"Warning: all headings are {span} deg. If these are radians, convert them to degrees.")
    if (length := table["distance"][1:].median()) < SHORT_KM:
        lines.append(f"Warning: legs are {length:.2g} km long. Average readings over some 20 km, or errors add up.")
    stops = table[table["stop"] != ""]
    if len(stops):
        lines.append(f"First stop: {stops['stop'].iloc[0]}, at row {stops['row'].iloc[0]} of the log.")
    if "miss_km" in table:
        halfway, end = table[["miss_km", "error_km"]].iloc[[len(table) // 2, -1]].to_numpy(float)
        text = "Error of the estimated displacement {}: {:.1f} km; stated {:.1f} km.".format
        lines += [text("halfway", *halfway), text("at the end", *end)]
    return [*lines, f"The destination is estimated to {last_displacement(table).ellipse()}."]


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line, replay the log, write the files and print the table.

    Raises:
        UsageError: for a log or a setting that is wrong.
    """
    config = parse(Config, RECIPE, __doc__, args)
    try:
        log = read_log(config)
        for name in ("log.csv", "log.md", "log.png"):
            check_writable(config.out / name)
        table = with_truth(config, replay(config, log, log.attrs["date"]))
        checked = log.assign(D_std=OUTAGE_STD * (config.north == "magnetic"))
        warnings = log.attrs["notes"] + mistakes(checked, log.attrs["date"])
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    write_with(config.out / "log.csv", table.drop(columns="covariance").to_csv, index=False)
    lines = [markdown(table), "", *notes(table), *(f"Warning: {text}." for text in warnings), ""]
    write_text(config.out / "log.md", "\n".join(lines))
    write_with(config.out / "log.png", figure(table, f"{config.log.name}: {config.navigator}").savefig, dpi=110)
    print(*lines, f"The picture is {config.out / 'log.png'}", sep="\n")


if __name__ == "__main__":
    command(RECIPE, main)
