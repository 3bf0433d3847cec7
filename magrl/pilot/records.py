"""The records of a pilot: what it knows before it starts, a reading, the state between steps, and the track."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

from pydantic import ConfigDict, Field, model_validator
from torch import Tensor

from magrl.checks import CheckedModel
from magrl.pilot import anomalies
from magrl.pilot.belief import ANOMALY_KM, LONGER_KM, Belief, LocalElements, Motion
from magrl.pilot.destination import RANGE_KM, Destination
from magrl.pilot.displacement import DestinationPosterior, Displacement
from magrl.pilot.earth import EarthModel
from magrl.pilot.noise import NoiseEstimate
from magrl.pilot.planning import CAUTION, STEP_PRICE
from magrl.sensor_std import SensorStd

FARTHEST_START_KM = 100.0
"""Largest error of a known place or a leg [km]: over longer distances, the field is not linear in the place."""
_Std = Annotated[float, Field(ge=0)]


class EpisodeRules(CheckedModel):
    """Rules of an episode that a vehicle knows: the limits of a leg, and what ends the episode.

    Each rule is declared here alone. Scenarios and :class:`Rules` inherit them, and commands and recipes take them from
    there (:func:`magrl.envs.scenario.rule_settings`).

    Raises:
        ValueError: for a value out of its range, or an unknown name.

    Example:
        >>> EpisodeRules(max_turn_deg=180.0).max_turn_rad, EpisodeRules(arrival="declared").declared
        (3.141592653589793, True)
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    max_steps: Annotated[int, Field(ge=1, le=10**9)] = 50
    """Legs after which an episode is truncated."""
    max_leg_km: Annotated[float, Field(gt=0, le=1000)] = 50.0
    """Longest leg [km]."""
    max_turn_deg: Annotated[float, Field(gt=0, le=180)] = 90.0
    """Largest turn to either side before a leg [deg]."""
    zeta: Annotated[float, Field(gt=0, lt=3)] = 0.01
    """Arrival threshold on the objective F (Eq. (7)), below 3, its largest value at the start."""
    arrival: Literal["objective", "distance", "declared"] = "objective"
    """Rule of arrival: F below zeta (objective); a distance below radius_km (distance); or a third number of the
    action, in [-1, 1], by which the vehicle declares above 0 that it has arrived (declared): that ends the episode,
    within radius_km as a success and elsewhere as a false arrival."""
    radius_km: Annotated[float, Field(gt=0)] = 25.0
    """Distance from the destination of an arrival by distance, or of a correct declaration [km]."""

    @property
    def max_turn_rad(self) -> float:
        """Largest turn [rad]."""
        return math.radians(self.max_turn_deg)

    @property
    def declared(self) -> bool:
        """Whether the vehicle declares its arrival; else, it gets a signal."""
        return self.arrival == "declared"


class Known(CheckedModel):
    """What a vehicle knows of its trip beside the rules of the episode, and decides with.

    Each is declared here alone. :class:`Rules` and the sheet of a simulated vehicle (:class:`magrl.evaluation.Sheet`)
    inherit it, and commands take their options from there. A title names it below tables, with its units.

    Raises:
        ValueError: for a value out of its range, or an unknown name.

    Example:
        >>> Known(confidence=2.0)
        Traceback (most recent call last):
        ValueError: confidence must be less than or equal to 1, got 2.0
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    start_km: Annotated[float | None, Field(ge=0, le=FARTHEST_START_KM, title="Error of the known start [km]")] = None
    """Error (RMS) of the start as vehicles know it, with a model [km]; by default they do not know their start."""
    target_std: Annotated[
        tuple[_Std, _Std, _Std] | None,
        Field(strict=False, title="Errors of the elements at the destination [deg, deg, nT]"),
    ] = (0.0, 0.0, 0.0)
    """Errors of D [deg], I [deg], B_H [nT] at the destination (standard deviations); exact by default.
    None if the elements are from the vehicles' own model, to which they add nothing."""
    confidence: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Minimum estimated probability of a correct arrival at which vehicles declare it."""


class Rules(Known, EpisodeRules):
    """What a vehicle knows before it starts: the rules of the episode, and what it expects of the field.

    Args:
        range_km: prior standard deviation of the displacement to the destination along each axis [km].
        step_price: price of a step [% of SPL]: a higher one gives fewer steps and a longer path.
        caution: weight of the uncertainty in the plan.
        model: model of the Earth that the vehicle carries (:func:`~magrl.pilot.earth_model`); None for no other
            knowledge than the spectrum of the Earth's field.
        target_km: root mean square error of the place of the destination [km]; None where it knows the elements alone.
        drift: constant drift of dead reckoning along each axis [share of the distance].
        wander_km: random part of it along each axis after 1 km [km].
        integrity: whether a claim must hold though start, drift or anomalies are not as stated, on board alone
            (:mod:`magrl.onboard.integrity`); a known place then has anomalies of five sizes, of a longer range.

    Raises:
        ValueError: for a value out of its range, or an unknown name.

    Example:
        >>> Rules(max_steps=80).replace(arrival="declared").signaled
        False
    """

    range_km: Annotated[float, Field(gt=0)] = RANGE_KM
    step_price: Annotated[float, Field(gt=0)] = STEP_PRICE
    caution: Annotated[float, Field(ge=0)] = CAUTION
    model: EarthModel | None = None
    target_km: Annotated[float | None, Field(ge=0, le=FARTHEST_START_KM)] = None
    drift: Annotated[float, Field(ge=0, le=1)] = 0.0
    wander_km: Annotated[float, Field(ge=0)] = 0.0
    integrity: bool = False

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
        if self.start_km is None:
            return Motion(None, self.drift, self.wander_km)
        return Motion(self.model, self.drift, self.wander_km, LONGER_KM if self.integrity else ANOMALY_KM)

    @property
    def signaled(self) -> bool:
        """Whether the vehicle gets an arrival signal, so that the destination is not where it has been."""
        return not self.declared


class Reading(NamedTuple):
    """What a vehicle measures and knows at one step.

    Args:
        field: ``(..., 3)`` D [deg], I [deg], B_H [nT] as read; NaN for an element that is missing.
        target: ``(..., 3)`` the same at the destination.
        distance: ``(...)`` of the leg before the reading [km].
        heading: ``(...)`` [rad].
        std: accuracy of the reading, tensors ``(..., 3)``.
        step: ``(...)`` number of the step, 0 at the start.
        known: ``(..., 3)`` elements at the start, where they are known; they count at the first reading.
        known_std: ``(..., 3)`` their standard deviations.
        price: ``(...)`` price of a step [% of SPL] of each vehicle; None for the rules' price.
        place: ``(..., 2)`` latitude, longitude [deg] of the start, where it is known; it counts at the first reading.
        target_place: ``(..., 2)`` the same of the destination.
        leg_std: ``(..., 2)`` standard deviations of the leg, along and across it, beside the drift of the rules [km].
        drift_km: ``(...)`` distance over which dead reckoning drifts by the rules [km]; None for that of the leg.
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
    drift_km: Tensor | None = None


class State(NamedTuple):
    """What a step needs of the one before, all tensors: the beliefs side by side (:mod:`~magrl.pilot.anomalies`)
    ``(..., H, S)``, ``(..., H, S, S)``, their place ``(..., 2)`` and the logarithms of their weights ``(..., H)``;
    their noise estimates ``(..., H, 3)`` twice; displacements to visited places ``(..., 24, 2)`` [km]; weights of the
    objective ``(..., 3)``; the path flown ``(...)`` and the displacement from the start ``(..., 2)`` [km]; and the
    angle of north ``(...)``, from the belief's north to the headings' north [rad]: D, where a compass and a place are
    known; and the size ``(...)`` of an anomaly at the destination alone [nT]."""

    mean: Tensor
    covariance: Tensor
    place: Tensor
    log_weight: Tensor
    log_ratio: Tensor
    readings: Tensor
    visited: Tensor
    weights: Tensor
    path: Tensor
    home: Tensor
    north: Tensor
    there: Tensor

    @property
    def belief(self) -> Belief:
        """The belief of the field."""
        return anomalies.mixture(self.beliefs, self.log_weight)

    @property
    def beliefs(self) -> Belief:
        """Those with anomalies of each size."""
        return Belief(self.mean, self.covariance, self.place.unsqueeze(-2))

    @property
    def noise(self) -> NoiseEstimate:
        """The noise over the stated one."""
        weight = self.log_weight.exp().unsqueeze(-1)
        return NoiseEstimate((weight * self.log_ratio).sum(-2), (weight * self.readings).sum(-2))

    @property
    def sizes(self) -> Tensor:
        """Sizes ``(H,)`` of the anomaly [nT]."""
        return anomalies.sizes(self.log_weight.shape[-1]).to(self.mean)

    @property
    def crust_nt(self) -> Tensor:
        """Expected size ``(...)`` of the anomaly [nT], the root of the mean of the squares."""
        return (self.log_weight.exp() * self.sizes.square()).sum(-1).sqrt()


class Track(NamedTuple):
    """What a vehicle knows after a reading.

    Attributes:
        state: what the next step needs.
        posterior: of the displacement to the destination.
        displacement: its mean and covariance [km].
        local: elements and gradients at the vehicle.
        aim: ``(..., 2)`` displacement to aim at [km]: the mean, or where it has not been.
        plan: ``(..., 2)`` displacement of the next leg as planned [km].
        surprise: ``(...)`` normalized square of the innovation by the stated noise, over the number of elements; about
            1 where all is right.
        tail: ``(...)`` probability of a reading that is more surprising, where everything stated is true.
        goal: the destination as seen from the belief; None if it is to be computed again, as from a TensorDict.
    """

    state: State
    posterior: DestinationPosterior
    displacement: Displacement
    local: LocalElements
    aim: Tensor
    plan: Tensor
    surprise: Tensor
    tail: Tensor
    goal: Destination | None = None
