"""The estimates of a vehicle: of the belief that its policy observes, or of one beside its navigator."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose

from magrl import tracking
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import RANGE_KM, ArrivalDecision, Belief, DestinationPosterior
from magrl.transforms import TrackField, TrackView
from magrl.transforms.errors.known_start import START_KEYS
from magrl.transforms.track import POSTERIOR_KEYS, belief_of
from magrl.vehicle.onboard.limits import view_of


class Estimator:
    """The estimates of one vehicle, as of :func:`~magrl.evaluation.scenarios.with_declaration`.

    A policy with a :class:`~magrl.transforms.TrackView` observes them. Beside any other navigator they stand alone.

    Args:
        navigator: policy or navigator.

    Example:
        >>> from magrl.agents import load_pretrained
        >>> from magrl.navigators import Secant
        >>> Estimator(load_pretrained("anywhere")).trained, Estimator(Secant()).trained
        (True, False)
    """

    def __init__(self, navigator: Any) -> None:
        self.navigator, view = navigator, view_of(navigator)
        self.tracked = isinstance(view, TrackView)
        self.trained = self.tracked and navigator.config.num_cells is not None
        self.range_km = view.range_km if isinstance(view, TrackView) else RANGE_KM
        track = TrackField(std_keys=STD_KEYS, estimate_noise=True, range_km=self.range_km)
        observed = view.observation_transforms(tracked=True) if isinstance(view, TrackView) else []
        self.observe = Compose(track, *observed)
        self.state: Any = None

    def act(self, seen: TensorDictBase) -> list[float]:
        """Return distance and turn, and of a policy that declares its arrival the declaration.

        Args:
            seen: public keys and standard deviations after a move, in a batch of one.
        """
        now = seen.copy()
        self.state = self.observe(now) if self.state is None else self.observe(self.state.set("next", now))["next"]
        if self.tracked:
            action = self.navigator.act.denormalize("action", self.navigator.actor(self.state)["action"])
        else:
            action = self.navigator(self.state)["action"]
        return action[0].tolist()

    def decide(self, seen: TensorDictBase, steps_left: Tensor, radius_km: float) -> ArrivalDecision:
        """Return the decision about the arrival, in a batch of one; see :func:`magrl.tracking.arrival_decision`."""
        goal = tracking.destination(self.belief, seen["target_field"], self.range_km)
        return tracking.arrival_decision(goal, self.posterior, SensorStd.read(self.state), steps_left, radius_km)

    @property
    def belief(self) -> Belief:
        """What is known of the field after the last reading, in a batch of one."""
        return belief_of(self.state)

    @property
    def posterior(self) -> DestinationPosterior:
        """Where the destination is, in a batch of one."""
        return DestinationPosterior(*(self.state[key] for key in POSTERIOR_KEYS))

    def surprise(self, seen: TensorDictBase) -> float:
        """Return the normalized square of the innovation of a reading, over the number of elements: 1 on average where
        the belief is right."""
        course, errors = seen["heading"].squeeze(-1), SensorStd.read(seen)
        reading = seen["field"] + seen.get(START_KEYS[0], 0.0)  # as it was read
        belief = tracking.moved(self.belief, seen["move"][..., 0], course, errors)
        square = tracking.innovation(belief, reading, errors.noise, course).square()
        return (square / belief.measured.sum(-1)).item()

    @property
    def steepest_inclination(self) -> float:
        """Return the greatest gradient that the inclination may have: the estimate and two standard deviations
        [deg / 100 km]."""
        local = tracking.elements(self.belief)
        spread = local.covariance[0, 1, 1:, 1:].diagonal().sum().sqrt()
        return 100 * (local.gradient[0, 1].norm() + 2 * spread).item()
