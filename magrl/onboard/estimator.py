"""The estimates of a vehicle: of the filter of its navigator, or of one beside it."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose

from magrl import tracking
from magrl.navigators import Kalman, QuasiNewton
from magrl.onboard.limits import view_of
from magrl.tracking import FieldTrack
from magrl.transforms import TrackGradient, TrackView
from magrl.transforms.track import IN_KEYS, OUT_KEYS, STD_KEYS

RANGE_KM = 1000.0
"""Prior standard deviation of the way along each axis, except for trained policies [km]."""


class Estimator:
    """The estimates of one vehicle, of the filter by which it is navigated where there is one.

    A trained policy that reads its own track observes the estimates. The filter of a :class:`QuasiNewton` navigator is
    read after its decision. Beside any other navigator runs a :class:`~magrl.transforms.TrackGradient`.

    Args:
        navigator: policy or navigator.

    Example:
        >>> from magrl.navigators import RunAndTumble, Secant
        >>> Estimator(Secant()).own, Estimator(RunAndTumble()).own
        (True, False)
    """

    def __init__(self, navigator: Any) -> None:
        self.navigator = navigator
        view = view_of(navigator)
        self.trained = isinstance(view, TrackView)
        self.own = isinstance(navigator, QuasiNewton) and navigator.elements == [0, 1, 2]
        options: dict[str, Any] = {}
        if self.own:
            relation = tracking.curl_relation if isinstance(navigator, Kalman) else None
            options = {"scales": navigator.scales.tolist(), "relation": relation}
        self.tracker = TrackGradient((*IN_KEYS, *STD_KEYS), range_km=RANGE_KM, frame="vehicle", **options)
        self.observe = navigator.observe if self.trained else Compose(self.tracker)
        self.state_keys = view.state_keys if isinstance(view, TrackView) else self.tracker.state_keys
        self.state: Any = None

    def act(self, seen: TensorDictBase) -> tuple[TensorDictBase, tuple[float, float]]:
        """Return the estimates, in the keys of :class:`~magrl.transforms.TrackGradient`, and distance and turn.

        Args:
            seen: public keys and standard deviations after a move, in a batch of one.
        """
        if self.own:
            action = self.navigator(seen)["action"]
            track = FieldTrack(self.navigator.memory["mean"], self.navigator.memory["covariance"])
            known = (seen[key].double() for key in ("target_field", "heading", STD_KEYS[1]))
            written = *track, *self.tracker.estimates(track, *known)
            observed = TensorDict(dict(zip(OUT_KEYS, written, strict=True)), [1])
        else:
            now = seen.copy()
            observed = self.observe(now) if self.state is None else self.observe(self.state.set("next", now))["next"]
            self.state = observed.select(*self.state_keys)
            if self.trained:
                action = self.navigator.act.denormalize("action", self.navigator.actor(observed)["action"])
            else:
                action = self.navigator(seen)["action"]
        distance, turn = action[0].tolist()
        return observed, (distance, turn)

    @property
    def track(self) -> FieldTrack:
        """State of the filter after the last reading."""
        state, keys = (self.navigator.memory, ("mean", "covariance")) if self.own else (self.state, OUT_KEYS[:2])
        return FieldTrack(*(state[key][0] for key in keys))

    def surprise(self, seen: TensorDictBase) -> float:
        """Return how badly a reading fits the track before it, see :func:`magrl.tracking.surprise`."""
        displacement = tracking.displacement_of(seen["move"], seen["heading"])[0]
        return tracking.surprise(self.track, displacement, seen["field"][0], seen["sensor_std"][0], self.tracker.scales)
