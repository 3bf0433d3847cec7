"""The reward for holding a heading."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from magrl import guidance
from magrl.checks import check_number
from magrl.transforms.base import Keys, key_list, several_keys, sorted_keys


class AlignmentReward(Transform):
    """Adds to the reward of a step what its angle deserves beside a reference (Eq. 3-6).

    The reference is read where the move was chosen, the angle where it led: the heading of the move just made. In a
    replay buffer or as a module, the angle and the reward are those under ``"next"``.

    Args:
        in_keys: the angle and the reference [rad], of equal shape; and, if wanted, a mask of the reference: where it
            is False the term is 0.
        out_keys: one reward, to which the term is added; created if the env has none of that name.
        weight: zeta_3 [1/rad].
        offset: deviation at which the term changes sign [rad]. The paper's pi/4 pays at every aligned step, so that
            dawdling pays too; 0 only ever takes away.

    Raises:
        ValueError: for a weight or an offset that is not finite, or another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> step = TensorDict(reference=torch.zeros(1), next=TensorDict(angle=torch.zeros(1), reward=torch.ones(1)))
        >>> AlignmentReward(["angle", "reference"], weight=4 / math.pi)(step)["next", "reward"]
        tensor([2.])
    """

    def __init__(
        self,
        in_keys: Keys = ("heading", "gradient_heading", "gradient_heading_valid"),
        out_keys: NestedKey | Keys = ("reward",),
        *,
        weight: float = 3.0,
        offset: float = math.pi / 4,
    ) -> None:
        super().__init__(in_keys=several_keys(in_keys), out_keys=key_list(out_keys))
        if len(self.in_keys) not in (2, 3) or len(self.out_keys) != 1:
            raise ValueError(
                f"AlignmentReward reads an angle, a reference and perhaps a mask, and writes one reward; "
                f"got in_keys {self.in_keys}, out_keys {self.out_keys}"
            )
        check_number(weight=weight, offset=offset)
        self.weight, self.offset = float(weight), float(offset)

    def term(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
        """The alignment term of a step, in the shape of the angle: what is added to the reward."""
        angle, (reference, *mask) = next_tensordict[self.in_keys[0]], (tensordict[key] for key in self.in_keys[1:])
        value = guidance.alignment_reward(angle, reference, self.weight, self.offset)
        return torch.where(mask[0], value, 0.0) if mask else value

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, source in zip(self.in_keys, (next_tensordict, tensordict, tensordict), strict=False):
            if source.get(key, None) is None:
                if self.missing_tolerance:
                    return next_tensordict
                raise KeyError(f"AlignmentReward reads {key!r}, which is not among {sorted_keys(source)}")
        term = self.term(tensordict, next_tensordict)
        reward = next_tensordict.get(self.out_keys[0], None)
        next_tensordict.set(self.out_keys[0], term if reward is None else reward + term)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds the term to the reward under ``next`` of whole transitions."""
        if tensordict.get("next", None) is None:
            raise KeyError(
                "AlignmentReward needs whole transitions: the reference at the root and the angle and reward under "
                f"'next', got {sorted_keys(tensordict)}"
            )
        self._step(tensordict, tensordict["next"])
        return tensordict

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """The reward without bounds, in the shape that it had or else in that of the angle."""
        key = self.out_keys[0]
        if key in reward_spec.keys(True, True):
            leaf = reward_spec[key]
            reward_spec[key] = Unbounded(leaf.shape, device=leaf.device, dtype=leaf.dtype)
        else:
            leaf = self._observed(self.in_keys[0])
            reward_spec[key] = Unbounded(leaf.shape, device=leaf.device, dtype=leaf.dtype)
        return reward_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Makes the reference part of the state, so that batched and parallel envs hand it to the next step."""
        input_spec = input_spec.clone()
        if input_spec["full_state_spec"] is None:
            input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
        for key in self.in_keys[1:]:
            input_spec["full_state_spec"][key] = self._observed(key).clone()
        return input_spec

    def _observed(self, key: NestedKey) -> TensorSpec:
        parent = self.parent
        spec = Composite() if parent is None else parent.full_observation_spec
        if key not in spec.keys(True, True):
            raise KeyError(f"AlignmentReward reads {key!r}, which is not among the observations {sorted_keys(spec)}")
        return spec[key]
