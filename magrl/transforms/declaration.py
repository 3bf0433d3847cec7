"""Transform that declares the arrival of a vehicle from its own estimate of the way to the target."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import Transform

from magrl.checks import check_number
from magrl.transforms.base import Keys, observed_spec, several_keys, sorted_keys, with_state


class DeclareArrival(Transform):
    """Declare the arrival of vehicles that estimate to be near their target; so any navigator can be flown.

    For an environment whose action has a third number that declares the arrival. To the policy, the action has the
    first two. Where the root of the mean square distance to the target, ``sqrt(|way|^2 + trace(covariance))``, is at
    most ``within_km``, the vehicle stays where it is and declares; elsewhere it moves as the policy wants.

    In ``Compose``, it stands behind :class:`~magrl.transforms.TrackGradient`, whose estimates it reads. It reads
    nothing privileged.

    Args:
        within_km: largest root mean square of the estimated distance at which a vehicle declares [km].
        way_keys: estimated way ``(..., 2)`` [km] and its covariance ``(..., 2, 2)`` [km^2].
        action_key: action, ``(..., 2)`` to the policy and ``(..., 3)`` to the environment.

    Raises:
        ValueError: for a distance that is not positive, other than two keys, or an environment whose action has no
            third number.
        KeyError: for a missing estimate.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.navigators import Kalman
        >>> from magrl.transforms import TrackGradient
        >>> base = GeomagneticNavEnv(num_envs=20, arrival="declared", arrival_radius_km=25.0, seed=0)
        >>> env = TransformedEnv(base, Compose(TrackGradient(), DeclareArrival(within_km=20.0)))
        >>> flown = env.rollout(50, Kalman(), break_when_any_done=False)
        >>> flown["next", "declared"].any(1).sum(), flown["next", "success"].any(1).sum()
        (tensor(20), tensor(20))
    """

    invertible = True

    def __init__(
        self,
        within_km: float,
        *,
        way_keys: Keys = ("way", "way_covariance"),
        action_key: NestedKey = "action",
    ) -> None:
        check_number(0, above=True, within_km=within_km)
        super().__init__(in_keys_inv=[action_key], out_keys_inv=[action_key])
        self.within_km, self.way_keys = float(within_km), several_keys(way_keys)
        if len(self.way_keys) != 2:
            raise ValueError(f"way_keys must be those of the way and its covariance, got {self.way_keys}")

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        missing = [key for key in (*self.way_keys, *self.in_keys_inv) if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"DeclareArrival reads {missing}, which are not among {sorted_keys(tensordict)}: it stands behind "
                "TrackGradient"
            )
        way, covariance = (tensordict.get(key) for key in self.way_keys)
        square = way.square().sum(-1, keepdim=True) + covariance.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
        declare = square <= self.within_km**2
        action = tensordict.get(self.in_keys_inv[0])
        action = torch.cat((action.masked_fill(declare, 0.0), 2.0 * declare - 1), -1)
        return tensordict.set(self.in_keys_inv[0], action)

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Leave the third number out of the action, and make the estimates part of the state for other processes."""
        key, action = self.in_keys_inv[0], input_spec["full_action_spec"][self.in_keys_inv[0]]
        if action.shape[-1] != 3:
            raise ValueError(
                "DeclareArrival needs an environment whose action has a third number that declares the arrival, such "
                f"as GeomagneticNavEnv(arrival='declared'); {key!r} is {tuple(action.shape)}"
            )
        observed = observed_spec(self)
        estimates = {key: observed[key] for key in self.way_keys if key in observed.keys(True, True)}
        input_spec = with_state(input_spec, estimates)
        low, high = action.space.low[..., :2], action.space.high[..., :2]
        input_spec["full_action_spec"][key] = Bounded(low, high, low.shape, device=action.device, dtype=action.dtype)
        return input_spec
