"""Declaration of arrival from the vehicle's own estimate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from magrl import tracking
from magrl.checks import check_number
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import DestinationPosterior
from magrl.transforms.base import Keys, ObservationTransform, observed_spec, with_state
from magrl.transforms.track import BELIEF_KEYS, POSTERIOR_KEYS, belief_of


class DeclareArrival(ObservationTransform):
    """Declare arrival from the vehicle's own estimate, so that any navigator can fly without an arrival signal.

    For an environment whose action has a third number that declares the arrival. To the policy, the action has the
    first two. Where the vehicle is probably within the radius, and further readings are not worth their cost
    (:func:`magrl.tracking.arrival_decision`), it stays where it is and declares. Before, where its estimated distance
    is less than the radius, it goes toward the estimated place (:func:`magrl.tracking.approach`), stops where readings
    are worth most, and turns between them. Elsewhere it moves as the policy wants.

    In ``Compose``, it stands behind :class:`TrackField`. It reads nothing privileged.

    Args:
        radius_km: distance from the target within which a declaration is correct [km].
        max_steps: step limit: the last step declares.
        confidence: minimum probability of arrival for a declaration; below it, episodes end without one.
        range_km: prior standard deviation of the way along each axis [km].
        crust_nt: as of :class:`TrackField`.
        in_keys: elements at the target ``(..., 3)``, belief and posterior of :class:`TrackField`, heading ``(..., 1)``
            [rad], and number of the step ``(..., 1)``.
        out_keys: probability ``(..., 1)`` that the target is within the radius, the probability ``(..., 1)`` at which
            continuing has the same value, the estimated way ``(..., 2)`` northward and eastward [km], and the distance
            ``(..., 1)`` from its end at which to stop [km].
        std_keys: where readings come with standard deviations ``(..., 3)``, :data:`magrl.sensor_std.STD_KEYS`.

    Raises:
        ValueError: for an option out of its range, another number of keys, or an environment whose action has no third
            number.
        KeyError: for a missing key.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.agents import kalman
        >>> from magrl.transforms import TrackField
        >>> base = GeomagneticNavEnv(num_envs=20, arrival="declared", arrival_radius_km=25.0, seed=0)
        >>> env = TransformedEnv(base, Compose(TrackField(), DeclareArrival(25.0, max_steps=50)))
        >>> flown = env.rollout(50, kalman(), break_when_any_done=False)
        >>> flown["next", "declared"].any(1).sum(), flown["next", "success"].any(1).sum()
        (tensor(20), tensor(20))
    """

    default_in_keys = ("target_field", *BELIEF_KEYS, *POSTERIOR_KEYS, "heading", "elapsed_steps")
    default_out_keys = ("arrival_probability", "arrival_worth", "arrival_way", "arrival_stop")
    optional_in_keys = STD_KEYS
    in_sizes = (3, None, None, 1, 2, None, 1, 1, 3, 3, 3, 3)
    out_sizes = ((1,), (1,), (2,), (1,))
    invertible = True

    def __init__(
        self,
        radius_km: float,
        *,
        max_steps: int,
        confidence: float = 0.0,
        range_km: float = tracking.RANGE_KM,
        crust_nt: float = 0.0,
        std_keys: Keys = (),
        **keys: Any,
    ) -> None:
        super().__init__(optional=std_keys, **keys, in_keys_inv=["action"], out_keys_inv=["action"])
        check_number(0, above=True, radius_km=radius_km, range_km=range_km)
        check_number(0, 1, confidence=confidence)
        check_number(0, crust_nt=crust_nt)
        check_number(1, whole=True, max_steps=max_steps)
        self.radius_km, self.range_km, self.crust_nt = float(radius_km), float(range_km), float(crust_nt)
        self.max_steps, self.confidence = int(max_steps), float(confidence)

    def _compute(self, values: list[Tensor]) -> Sequence[Tensor]:
        seen = self._named(values)
        target, none = seen["target_field"], torch.zeros_like(seen["target_field"])
        errors = SensorStd(*(seen.get(key, none) for key in STD_KEYS))
        left = self.max_steps - 1 - seen["elapsed_steps"].squeeze(-1)
        goal = tracking.destination(belief_of(seen), target, self.range_km, self.crust_nt)
        posterior = DestinationPosterior(*(seen[key] for key in POSTERIOR_KEYS))
        decision = tracking.arrival_decision(goal, posterior, errors, left, self.radius_km)
        probability, worth, stop = (x.unsqueeze(-1) for x in (decision.probability, decision.worth, decision.stop_km))
        return tuple(x.to(target.dtype) for x in (probability, worth, decision.way, stop))

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(tensordict, [*self.out_keys, self._named(self.in_keys)["heading"], *self.in_keys_inv])
        if values is None:
            return tensordict
        probability, worth, way, stop, heading, action = values
        high = self.parent.full_action_spec[self.in_keys_inv[0]].space.high
        approach = tracking.approach(way, heading, stop, *high[..., :2].split(1, -1)).to(action.dtype)
        near = way.norm(dim=-1, keepdim=True) < self.radius_km
        declare = (probability >= worth) & (probability >= self.confidence)
        action = torch.where(near, approach, action).masked_fill(declare, 0.0)
        return tensordict.set(self.in_keys_inv[0], torch.cat((action, 2.0 * declare - 1), -1))

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Leave the third number out of the action, and make the estimates part of the state for other processes."""
        key, action = self.in_keys_inv[0], input_spec["full_action_spec"][self.in_keys_inv[0]]
        if action.shape[-1] != 3:
            raise ValueError(
                "DeclareArrival needs an environment whose action has a third number that declares the arrival, such "
                f"as GeomagneticNavEnv(arrival='declared'); {key!r} is {tuple(action.shape)}"
            )
        if self.parent is not None:
            observed = self.transform_observation_spec(observed_spec(self).clone())
            input_spec = with_state(input_spec, {name: observed[name] for name in self.out_keys})
        low, high = action.space.low[..., :2], action.space.high[..., :2]
        input_spec["full_action_spec"][key] = Bounded(low, high, low.shape, device=action.device, dtype=action.dtype)
        return input_spec
