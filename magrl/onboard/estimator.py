"""The estimates of a vehicle: of the filter that its policy observes, or of one beside its navigator."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose

from magrl import tracking
from magrl.onboard.limits import view_of
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import ArrivalDecision, FieldTrack
from magrl.transforms import NoiseScale, TrackGradient, TrackView
from magrl.transforms.track import TRACK_KEYS


class Estimator:
    """The estimates of one vehicle, by the filter of :func:`~magrl.evaluation.scenarios.with_declaration`.

    A trained policy that reads its own track observes this filter. Beside any other navigator it runs on its own.

    Args:
        navigator: policy or navigator.

    Example:
        >>> from magrl.agents import load_pretrained
        >>> from magrl.navigators import Secant
        >>> Estimator(load_pretrained("anywhere")).trained, Estimator(Secant()).trained
        (True, False)
    """

    def __init__(self, navigator: Any) -> None:
        self.navigator = navigator
        self.trained = isinstance(view_of(navigator), TrackView)
        self.observe = navigator.observe if self.trained else Compose(TrackGradient(std_keys=STD_KEYS))
        self.noise = NoiseScale()
        self.state: Any = None

    def act(self, seen: TensorDictBase) -> list[float]:
        """Return distance and turn, and of a policy that declares its arrival the declaration.

        Args:
            seen: public keys and standard deviations after a move, in a batch of one.
        """
        now = seen.copy()
        if self.state is None:
            self.state = self.observe(self.noise(now))
        else:
            self.state = self.observe(self.noise(self.state.set("next", now)))["next"]
        if self.trained:
            action = self.navigator.act.denormalize("action", self.navigator.actor(self.state)["action"])
        else:
            action = self.navigator(self.state)["action"]
        return action[0].tolist()

    def decide(self, seen: TensorDictBase, steps_left: Tensor, radius_km: float) -> ArrivalDecision:
        """Return the decision about the arrival, in a batch of one; see :func:`magrl.tracking.arrival_decision`."""
        target = seen["target_field"]
        std = SensorStd.read(seen)._replace(noise=self.state["sensor_std"])
        track = FieldTrack(*(self.state[key].to(target.dtype) for key in TRACK_KEYS))
        return tracking.arrival_decision(track, target, *std, steps_left, radius_km)

    @property
    def track(self) -> FieldTrack:
        """State of the filter after the last reading."""
        return FieldTrack(*(self.state[key][0] for key in TRACK_KEYS))

    def surprise(self, seen: TensorDictBase) -> float:
        """Return how badly a reading fits the track before it, see :func:`magrl.tracking.surprise`."""
        displacement = tracking.displacement_of(seen["move"], seen["heading"])[0]
        std = tracking.reading_std(seen["sensor_std"], seen["drift_std"])[0]
        return tracking.surprise(self.track, displacement, seen["field"][0], std)
