"""Actions and observations do not depend on the private keys of the environment and of the errors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from support.errors import every_error
from support.networks import network_file
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Compose, Transform, TransformedEnv

from magrl.envs import PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv
from magrl.errors import CONDITIONS, TRUE_KEYS, MagneticNorth, TargetErrors
from magrl.navigators import NAVIGATORS, FieldPolicy, PolicyConfig, export_policy
from magrl.navigators.names import make_navigator
from magrl.pilot import Rules
from magrl.sensor_std import STD_KEYS
from magrl.transforms import ReadingView, TrackField
from magrl.transforms.episode import EPISODE_STREAM

ORACLES = {"parallel", "geodesic", "ga", "pso", "afsa"}
PLACES = {"dead_reckoning": ("start_position", "target_position")}
"""Private keys of the places that a navigator knows."""
CONDITION = CONDITIONS["low-cost"]
PRIVATE = {*PRIVILEGED_KEYS, *TRUE_KEYS}
COMPASS = {"compass_declination", "compass_stream", "true_target_field"}
TARGET = TargetErrors((0.1, 0.05, 30.0))
TOLD = ["sensor_std", "bias_std", "drift_std"]
PUBLIC = {*PUBLIC_KEYS, *STD_KEYS, "elapsed_steps", "done", "terminated", "truncated"}


def base_env(seed: int = 5) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=3, seed=seed, drift_km=CONDITION.drift_km(50.0))


def erring_env(magnetic: bool = False) -> TransformedEnv:
    """The environment with every error; a vehicle has one north."""
    *errors, north = every_error()
    return TransformedEnv(base_env(), Compose(*errors, MagneticNorth() if magnetic else north, TARGET.clone()))


@pytest.fixture(scope="module", params=["true", "magnetic"])
def states(request: pytest.FixtureRequest) -> list[TensorDict]:
    torch.manual_seed(0)
    magnetic = request.param == "magnetic"
    rollout = erring_env(magnetic).rollout(3)
    private = PRIVATE - ({"north_error", "north_stream"} if magnetic else COMPASS)
    assert set(rollout.keys()) - {"action", "next"} == private | PUBLIC, "a key is in one of the lists"
    return list(rollout.exclude("action", "next").unbind(1))


def private(key: NestedKey) -> bool:
    return (key if isinstance(key, str) else key[0]) in PRIVATE


def scrambled(state: TensorDict) -> TensorDict:
    """Return a state with other values of all private keys."""
    state = state.clone()
    for key in filter(private, state.keys(True, True)):
        value = state[key]
        state[key] = ~value if value.dtype == torch.bool else value + torch.rand(value.shape).mul(9).to(value.dtype) + 1
    return state


def policy(kind: str, folder: Path) -> TensorDictModuleBase:
    torch.manual_seed(0)
    env = base_env()
    if kind == "feedforward":
        return FieldPolicy(PolicyConfig(env.observation_view(), (8,)))
    if kind == "exported":
        view = ReadingView(max_leg_km=50.0, max_turn_rad=1.5)
        return export_policy(network_file(folder, view.size), view)
    return make_navigator(kind, env)


def actions(policy: TensorDictModuleBase, states: list[TensorDict]) -> Tensor:
    """The actions of a policy in successive states, with the memory or the track that it has there."""
    chain, found, before = Compose(*policy.transforms(erring_env())), [], None
    for state in (state.clone() for state in states):
        seen = chain._step(before, state.update(before.get("next", {}))) if found else chain._reset(state, state)
        before = policy(seen)
        found.append(before["action"])
    return torch.stack(found)


@pytest.mark.parametrize("kind", [*sorted(set(NAVIGATORS) - ORACLES), "feedforward", "exported"])
def test_actions_do_not_depend_on_private_keys(kind: str, states: list[TensorDict], tmp_path: Path) -> None:
    plain, blind = policy(kind, tmp_path), policy(kind, tmp_path)
    assert not getattr(plain, "oracle", False)
    known = PLACES.get(kind, ())
    assert not {*plain.in_keys} & PRIVATE - {*known}
    others = [scrambled(state).update(state.select(*known)) for state in states]
    assert torch.equal(actions(plain, states), actions(blind, others))


def written(transforms: list[Transform], states: list[TensorDict]) -> list[TensorDict]:
    """What transforms write into successive states of an environment."""
    chain, found = Compose(*transforms), []
    for state in states:
        found.append(chain._step(found[-1], state) if found else chain._reset(state, state))
    return found


@pytest.mark.parametrize("kind", ["view", "track", "errors"])
def test_observations_do_not_depend_on_private_keys(kind: str, states: list[TensorDict]) -> None:
    """Those of the views, with all that they carry along, and the standard deviations that a vehicle is told.

    The stream of the random numbers is kept: an outage, which a vehicle notices, is drawn from it.
    """

    def transforms() -> list[Transform]:
        if kind == "track":
            return [TrackField(Rules(), STD_KEYS)]
        return CONDITION.transforms(1) if kind == "errors" else base_env().observation_view().observation_transforms()

    others = [scrambled(state).update(state.select(EPISODE_STREAM)) for state in states]
    seen, blindly = (written(transforms(), [state.clone() for state in rows]) for rows in (states, others))
    for plain, blind in zip(seen, blindly, strict=True):
        keys = TOLD if kind == "errors" else [key for key in plain.keys(True, True) if not private(key)]
        assert kind == "errors" or "observation" in keys
        assert all(torch.allclose(plain[key], blind[key], rtol=0, atol=0, equal_nan=True) for key in keys)
