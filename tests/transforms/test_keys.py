"""Transforms of observations: other keys in a foreign environment of any batch, stored data, states of one each."""

import copy
from collections.abc import Callable

import pytest
import torch
from support.conformance import check_one_device
from support.environments import paper_field
from support.errors import all_errors
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.testing import assert_close
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from magrl import Scenario, errors, transforms
from magrl.pilot import Rules
from magrl.transforms import AngleVector, DeclareArrival, EpisodeSum, MinMaxNorm, TrackField
from magrl.transforms.base import ObservationTransform, StatefulTransform
from magrl.transforms.track import READ_KEYS

FLAGS = ("done", "terminated", "truncated")
SIZES = {"field": 3, "target_field": 3, "leg": 2, "heading": 1, "elapsed_steps": 1, "position": 2}
SIZES |= {"target_position": 2, "start_position": 2, "true_displacement": 2, "highest_spl": 1, "step_price": 1}
SIZES |= {"fix": 2, "target_fix": 2, "earned_spl": 1, "path_km": 1, "trip_km": 1, "recent_legs": 45, "current": 2}
SIZES |= {"gradient_heading": 1, "number": 1, "field_gradient": 6} | dict.fromkeys(("success", *FLAGS), 1)
LEAST = {"field": (5.0, -16.0, 35000.0), "target_field": (6.0, -20.0, 35500.0), "true_displacement": (300.0, 100.0)}
LEAST |= {"position": (3.0, 160.0), "target_position": (6.0, 163.0), "start_position": (2.0, 159.0)}
LEAST |= {"fix": (3.0, 160.0), "target_fix": (6.0, 163.0)}


class Foreign(EnvBase):
    """An environment of any batch with any keys, whose values depend on the number of the step alone."""

    def __init__(
        self,
        batch: tuple[int, ...],
        names: list[str],
        key: Callable[[str], NestedKey],
        actions: int,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(batch_size=torch.Size(batch))
        self.names, self.key, self.count, self.dtype = names, key, 0, dtype
        self.observation_spec = Composite(leg_error=Bounded(-99.0, 99.0, (*batch, 2), dtype=torch.float64), shape=batch)
        for name, value in self._values().items():
            if key(name) not in FLAGS:
                self.observation_spec[key(name)] = Unbounded(value.shape, dtype=value.dtype)
        self.action_spec = Composite(action=Bounded(0.0, 1.0, (*batch, actions)), shape=batch)
        reward = Composite(shape=batch)
        reward[key("reward")] = Unbounded((*batch, 1))
        self.reward_spec = reward
        self.full_done_spec = Composite({flag: Binary(1, (*batch, 1), dtype=torch.bool) for flag in FLAGS}, shape=batch)

    def _set_seed(self, seed: int | None) -> None: ...

    def _values(self) -> dict[str, Tensor]:
        draw, values = torch.Generator().manual_seed(self.count), {}
        for name in self.names:
            value = torch.rand(*self.batch_size, SIZES[name], generator=draw) + torch.tensor(LEAST.get(name, 0.0))
            values[name] = value.to(torch.float64 if "position" in name or "fix" in name else self.dtype)
        flags = {name: torch.zeros(*self.batch_size, 1, dtype=torch.bool) for name in ("success", *FLAGS)}
        values |= {name: flag for name, flag in flags.items() if name in self.names}
        if "elapsed_steps" in values:
            values["elapsed_steps"] = torch.full((*self.batch_size, 1), self.count)
        if "field_gradient" in values:
            values["field_gradient"] = values["field_gradient"].unflatten(-1, (3, 2))
        return values

    def _state(self) -> TensorDict:
        td = TensorDict({flag: torch.zeros(*self.batch_size, 1, dtype=torch.bool) for flag in FLAGS}, self.batch_size)
        td["leg_error"] = torch.zeros(*self.batch_size, 2, dtype=torch.float64)
        for name, value in self._values().items():
            td[self.key(name)] = value
        return td

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDictBase:  # noqa: ARG002
        self.count = 0
        return self._state()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        self.count += 1
        return self._state().set(self.key("reward"), torch.ones(*self.batch_size, 1))


def waves(position: Tensor) -> Tensor:
    return torch.stack((position[..., 0] * position[..., 1], torch.sin(position[..., 1])), -1)


STD, RULES = (0.1, 0.1, 10.0), Rules(arrival="declared")
PUBLIC = [kind for kind in (vars(transforms) | vars(errors)).values() if isinstance(kind, type)]
KINDS = [kind for kind in PUBLIC if issubclass(kind, ObservationTransform)]  # Shield writes none
OPTIONS: dict[type[Transform], dict] = {
    transforms.CurrentReading: {"field": paper_field()},
    transforms.DistanceCost: {"cost": 0.1},
    transforms.FieldGradient: {"field": waves},
    transforms.Fix: {"field": paper_field(), "region": Scenario().edge},
    errors.KnownPlace: {"start_km": 5.0, "target_km": 5.0},
    errors.MagneticWeather: {"speed_km_h": 20, "span_h": 9},
    errors.MotionError: {"log_scale": 0.1},
    errors.NorthReferenceError: {"constant_deg": 2.0},
    transforms.RandomStepPrice: {"price_range": (0.1, 1.0)},
    errors.SensorErrors: {"noise": STD},
    errors.TargetErrors: {"target_std": STD},
    errors.Spikes: {"sizes": STD, "rate": 0.5},
}
IN_KEYS = {AngleVector: ["heading"], EpisodeSum: ["number"], MinMaxNorm: ["leg"]}
IN_KEYS |= {
    transforms.AlignmentReward: ["heading", "gradient_heading"],
    TrackField: READ_KEYS,
    DeclareArrival: READ_KEYS,
}
OUT_KEYS = {AngleVector: ["course"], EpisodeSum: ["episode_number"], MinMaxNorm: ["scaled"]}
FIXED = (errors.MagneticNorth, errors.TargetErrors, EpisodeSum, DeclareArrival)
"""Those whose out_keys follow from their in_keys."""


def make(kind: type[Transform], ins: list[NestedKey], outs: list[NestedKey]) -> Transform:
    if kind is DeclareArrival:
        track = TrackField(RULES, in_keys=ins, out_keys=["track", "seen"])
        return Compose(track, DeclareArrival(RULES, in_keys=ins))
    if kind is MinMaxNorm:
        return MinMaxNorm(ins, outs, bounds={key: (-torch.ones(2), torch.ones(2)) for key in ins})
    return kind(in_keys=ins, **({} if kind in FIXED else {"out_keys": outs}), **copy.deepcopy(OPTIONS.get(kind, {})))


def other(name: str) -> NestedKey:
    return "agents", f"other_{name}"


def keys_of(kind: type[Transform], key: Callable[[str], NestedKey] = str) -> tuple[list[NestedKey], list[NestedKey]]:
    """Return in_keys and out_keys by the names of their default ones."""
    ins, outs = (IN_KEYS.get(kind) or kind.default_in_keys), OUT_KEYS.get(kind) or kind.default_out_keys
    return [key(name) for name in ins], [
        key(name if key is str or name == "reward" else f"new_{name}") for name in outs
    ]


def flight(kind: type[Transform], batch: tuple[int, ...], key: Callable[[str], NestedKey]) -> list[dict]:
    """Return what a transform writes at a reset and in two steps."""
    torch.manual_seed(0)
    ins, outs = keys_of(kind, key)
    transform = make(kind, ins, outs)
    assert transform.out_keys == outs or kind in FIXED
    env = TransformedEnv(Foreign(batch, keys_of(kind)[0], key, 3 if kind is DeclareArrival else 2), transform)
    states = [env.reset()]
    for _ in range(2):
        states.append(env.step(states[-1].clone().set("action", torch.zeros(*batch, 2)))["next"])
    if batch and key is other:
        check_env_specs(env)
    found = [[state[key] for key in transform.out_keys if key in state.keys(True)] for state in states]
    return [TensorDict({str(number): value for number, value in enumerate(row)}).to_dict() for row in found]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("batch", [(), (2, 3)], ids=str)
def test_every_key_may_be_renamed_in_a_foreign_environment(kind: type[Transform], batch: tuple[int, ...]) -> None:
    """It then writes there what it writes at its own names."""
    plain, renamed = (flight(kind, batch, key) for key in (str, other))
    assert_close(plain, renamed, rtol=0, atol=0, equal_nan=True)
    assert plain[-1] or kind is DeclareArrival


# Types


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_values_keep_their_type_whatever_the_default_is(kind: type[Transform], dtype: torch.dtype) -> None:
    ins, outs = keys_of(kind)
    for default in (torch.float32, torch.float64):
        torch.set_default_dtype(default)
        try:
            foreign = Foreign((2,), ins, str, 3 if kind is DeclareArrival else 2, dtype)
            env = TransformedEnv(foreign, make(kind, ins, outs))
            check_env_specs(env)
            state = env.rollout(2)["next"]
        finally:
            torch.set_default_dtype(torch.float32)
        for name, spec in foreign.observation_spec.items():
            assert state[name].dtype == spec.dtype, name


# Data


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_stored_data_stay_as_they_are_and_a_missing_key_is_named(kind: type[Transform]) -> None:
    """A transition as of a replay buffer: a sample that is written in place would change what is stored."""
    ins, outs = keys_of(kind)
    foreign = Foreign((7,), ins, str, 3 if kind is DeclareArrival else 2)
    env, transform = TransformedEnv(foreign, make(kind, ins, outs)), make(kind, ins, outs)
    stored = env.step(env.reset().set("action", torch.zeros(7, 2)))
    before, tensors = stored.clone(), dict(stored.items(True, True))
    transform(stored)
    for key, value in tensors.items():
        assert_close(value, before[key], rtol=0, atol=0, equal_nan=True, msg=f"{key} was written in place")
    incomplete = before.exclude(ins[-1], ("next", ins[-1]))
    with pytest.raises(KeyError, match=rf"\w+ reads .*{ins[-1]}.*, which"):
        transform(incomplete)


# States


@pytest.mark.parametrize("kind", [kind for kind in KINDS if issubclass(kind, StatefulTransform)])
def test_two_of_a_class_never_share_their_state(kind: type[Transform]) -> None:
    """Those of one name for it are refused."""
    first, second = (make(kind, *keys_of(kind)) for _ in range(2))
    env = TransformedEnv(Foreign((2,), first.in_keys, str, 2), Compose(first, second))
    if set(first.state_keys) <= set(first.in_keys):  # it has none of its own
        assert env.reset() is not None
    else:
        with pytest.raises(ValueError, match=f"{kind.__name__} keeps its state at .* merge two transforms of one"):
            env.reset()


# Devices


@pytest.mark.parametrize(
    "kind", [kind for kind in KINDS if kind not in (TrackField, DeclareArrival)], ids=lambda kind: kind.__name__
)
def test_a_transform_stays_on_the_device_of_its_values(kind: type[Transform], monkeypatch) -> None:
    """On fake tensors, which refuse to be mixed with those of the processor; tracks do as those of navigators."""
    ins, outs = keys_of(kind)
    check_step(TransformedEnv(Foreign((4,), ins, str, 2), make(kind, ins, outs)), monkeypatch)


def test_all_options_of_errors_stay_on_the_device_of_their_values(monkeypatch) -> None:
    check_step(all_errors(4), monkeypatch)


def check_step(env: TransformedEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    state, transform = env.reset(), env.transform
    after = env.step(state.clone().set("action", torch.zeros(4, 2)))["next"]
    check_one_device(monkeypatch, transform, lambda move: transform._step(move(state), move(after)))
    check_one_device(monkeypatch, transform, lambda move: transform._reset(move(state), move(state)))
