"""Tests of a transform in environments, after those of TorchRL's own transforms; parametrize a subclass by cases."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torchrl.envs import EnvBase, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

Base = Callable[[], EnvBase]
Make = Callable[[], Transform]


class Conformance:
    def test_single_trans_env_check(self, base: Base, make: Make) -> None:
        check_env_specs(TransformedEnv(base(), make()), break_when_any_done="both")

    def test_serial_trans_env_check(self, base: Base, make: Make) -> None:
        check_env_specs(SerialEnv(2, lambda: TransformedEnv(base(), make())))

    def test_trans_serial_env_check(self, base: Base, make: Make) -> None:
        check_env_specs(TransformedEnv(SerialEnv(2, base), make()))

    def test_copies(self, base: Base, make: Make) -> None:
        env = TransformedEnv(base(), make())
        env.rollout(2)
        check_env_specs(copy.deepcopy(env))
        check_env_specs(TransformedEnv(base(), env.transform.clone()))
        check_env_specs(TransformedEnv(base(), pickle.loads(pickle.dumps(make()))))

    def test_a_partial_reset_leaves_the_others_alone(self, base: Base, make: Make) -> None:
        env = TransformedEnv(base(), make())
        if not env.batch_size or not env.base_env.batch_locked or not hasattr(env.base_env, "vehicle"):
            pytest.skip("the environment keeps no state of some")
        state = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
        chosen = torch.arange(len(state)) % 2 == 0
        after = env.reset(state.clone().set("_reset", chosen.unsqueeze(-1)))
        again = TransformedEnv(base(), make())
        begun = [again.reset() for _ in range(2)][1]  # the second episode of all
        for key in begun.keys(True, True):
            torch.testing.assert_close(after[key][~chosen], state[key][~chosen], rtol=0, atol=0, equal_nan=True)
            torch.testing.assert_close(after[key][chosen], begun[key][chosen], rtol=0, atol=0, equal_nan=True)

    def test_parent_specs_are_not_mutated(self, base: Base, make: Make) -> None:
        plain = base()
        before = plain.specs.clone()
        env = TransformedEnv(plain, make())
        env.rollout(2)
        assert env.specs != before
        assert plain.specs == before


def check_one_device(monkeypatch: pytest.MonkeyPatch, module: nn.Module, step: Callable[[Callable], Any]) -> None:
    """Run a step of a module on another device than the processor; raise where tensors of two devices meet.

    Fake tensors have a device and no values, so that no accelerator is needed. It is "meta", as torch for processors
    alone knows no "cuda". A branch on values is taken.

    Args:
        monkeypatch: of pytest.
        module: module, which moves to the device.
        step: called with a function that moves a TensorDict there.
    """
    module.to("meta")

    def moved(td: TensorDictBase) -> TensorDictBase:
        return td.apply(lambda value: torch.empty_like(value, device="meta"), device=torch.device("meta"))

    with monkeypatch.context() as patch, FakeTensorMode(allow_non_fake_inputs=True):  # constants move by themselves
        patch.setattr(torch.Tensor, "__bool__", lambda _: True)
        step(moved)
