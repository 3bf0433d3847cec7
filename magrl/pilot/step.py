"""The step of a vehicle that navigates by its own readings: a reading and a record in, a record and an action out.

:func:`begin` and :func:`advance` keep the record, :func:`act` chooses the leg, :func:`declaring` the end, and all are
pure functions: the same ones run in simulation, on board and in training. A step in ten lines::

    beliefs = moved(beliefs, distance, heading, std, motion)        # dead reckoning of the field and the place
    new = innovation(beliefs, field, std.noise)                     # the reading minus its prediction
    noise = noise_estimate(noise, new, std.noise)                   # is the stated noise right, is this a spike?
    beliefs = updated(beliefs, innovation(..., std.noise * noise.factor))
    belief = mixture(beliefs, reweighed(log_weight, new))           # how large are anomalies here?
    goal = destination(belief, target)                              # where are its elements, or its place?
    posterior = posterior(goal)
    aim = unvisited(posterior.displacement(), visited, ellipse)     # not where the vehicle has been
    plan = planned_leg(goal, posterior, aim, std, price)            # dual control
    plan = corrected(plan, network(observation(...)))               # of an agent
    action = steer(heading, plan), or the declaration of arrival
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import pad

from magrl.field.elements import element_difference
from magrl.geodesy import steer
from magrl.pilot import anomalies
from magrl.pilot.belief import (
    PLACE,
    STATES,
    Belief,
    Innovation,
    at_place,
    before,
    elements,
    known,
    moved,
    predicted,
    updated,
)
from magrl.pilot.decision import ArrivalDecision, Progress, approach, arrival_decision
from magrl.pilot.destination import Destination, destination, posterior
from magrl.pilot.displacement import Displacement, displacement_between
from magrl.pilot.earth import EarthModel
from magrl.pilot.local import COEFFICIENTS, slopes
from magrl.pilot.noise import NoiseEstimate, noise_estimate, spike_factor
from magrl.pilot.observation import track_observation, turned
from magrl.pilot.planning import corrected, planned_leg, step_price
from magrl.pilot.records import Reading, Rules, State, Track
from magrl.pilot.search import arrival_ellipse, arrival_weights, unvisited, unvisited_yet, visit
from magrl.pilot.survey import anomaly_there, surveyed
from magrl.sensor_std import OUTAGE_STD, SensorStd

PRICE_KM = 300.0
"""Displacement that counts as 100 % in the price of a step [km]."""
FIRST = 2.0
"""Factor of the noise of the first reading, from which latitude and slopes are expected: it may be a spike. Chosen on
random planets, with 7 % of spikes and without."""


def begin(rules: Rules, reading: Reading) -> Track:
    """Return the track at the first reading.

    Example:
        >>> here, none = torch.tensor([3.0, 65.0, 18000.0]), torch.zeros(3)
        >>> accuracy = SensorStd(torch.tensor([0.05, 0.05, 5.0]), none, none, none)
        >>> zero = torch.tensor(0.0)
        >>> begin(Rules(), Reading(here, torch.tensor([3.0, 66.0, 17500.0]), zero, zero, accuracy, zero)).aim.shape
        torch.Size([2])
    """
    return estimated(rules, reading, *started(rules, reading)[:3])


def advance(rules: Rules, state: State, reading: Reading) -> Track:
    """Return the track after a leg and the reading at its end.

    The stated noise is always scaled by what the readings show (``noise_estimate``), and a spike
    counts less (:func:`~magrl.pilot.spike_factor`).
    """
    return estimated(rules, reading, *advanced(rules, state, reading)[:3])


def started(rules: Rules, reading: Reading) -> tuple[State, Tensor, Tensor, Tensor]:
    """Return the state at the first reading, no surprise, and the tail probability and the evidence of the reading."""
    field, none = reading.field, torch.zeros_like(reading.field, dtype=torch.float64)
    beliefs = _first_beliefs(rules, reading)
    log_weight = anomalies.prior_weights(beliefs.mean[..., 0])
    north = _declination(anomalies.mixture(beliefs, log_weight), reading)
    seen = _side_by_side(_true(reading, north))
    first = FIRST * seen.std.noise
    prediction = predicted(beliefs, seen.field, first < math.inf, seen.heading)
    new = prediction.noisy(first)
    beliefs = updated(beliefs, prediction.noisy(first * spike_factor(new, first)))
    beliefs = anomalies.recentered(beliefs, log_weight)
    weights, home, quiet = arrival_weights(field, reading.target, rules.zeta), none[..., :2], 0 * beliefs.mean[..., :3]
    after, tail = anomalies.mixture(beliefs, log_weight), anomalies.tail(log_weight, new, _count(beliefs, seen))
    rest = quiet, quiet, unvisited_yet(field), weights, home[..., 0], home, _declination(after, reading), none[..., 0]
    state = State(beliefs.mean, beliefs.covariance, after.place, log_weight, *rest)
    return _surveyed(rules, state, reading), none[..., 0], tail, anomalies.reweighed(log_weight, new)[1]


def _surveyed(rules: Rules, state: State, reading: Reading) -> State:
    """Return a state with the size of the anomaly at the destination, where a survey shows it."""
    if survey := _survey(rules, reading):
        errors = _true(reading, state.north).std
        return state._replace(there=anomaly_there(state.belief, *survey, state.crust_nt, errors))
    return state._replace(there=torch.zeros_like(state.there))


def retargeted(rules: Rules, state: State, reading: Reading) -> State:
    """Return the state at the start of a trip to another destination, with what was learned.

    Args:
        rules: with what is known of that destination.
        state: after the last reading.
        reading: the last one, with that destination.
    """
    weights = arrival_weights(reading.field, reading.target, rules.zeta).expand_as(state.weights)
    nothing = torch.zeros_like(state.path), torch.zeros_like(state.home)
    return _surveyed(rules, state._replace(weights=weights, path=nothing[0], home=nothing[1]), reading)


def _first_beliefs(rules: Rules, reading: Reading) -> Belief:
    """Return the beliefs before the first reading."""
    if rules.start_km is not None and rules.model is not None:
        if reading.place is None:
            raise ValueError(f"start_km {rules.start_km:g} needs the place of the start, as KnownPlace writes it")
        belief = at_place(reading.place, rules.start_km, reading.std, rules.motion)
        return anomalies.side_by_side(belief, reading.std, 5 if rules.integrity else 3)
    if reading.known is None or reading.known_std is None:
        return anomalies.side_by_side(before(reading.field, reading.std, rules.model), reading.std)
    beliefs = anomalies.side_by_side(before(reading.known, reading.std, rules.model), reading.std)
    given = reading.known.unsqueeze(-2), reading.known_std.unsqueeze(-2)
    return known(beliefs, *given, anomalies.sizes().to(beliefs.mean))


def advanced(rules: Rules, state: State, reading: Reading) -> tuple[State, Tensor, Tensor, Tensor]:
    """Return the state after a leg and the reading at its end, and the surprise, the tail probability and the evidence
    of that."""
    one = _true(reading, state.north)
    seen, own = _side_by_side(one), NoiseEstimate(state.log_ratio, state.readings)
    std, heading, field = seen.std.noise, seen.heading, seen.field
    motion = rules.motion._replace(drift_km=seen.drift_km)
    beliefs = moved(state.beliefs, seen.distance, heading, seen.std, motion, state.sizes)
    if seen.leg_std is not None:
        beliefs = displaced(beliefs, _leg_covariance(seen.leg_std, heading))
    prediction = predicted(beliefs, field, std < math.inf, heading)
    stated, scaled = prediction.noisy(std), std * (own.log_ratio / 2).exp()
    wide = spike_factor(prediction.noisy(scaled), scaled)
    own = noise_estimate(own, prediction.noisy(scaled * wide), std * wide)
    new = prediction.noisy(std * own.factor * wide)
    (log_weight, evidence), count = anomalies.reweighed(state.log_weight, new), _count(beliefs, seen)
    tail = anomalies.tail(state.log_weight, new, count)
    beliefs = anomalies.recentered(updated(beliefs, new), log_weight)
    surprise = (state.log_weight.exp() * stated.square()).sum(-1) / count.squeeze(-1)
    after, heading = anomalies.mixture(beliefs, log_weight), one.heading
    leg = reading.distance.unsqueeze(-1) * torch.stack((torch.cos(heading), torch.sin(heading)), -1)
    path, home, visited = state.path + reading.distance, state.home + leg, visit(state.visited, leg.to(state.visited))
    rest = visited, state.weights, path, home, _declination(after, reading), state.there
    state = State(beliefs.mean, beliefs.covariance, after.place, log_weight, *own, *rest)
    return state, surprise, tail, evidence


def _count(beliefs: Belief, seen: Reading) -> Tensor:
    """Return the number ``(..., 1)`` of elements that were read, at least 1; noise as of an outage means none."""
    read = (seen.std.noise < OUTAGE_STD) & (seen.field == seen.field) & beliefs.measured
    return read.sum(-1).clamp_min(1)


def _side_by_side(reading: Reading) -> Reading:
    """Return a reading with a dimension for beliefs side by side."""
    std = SensorStd(*(torch.as_tensor(part).unsqueeze(-2) for part in reading.std))
    distance, heading = reading.distance.unsqueeze(-1), reading.heading.unsqueeze(-1)
    leg_std = None if reading.leg_std is None else reading.leg_std.unsqueeze(-2)
    far_km = None if reading.drift_km is None else reading.drift_km.unsqueeze(-1)
    field = reading.field.unsqueeze(-2)
    return reading._replace(field=field, distance=distance, heading=heading, std=std, leg_std=leg_std, drift_km=far_km)


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
        belief: of a vehicle that knows its place.
        place: ``(..., 2)`` latitude, longitude [deg] of the fix.
        std_km: its root mean square error [km].
    """
    apart = displacement_between(belief.place, place) - belief.mean[..., PLACE]
    rows = torch.zeros_like(belief.covariance[..., :3, :])
    rows[..., :2, PLACE] = torch.eye(2).to(rows)
    noise = torch.diag(rows.new_tensor((std_km**2 / 2, std_km**2 / 2, 1.0)))
    return Innovation(pad(apart, (0, 1)), rows, rows @ belief.covariance @ rows.mT + noise)


def _leg_covariance(std: Tensor, heading: Tensor) -> Tensor:
    """Return the covariance ``(..., 2, 2)`` northward and eastward of a leg with errors along and across it."""
    cos, sin = torch.cos(heading.double()), torch.sin(heading.double())
    turn = torch.stack((cos, -sin, sin, cos), -1).unflatten(-1, (2, 2))
    return turn @ torch.diag_embed(std.double().square()) @ turn.mT


def _declination(belief: Belief, reading: Reading) -> Tensor:
    """Return the angle ``(...)`` [rad] from true north to the headings' north: D, where a vehicle steers by a compass
    and knows its place; else 0."""
    compass = reading.std.bias[..., 0].isinf() & belief.located
    return torch.where(compass, torch.atan2(belief.field[..., 1], belief.field[..., 0]), 0.0)


def _true(reading: Reading, north: Tensor) -> Reading:
    """Return a reading whose heading is that in the axes of the belief; by a compass, D is no reading."""
    compass = reading.std.bias[..., :1].isinf()
    first = torch.tensor([True, False, False], device=compass.device)
    noise = torch.where(compass & first, math.inf, reading.std.noise)
    return reading._replace(heading=reading.heading + north.to(reading.heading), std=reading.std._replace(noise=noise))


def goal_of(rules: Rules, state: State, reading: Reading) -> Destination:
    belief, crust, errors = state.belief, state.crust_nt, _true(reading, state.north).std
    std = None if rules.target_std is None else torch.tensor(rules.target_std, dtype=torch.float64)
    if rules.target_km is None:
        return destination(belief, reading.target, rules.range_km, crust, errors, std)
    place = reading.target_place
    if survey := _survey(rules, reading):
        belief = surveyed(belief, *survey, crust, errors, state.there)
    return destination(belief, reading.target, rules.range_km, crust, errors, place=place, place_km=rules.target_km)


def _survey(rules: Rules, reading: Reading) -> tuple[Tensor, Tensor, Tensor, EarthModel] | None:
    """Return the elements measured at the destination, their errors, its place and the model; None without any."""
    place, std, model = reading.target_place, rules.target_std, rules.model
    if rules.target_km is None or place is None or std is None or model is None:
        return None
    return reading.target, torch.tensor(std, dtype=torch.float64).to(place), place.double(), model


def _accuracy(state: State, reading: Reading) -> SensorStd:
    """Return the accuracy of a reading with the noise as the readings show it."""
    std = _true(reading, state.north).std
    return std._replace(noise=(std.noise * state.noise.factor).to(reading.target.dtype))


def estimated(rules: Rules, reading: Reading, state: State, surprise: Tensor, tail: Tensor) -> Track:
    """Return the track with the estimates and the plan that follow from a state."""
    goal, local, dtype = goal_of(rules, state, reading), elements(state.belief), reading.target.dtype
    points = posterior(goal)
    displacement = points.displacement()
    aim = displacement.mean.to(dtype)
    if rules.signaled and rules.target_km is None:
        radius = rules.radius_km if rules.arrival == "distance" else None
        ellipse = arrival_ellipse(local.gradient, local.covariance[..., 1:, 1:], state.weights.double(), radius)
        exact = Displacement(*(part.double() for part in displacement))
        aim = unvisited(exact, state.visited.double(), ellipse).to(dtype)
    std, percent = _accuracy(state, reading), rules.step_price if reading.price is None else reading.price.double()
    limits = rules.max_steps, rules.max_leg_km
    price = step_price(percent, PRICE_KM, aim.double(), reading.step, std.noise, *limits)
    plan = planned_leg(goal, points, aim.double(), std, price, rules.max_leg_km, rules.caution).to(dtype)
    return Track(state, points, displacement, local, aim, plan, surprise, tail, goal)


def observation(rules: Rules, track: Track, reading: Reading) -> Tensor:
    """Return what a network observes of a track ``(..., 19)``, relative to the heading
    (:func:`~magrl.pilot.observation.track_observation`)."""
    heading, like = _true(reading, track.state.north).heading.unsqueeze(-1), reading.target

    def ahead(vector: Tensor) -> Tensor:
        return turned(vector.to(like).unsqueeze(-2), heading).squeeze(-2)

    price = torch.full_like(heading, rules.step_price) if reading.price is None else reading.price.unsqueeze(-1)
    return track_observation(
        aim=ahead(track.aim),
        plan=ahead(track.plan),
        covariance=turned(turned(track.displacement.covariance, heading).mT, heading),
        gradient=turned(track.local.gradient.to(like), heading),
        remaining=element_difference(reading.target, track.local.value.to(like)),
        weights=track.state.weights,
        std=reading.std.noise.to(like) * track.state.noise.factor.to(like),
        # A policy may fly longer than it was trained for.
        time=(reading.step.unsqueeze(-1).to(heading.dtype) / rules.max_steps).clamp(max=1),
        price=price,
    )


def act(rules: Rules, track: Track, reading: Reading, network: Callable[[Tensor], Tensor] | None = None) -> Tensor:
    """Return the action of a track: distance [km] and turn [rad] ``(..., 2)``.

    Args:
        rules: rules.
        track: after the reading.
        reading: that reading.
        network: from an :func:`observation` to a correction ``(..., 2)`` of the plan
            (:func:`~magrl.pilot.planning.corrected`); None to fly as planned.
    """
    plan = track.plan if network is None else corrected(track.plan, network(observation(rules, track, reading)))
    return moving(rules, plan, _true(reading, track.state.north).heading)


def moving(rules: Rules, plan: Tensor, heading: Tensor) -> Tensor:
    """Return the action ``(..., 2)``, distance [km] and turn [rad], of a displacement ``(..., 2)`` [km]."""
    north, east = plan.unbind(-1)
    limits = rules.max_leg_km, rules.max_turn_rad
    return torch.stack(steer(heading, torch.atan2(east, north), torch.hypot(north, east), *limits), -1)


def declaring(rules: Rules, track: Track, reading: Reading, action: Tensor) -> tuple[Tensor, ArrivalDecision]:
    """Return an action ``(..., 2)`` with the declaration ``(..., 3)``: 1 where the vehicle has arrived, else -1.

    Where it is probably within the radius, and further readings are not worth their cost
    (:func:`~magrl.pilot.decision.arrival_decision`), it stays and declares.
    Before, where its estimated distance is less than the radius, it approaches the estimated place and stops where
    readings are worth most (:func:`~magrl.pilot.decision.approach`). Elsewhere it moves as ``action`` says.
    """
    state, left = track.state, rules.max_steps - 1 - reading.step
    price = rules.step_price if reading.price is None else reading.price
    progress = Progress(state.path, state.home, left, price, rules.max_leg_km)
    goal, std = track.goal or goal_of(rules, state, reading), _accuracy(state, reading)
    decision = arrival_decision(goal, track.posterior, std, progress, rules.radius_km)
    heading = _true(reading, state.north).heading.unsqueeze(-1)
    displacement, stop = (part.to(action.dtype) for part in (decision.displacement, decision.stop_km.unsqueeze(-1)))
    near = displacement.norm(dim=-1, keepdim=True) < rules.radius_km
    last = approach(displacement, heading, stop, rules.max_leg_km, rules.max_turn_rad)
    action = torch.where(near, last.to(action), action)
    declare = (decision.declare & (decision.probability >= rules.confidence)).unsqueeze(-1)
    return torch.cat((action.masked_fill(declare, 0.0), 2.0 * declare.to(action) - 1), -1), decision
