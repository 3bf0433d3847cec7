"""Base classes of policies: a state from step to step, and the limits of an environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from magrl.checks import check_type
from magrl.envs import GeomagneticNavEnv
from magrl.transforms import ObservationView


class Memory(TensorDictModuleBase):
    """Base class of modules that keep a state for each vehicle from step to step."""

    state_keys: Sequence[str] = ()
    """Keys of the state."""
    state: TensorDictBase | None = None
    """State after the last call, with the state before it; None before the first call."""

    def _state_before(self, seen: TensorDictBase) -> tuple[TensorDictBase | None, Tensor]:
        """Return the state before a step and a mask of new episodes ``(..., 1)``; repeated calls return the same."""
        stored, starts = self.state, seen["elapsed_steps"] == 0
        if stored is None or stored.shape != seen.shape or stored.device != seen.device:
            return None, torch.ones_like(starts)
        again = stored["step"] == seen["elapsed_steps"]
        before = torch.where(again.squeeze(-1), stored["before"], stored.select(*self.state_keys))
        return before, starts | (again & stored["starts"])

    def _keep_state(
        self, seen: TensorDictBase, before: TensorDictBase | None, starts: Tensor, state: TensorDictBase
    ) -> None:
        """Store the state for the next step, and the state before this one."""
        begun = {"step": seen["elapsed_steps"].clone(), "starts": starts, "before": state if before is None else before}
        self.state = state.clone(recurse=False).update(begun)


class TrainedPolicy(Memory):
    """Base class of trained policies: from public keys of the plain environment to an action in km and rad."""

    out_keys: ClassVar[list[str]] = ["action"]
    view: Any
    """What the policy observes, with the range of the field where it was trained, if it was trained in one region."""
    declares = False
    """Whether its action has a third number, which declares the arrival."""

    def for_env(self, env: EnvBase) -> TrainedPolicy:
        """Return the policy for the limits of an environment.

        Raises:
            ValueError: as :meth:`check_fits`.
        """
        self.check_fits(env)
        return self

    def check_fits(self, env: EnvBase) -> None:
        """Raise unless an environment has the field of the policy, and allows its moves and declarations.

        Args:
            env: navigation environment, with transforms or without.

        Raises:
            ValueError: naming the element and both ranges, or both limits; or for a policy that declares its arrival,
                where the episode ends otherwise.
        """
        env = getattr(env, "base_env", env)
        check_type(GeomagneticNavEnv, env=env)
        if self.declares and not env.arrival.declared:
            raise ValueError(
                f"the policy declares its arrival: fly it with arrival 'declared', not {env.arrival.rule!r}"
            )
        if isinstance(self.view, ObservationView):
            self.view.check_covers(env.field, env.region.grid(81).to(env.device))
