"""A policy's actions depend on the TensorDict alone: what it remembers is there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from bars import Around, Detour, Sighted
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp
from torchrl.modules import LSTMModule

from magrl import FieldPolicy
from magrl.envs import GeomagneticNavEnv
from magrl.evaluation.arrays import ArrayPolicy
from magrl.named_tasks import NAMED_TASKS
from magrl.navigators import NAVIGATORS, PolicyConfig, Secant, policy_env
from magrl.navigators.metaheuristics import Metaheuristic
from magrl.navigators.names import make_navigator

SIZE = 26


def recurrent() -> TensorDictModuleBase:
    torch.manual_seed(0)
    memory = LSTMModule(SIZE, 8, in_key="observation", out_key="seen")
    head = nn.Sequential(nn.Linear(8, 2), nn.Tanh())
    return TensorDictSequential(memory, TensorDictModule(head, ["seen"], ["action"]))


def act(observations: np.ndarray, state: Any, _: np.ndarray) -> tuple[np.ndarray, Any]:
    """Steps and a sum of observations as action; the state is an array and a tensor."""
    count, total = state or (np.zeros((len(observations), 1)), torch.zeros(len(observations)))
    total = total + torch.from_numpy(observations[:, :2]).sum(-1)
    return np.stack((count[:, 0] / 10, np.tanh(total.numpy())), 1), (count + 1, total)


def plain(seed: int, **options: Any) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=5, seed=seed, start_heading="random", max_steps=7, **options)


def named(task: str, **options: Any) -> Callable[[int], EnvBase]:
    return lambda seed: NAMED_TASKS[task].make(5, seed=seed, max_steps=7, **options)


def region_policy() -> FieldPolicy:
    torch.manual_seed(0)
    return FieldPolicy(PolicyConfig(plain(0).observation_view(), (8,)))


DICT = {"observation": "dict", "scale_actions": False}
POLICIES: dict[str, tuple[Callable[[], Any], Callable[..., EnvBase]]] = {
    **{name: (lambda name=name: make_navigator(name, plain(0)), plain) for name in NAVIGATORS},
    "declared": (Secant, lambda seed: plain(seed, arrival="declared")),
    "trained": (region_policy, plain),
    "recurrent": (recurrent, named("readings")),
    "function": (lambda: ArrayPolicy(act), named("readings")),
    "detour": (Detour, named("nogo", **DICT)),
    "sighted": (Sighted, named("nogo", **DICT)),
    "around": (Around, named("nogo", **DICT)),
}
"""Each kind of policy, and its environment by a seed."""


@pytest.fixture(autouse=True)
def short_search(monkeypatch) -> None:
    monkeypatch.setattr(Metaheuristic, "generations", 2)


def states_of(env: EnvBase, policy: TensorDictModuleBase, steps: int = 4) -> list[TensorDictBase]:
    """Return successive states with their actions; two vehicles begin a new episode after two steps."""
    states, state = [], env.reset()
    for step in range(steps):
        states.append(policy(state))
        state = step_mdp(env.step(states[-1].clone()))
        if step == 1:
            state = env.reset(
                state.set("_reset", torch.tensor([[True], [False], [False], [True], [False]])), set_state=False
            )
    return states


@pytest.mark.parametrize("kind", POLICIES)
def test_actions_depend_on_the_tensordict_alone(kind: str) -> None:
    """Of an object that flies two environments in turn, on permuted rows, and on batches of a replay buffer."""
    make, env_of = POLICIES[kind]
    with torch.no_grad():
        shared = make()
        envs = [policy_env(env_of(seed), shared) for seed in (1, 2)]
        wanted = [states_of(policy_env(env_of(seed), policy), policy) for seed, policy in ((1, make()), (2, make()))]
        flown = [[env.reset()] for env in envs]
        for _ in range(3):
            for env, states in zip(envs, flown, strict=True):
                states.append(step_mdp(env.step(shared(states[-1]))))
        for states, alone in zip(flown, wanted, strict=True):
            for found, expected in zip(states[:2], alone, strict=False):
                assert torch.equal(found["action"], expected["action"])
        every = torch.cat(wanted[0])
        buffer = ReplayBuffer(storage=LazyTensorStorage(len(every)), batch_size=8)
        buffer.extend(every)
        torch.manual_seed(0)
        fresh = make()
        policy_env(env_of(1), fresh)
        for batch in (buffer.sample(), every[torch.randperm(len(every))], wanted[0][-1]):
            for policy in (shared, fresh):
                again = policy(batch.exclude("action", "next"))["action"]
                torch.testing.assert_close(again, batch["action"], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", ["secant", "kalman", "memory", "dead_reckoning", "sighted"])
def test_a_call_without_its_memory_says_how_to_add_it(kind: str) -> None:
    make, env_of = POLICIES[kind]
    with pytest.raises(KeyError, match=r"policy_env\(env, policy\)"):
        make()(env_of(1).reset())
