"""The step of a vehicle that navigates by its own readings: a reading and a record in, a record and an action out.

:func:`begin` and :func:`advance` keep the record, :func:`act` chooses the move, and all three are pure functions: the
same ones run in simulation, on board and in training. A step in ten lines::

    belief = moved(belief, distance, heading, std, motion)          # dead reckoning of the field and the place
    new = innovation(belief, field, std.noise)                      # the reading minus its prediction
    noise = noise_estimate(noise, new, std.noise)                   # is the stated noise right, is this a spike?
    belief = updated(belief, innovation(..., std.noise * noise.factor))
    goal = destination(belief, target)                              # where are its elements, or its place?
    posterior = posterior(goal)
    aim = unvisited(posterior.way(), visited, ellipse)              # not where the vehicle has been
    plan = planned_move(goal, posterior, aim, std, price)           # dual control
    plan = corrected(plan, network(observation(...)))               # of an agent
    action = steer(heading, plan), or the declaration of arrival
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field, model_validator
from torch import Tensor
from torch.nn.functional import pad

from magrl.checks import CheckedModel
from magrl.field.elements import element_difference
from magrl.geodesy import geodesic, steer
from magrl.sensor_std import SensorStd
from magrl.tracking.belief import (
    PLACE,
    STATES,
    Belief,
    Innovation,
    LocalElements,
    Motion,
    at_place,
    before,
    elements,
    innovation,
    known,
    moved,
    updated,
)
from magrl.tracking.decision import ArrivalDecision, Trip, approach, arrival_decision
from magrl.tracking.destination import RANGE_KM, Destination, destination, posterior
from magrl.tracking.earth import EarthModel
from magrl.tracking.local import COEFFICIENTS, slopes
from magrl.tracking.noise import NoiseEstimate, noise_estimate, spike_factor
from magrl.tracking.observation import track_observation, turned
from magrl.tracking.planning import CAUTION, STEP_PRICE, corrected, planned_move, step_price
from magrl.tracking.search import VISITED, arrival_ellipse, arrival_weights, unvisited, unvisited_yet, visit
from magrl.tracking.way import DestinationPosterior, Way

PRICE_KM = 300.0
"""Way that counts as 100 % in the price of a step [km]."""
FIRST = 2.0
"""Factor of the noise of the first reading, from which latitude and slopes are expected: it may be a spike. Chosen on
random planets, with 7 % of spikes and without."""
FARTHEST_START_KM = 100.0
"""Largest error of a known start [km]: over longer distances, the field is not linear in the place."""


class Rules(CheckedModel):
    """What a vehicle knows before it starts: its limits, the rule of arrival, and what it expects of the field.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn before a move [rad].
        max_steps: step limit.
        zeta: arrival threshold on the objective.
        arrival: what ends the episode: the objective or the distance, with a signal at each step, or a declaration by
            the vehicle.
        radius_km: distance from the destination that counts as arrived, but by the objective [km].
        confidence: least probability of a correct declaration; below it, episodes end without one.
        range_km: prior standard deviation of the displacement to the destination along each axis [km].
        crust_nt: standard deviation of the field of the crust in each axis [nT].
        step_price: price of a step [% of SPL]: a higher one gives fewer steps and a longer path.
        caution: weight of the uncertainty in the plan.
        model: model of the Earth that the vehicle carries (:func:`~magrl.tracking.earth_model`); None for no other
            knowledge than the spectrum of the Earth's field.
        start_km: root mean square error of the place where it starts, with a model [km]; None where it does not know
            its place.
        target_km: the same of the destination's place; None where it knows the elements alone.
        drift: constant drift of dead reckoning along each axis [share of the way].
        wander_km: random part of it along each axis after 1 km [km].

    Raises:
        ValueError: for a value out of its range, or an unknown name.

    Example:
        >>> Rules(max_steps=80).replace(arrival="declared").signaled
        False
    """

    max_move_km: Annotated[float, Field(gt=0)] = 50.0
    max_turn_rad: Annotated[float, Field(gt=0, le=math.pi)] = math.pi / 2
    max_steps: Annotated[int, Field(ge=1)] = 50
    zeta: Annotated[float, Field(gt=0)] = 0.01
    arrival: Literal["objective", "distance", "declared"] = "objective"
    radius_km: Annotated[float, Field(gt=0)] = 25.0
    confidence: Annotated[float, Field(ge=0, le=1)] = 0.0
    range_km: Annotated[float, Field(gt=0)] = RANGE_KM
    crust_nt: Annotated[float, Field(ge=0)] = 0.0
    step_price: Annotated[float, Field(gt=0)] = STEP_PRICE
    caution: Annotated[float, Field(ge=0)] = CAUTION
    model: EarthModel | None = None
    start_km: Annotated[float | None, Field(ge=0, le=FARTHEST_START_KM)] = None
    target_km: Annotated[float | None, Field(ge=0)] = None
    drift: Annotated[float, Field(ge=0, le=1)] = 0.0
    wander_km: Annotated[float, Field(ge=0)] = 0.0

    @model_validator(mode="after")
    def _check_places(self) -> Rules:
        if self.start_km is not None and self.model is None:
            raise ValueError(
                f"start_km {self.start_km:g} needs a model of the Earth: model=earth_model('IGRF-14', date)"
            )
        if self.target_km is not None and self.start_km is None:
            raise ValueError(
                f"target_km {self.target_km:g} needs start_km: without its own place, a vehicle compares elements"
            )
        return self

    @property
    def motion(self) -> Motion:
        """How place and field go on."""
        return Motion(self.model if self.start_km is not None else None, self.drift, self.wander_km)

    @property
    def signaled(self) -> bool:
        """Whether the vehicle is told of its arrival, so that the destination is not where it has been."""
        return self.arrival != "declared"


class Reading(NamedTuple):
    """What a vehicle measures and knows at one step.

    Args:
        field: ``(..., 3)`` D [deg], I [deg], B_H [nT] as read; NaN for an element that is missing.
        target: ``(..., 3)`` the same at the destination.
        distance: ``(...)`` of the move before the reading [km].
        heading: ``(...)`` [rad].
        std: accuracy of the reading, tensors ``(..., 3)``.
        step: ``(...)`` number of the step, 0 at the start.
        known: ``(..., 3)`` elements at the start, where they are known; they count at the first reading.
        known_std: ``(..., 3)`` their standard deviations.
        price: ``(...)`` price of a step [% of SPL] of each vehicle; None for that of the rules.
        place: ``(..., 2)`` latitude, longitude [deg] of the start, where it is known; it counts at the first reading.
        target_place: ``(..., 2)`` the same of the destination.
        leg_std: ``(..., 2)`` standard deviations of the move, along and across it, beside the drift of the rules [km].
    """

    field: Tensor
    target: Tensor
    distance: Tensor
    heading: Tensor
    std: SensorStd
    step: Tensor
    known: Tensor | None = None
    known_std: Tensor | None = None
    price: Tensor | None = None
    place: Tensor | None = None
    target_place: Tensor | None = None
    leg_std: Tensor | None = None


class State(NamedTuple):
    """What a step needs of the one before, all tensors: the belief ``(..., S)``, ``(..., S, S)``, ``(..., 2)``; the
    noise estimate ``(..., 3)`` twice; displacements to visited places ``(..., 24, 2)`` [km]; weights of the objective
    ``(..., 3)``; the path flown ``(...)`` and the displacement from the start ``(..., 2)`` [km]; and the angle of north
    ``(...)``, from that of the belief to that of the headings [rad]: D, where a compass and a place are known."""

    mean: Tensor
    covariance: Tensor
    place: Tensor
    log_ratio: Tensor
    readings: Tensor
    visited: Tensor
    weights: Tensor
    path: Tensor
    home: Tensor
    north: Tensor

    @property
    def belief(self) -> Belief:
        """The belief of the field."""
        return Belief(self.mean, self.covariance, self.place)

    @property
    def noise(self) -> NoiseEstimate:
        """The noise over the stated one."""
        return NoiseEstimate(self.log_ratio, self.readings)


class Track(NamedTuple):
    """What a vehicle knows after a reading.

    Attributes:
        state: what the next step needs.
        posterior: of the displacement to the destination.
        way: its mean and covariance [km].
        local: elements and gradients at the vehicle.
        aim: ``(..., 2)`` displacement to aim at [km]: the mean, or where it has not been.
        plan: ``(..., 2)`` displacement of the next move as planned [km].
        surprise: ``(...)`` normalized square of the innovation by the stated noise, over the number of elements; about
            1 where all is right.
    """

    state: State
    posterior: DestinationPosterior
    way: Way
    local: LocalElements
    aim: Tensor
    plan: Tensor
    surprise: Tensor


def begin(rules: Rules, reading: Reading) -> Track:
    """Return the track at the first reading.

    Example:
        >>> here, none = torch.tensor([3.0, 65.0, 18000.0]), torch.zeros(3)
        >>> accuracy = SensorStd(torch.tensor([0.05, 0.05, 5.0]), none, none, none)
        >>> zero = torch.tensor(0.0)
        >>> begin(Rules(), Reading(here, torch.tensor([3.0, 66.0, 17500.0]), zero, zero, accuracy, zero)).aim.shape
        torch.Size([2])
    """
    return _estimated(rules, reading, *_started(rules, reading))


def advance(rules: Rules, state: State, reading: Reading) -> Track:
    """Return the track after a move and the reading at its end.

    The stated noise is always scaled by what the readings show (:func:`~magrl.tracking.noise_estimate`), and a spike
    counts less (:func:`~magrl.tracking.spike_factor`).
    """
    return _estimated(rules, reading, *_advanced(rules, state, reading))


def step(rules: Rules, state: State, reading: Reading) -> Track:
    """Return the track of vehicles of which some begin (step 0) and the others advance."""
    first = reading.step == 0

    def chosen(one: Tensor, other: Tensor) -> Tensor:
        return torch.where(first.reshape((*first.shape, *[1] * (one.ndim - first.ndim))), one, other)

    started, later = _started(rules, reading), _advanced(rules, state, reading)
    state = State(*map(chosen, started[0], later[0]))
    return _estimated(rules, reading, state, chosen(started[1], later[1]))


def _started(rules: Rules, reading: Reading) -> tuple[State, Tensor]:
    """Return the state at the first reading, and no surprise."""
    field, crust = reading.field, rules.crust_nt
    none = torch.zeros_like(field, dtype=torch.float64)
    if rules.start_km is not None and rules.model is not None:
        if reading.place is None:
            raise ValueError(f"start_km {rules.start_km:g} needs the place of the start, as KnownPlace writes it")
        belief = at_place(reading.place, rules.start_km, reading.std, rules.motion, crust)
    elif reading.known is None or reading.known_std is None:
        belief = before(field, reading.std, crust, rules.model)
    else:
        belief = before(reading.known, reading.std, crust, rules.model)
        belief = known(belief, reading.known, reading.known_std, crust)
    seen = _true(reading, _declination(belief, reading))
    belief = updated(belief, innovation(belief, field, FIRST * seen.std.noise, seen.heading))
    weights, home = arrival_weights(field, reading.target, rules.zeta), none[..., :2]
    north = _declination(belief, reading)
    return State(*belief, none, none, unvisited_yet(field), weights, home[..., 0], home, north), none[..., 0]


def _advanced(rules: Rules, state: State, reading: Reading) -> tuple[State, Tensor]:
    """Return the state after a move and the reading at its end, and the surprise of that."""
    seen = _true(reading, state.north)
    std, noise, heading, field = seen.std.noise, state.noise, seen.heading, reading.field
    belief = moved(state.belief, reading.distance, heading, seen.std, rules.motion, rules.crust_nt)
    if reading.leg_std is not None:
        belief = displaced(belief, _leg_covariance(reading.leg_std, heading))
    stated, scaled = innovation(belief, field, std, heading), std * (noise.log_ratio / 2).exp()
    wide = spike_factor(innovation(belief, field, scaled, heading), scaled)
    noise = noise_estimate(noise, innovation(belief, field, scaled * wide, heading), std * wide)
    after = updated(belief, innovation(belief, field, std * noise.factor * wide, heading))
    move = reading.distance.unsqueeze(-1) * torch.stack((torch.cos(heading), torch.sin(heading)), -1)
    path, home, visited = state.path + reading.distance, state.home + move, visit(state.visited, move.to(state.visited))
    state = State(*after, *noise, visited, state.weights, path, home, _declination(after, reading))
    return state, stated.square() / belief.measured.sum(-1)


def displaced(belief: Belief, covariance: Tensor) -> Belief:
    """Return a belief after an unknown displacement, by which the vehicle is not where it has reckoned.

    Args:
        belief: that before it.
        covariance: ``(..., 2, 2)`` of the displacement, northward and eastward [km^2].
    """
    slope = slopes(belief.mean[..., :COEFFICIENTS], belief.place)
    lever = torch.cat((slope, torch.eye(2).to(slope).expand(*slope.shape[:-2], 2, 2)), -2)
    return belief._replace(
        covariance=belief.covariance + pad(lever @ covariance.to(lever) @ lever.mT, (0, STATES - PLACE.stop) * 2)
    )


def position_fix(belief: Belief, place: Tensor, std_km: float) -> Innovation:
    """Return a fix of the position minus the estimated place, northward and eastward [km], as an innovation whose third
    entry is missing.

    Args:
        belief: that of a vehicle that knows its place.
        place: ``(..., 2)`` latitude, longitude [deg] of the fix.
        std_km: its root mean square error [km].
    """
    distance, bearing = geodesic(*belief.place.unbind(-1), *place.to(belief.place).unbind(-1))
    apart = distance.unsqueeze(-1) * torch.stack((torch.cos(bearing), torch.sin(bearing)), -1)
    rows = torch.zeros_like(belief.covariance[..., :3, :])
    rows[..., :2, PLACE] = torch.eye(2).to(rows)
    noise = torch.diag(rows.new_tensor((std_km**2 / 2, std_km**2 / 2, 1.0)))
    return Innovation(pad(apart, (0, 1)), rows, rows @ belief.covariance @ rows.mT + noise)


def _leg_covariance(std: Tensor, heading: Tensor) -> Tensor:
    """Return the covariance ``(..., 2, 2)`` northward and eastward of a move with errors along and across it."""
    cos, sin = torch.cos(heading.double()), torch.sin(heading.double())
    turn = torch.stack((cos, -sin, sin, cos), -1).unflatten(-1, (2, 2))
    return turn @ torch.diag_embed(std.double().square()) @ turn.mT


def _declination(belief: Belief, reading: Reading) -> Tensor:
    """Return the angle ``(...)`` [rad] from true north to that of the headings: D, where a vehicle steers by a compass
    and knows its place; else 0."""
    compass = reading.std.bias[..., 0].isinf() & belief.located
    return torch.where(compass, torch.atan2(belief.field[..., 1], belief.field[..., 0]), 0.0)


def _true(reading: Reading, north: Tensor) -> Reading:
    """Return a reading whose heading is that in the axes of the belief; by a compass, D is no reading."""
    compass = reading.std.bias[..., :1].isinf()
    first = torch.tensor([True, False, False], device=compass.device)
    noise = torch.where(compass & first, math.inf, reading.std.noise)
    return reading._replace(heading=reading.heading + north.to(reading.heading), std=reading.std._replace(noise=noise))


def blank(reading: Reading) -> State:
    """Return a state of the right shapes before the first reading, of zeros."""
    like, shape = reading.field, reading.field.shape[:-1]
    wide = {"mean": (STATES,), "covariance": (STATES, STATES), "place": (2,), "log_ratio": (3,), "readings": (3,)}
    zeros = {name: like.new_zeros(*shape, *size, dtype=torch.float64) for name, size in wide.items()}
    rest = {name: like.new_zeros(shape, dtype=torch.float64) for name in ("path", "north")}
    rest["home"] = like.new_zeros(*shape, 2, dtype=torch.float64)
    return State(**zeros, **rest, visited=like.new_zeros(*shape, VISITED, 2), weights=like.new_zeros(*shape, 3))


def _goal(rules: Rules, state: State, reading: Reading) -> Destination:
    place = None if rules.target_km is None else reading.target_place
    std = _true(reading, state.north).std
    return destination(state.belief, reading.target, rules.range_km, rules.crust_nt, std, place, rules.target_km or 0.0)


def _accuracy(state: State, reading: Reading) -> SensorStd:
    """Return the accuracy of a reading with the noise as the readings show it."""
    std = _true(reading, state.north).std
    return std._replace(noise=(std.noise * state.noise.factor).to(reading.target.dtype))


def _estimated(rules: Rules, reading: Reading, state: State, surprise: Tensor) -> Track:
    """Return the track with the estimates and the plan that follow from a state."""
    goal, local, dtype = _goal(rules, state, reading), elements(state.belief), reading.target.dtype
    points = posterior(goal)
    way = points.way()
    aim = way.displacement
    if rules.signaled and rules.target_km is None:
        radius = rules.radius_km if rules.arrival == "distance" else None
        ellipse = arrival_ellipse(local.gradient, local.covariance[..., 1:, 1:], state.weights.double(), radius)
        aim = unvisited(Way(*(part.double() for part in way)), state.visited.double(), ellipse).to(dtype)
    std, percent = _accuracy(state, reading), rules.step_price if reading.price is None else reading.price.double()
    limits = rules.max_steps, rules.max_move_km
    price = step_price(percent, PRICE_KM, aim.double(), reading.step, std.noise, *limits)
    plan = planned_move(goal, points, aim.double(), std, price, rules.max_move_km, rules.caution).to(dtype)
    return Track(state, points, way, local, aim, plan, surprise)


def observation(rules: Rules, track: Track, reading: Reading) -> Tensor:
    """Return what a network observes of a track ``(..., 19)``, relative to the heading
    (:func:`~magrl.tracking.track_observation`)."""
    heading, like = _true(reading, track.state.north).heading.unsqueeze(-1), reading.target

    def ahead(vector: Tensor) -> Tensor:
        return turned(vector.to(like).unsqueeze(-2), heading).squeeze(-2)

    price = torch.full_like(heading, rules.step_price) if reading.price is None else reading.price.unsqueeze(-1)
    return track_observation(
        aim=ahead(track.aim),
        plan=ahead(track.plan),
        covariance=turned(turned(track.way.covariance, heading).mT, heading),
        gradient=turned(track.local.gradient.to(like), heading),
        remaining=element_difference(reading.target, track.local.value.to(like)),
        weights=track.state.weights,
        std=reading.std.noise.to(like) * track.state.noise.factor.to(like),
        # A policy may fly longer than it was trained for.
        time=(reading.step.unsqueeze(-1).to(heading.dtype) / rules.max_steps).clamp(max=1),
        price=price,
    )


def act(
    rules: Rules, track: Track, reading: Reading, network: Callable[[Tensor], Tensor] | None = None
) -> tuple[Tensor, ArrivalDecision | None]:
    """Return the action of a track: distance [km] and turn [rad] ``(..., 2)``; with the declaration as a third number
    and the decision behind it, where the vehicle must declare its arrival.

    Args:
        rules: rules.
        track: after the reading.
        reading: that reading.
        network: from an :func:`observation` to a correction ``(..., 2)`` of the plan
            (:func:`~magrl.tracking.corrected`); None to fly as planned.
    """
    plan = track.plan if network is None else corrected(track.plan, network(observation(rules, track, reading)))
    action = moving(rules, plan, _true(reading, track.state.north).heading)
    return (action, None) if rules.signaled else declaring(rules, track, reading, action)


def moving(rules: Rules, plan: Tensor, heading: Tensor) -> Tensor:
    """Return the action ``(..., 2)``, distance [km] and turn [rad], of a displacement ``(..., 2)`` [km]."""
    north, east = plan.unbind(-1)
    limits = rules.max_move_km, rules.max_turn_rad
    return torch.stack(steer(heading, torch.atan2(east, north), torch.hypot(north, east), *limits), -1)


def declaring(rules: Rules, track: Track, reading: Reading, action: Tensor) -> tuple[Tensor, ArrivalDecision]:
    """Return an action ``(..., 2)`` with the declaration ``(..., 3)``: 1 where the vehicle has arrived, else -1.

    Where it is probably within the radius, and further readings are not worth their cost
    (:func:`~magrl.tracking.arrival_decision`), it stays and declares.
    Before, where its estimated distance is less than the radius, it approaches the estimated place and stops where
    readings are worth most (:func:`~magrl.tracking.approach`). Elsewhere it moves as ``action`` says.
    """
    state, left = track.state, rules.max_steps - 1 - reading.step
    price = rules.step_price if reading.price is None else reading.price
    trip = Trip(state.path, state.home, left, price, rules.max_move_km)
    goal, std = _goal(rules, state, reading), _accuracy(state, reading)
    decision = arrival_decision(goal, track.posterior, std, trip, rules.radius_km)
    heading = _true(reading, state.north).heading.unsqueeze(-1)
    way, stop = (part.to(action.dtype) for part in (decision.way, decision.stop_km.unsqueeze(-1)))
    near = way.norm(dim=-1, keepdim=True) < rules.radius_km
    action = torch.where(near, approach(way, heading, stop, rules.max_move_km, rules.max_turn_rad).to(action), action)
    declare = (decision.declare & (decision.probability >= rules.confidence)).unsqueeze(-1)
    return torch.cat((action.masked_fill(declare, 0.0), 2.0 * declare.to(action) - 1), -1), decision
