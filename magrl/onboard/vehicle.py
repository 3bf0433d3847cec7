"""Navigation on board one vehicle: plain numbers in, a command out, without an environment.

Angles are in degrees, clockwise from the vehicle's north, true or magnetic, distances in kilometers, and intensities in
nanotesla. The step is :mod:`magrl.pilot.step`.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from magrl.checks import check_type
from magrl.files import write_atomically
from magrl.onboard import integrity, limits
from magrl.onboard.doubt import LEAST_FIT, LOST_SURPRISE, Doubt
from magrl.onboard.journal import Command, Destination, Fix, Journal, Options, Step, estimates_of
from magrl.onboard.start import at_flight_altitude, at_rest, check_first_reading, fixed, known_at_start
from magrl.pilot import Reading, Rules, Track, act, advanced, declaring, estimated, retargeted
from magrl.pilot.belief import PLACE
from magrl.pilot.decision import ArrivalDecision
from magrl.pilot.earth import NEWEST
from magrl.pilot.network import pilot_of
from magrl.pilot.records import State
from magrl.sensor_std import OUTAGE_STD

USUAL: dict[str, Any] = {"arrival": "declared", "max_steps": 120, "confidence": 0.8, "drift": 0.03, "wander_km": 0.1}
"""Rules of a vehicle, which replace the defaults of :class:`~magrl.pilot.Rules` and the training's; the drift is that
of a log to 3 %, and a current of as much."""
LONGEST_DISPLACEMENT_KM = 2500.0
"""Estimated distance beyond which an agent without a map is out of range: there its observation saturates."""
HIGHEST_LATITUDE = 85.0
"""Latitude beyond which a known place is out of range: its region of 90 % held 78 % of the places at 86 to 88° S."""
_UNCHECKED = {"true": "the sign of D and the compass were", "magnetic": "the compass was"}
_NOT_STARTED = "the vehicle has no destination yet: call start(target) first"


class Onboard:
    """A navigator on board one vehicle.

    :meth:`start` takes the elements at the destination. The first :meth:`step` takes the reading at the start, every
    later one what the vehicle did since the last step by its own log and compass, and the reading at the end of that
    leg. Each returns a :class:`Command`. A call that raises an error changes nothing: repeat it with right values.

    Args:
        navigator: ``"anywhere"`` for the pretrained agent, ``"kalman"``, or a file of
            :func:`~magrl.pilot.network.save_pilot`, which run without TorchRL; ``"secant"``, a file of
            :func:`magrl.save_policy`, a policy or a navigator, of which the vehicle gets a copy.
        options: of :class:`~magrl.onboard.journal.Options`. Rules that are not given are from the
            training, but :data:`USUAL`. The limits of a leg are at most the training's limits.

    Raises:
        ValueError: for an option out of its range, an unknown navigator, or one that reads more than the vehicle knows.

    Example:
        >>> vehicle = Onboard("kalman", sensor_std=(0.02, 0.02, 2.0))
        >>> vehicle.start((-11.6, 75.4, 13240.0), target_std=(0.1, 0.05, 30.0))
        >>> command = vehicle.step(3.5, 73.0, 15000.0, heading=290.0)
        >>> command.distance_km, command.stop
        (0.0, None)
    """

    _template: Any = None  # a Reading with what the vehicle knows at the start
    _flown: Any = None  # the other navigator in this flight

    def __init__(self, navigator: str | nn.Module = "anywhere", **options: Any) -> None:
        check_type((str, nn.Module), navigator=navigator)
        pilot, self._other = pilot_of(navigator), None
        rules, self._network = pilot or (Rules(), None)
        if pilot is None:
            from magrl.onboard.policies import Other

            self._other = Other(navigator)
        given = Options(**rules.model_dump() | USUAL | options)
        most = rules.model_dump(include={"max_leg_km", "max_turn_deg"}) if self._network else {}
        name, module = "anywhere" if self._network else "kalman", self._network or nn.Identity()
        self._range = ((-180.0, -90.0, limits.LEAST_NT), (180.0, 90.0, math.inf))
        if self._other:
            name, module, most, self._range = (
                getattr(self._other, part) for part in ("name", "navigator", "most", "range")
            )
        shorter = {limit: min(getattr(given, limit), value) for limit, value in most.items()}
        content = b"".join(value.cpu().numpy().tobytes() for value in module.state_dict().values())
        self.options = given.replace(**shorter, navigator=name, weights=hashlib.sha256(content).hexdigest())

    @property
    def _state(self) -> State | None:
        """By what is stated."""
        return self._states and State(*(part[0] for part in self._states))

    @property
    def target(self) -> Any:
        """Elements at the destination; None before :meth:`start`."""
        return None if self._template is None else tuple(self._template.target.tolist())

    def start(
        self,
        target: Sequence[float | None],
        start: Sequence[float] | None = None,
        *,
        target_elements: Sequence[float | None] | None = None,
        target_std: Sequence[float] | None = None,
        start_std: Sequence[float] | None = None,
        date: str | None = None,
        model: str | None = NEWEST,
        start_km: float = 0.1,
        target_km: float = 0.1,
        target_altitude_km: float | None = None,
        altitude_km: float = 0.0,
    ) -> None:
        """Begin an episode to a destination, with what the vehicle knows.

        With a date, the vehicle carries a model of the Earth, by default the newest that ships with the library. Where
        it also knows its place, it follows it along the path, and steers between places. Without a date, it knows
        nothing of the Earth but the spectrum of its field, as in the paper. Where the elements at the start are known,
        the first reading shows the constant errors of the sensors (``known``). A first reading that
        does not fit the start raises an error.

        Args:
            target: elements of the destination, D [deg], I [deg], B_H [nT]; or its latitude and longitude [deg]. D does
                not count where the vehicle's north is magnetic, and may be None.
            start: latitude and longitude of the start [deg], with a date; or the elements there.
            target_elements: D, I [deg], B_H [nT] that were measured at a target that is given by its place: where the
                vehicle also knows its own, they show how far the model is off there.
            target_std: standard deviations of the elements of the destination, with the crust there; needed with
                elements, and (0, 0, 0) for exact ones.
            start_std: standard deviations of the elements at the start, 0 by default.
            date: date of the flight, such as ``"2026-06-30"``.
            model: model of the Earth that the vehicle carries (:func:`magrl.pilot.earth_model`); None for none.
            start_km: root mean square error of the place of the start [km].
            target_km: the same of the destination.
            target_altitude_km: altitude at which elements of the destination hold [km], by default the flight's.
            altitude_km: altitude of the flight above the ellipsoid [km], at which the vehicle knows the field.

        Raises:
            ValueError: for elements that are not possible on the Earth, or beyond the range of the policy; a place
                without a model; or a model that does not cover the date.
        """
        target, target_elements = self._comparable(target), self._comparable(target_elements)
        given = {name: value for name, value in locals().items() if name in Journal.model_fields}
        self._take(journal := Journal(options=self.options, **given))
        self._journal = journal
        self._steps: tuple[Step | Fix | Destination, ...] = ()
        self._commands: tuple[dict[str, Any], ...] = ()
        self._states: State | None = None  # by what is stated, and without relying on it
        self._evidence: Any = 0.0  # of these hypotheses
        self._held: tuple[integrity.Hypothesis, ...] = ()
        self._last: Any = None  # the last elements
        self._doubt = Doubt()
        self._unchanged: limits.Triple = (0.0, 0.0, 0.0)  # path since each element last changed [km]
        self._number, self._unread_km = 0, 0.0  # steps without fixes, and path since the last complete reading

    def _take(self, journal: Journal, place: Tensor | None = None) -> None:
        """Take in what the vehicle knows at the start of a trip, from a place, by default the one that is given."""
        rules, template = known_at_start(journal, place)
        free = rules.start_km is not None and not (self._network or self._other)  # a filter with a place and a model
        within = limits.ANYWHERE if free else self._range
        if text := limits.out_of_range(within, template.target.tolist()):
            raise ValueError(f"the target: {text}")
        self._rules, self._template, self._within = rules, template, within

    def retarget(self, target: Sequence[float | None], **known: Any) -> None:
        """Go on to another destination with what was learned: field, place, drift and errors of the sensors.

        The trip, and its number of steps, begin with the next :meth:`step`.

        Args:
            target: as for :meth:`start`.
            **known: ``target_elements``, ``target_std``, ``target_km``, ``target_altitude_km``, as for :meth:`start`.

        Raises:
            RuntimeError: before the first :meth:`step`.
            ValueError: as :meth:`start`.
        """
        if self._template is None or not self._states:
            raise RuntimeError("the vehicle has no estimate to keep: call start(target) and step() first")
        known["target_elements"] = self._comparable(known.get("target_elements"))
        trip = Destination(target=self._comparable(target), **known)
        self._take(self._journal.replace(**dict(trip)), self._states.place[0])
        with torch.inference_mode():
            here = self._template._replace(field=torch.tensor(self._last, dtype=torch.float32))
            self._states = retargeted(self._rules, self._states, here)
        self._steps, self._number = (*self._steps, trip), 0

    def step(
        self,
        declination: float | None,
        inclination: float | None,
        horizontal_intensity: float | None,
        heading: float,
        distance: float = 0.0,
        *,
        distance_std: float = 0.0,
        heading_std: float = 0.0,
        hours: float | None = None,
        altitude_km: float | None = None,
    ) -> Command:
        """Return what to do after a leg.

        An element that could not be read is None: the vehicle goes on by dead reckoning. From magnetic north, D is
        always None, and the heading of a leg is the heading at its start. A distance that is longer than a leg is
        reported in parts, each but the last without a reading.

        Args:
            declination: D at the end of the leg [deg].
            inclination: I there [deg].
            horizontal_intensity: B_H there [nT].
            heading: heading of the leg [deg], -360 to 360; in the first step the heading at the start.
            distance: length of the leg [km]; 0 in the first step.
            distance_std: standard deviation of that length [km], beside the drift of the options, such as for an
                inertial navigation system.
            heading_std: the same of the heading of the leg [deg].
            hours: time since the last :meth:`step` or :meth:`fix` [h], in which a vehicle that knows its place drifts,
                also at rest, as it does at the speed of the options (``speed_km_h``); None to drift by distance.
            altitude_km: altitude of the reading [km], by default that of :meth:`start`, to which it is reduced: by the
                model at the known place before the leg, else as the field of a dipole.

        Raises:
            RuntimeError: before :meth:`start`.
            ValueError: for values that are not possible, naming the value and what would be right.
        """
        if self._template is None:
            raise RuntimeError(_NOT_STARTED)
        if self.options.magnetic and declination is not None:
            raise ValueError(f"declination {declination!r}: headings are from magnetic north, D is not measured: None")
        step = Step(**{name: value for name, value in locals().items() if name in Step.model_fields})
        new = copy.copy(self)  # an error changes nothing
        command, new._steps, new._number = new._after(step), (*self._steps, step), self._number + 1
        new._commands += (vars(command),)
        self.__dict__ = new.__dict__
        return command

    def fix(self, latitude: float, longitude: float, std_km: float, *, hours: float | None = None) -> None:
        """Take in a fix of the position, such as a bearing, a sounding or a moment of satellite navigation, which
        counts from the next step on. One that is better than the estimate ends a doubt (``fit``).

        Args:
            latitude: of the vehicle at the end of the last leg [deg].
            longitude: the same [deg].
            std_km: root mean square error of the fix [km].
            hours: time at rest since the last call [h], in which the vehicle drifted, as for :meth:`step`.

        Raises:
            RuntimeError: before the first :meth:`step`, or where the vehicle does not know its place.
            ValueError: for a fix that does not fit the estimated place (p < 0.001).
        """
        fix = Fix(latitude=latitude, longitude=longitude, std_km=std_km, hours=hours)
        if self._template is None or not self._states or self._rules.start_km is None:
            raise RuntimeError("a fix corrects an estimated place: start with a place and a date, and step, before it")
        states, rules = self._states, self._rules
        states = states if fix.hours is None else at_rest(rules, states, self.options.drift_km(fix.hours))
        better = std_km**2 < states.belief.covariance[0, PLACE, PLACE].trace().item()
        self._states, evidence = fixed(states, fix)
        self._evidence = self._evidence + evidence
        self._doubt = Doubt(hung=self._doubt.hung) if better else self._doubt
        self._steps += (fix,)

    def _after(self, step: Step) -> Command:
        """Return what to do after a new leg."""
        doubt = self._doubt.found(self._state, self.options.sensor_std.noise, self._last, step)
        read = [None if hung else value for hung, value in zip(doubt.hung, step.elements, strict=True)]
        some, read = read != [None, None, None], self._comparable(read)
        last = self._last or read
        elements: Any = tuple(old if new is None else new for new, old in zip(read, last, strict=True))
        limits.check_earth_reading(*elements)
        self._check(step, elements)
        course = math.remainder(math.radians(step.heading), 2 * math.pi)
        reading = self._reading(step, read, elements, course)
        with torch.inference_mode():
            if self._states is None:
                states, surprise, tail, evidence = integrity.begun(self._rules, reading)
                check_first_reading(reading, tail[0].item())
                self._flown = self._other and self._other.begun(self.options, reading)
            else:
                states, surprise, tail, evidence = advanced(self._rules, self._states, reading)
            track = estimated(self._rules, reading, State(*(part[0] for part in states)), surprise[0], tail[0])
            self._evidence = self._evidence + evidence
            network, other = self._network, copy.copy(self._flown)
            action = other.act(reading) if other else act(self._rules, track, reading, network)
            action, decision = declaring(self._rules, track, reading, action)
            self._held = integrity.hypotheses(self._rules, states, reading, self._evidence, decision.probability)
        if some and (reading.known is not None or self._states):
            doubt = doubt.after(track, first=self._states is None)
        self._unchanged = limits.unchanged_km(self._unchanged, last, step.elements, step.distance)
        self._unread_km = self._unread_km + step.distance if None in read else 0.0
        self._last, self._states, self._doubt, self._flown = elements, states, doubt, other
        return self._command(track, decision, action, course)

    def _reading(self, step: Step, read: limits.Incomplete, elements: limits.Triple, course: float) -> Reading:
        """Return the reading of the pilot; a missing element is the last one, with the accuracy of an outage."""
        missing = torch.tensor([value is None for value in read])
        std = self._template.std
        distance, heading = torch.tensor((step.distance, course), dtype=torch.float32)
        leg = step.distance_std, step.distance * math.radians(step.heading_std)
        if step.altitude_km is not None:
            place = (self._state or self._template).place
            elements = self._comparable(at_flight_altitude(self._journal, elements, step.altitude_km, place))
        return self._template._replace(
            field=torch.tensor(elements, dtype=torch.float32),
            distance=distance,
            heading=heading,
            std=std._replace(noise=std.noise.masked_fill(missing, OUTAGE_STD)),
            step=torch.tensor(self._number),
            leg_std=torch.tensor(leg, dtype=torch.float64) if any(leg) else None,
            drift_km=None if step.hours is None else self.options.drift_km(step.hours, step.distance),
        )

    def _comparable(self, elements: Any) -> Any:
        """Return D, I, B_H, if these are given, with 0 for D where the vehicle does not measure it."""
        given = elements.tolist() if hasattr(elements, "tolist") else elements
        hidden = self.options.magnetic and isinstance(given, Sequence) and len(given) == 3
        return (0.0, *given[1:]) if hidden else elements

    def _check(self, step: Step, elements: limits.Triple) -> None:
        """Raise unless elements and a distance are possible together."""
        limits.check_leg(step.distance, step.distance_std, self.options.max_leg_km)
        if self._states is not None:
            since_km, noise = step.distance + self._unread_km, self.options.sensor_std.noise
            limits.check_earth_jump(self._last, elements, since_km, noise)
            return
        if step.distance or step.hours:
            raise ValueError(f"distance and hours must be 0 in the first step, got {step.distance:g} and {step.hours}")
        if text := limits.out_of_range(self._within, elements):
            raise ValueError(f"the reading at the start: {text}")
        longest = LONGEST_DISPLACEMENT_KM if self._network else self.options.max_steps * self.options.max_leg_km
        limits.check_earth_distance(elements, self.target, longest)

    def _command(self, track: Track, decision: ArrivalDecision, action: Tensor, course: float) -> Command:
        """Return the command: to stop, or the action of the navigator."""
        radius = track.posterior.radius(self.options.confidence).item()
        stop, reason = self._stop(track, decision, radius)
        if not (stop or self._steps or self._template.known is not None):
            reason = f"{_UNCHECKED[self.options.north]} not checked: give the start"
        unread = f"no complete reading over the last {self._unread_km:.0f} km"
        unread = unread if self._unread_km >= limits.STUCK_KM[0] else ""
        reason = reason if stop else self._doubt.text or unread or reason
        distance, turn = (0.0, 0.0) if stop else action[:2].tolist()
        steer = math.degrees(course + turn) % 360.0
        north, east = track.displacement.mean.tolist()
        (nn, ne), (en, ee) = track.displacement.covariance.tolist()
        estimates = (north, east), ((nn, ne), (en, ee)), integrity.probability(self._held), radius, stop, reason
        found = estimates_of(track.state, located=self._rules.start_km is not None)
        return Command(
            distance, math.degrees(turn), steer, *estimates, fit=self._doubt.fit, hypotheses=self._held, **found
        )

    def _stop(self, track: Track, decision: ArrivalDecision, radius_km: float) -> tuple[str | None, str]:
        """Return the reason to stop, as a keyword and as a sentence."""
        options, doubt = self.options, self._doubt
        if text := self._lost(track):
            return "lost", text
        if text := limits.out_of_range(self._within, self._last):
            return "out of range", text
        if self._rules.start_km is not None and abs(latitude := track.state.place[0].item()) > HIGHEST_LATITUDE:
            return "out of range", f"latitude {latitude:.1f}: the model is valid to {HIGHEST_LATITUDE:g} degrees"
        left_km, error_km = track.displacement.mean.norm().item(), track.displacement.covariance.trace().sqrt().item()
        if self._network and left_km - 2 * error_km > LONGEST_DISPLACEMENT_KM:
            return "out of range", f"{left_km:.0f} ± {error_km:.0f} km to go, of at most {LONGEST_DISPLACEMENT_KM:g}"
        declare, last = decision.declare.item(), self._number >= options.max_steps - 1
        if not (declare or last) or doubt.level > LOST_SURPRISE:
            return None, ""
        if declare and decision.probability.item() >= options.confidence:
            probability = f"an estimated probability of {decision.probability.item():.2f}"
            if doubt.fit < LEAST_FIT:
                return "nearest", f"{probability}, but readings do not fit what is stated (p = {doubt.fit:.1g})"
            if text := integrity.objection(self._rules, self._held, track.state.crust_nt.item()):
                return "nearest", f"{probability}, but {text}"
            held = f"an estimated probability of {integrity.probability(self._held):.2f}"
            return "arrived", f"within {options.radius_km:g} km with {held}"
        near = f"within {radius_km:.0f} km with an estimated probability of {options.confidence:.2f}"
        if last:
            return "nearest", f"out of steps: {near}"
        if 0 < decision.attainable.item() < options.confidence:  # 0 where nothing is known yet
            return "nearest", f"as near as these sensors allow: {near}"
        return None, ""

    def _lost(self, track: Track) -> str:
        """Return why readings or legs cannot be from a vehicle, as text; empty if they can."""
        useful = limits.measured(self.options.sensor_std.noise)
        useful = (useful[0] and not self.options.magnetic, *useful[1:])
        if text := limits.stuck(self._unchanged, self.options.max_leg_km, useful, self._doubt.hung):
            return text
        if self._doubt.lost:
            return self._doubt.contradiction
        local = track.local
        slope = local.gradient[1].norm() + 2 * local.covariance[1, 1:, 1:].trace().sqrt()
        return limits.in_radians(self._last[1], slope.item()) if useful[1] else ""

    def save(self, path: Path | str) -> None:
        """Write the arguments of :meth:`start` and of all calls since, and the commands that were returned, to a file
        of JSON, for :meth:`restore`.

        Raises:
            RuntimeError: before :meth:`start`.
            OSError: if the file cannot be written.
        """
        if self._template is None:
            raise RuntimeError(_NOT_STARTED)
        journal = self._journal.replace(steps=self._steps, commands=self._commands)
        write_atomically(Path(path), journal.model_dump_json().encode())

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
        resumed.start(**journal.model_dump(exclude={"format", "options", "steps", "commands"}))
        for step in journal.steps:
            getattr(resumed, step.CALL)(**dict(step))
        resumed._commands = journal.commands  # as they were returned
        self.__dict__ = resumed.__dict__
