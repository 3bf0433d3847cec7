"""Navigation on board one vehicle: plain numbers in, a command out, without an environment.

Angles are in degrees, clockwise from the vehicle's north, true or magnetic, distances in kilometers, and intensities in
nanotesla.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from magrl import tracking
from magrl.agents import FieldPolicy, kalman, load_pretrained
from magrl.checks import check_type
from magrl.envs.geomagnetic import PUBLIC_KEYS
from magrl.field.elements import NAMES
from magrl.navigators import Secant
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import ArrivalDecision, Way
from magrl.transforms import TrackView
from magrl.transforms.errors.known_start import START_KEYS
from magrl.transforms.errors.sensors import OUTAGE_STD
from magrl.vehicle.onboard.command import Command
from magrl.vehicle.onboard.estimator import Estimator
from magrl.vehicle.onboard.journal import Journal, Options, Step
from magrl.vehicle.onboard.limits import check_move, measured, move_limits, out_of_range, stuck, unchanged_km, view_of
from magrl.vehicle.onboard.readings import (
    EQUATOR_SLOPE_DEG,
    check_earth_distance,
    check_earth_jump,
    check_earth_reading,
)
from magrl.vehicle.onboard.start import Elements, calibrated, check_start, known_elements, nearby_elements

NAMED = ("anywhere", "secant", "kalman")
"""Navigators by name; any other is given as a module."""
LONGEST_WAY_KM = 2500.0
"""Estimated way beyond which an agent without a map is out of range: there its observation of the way saturates."""
LOST_SURPRISE = 20.0
"""Mean of the last surprises (:meth:`Estimator.surprise`) beyond which the readings contradict each other. With the
right accuracy, it stayed below 7 in simulation, under the conditions of four vehicles."""
Values = tuple[float, ...]
_SURPRISES, _LEAST_SURPRISES = 8, 2
_UNCHECKED = {
    "true": "the sign of D and the compass were not checked: give here or near in start",
    "magnetic": "the compass was not checked: give here or near in start",
}
_NOT_STARTED = "the vehicle has no destination yet: call start(target) first"


class Onboard:
    """A navigator on board one vehicle.

    :meth:`start` takes the elements at the destination. The first :meth:`step` takes the reading at the start, every
    later one what the vehicle did since the last step by its own log and compass, and the reading at the end of that
    move. Each returns a :class:`Command`. A call that raises an error changes nothing: repeat it with right values.

    Args:
        navigator: ``"anywhere"`` for the pretrained agent, ``"secant"`` or ``"kalman"``; or a policy from
            :func:`magrl.load_policy`, or a navigator, of which the vehicle gets a copy.
        options: those of :class:`~magrl.vehicle.onboard.journal.Options`.

    Raises:
        ValueError: for an option out of its range, an unknown navigator, one that reads more than the vehicle knows,
            or moves that are shorter than those of a trained policy.

    Example:
        >>> vehicle = Onboard("secant", sensor_std=(0.02, 0.02, 2.0))
        >>> vehicle.start((-11.6, 75.4, 13240.0))
        >>> command = vehicle.step(3.5, 73.0, 15000.0, heading=290.0)
        >>> round(command.distance_km, 1), command.heading_deg, command.stop
        (6.1, 290.0, None)
        >>> round(vehicle.step(3.4, 73.0, 14995.0, heading=290.0, distance=6.0).turn_deg, 3)
        90.0
    """

    target: Any = None
    """Elements at the destination; None before :meth:`start`."""

    def __init__(self, navigator: str | TensorDictModuleBase = "anywhere", **options: Any) -> None:
        check_type((str, TensorDictModuleBase), navigator=navigator)
        given = Options(**options)
        source = load_pretrained("anywhere") if navigator == "anywhere" else navigator
        policy = None if isinstance(source, str) else source
        self.max_move_km, self.max_turn_deg = move_limits(policy, given.max_move_km, given.max_turn_deg)
        self.options, self._sensor_std = given, given.accuracy
        if isinstance(policy, FieldPolicy) and isinstance(view_of(policy), TrackView):  # nothing signals the arrival
            policy = policy.adapted(search=False, max_steps=given.max_steps)
        self._source = source if policy is None else copy.deepcopy(policy).cpu()
        self.navigator = self._new_navigator()
        name, weights = type(self.navigator).__name__, self.navigator.state_dict().values()
        content = b"".join(value.cpu().numpy().tobytes() for value in weights if isinstance(value, torch.Tensor))
        resolved = {"max_move_km": self.max_move_km, "max_turn_deg": self.max_turn_deg, "navigator": name}
        self.options = given.replace(**resolved, weights=hashlib.sha256(content).hexdigest())
        if unknown := sorted({*map(str, self.navigator.in_keys)} - {*PUBLIC_KEYS, *STD_KEYS, "elapsed_steps", "done"}):
            raise ValueError(f"{name} reads {', '.join(unknown)}, which a vehicle does not know")
        self._view, self._estimator = view_of(self.navigator), Estimator(self.navigator)

    def _new_navigator(self) -> Any:
        """Return the navigator before its first step."""
        if not isinstance(self._source, str):
            return copy.deepcopy(self._source)
        options, bounds = self.options, (self.max_move_km, math.radians(self.max_turn_deg))
        if self._source == "secant":
            elements = NAMES[1:] if options.magnetic else NAMES
            return Secant(*bounds, elements=elements, sensor_std=self._sensor_std)
        if self._source == "kalman":
            limits = {"max_move_km": bounds[0], "max_turn_rad": bounds[1], "max_steps": options.max_steps}
            return kalman(**limits, search=False)
        raise ValueError(f"unknown navigator {self._source!r}: choose from {', '.join(NAMED)}, or give a policy")

    def start(
        self,
        target: Sequence[float | None],
        here: Sequence[float] | None = None,
        *,
        here_std: Sequence[float] | None = None,
        near: Sequence[float] | None = None,
        date: str | None = None,
    ) -> None:
        """Begin an episode to a destination given by its elements: D [deg], I [deg], B_H [nT].

        Where the start is known, the first reading shows the constant errors of the sensors, which are subtracted from
        all readings (:func:`magrl.transforms.calibration`); and a reading that does not fit the place raises an error.

        Args:
            target: elements of the destination; D does not count where the vehicle's north is magnetic, and may be
                None.
            here: elements at the start; or its latitude and longitude [deg], with a ``date``.
            here_std: standard deviations of the elements at the start: by default 0 for elements, and for a position
                those of a model of the core (:data:`magrl.vehicle.onboard.start.MODEL_STD`).
            near: latitude and longitude [deg] of the start, known to 200 km; it serves only to check the
                first reading and the distance of the target.
            date: date for a position, such as ``"2026-06-30"``.

        Raises:
            ValueError: for elements that are not possible on the Earth, or beyond the range of the policy.
        """
        target = self._comparable(target) if len(target) == 3 else target
        given: dict[str, Any] = {"target": target, "here": here, "here_std": here_std, "near": near, "date": date}
        journal = Journal(options=self.options, **given)
        check_earth_reading(*journal.target, what="the target")
        if text := out_of_range(self._view, journal.target):
            raise ValueError(f"the target: {text}")
        here, near, goal = journal.here, journal.near, journal.target
        nearby = None if near is None else nearby_elements(near, date, goal, self._longest_way())
        elements = None if here is None else known_elements(here, journal.here_std, date)
        self._near = nearby and (self._comparable(nearby[0]), nearby[1])
        self._here = elements and (self._comparable(elements[0]), elements[1])
        self._journal, self.target = journal, goal
        self._error, self._sensor_std = self._calibrated()
        self.navigator = self._new_navigator()
        self._estimator = Estimator(self.navigator)
        self._steps: tuple[Step, ...] = ()
        self._last_command: Command | None = None
        self._raw: tuple[Any, ...] = (None, None, None)  # the last reading, without calibration
        self._last, self._surprises = Values(), Values()  # the last reading with its course
        self._unchanged = (0.0, 0.0, 0.0)  # path since each element last changed [km]
        self._unread_km = 0.0  # path since the last complete reading
        self._radians = Values()  # commanded headings that were reported in radians
        self._northward = Values()  # the first inclination, and how far magnetic north the vehicle has come [km]

    def step(
        self,
        declination: float | None,
        inclination: float | None,
        horizontal_intensity: float | None,
        heading: float,
        distance: float = 0.0,
        time: float | None = None,
    ) -> Command:
        """Return what to do after a move.

        An element that could not be read is None: the vehicle goes on by dead reckoning. From magnetic north, D is
        always None, and the heading of a move is that at its start. A way that is longer than a
        move is reported in parts, each but the last without a reading.

        Args:
            declination: D at the end of the move [deg].
            inclination: I there [deg].
            horizontal_intensity: B_H there [nT].
            heading: heading of the move [deg], -360 to 360; in the first step the heading at the start.
            distance: length of the move [km]; 0 in the first step.
            time: time of the message, by any clock that does not run backward. A repeated message is then no second
                move: it returns the same command.

        Raises:
            RuntimeError: before :meth:`start`.
            ValueError: for values that are not possible, naming the value and what would be right.
        """
        if self.target is None:
            raise RuntimeError(_NOT_STARTED)
        given = {"declination": declination, "inclination": inclination, "horizontal_intensity": horizontal_intensity}
        if self.options.magnetic and declination is not None:
            raise ValueError(
                f"declination {declination!r}: headings are from magnetic north, and D is not measured: None"
            )
        step = Step(**given, heading=heading, distance=distance, time=time)
        if self._last_command is None or not step.repeats(self._steps[-1]):
            self._last_command = self._move(step)
            self._steps += (step,)
        return self._last_command

    def _move(self, step: Step) -> Command:
        """Return what to do after a new move."""
        read = self._comparable(step.reading)
        raw: Any = tuple(old if new is None else new for new, old in zip(read, self._raw, strict=True))
        check_earth_reading(*raw)
        error = self._error if self._last else self._calibrated(raw)[0]
        reading = math.remainder(raw[0] - error[0], 360), raw[1] - error[1], raw[2] - error[2]
        self._check(step, reading)
        course = math.remainder(math.radians(step.heading), 2 * math.pi)
        turn = math.remainder(course - self._last[3], 2 * math.pi) if self._last else 0.0
        noise = zip(read, self._sensor_std.noise, strict=True)
        std = self._sensor_std._replace(noise=[OUTAGE_STD if new is None else sigma for new, sigma in noise])
        with torch.inference_mode():
            self._error = error
            seen = self._seen(reading, course, (step.distance, turn), std)
            if self._last and read[1:] != (None, None):
                self._surprises = (*self._surprises, self._estimator.surprise(seen))[-_SURPRISES:]
            action = self._estimator.act(seen)
            self._last = (*reading, course)
            self._remember(step, raw)
            return self._command(seen, action, course)

    def _remember(self, step: Step, raw: Values) -> None:
        """Keep what later steps are compared with."""
        read = self._comparable(step.reading)
        self._unchanged = unchanged_km(self._unchanged, self._raw, read, step.distance)
        self._raw = raw
        self._unread_km = self._unread_km + step.distance if None in read else 0.0
        declination, inclination, _, course = self._last
        first, north = self._northward or (inclination, 0.0)
        self._northward = first, north + step.distance * math.cos(course - math.radians(declination))
        if self._last_command:
            self._radians = step.in_radians(self._radians, self._last_command.heading_deg)

    def _comparable(self, elements: Any) -> Any:
        """Return D, I, B_H, with 0 for D where the vehicle does not measure it."""
        return (0.0, *elements[1:]) if self.options.magnetic else elements

    def _calibrated(self, reading: Elements | None = None) -> tuple[Values, SensorStd]:
        """Return the constant error of readings, as far as it is known, and the accuracy without it."""
        stated = self.options.accuracy
        if reading and self._near:
            check_start(reading, self._near[0], stated, self._near[1])
        return ((0.0, 0.0, 0.0), stated) if self._here is None else calibrated(*self._here, stated, reading)

    def _check(self, step: Step, reading: Elements) -> None:
        """Raise unless a reading and a distance are possible, and possible together."""
        check_move(step.distance, self.max_move_km)
        if self._last:
            check_earth_jump(self._last[:3], reading, step.distance + self._unread_km, self._sensor_std.noise)
            return
        if step.distance != 0:
            raise ValueError(f"distance must be 0 in the first step, which is at the start, got {step.distance!r}")
        if text := out_of_range(self._view, reading):
            raise ValueError(f"the reading at the start: {text}")
        check_earth_distance(reading, self.target, self._longest_way())

    def _longest_way(self) -> float:
        """Return how far the target may be [km]."""
        return LONGEST_WAY_KM if self._estimator.trained else self.options.max_steps * self.max_move_km

    def _seen(self, reading: Elements, course: float, move: tuple[float, float], std: SensorStd) -> TensorDict:
        """Return what a policy reads, in a batch of one."""
        rows = {"field": reading, "target_field": self.target, "move": move, "heading": (course,)}
        rows |= dict(zip(STD_KEYS, std, strict=True))
        if self._here is not None:
            known = self._error, *self._here, self.options.accuracy.bias
            rows |= dict(zip(START_KEYS, known, strict=True))
        seen = {key: torch.tensor([row], dtype=torch.float32) for key, row in rows.items()}
        seen |= {"elapsed_steps": torch.tensor([[len(self._steps)]]), "done": torch.zeros(1, 1, dtype=torch.bool)}
        return TensorDict(seen, [1], device="cpu")

    def _command(self, seen: TensorDictBase, action: list[float], course: float) -> Command:
        """Return the command: to stop, to go to a near estimated destination, or the action of the navigator."""
        left = torch.tensor([self.options.max_steps - 1 - len(self._steps)])
        decision = self._estimator.decide(seen, left, self.options.arrival_km)
        posterior = self._estimator.posterior
        way, probability = posterior.way(), decision.probability.item()
        radius = posterior.radius(self.options.confidence).item()
        stop, reason = self._stop(way, decision, radius, declared=action[2:] > [0.0])
        if not (stop or self._steps or self._here or self._near):
            reason = _UNCHECKED[self.options.north]
        if stop:
            action = [0.0, 0.0]
        elif decision.way.norm() < self.options.arrival_km:
            limits = decision.stop_km.unsqueeze(-1), self.max_move_km, math.radians(self.max_turn_deg)
            action = tracking.approach(decision.way, seen["heading"], *limits)[0].tolist()
        steer = math.degrees(course + action[1]) % 360.0
        north, east = way.displacement[0].tolist()
        (nn, ne), (en, ee) = way.covariance[0].tolist()
        estimates = (north, east), ((nn, ne), (en, ee)), probability, stop, reason, radius
        return Command(action[0], math.degrees(action[1]), steer, *estimates)

    def _stop(self, way: Way, decision: ArrivalDecision, radius_km: float, declared: bool) -> tuple[str | None, str]:
        """Return the reason to stop, as a keyword and as a sentence."""
        options, level = self.options, sum(self._surprises) / max(len(self._surprises), 1)
        if text := self._lost(level):
            return "lost", text
        if text := out_of_range(self._view, self._last[:3]):
            return "out of range", text
        way_km, error_km = way.displacement.norm().item(), way.covariance[0].trace().sqrt().item()
        if self._estimator.trained and way_km - 2 * error_km > LONGEST_WAY_KM:
            return "out of range", f"the way is {way_km:.0f} ± {error_km:.0f} km, the policy's {LONGEST_WAY_KM:g} km"
        wanted = ("arrived", "the policy declares its arrival") if declared else (None, "")
        if not decision.declare.item() or level > LOST_SURPRISE:
            return wanted
        if decision.probability.item() >= options.confidence:
            probability = f"an estimated probability of {decision.probability.item():.2f}"
            return "arrived", f"within {options.arrival_km:g} km with {probability}"
        near = f"within {radius_km:.0f} km with an estimated probability of {options.confidence:.2f}"
        if len(self._steps) >= options.max_steps - 1:
            return "nearest", f"out of steps: {near}"
        if 0 < decision.attainable.item() < options.confidence:  # 0 where nothing is known yet
            return "nearest", f"as near as these sensors allow: {near}"
        return wanted

    def _lost(self, level: float) -> str:
        """Return why readings or moves cannot be those of a vehicle, as text; empty if they can.

        Args:
            level: mean of the last surprises.
        """
        useful = measured(self._sensor_std.noise)
        useful = (useful[0] and not self.options.magnetic, *useful[1:])
        if text := stuck([km * use for km, use in zip(self._unchanged, useful, strict=True)], self.max_move_km):
            return text
        if len(self._radians) > 1:
            steered = " and ".join(f"{heading:.0f}" for heading in self._radians)
            return f"the headings {steered} deg were reported in radians: degrees are expected"
        if len(self._surprises) >= _LEAST_SURPRISES and level > LOST_SURPRISE:
            causes = "the sign of I, its zero (from the horizontal), swapped elements, units, sensors and compass"
            return f"readings deviate {level**0.5:.0f} times as much as expected: check {causes}"
        first, north_km = self._northward
        change = abs(self._last[1] - first) * 100 / max(abs(north_km), 1e-9) if abs(north_km) >= 100 else math.inf
        slope = min(change, self._estimator.steepest_inclination)
        if useful[1] and abs(self._last[1]) <= math.pi / 2 and slope < EQUATOR_SLOPE_DEG:
            return f"inclination {self._last[1]:g} hardly changes: it looks like radians; degrees are expected"
        return ""

    def save(self, path: Path | str) -> None:
        """Write the arguments of :meth:`start` and of all steps since to a file, for :meth:`restore`.

        Raises:
            RuntimeError: before :meth:`start`.
            OSError: if the file cannot be written.
        """
        if self.target is None:
            raise RuntimeError(_NOT_STARTED)
        self._journal.replace(steps=self._steps).write(Path(path))

    def restore(self, path: Path | str) -> None:
        """Repeat the steps of a file of :meth:`save`: the same readings then give the same commands, bit for bit.

        Raises:
            ValueError: for a file that is damaged, of another format, or of a vehicle with other options.
            OSError: if the file cannot be read.
        """
        journal, options = Journal.read(Path(path)), dict(self.options)
        for name, value in journal.options:
            if value != options[name]:
                raise ValueError(f"{path} is of a vehicle with another {name}, {value!r}")
        resumed = copy.copy(self)
        resumed.start(journal.target, journal.here, here_std=journal.here_std, near=journal.near, date=journal.date)
        for step in journal.steps:
            resumed.step(**dict(step))
        self.__dict__ = resumed.__dict__
