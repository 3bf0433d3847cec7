"""Read the log of a vehicle: what it holds, beside IGRF, and readings of D, I, B_H for a replay.

    python -m magrl.vehicle.logs swing.csv --calibrate quay.json --here 60.4 5.3 --date 2026-06-30    # a swing
    python -m magrl.vehicle.logs way.csv --calibration quay.json --every-km 20          # writes way_readings.csv
    python recipes/replay_log.py way_readings.csv                                       # what would be commanded

Logs are CSV files, or recorded by autopilots and ships (docs/logs.md).
Axes are forward, right, down; angles are roll, pitch, heading.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas
from pandas import DataFrame

from magrl.checks import command, printable
from magrl.field.elements import NAMES
from magrl.files import check_writable, write_with
from magrl.sensor_std import OUTAGE_STD
from magrl.vehicle.logs.calibration import Calibration, calibrate
from magrl.vehicle.logs.conventions import NORTHS
from magrl.vehicle.logs.readers import read_log
from magrl.vehicle.logs.readings import STD_NAMES, difference_from_igrf, mistakes, readings_of
from magrl.vehicle.logs.samples import ATTITUDE, AXES, Log, total_intensity

_DIGITS = {"time": 2, "D": 4, "I": 4, "B_H": 2, "heading": 3, "distance": 4, "latitude": 6, "longitude": 6}
_DIGITS |= {"altitude": 4, "D_std": 4, "I_std": 4, "B_H_std": 2}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    arguments = argparse.ArgumentParser(
        prog="python -m magrl.vehicle.logs", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = arguments.add_argument
    add("log", type=Path, nargs="+", help="log of the vehicle: one file, or several with one clock")
    add("--sensor", help="magnetometer of PX4, ArduPilot or ROS; default a calibrated one in use")
    add("--north", choices=NORTHS, help="north of the heading; default from the log")
    add("--every-km", type=float, default=20.0, help="minimum length of a leg [km]; default 20")
    add("--calibration", type=Path, help="file of a calibration, which corrects the axes")
    add("--calibrate", type=Path, help="calibration to write (.json), of the swing in this log")
    add("--here", type=float, nargs="+", help="place of the swing: latitude, longitude, or D, I, B_H")
    add("--alignment-deg", type=float, default=0.5, help="misalignment of the axes [deg]; default 0.5")
    add("--date", help="date for IGRF, such as 2026-06-30; default from the log")
    add("--out", type=Path, help="readings (.csv); default beside the first file, with _readings")
    return arguments


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and the log, and print the results."""
    command("python -m magrl.vehicle.logs", lambda: _main(parser().parse_args(args)), ValueError, ImportError)


def _main(options: argparse.Namespace) -> None:
    log = read_log(*options.log, sensor=options.sensor)
    notes = [*log.notes, *([] if options.calibrate else remarks(log, options))]
    print(*map(printable, (*summary(log), *(f"note: {text}" for text in notes))), sep="\n", flush=True)
    date = options.date or log.date
    print(*map(printable, (swing if options.calibrate else way)(log, options, date)), sep="\n")


def summary(log: Log) -> list[str]:
    """Return what a log holds: source, columns, duration, rate, and field."""
    samples = log.samples
    time = samples["time"].to_numpy(float)
    rate = f"{1 / np.median(np.diff(time)):.3g} Hz" if len(time) > 1 else "one sample"
    total = total_intensity(samples)
    return [
        f"{log.source}: {len(samples)} samples in {time[-1] - time[0]:.4g} s, {rate}, date {log.date or 'unknown'}",
        f"columns: {', '.join(samples)}; north of the heading: {log.north or 'not stated'}",
        f"total intensity as logged: {total.median():.0f} nT, from {total.min():.0f} to {total.max():.0f}",
    ]


def remarks(log: Log, options: argparse.Namespace) -> list[str]:
    """Return what makes readings less accurate and does not prevent them, with the remedy."""
    texts = []
    if missing := " and ".join(name for name in ATTITUDE[:2] if name not in log.samples):
        texts.append(f"no {missing}: the vehicle is taken as level, and I is wrong by up to its tilt; log both angles")
    if not options.calibration:
        texts.append("no calibration: iron remains, unless the autopilot corrected it; swing, and give --calibration")
    return texts


def _north(log: Log, options: argparse.Namespace) -> str | None:
    """Return the north of the heading; without a heading it is magnetic."""
    return (options.north or log.north) if "heading" in log.samples else "magnetic"


def swing(log: Log, options: argparse.Namespace, date: str | None) -> list[str]:
    """Calibrate by a log, write the file and return the quality of the calibration."""
    here = options.here
    if here is None:
        if "latitude" not in log.samples:
            raise ValueError("the log has no position: state the place of the swing by --here, such as --here 60.4 5.3")
        here = log.tensor("latitude", "longitude").median(0).values.tolist()
    attitude = log.tensor(*ATTITUDE) if _north(log, options) == "true" else None
    axes, alignment = log.tensor(*AXES), options.alignment_deg
    calibration = calibrate(axes, here, date=date, attitude_deg=attitude, alignment_deg=alignment)
    check_writable(options.calibrate)
    calibration.save(options.calibrate)
    offset = "{:.0f}, {:.0f}, {:.0f} nT".format(*calibration.offset_nt)
    return [
        f"calibration by {calibration.method}: hard iron {offset}, residuals {calibration.noise_nt:.0f} nT, "
        f"{100 * calibration.outliers:.1f} % outliers",
        f"remaining standard deviations: {_elements(calibration.std)}",
        f"calibration: {options.calibrate}",
    ]


def way(log: Log, options: argparse.Namespace, date: str | None) -> list[str]:
    """Write the readings of a log, and return them beside IGRF, with the likely mistakes."""
    iron = Calibration.load(options.calibration) if options.calibration else None
    table = readings_of(log, every_km=options.every_km, north=options.north, calibration=iron)
    lines = [f"first reading: {_elements(table.iloc[0][list(NAMES)])}; {int(table['spikes'].sum())} spikes left out"]
    if "latitude" in table and date:
        mean = difference_from_igrf(table, date).mean(0)
        lines.append(f"minus IGRF of {date}, mean of {len(table)}: {_elements(mean)}")
    lines += [f"warning: {text}" for text in mistakes(table, date)]
    if len(table) < 2:
        return [*lines, "one reading: no file is written; choose shorter legs by --every-km"]
    return [*lines, *_written(table, log, options, iron)]


def _written(table: DataFrame, log: Log, options: argparse.Namespace, iron: Calibration | None) -> list[str]:
    """Write readings, and return the file and the command of a replay."""
    out = options.out or options.log[0].with_name(f"{options.log[0].stem}_readings.csv")
    check_writable(out)
    stamp = pandas.to_datetime(table["time"], unit="s", utc=True).dt.strftime("%Y-%m-%dT%H:%M:%SZ")
    rounded = table.round(_DIGITS).assign(**({"time": stamp} if log.date else {}))
    write_with(out, rounded.to_csv, index=False)
    std = np.sqrt(np.square(table[list(STD_NAMES)]).mean()).replace(OUTAGE_STD, 0.0)  # of D that is not measured
    noise, bias = (" ".join(f"{value:.3g}" for value in values) for values in (std, iron.std if iron else np.zeros(3)))
    missing = "" if iron else "; no calibration: give --bias of your sensors"
    magnetic = "" if _north(log, options) == "true" else " --north magnetic"
    return [
        f"{len(table)} readings, legs of {table['distance'][1:].mean():.3g} km: {out}",
        f"replay: python recipes/replay_log.py {out}{magnetic} --noise {noise} --bias {bias}{missing}",
    ]


def _elements(values: Iterable[float]) -> str:
    return "D {:.2f} deg, I {:.2f} deg, B_H {:.0f} nT".format(*values)


if __name__ == "__main__":
    main()
