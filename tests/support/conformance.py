"""Tests of a transform in environments, after those of TorchRL's own transforms; parametrize a subclass by cases."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable

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

    def test_parent_specs_are_not_mutated(self, base: Base, make: Make) -> None:
        plain = base()
        before = plain.specs.clone()
        env = TransformedEnv(plain, make())
        env.rollout(2)
        assert env.specs != before
        assert plain.specs == before
