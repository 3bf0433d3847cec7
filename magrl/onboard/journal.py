"""The inputs of a vehicle as declared models: options, start and steps, which together are its saved state; and the
command that it returns.

A number may be one of Python, NumPy or torch; it becomes a finite Python float.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import BeforeValidator, Field, model_validator
from pydantic_core import from_json
from torch import Tensor

from magrl.checks import CheckedModel
from magrl.onboard.integrity import Hypothesis
from magrl.pilot import Rules
from magrl.pilot.belief import CONSTANT, DRIFT, PLACE
from magrl.pilot.displacement import Displacement
from magrl.pilot.records import FARTHEST_START_KM, State
from magrl.sensor_std import OUTAGE_STD, PERFECT, North, SensorStd

LEAST_STD_NT = 0.2
"""Least standard deviation of B_H of a sensor that is not perfect, in any vehicle; chosen [nT]."""
_LAX = Field(strict=False)  # a tuple may be given as a list
Triple = Annotated[tuple[float, float, float], _LAX]
_Altitude = Annotated[float | None, Field(ge=-15, le=1000)]  # of the model


def _plain(value: Any) -> Any:
    """Return scalars and arrays of NumPy and torch as plain numbers and lists."""
    return value.tolist() if hasattr(value, "tolist") else value


def _finite(values: Any) -> bool:
    """Return whether all numbers among texts, numbers and tuples of them are finite."""
    return all(_finite(x) if isinstance(x, tuple) else not isinstance(x, float) or math.isfinite(x) for x in values)


class Inputs(CheckedModel):
    """Take numbers of Python, NumPy and torch.

    Example:
        >>> Inputs()
        Inputs()
    """

    @model_validator(mode="before")
    @classmethod
    def _plain_values(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        return {name: value.tolist() if hasattr(value, "tolist") else value for name, value in values.items()}


def _accuracy(value: Any) -> SensorStd:
    """Return the accuracy given by an argument (three numbers are white noise) or a file.

    Raises:
        ValueError: for a standard deviation that is out of its range, or one of B_H that looks like microtesla.
    """
    whole = isinstance(value, SensorStd) or (isinstance(value, list) and isinstance(value[0], list))
    sensor_std = SensorStd.of(SensorStd(*map(_plain, value)) if whole else value)
    for name, std in sensor_std._asdict().items():
        if max(std[1:] if name == "bias" and sensor_std.magnetic else std) > OUTAGE_STD:
            raise ValueError(f"sensor_std.{name} must be at most {OUTAGE_STD:g}, as in an outage, got {max(std):g}")
        if 0 < std[2] < LEAST_STD_NT:
            raise ValueError(
                f"sensor_std.{name}: {std[2]:g} nT of B_H is less than the {LEAST_STD_NT:g} nT of the best sensors in "
                "a vehicle: it looks like microtesla, and nanotesla are expected; give 0 for a perfect sensor"
            )
    return sensor_std


class Options(Inputs, Rules):
    """Hold the options of :class:`~magrl.onboard.Onboard`: all :class:`~magrl.pilot.Rules`, and the sensors.

    Args:
        arrival: always declared: nothing tells a vehicle that it has arrived.
        model: given to :meth:`~magrl.onboard.Onboard.start`, as are ``start_km`` and ``target_km``.
        north: ``"true"``: headings are from true north, and D is measured; or ``"magnetic"``: they are from magnetic
            north, as of a compass, and D is not measured.
        sensor_std: accuracy of the sensors, a :class:`~magrl.sensor_std.SensorStd`; three numbers are white noise of
            D [deg], I [deg], B_H [nT]. A noise that is not 0 is corrected by what the readings show. The drift is what
            a known start does not show, and what readings average in part.
        speed_km_h: speed at which ``drift`` and ``wander_km`` are stated; needed with hours.
        navigator: name of the navigator; the vehicle writes it.
        weights: digest of its weights; the vehicle writes it.

    Example:
        >>> Options(sensor_std=(0.02, 0.02, 0.002))
        Traceback (most recent call last):
        ValueError: sensor_std.noise: 0.002 nT of B_H is less than the 0.2 nT of the best sensors in a vehicle: it \
looks like microtesla, and nanotesla are expected; give 0 for a perfect sensor
    """

    arrival: Literal["declared"] = "declared"
    model: None = None
    start_km: None = None
    target_km: None = None
    north: North = "true"
    sensor_std: Annotated[SensorStd, BeforeValidator(_accuracy)] = PERFECT
    speed_km_h: Annotated[float | None, Field(gt=0)] = None
    navigator: str = ""
    weights: str = ""

    @property
    def magnetic(self) -> bool:
        """Whether the vehicle has no true north."""
        return self.north == "magnetic"

    @property
    def accuracy(self) -> SensorStd:
        """Accuracy of the sensors; where D is not measured, its error has no limit."""
        if not self.magnetic:
            return self.sensor_std
        return self.sensor_std._replace(bias=(math.inf, *self.sensor_std.bias[1:]))

    def drift_km(self, hours: float, distance: float = 0.0) -> Tensor:
        """Return over which distance dead reckoning drifts in the time of a leg [km].

        Raises:
            ValueError: without a speed, and for times that are not in hours.

        Example:
            >>> Options(speed_km_h=18.0).drift_km(10.0)
            tensor(180., dtype=torch.float64)
        """
        if self.speed_km_h is None:
            raise ValueError(f"hours {hours:g} need the option speed_km_h, at which drift and wander_km are stated")
        far_km = hours * self.speed_km_h
        if hours == 0 < distance or self.drift * far_km > FARTHEST_START_KM:
            text = f"a leg of {distance:g} km, or a drift of {self.drift * far_km:.0f} km, of at most 100 km"
            raise ValueError(f"hours {hours:g} do not fit {text}: give hours since the last call")
        return torch.tensor(far_km, dtype=torch.float64)


class Step(Inputs):
    """Hold the arguments of :meth:`~magrl.onboard.Onboard.step`.

    Example:
        >>> Step(declination=3.5, inclination=None, horizontal_intensity=15000, heading=float("nan"))
        Traceback (most recent call last):
        ValueError: heading must be a finite number, got nan
    """

    CALL: ClassVar[str] = "step"
    declination: float | None
    inclination: float | None
    horizontal_intensity: float | None
    heading: float = Field(ge=-360, le=360)
    distance: float = Field(0.0, ge=0)
    distance_std: float = Field(0.0, ge=0, le=FARTHEST_START_KM)
    heading_std: float = Field(0.0, ge=0, le=180)
    hours: float | None = Field(None, ge=0)
    altitude_km: _Altitude = None

    @property
    def elements(self) -> tuple[float | None, float | None, float | None]:
        """D [deg], I [deg], B_H [nT]; None for one that was not read."""
        return self.declination, self.inclination, self.horizontal_intensity


class Fix(Inputs):
    """Hold the arguments of :meth:`~magrl.onboard.Onboard.fix`.

    Example:
        >>> Fix(latitude=64.1, longitude=-21.9, std_km=0.0)
        Traceback (most recent call last):
        ValueError: std_km must be greater than 0, got 0.0
    """

    CALL: ClassVar[str] = "fix"
    latitude: float = Field(ge=-90, le=90)
    longitude: float = Field(ge=-360, le=360)
    std_km: float = Field(gt=0, le=FARTHEST_START_KM)
    hours: float | None = Field(None, ge=0)


class Destination(Inputs):
    """Hold the arguments of :meth:`~magrl.onboard.Onboard.retarget`.

    Example:
        >>> Destination(target=(64.1, -21.9)).target_km
        0.1
    """

    CALL: ClassVar[str] = "retarget"
    target: Annotated[tuple[float, ...], _LAX]
    target_elements: Triple | None = None
    target_std: Triple | None = None
    target_km: float = Field(0.1, ge=0, le=FARTHEST_START_KM)
    target_altitude_km: _Altitude = None


class Journal(Destination):
    """Hold all inputs of a vehicle since its start, which determine its state with any navigator, and its commands.

    Example:
        >>> import torch
        >>> Journal(options=Options(), target=torch.tensor([-11.5, 75.5, 13240.0])).target
        (-11.5, 75.5, 13240.0)
    """

    format: Literal[19] = 19
    options: Annotated[Options, _LAX]
    start: Annotated[tuple[float, ...], _LAX] | None = None
    start_std: Triple | None = None
    date: str | None = None
    altitude_km: float = 0.0
    model: str | None = None
    start_km: float = Field(0.1, ge=0, le=FARTHEST_START_KM)
    steps: Annotated[tuple[Annotated[Step, _LAX] | Annotated[Fix, _LAX] | Annotated[Destination, _LAX], ...], _LAX] = ()
    commands: Annotated[tuple[dict[str, Any], ...], _LAX] = ()

    @classmethod
    def read(cls, path: Path) -> Journal:
        """Read a file of its JSON.

        Raises:
            ValueError: for anything else, naming what is wrong.
            OSError: if it cannot be read.
        """
        content = path.read_bytes()
        try:
            return cls(**from_json(content))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path} is not the state of a vehicle: {error}") from error


@dataclass(frozen=True)
class Command:
    """Hold the command of a step and the estimates of the destination.

    Args:
        distance_km: length of the leg; 0 to stay and read again.
        turn_deg: turn before the leg, to the right.
        heading_deg: heading after that turn, 0 to 360: what to steer.
        displacement_km: mean of the displacement to the destination, northward and eastward.
        displacement_covariance_km2: its covariance, by rows.
        confidence: estimated probability that the destination is within ``radius_km`` of the options, by all
            hypotheses.
        error_radius_km: radius that holds the destination with the ``confidence`` of the options.
        stop: None, or ``"arrived"``, ``"nearest"`` (these sensors allow no better), ``"lost"`` or ``"out of range"``;
            the distance is then 0.
        reason: why to stop, as text; without a stop, what is not read, or in the first command, what was not checked.
        place: estimated latitude and longitude [deg], where the vehicle knows its start; else None.
        place_covariance_km2: covariance of the place, northward and eastward.
        drift: estimated drift of dead reckoning, such as by a current, northward and eastward [share of the distance;
            with hours, of the speed of the options].
        drift_covariance: its covariance, by rows.
        sensor_errors: estimated constant errors of D [deg], I [deg], B_H [nT], to be subtracted from readings.
        sensor_errors_std: their standard deviations.
        anomaly_weights: probabilities that anomalies here are as large as each of
            :data:`~magrl.pilot.anomalies.SIZES_NT`.
        fit: probability that readings as surprising as the first and the last ones occur if everything stated is true;
            below :data:`~magrl.onboard.doubt.LEAST_FIT`, a vehicle does not say that it has arrived.
        hypotheses: what may be, with its probability and that of an arrival by it: with integrity and a known start
            that start or drift are not as stated (:mod:`magrl.onboard.integrity`).

    Raises:
        ValueError: for a number that is not finite.

    Example:
        >>> Command(30.0, -5.0, 355.0, (90.0, -12.0), ((9.0, 0.0), (0.0, 16.0)), 0.0, 96.0).error_km
        5.0
    """

    distance_km: float
    turn_deg: float
    heading_deg: float
    displacement_km: tuple[float, float]
    displacement_covariance_km2: tuple[tuple[float, float], tuple[float, float]]
    confidence: float
    error_radius_km: float
    stop: str | None = None
    reason: str = ""
    place: tuple[float, float] | None = None
    place_covariance_km2: tuple[tuple[float, float], tuple[float, float]] | None = None
    drift: tuple[float, float] | None = None
    drift_covariance: tuple[tuple[float, float], tuple[float, float]] | None = None
    sensor_errors: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sensor_errors_std: tuple[float, float, float] = (0.0, 0.0, 0.0)
    anomaly_weights: tuple[float, ...] = ()
    fit: float = 1.0
    hypotheses: tuple[Hypothesis, ...] = ()

    def __post_init__(self) -> None:
        if not _finite(vars(self).values()):
            raise ValueError("the estimate is not finite after this leg: check its distance and errors, and the target")

    @property
    def error_km(self) -> float:
        """Root mean square error of the estimated displacement: the root of the trace of its covariance [km]."""
        return math.sqrt(self.displacement_covariance_km2[0][0] + self.displacement_covariance_km2[1][1])

    @property
    def axes(self) -> tuple[float, float, float]:
        """Standard deviations along the long axis of the displacement's ellipse and across it [km], and its direction.

        The direction is from 0 to 180 [deg]. A long ellipse is a line on which the destination is.
        """
        moments = self.displacement_km, self.displacement_covariance_km2
        along, across, bearing = Displacement(*map(torch.tensor, moments)).axes()
        return along.item(), across.item(), bearing.item()


def estimates_of(state: State, located: bool) -> dict[str, Any]:
    """Return the values of a :class:`Command` that a state holds: sizes of anomalies, constant errors of the sensors,
    and place and drift where the vehicle knows its place."""
    mean, covariance, place = state.belief
    found: dict[str, Any] = {"anomaly_weights": tuple(state.log_weight.exp().tolist())}
    found["sensor_errors"] = tuple(mean[CONSTANT].tolist())
    found["sensor_errors_std"] = tuple(covariance[CONSTANT, CONSTANT].diagonal().sqrt().tolist())
    if located:
        found |= {"place": tuple(place.tolist()), "drift": tuple(mean[DRIFT].tolist())}
        for name, part in {"place_covariance_km2": PLACE, "drift_covariance": DRIFT}.items():
            found[name] = tuple(map(tuple, covariance[part, part].tolist()))
    return found
