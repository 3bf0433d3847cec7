"""Transforms: TorchRL's conformance list for each of them by two tables, then what is particular to each."""

from __future__ import annotations

import copy
import itertools
import math
import pickle
import re
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import pytest
import torch
from support.environments import PlaneEnv, nested, parallel
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import (
    Bounded,
    Composite,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import Compose, EnvBase, ParallelEnv, PendulumEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from magrl import guidance
from magrl.envs.geomagnetic import GeomagneticNavEnv
from magrl.envs.regions import Region
from magrl.envs.scenario import Scenario
from magrl.field.model import elements_at
from magrl.field.regional import RegionalField
from magrl.geodesy import move
from magrl.tracking import GradientPrior, dipole_prior
from magrl.transforms import (
    AlignmentReward,
    AngleVector,
    FieldGradient,
    GradientHeading,
    MinMaxNorm,
    TargetDifference,
    TrackGradient,
)

pytestmark = pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped")

BATCHES = [(), (1,), (3,), (2, 3)]
DTYPES = [torch.float32, torch.float64]
KeyNamer = Callable[[str], NestedKey]


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def flat(name: str) -> NestedKey:
    return name


# ---------------------------------------------------------------------------------------------------------------------
# Stand-ins


class LinearField:
    """30 000 nT northward at every place; eastward it grows by 30 nT/km to the north, downward by 60 to the east."""

    def __call__(self, latitude: Tensor, longitude: Tensor, /) -> Tensor:
        return self.value_and_gradient(latitude, longitude)[0]

    def value_and_gradient(self, latitude: Tensor, longitude: Tensor, /) -> tuple[Tensor, Tensor]:
        value = torch.tensor([30000.0, 0.0, 0.0], dtype=torch.float64)
        gradient = torch.tensor([[0.5, 0.0], [30.0, 0.0], [0.0, 60.0]], dtype=torch.float64)
        shape = torch.broadcast_shapes(latitude.shape, longitude.shape)
        return value.expand(*shape, 3), gradient.expand(*shape, 3, 2)


LINEAR_FIELD_GRADIENT = torch.tensor([[math.degrees(1e-3), 0.0], [0.0, math.degrees(2e-3)], [0.5, 0.0]])
"""By hand: D turns by 30/30000 rad/km northward, I by 60/30000 rad/km eastward, B_H grows by 0.5 nT/km northward."""


def hyperbola_and_wave(position: Tensor) -> Tensor:
    """Two values at a place: the gradients are (east, north) and (0, cos east)."""
    north, east = position.unbind(-1)
    return torch.stack((north * east, torch.sin(east)), -1)


@cache
def field() -> RegionalField:
    return Scenario().build_field()


def nav(num_envs: int = 2, scenario: Scenario | None = None, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(scenario or Scenario(field=field()), num_envs=num_envs, **({"seed": 0} | options))


def guided(num_envs: int = 2, **options: object) -> TransformedEnv:
    """The env with the theoretical heading on it, which the alignment reward reads."""
    base = nav(num_envs, **options)
    return TransformedEnv(base, Compose(FieldGradient(base.field), GradientHeading()))


def full_chain(num_envs: int = 2, **options: object) -> TransformedEnv:
    """Every transform of the module at once, in the order of use."""
    base = nav(num_envs, **options)
    chain = Compose(
        FieldGradient(base.field),
        GradientHeading(),
        AlignmentReward(),
        TargetDifference(),
        AngleVector(["heading"], ["course"]),
        MinMaxNorm(["field", "target_field", "move"], ["f", "t", "m"], ["action"]),
    )
    return TransformedEnv(base, chain)


# ---------------------------------------------------------------------------------------------------------------------
# Conformance, with an environment: each row says what the transform stands on


class EnvCase(NamedTuple):
    base: Callable[[], EnvBase]
    transform: Callable[[], Transform]


def sloped() -> TransformedEnv:
    return TransformedEnv(nav(), FieldGradient(field()))


def gradient_nav() -> Transform:
    return FieldGradient(field())


def minmax_nav() -> Transform:
    return MinMaxNorm(["field", "move"], ["f", "m"], ["action"])


def minmax_vec() -> Transform:
    return MinMaxNorm(["observation"], ["o"], ["action"], ["scaled"], bounds={"observation": (-10.0, 10.0)})


def minmax_pendulum() -> Transform:
    return MinMaxNorm(["th", "thdot"], ["a", "b"], ["action"], interval=(0.0, 1.0))


def minmax_plane() -> Transform:
    return MinMaxNorm([nested("obs")], in_keys_inv=[nested("action")])


def gradient_plane() -> Transform:
    return FieldGradient(LinearField(), [nested("place")], [nested("gradient")])


def function_gradient_plane() -> Transform:
    return FieldGradient(hyperbola_and_wave, [nested("place")], [nested("gradient")])


def heading_plane() -> Transform:
    keys = [nested(name) for name in ("scent", "scent_there", "slope")]
    return GradientHeading(keys, [nested("way"), nested("way_valid")], pair=(0, 1))


def alignment_plane() -> Transform:
    return AlignmentReward([nested("angle"), nested("reference"), nested("trusted")], [nested("reward")])


def alignment_apart() -> Transform:
    return AlignmentReward(out_keys=["alignment"])


def alignment_twice() -> Transform:
    return AlignmentReward(out_keys=["reward", "reward_alignment"])


def track_plane() -> Transform:
    keys = [nested(name) for name in ("scent", "scent_there", "place", "angle")]
    outs = [nested(f"track_{k}") for k in range(6)]
    return TrackGradient(
        keys, outs, prior=flat_prior, relation=None, scales=(1.0, 1.0), curvature=(1.0, 1.0), angles=()
    )


def flat_prior(reading: Tensor) -> GradientPrior:
    return GradientPrior(torch.zeros(2, 2), torch.ones(2, 2), torch.zeros_like(reading[..., 0]))


double_plane = partial(PlaneEnv, (3,), torch.float64)
ENV_CASES = {
    "MinMaxNorm-nav": EnvCase(nav, minmax_nav),
    "MinMaxNorm-vec": EnvCase(ContinuousActionVecMockEnv, minmax_vec),
    "MinMaxNorm-pendulum": EnvCase(PendulumEnv, minmax_pendulum),
    "MinMaxNorm-plane": EnvCase(PlaneEnv, minmax_plane),
    "AngleVector-nav": EnvCase(nav, partial(AngleVector, ["heading"], ["course"])),
    "AngleVector-plane": EnvCase(double_plane, partial(AngleVector, [nested("angle")], [nested("course")])),
    "TargetDifference-nav": EnvCase(nav, TargetDifference),
    "TargetDifference-plane": EnvCase(
        double_plane, partial(TargetDifference, [nested("scent"), nested("scent_there")], [nested("left")])
    ),
    "FieldGradient-nav": EnvCase(nav, gradient_nav),
    "FieldGradient-plane": EnvCase(PlaneEnv, gradient_plane),
    "FieldGradient-function": EnvCase(double_plane, function_gradient_plane),
    "GradientHeading-nav": EnvCase(sloped, partial(GradientHeading, pair=("I", "B_H"))),
    "GradientHeading-auto": EnvCase(sloped, partial(GradientHeading, pair="auto")),
    "GradientHeading-plane": EnvCase(double_plane, heading_plane),
    "AlignmentReward-nav": EnvCase(guided, AlignmentReward),
    "AlignmentReward-apart": EnvCase(guided, alignment_apart),
    "AlignmentReward-twice": EnvCase(guided, alignment_twice),
    "AlignmentReward-plane": EnvCase(double_plane, alignment_plane),
    "TrackGradient-nav": EnvCase(nav, TrackGradient),
    "TrackGradient-plane": EnvCase(double_plane, track_plane),
}
env_cases = pytest.mark.parametrize("case", ENV_CASES.values(), ids=ENV_CASES.keys())
# Each of these starts processes: one env for each transform is enough.
NAV = [name for name in ENV_CASES if name.endswith("-nav")]
PARALLEL = [*NAV, "MinMaxNorm-plane"]
nav_cases = pytest.mark.parametrize("case", [ENV_CASES[name] for name in NAV], ids=NAV)
parallel_cases = pytest.mark.parametrize("case", [ENV_CASES[name] for name in PARALLEL], ids=PARALLEL)


def as_tuple(key: NestedKey) -> tuple[str, ...]:
    return key if isinstance(key, tuple) else (key,)


def with_bounds_of(env: TransformedEnv, transform: Transform) -> Transform:
    """A transform that stands alone, with the state of the env's last one."""
    attached = env.transform[-1] if isinstance(env.transform, Compose) else env.transform
    transform.load_state_dict(attached.state_dict())
    return transform


def begun(env: EnvBase) -> TensorDictBase:
    """The same first observation whenever it is asked for."""
    torch.manual_seed(1)
    env.set_seed(1)
    return env.reset()


def collected(env: EnvBase, **options: object) -> TensorDict:
    """Three steps of a collector that moves at random, the same ones whenever it is asked for."""
    begun(env)
    (batch,) = Collector(env, None, frames_per_batch=6, total_frames=6, **options)
    return batch


def transformed(case: EnvCase) -> TransformedEnv:
    return TransformedEnv(case.base(), case.transform())


class TestConformanceInEnvs:
    @env_cases
    def test_single_trans_env_check(self, case: EnvCase) -> None:
        check_env_specs(transformed(case), break_when_any_done="both")

    @env_cases
    def test_serial_trans_env_check(self, case: EnvCase) -> None:
        check_env_specs(SerialEnv(2, partial(transformed, case)))

    @env_cases
    def test_trans_serial_env_check(self, case: EnvCase) -> None:
        check_env_specs(TransformedEnv(SerialEnv(2, case.base), case.transform()))

    @env_cases
    def test_transform_env(self, case: EnvCase) -> None:
        """A step of the transformed env is one of the plain env with the transform around it as a module."""
        env, plain = transformed(case), case.base()
        transform = with_bounds_of(env, case.transform())
        start, plain_start = begun(env), begun(plain)
        if isinstance(transform, TrackGradient):
            plain_start = transform(plain_start)  # its state, which a step reads
        inside = env.step(env.rand_action(start))
        action = transform.inv(inside.clone()).select(*plain.action_keys)
        around = transform(plain.step(plain_start.update(action)))
        if not isinstance(transform, (AlignmentReward, TrackGradient)):
            around["next"] = transform(around["next"])
        for name in (*env.observation_keys, *(("next", *as_tuple(k)) for k in env.observation_keys + env.reward_keys)):
            torch.testing.assert_close(inside[name], around[name], rtol=1e-5, atol=1e-6)

    @nav_cases
    def test_postproc(self, case: EnvCase) -> None:
        """On what a collector hands out, a transform writes what it would have written inside the env."""
        env = transformed(case)
        transform = with_bounds_of(env, case.transform())
        if isinstance(transform, TrackGradient):  # a filter needs its state, which the data of the plain env lack
            with pytest.raises(KeyError, match="state"):
                collected(case.base(), postproc=transform)
            return
        inside, after = collected(env), collected(case.base(), postproc=transform)
        for name in transform.out_keys:
            name = ("next", name) if name == "reward" else name
            torch.testing.assert_close(after[name], inside[name], rtol=1e-5, atol=1e-5)

    @parallel_cases
    def test_parallel_trans_env_check(self, case: EnvCase) -> None:
        env = parallel(partial(transformed, case))
        try:
            check_env_specs(env)
        finally:
            env.close()

    @parallel_cases
    def test_trans_parallel_env_check(self, case: EnvCase) -> None:
        env = TransformedEnv(parallel(case.base), case.transform())
        try:
            check_env_specs(env)
        finally:
            env.close()

    def test_a_spawned_process_that_is_sent_the_whole_chain(self) -> None:
        env = ParallelEnv(1, partial(full_chain, 3), mp_start_method="spawn")
        try:
            check_env_specs(env)
        finally:
            env.close()

    @pytest.mark.parametrize("num_envs", [1, 5])
    def test_the_whole_chain(self, num_envs: int) -> None:
        check_env_specs(full_chain(num_envs), break_when_any_done="both")

    def test_the_alignment_term_is_the_same_inside_and_outside_other_processes(self) -> None:
        """A worker is sent the state alone: the reference has to be part of it, or it is that of the last step."""
        actions = torch.rand(3, 2, 2, 2) * torch.tensor([50.0, 1.5])
        inside = parallel(partial(transformed, ENV_CASES["AlignmentReward-nav"]))
        outside = TransformedEnv(SerialEnv(2, guided), AlignmentReward())
        rewards = []
        for env in (inside, outside):
            start = env.reset()
            steps = [env.step(start.clone().set("action", action)) for action in actions]  # three ways from one place
            rewards.append(torch.stack([step["next", "reward"] for step in steps]))
            env.close()
        assert torch.equal(*rewards)

    @env_cases
    def test_parent_specs_are_not_mutated(self, case: EnvCase) -> None:
        base = case.base()
        before = base.specs.clone()
        env = TransformedEnv(base, case.transform())
        assert env.specs != before
        env.rollout(2)
        assert base.specs == before

    @env_cases
    def test_env_survives_deepcopy_and_clone_of_its_transform(self, case: EnvCase) -> None:
        env = transformed(case)
        env.rollout(2)
        check_env_specs(copy.deepcopy(env))
        check_env_specs(TransformedEnv(case.base(), env.transform.clone()))

    @pytest.mark.parametrize("mask", [[1, 0, 0, 0], [0, 1, 1, 0], [1, 1, 1, 1]])
    def test_partial_reset_leaves_the_others_alone(self, mask: list[int]) -> None:
        env = full_chain(4)
        td = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
        kept = td.clone()
        chosen = torch.tensor(mask, dtype=torch.bool)
        td["_reset"] = chosen.unsqueeze(-1)
        after = env.reset(td)
        for key in ("f", "t", "m", "course", "field_difference", "field_gradient", "gradient_heading", "position"):
            assert torch.equal(after[key][~chosen], kept[key][~chosen]), key
            assert (after[key] != kept[key])[chosen].flatten(1).any(-1).all(), key


# ---------------------------------------------------------------------------------------------------------------------
# Conformance, without an environment: each row gives inputs and, worked out another way, the outputs


class DataCase(NamedTuple):
    transform: Callable[[KeyNamer], Transform]
    inputs: Callable[[Callable[..., Tensor]], dict[str, Tensor]]  # from a source of uniform numbers in [0, 1)
    outputs: Callable[[dict[str, Tensor]], dict[str, Tensor]]


def deviation(angle: Tensor, reference: Tensor) -> Tensor:
    """Between two headings, by the angle between two arrows: in [0, pi]."""
    return torch.acos(torch.cos(angle.double() - reference.double()))


def way_of(error: Tensor, gradient: Tensor) -> Tensor:
    """The direction of J^-1 (B_T - B), by a linear solver."""
    north, east = torch.linalg.solve(gradient.double(), error.double()).unbind(-1)
    return torch.atan2(east, north).unsqueeze(-1)


DATA_CASES = {
    "MinMaxNorm": DataCase(
        lambda key: MinMaxNorm(
            [key("x")], [key("y")], bounds={key("x"): (torch.tensor([0.0, -2.0]), torch.tensor([10.0, 2.0]))}
        ),
        lambda rand: {"x": 20 * rand(2) - 5},
        lambda td: {"y": torch.stack((td["x"][..., 0] / 5 - 1, td["x"][..., 1] / 2), -1)},
    ),
    "AngleVector": DataCase(
        lambda key: AngleVector([key("x")], [key("y")]),
        lambda rand: {"x": 8 * rand(1) - 4},
        lambda td: {"y": torch.cat((torch.sin(td["x"] + math.pi / 2), torch.sin(td["x"])), -1)},
    ),
    "TargetDifference": DataCase(
        lambda key: TargetDifference([key("x"), key("x_there")], [key("y")]),
        lambda rand: {"x": rand(3), "x_there": rand(3)},
        lambda td: {"y": -(td["x"] - td["x_there"])},
    ),
    "FieldGradient": DataCase(
        lambda key: FieldGradient(LinearField(), [key("x")], [key("y")]),
        lambda rand: {"x": rand(2)},
        lambda td: {"y": LINEAR_FIELD_GRADIENT.expand(*td["x"].shape[:-1], 3, 2)},
    ),
    "FieldGradient-function": DataCase(
        lambda key: FieldGradient(hyperbola_and_wave, [key("x")], [key("y")]),
        lambda rand: {"x": rand(2)},
        lambda td: {
            "y": torch.stack(
                (td["x"].flip(-1), torch.stack((torch.zeros_like(td["x"][..., 0]), td["x"][..., 1].cos()), -1)), -2
            )
        },
    ),
    "GradientHeading": DataCase(
        lambda key: GradientHeading([key("x"), key("x_there"), key("slope")], [key("y"), key("valid")], pair=(0, 1)),
        lambda rand: {
            "x": rand(2),
            "x_there": rand(2),
            "slope": torch.stack((rand(2) + torch.tensor([1.0, 0.0]), rand(2) - torch.tensor([1.0, -1.0])), -2),
        },
        lambda td: {
            "y": way_of(td["x_there"] - td["x"], td["slope"]),
            "valid": torch.ones_like(td["x"][..., :1], dtype=torch.bool),
        },
    ),
    "AlignmentReward": DataCase(
        lambda key: AlignmentReward([key("angle"), key("reference"), key("ok")], [key("r")], weight=2.0, offset=0.5),
        lambda rand: {
            "angle": 3 * rand(1),
            "reference": 3 * rand(1) - 3,
            "ok": rand(1) > 0.3,
            "next angle": 3 * rand(1),
            "next reference": 3 * rand(1) - 3,
            "next r": rand(1),
        },
        lambda td: {
            "next r": td["next r"] + td["ok"] * 2.0 * (0.5 - deviation(td["next angle"], td["reference"])),
        },
    ),
    "AlignmentReward-twice": DataCase(
        lambda key: AlignmentReward([key("angle"), key("reference")], [key("r"), key("r_alignment")]),
        lambda rand: {"angle": rand(1), "reference": 3 * rand(1) - 3, "next angle": 3 * rand(1), "next r": rand(1)},
        lambda td: {
            "next r": td["next r"] + 3 * (math.pi / 4 - deviation(td["next angle"], td["reference"])),
            "next r_alignment": 3 * (math.pi / 4 - deviation(td["next angle"], td["reference"])),
        },
    ),
}
DATA_CASES["TrackGradient"] = DataCase(
    lambda key: TrackGradient(
        [key(x) for x in ("x", "y", "move", "angle")], [key(f"o{k}") for k in range(6)], relation=None
    ),
    lambda rand: {"x": 90 * rand(3), "y": 90 * rand(3), "move": rand(2), "angle": rand(1)},
    lambda td: {"o2": td["x"], "o3": dipole_prior(td["x"]).gradient},  # the first reading and the prior
)
data_cases = pytest.mark.parametrize("case", DATA_CASES.values(), ids=DATA_CASES.keys())
key_namers = pytest.mark.parametrize("key", [flat, nested])


def as_key(name: str, key: KeyNamer) -> NestedKey:
    """The key of a row's entry; ``"next x"`` is ``x`` of the step after."""
    *prefix, name = name.split()
    full = key(name)
    return (*prefix, *as_tuple(full)) if prefix else full


def data_of(
    case: DataCase, key: KeyNamer, batch: tuple[int, ...] = (3,), dtype: torch.dtype = torch.float32
) -> tuple[TensorDict, dict[NestedKey, Tensor]]:
    """A TensorDict of a row's inputs, and what the transform must add to it or change in it."""
    inputs = case.inputs(lambda *shape: torch.rand(*batch, *shape, dtype=dtype))
    td = TensorDict({}, batch)
    for name, value in inputs.items():
        td[as_key(name, key)] = value
    return td, {as_key(name, key): value for name, value in case.outputs(inputs).items()}


def check_outputs(td: TensorDictBase, expected: dict[NestedKey, Tensor]) -> None:
    for name, value in expected.items():
        got = td[name]
        tolerance = {"rtol": 1e-12, "atol": 1e-12} if got.dtype == torch.float64 else {"rtol": 1e-5, "atol": 1e-5}
        torch.testing.assert_close(got, value.to(got.dtype), **tolerance)


class TestConformanceOnData:
    @data_cases
    def test_transform_no_env(self, case: DataCase) -> None:
        for batch, dtype, key in itertools.product(BATCHES, DTYPES, (flat, nested)):
            self.check_no_env(case, batch, dtype, key)

    def check_no_env(self, case: DataCase, batch: tuple[int, ...], dtype: torch.dtype, key: KeyNamer) -> None:
        td, expected = data_of(case, key, batch, dtype)
        given, tensors = td.clone(), dict(td.items(True, True))
        transform = case.transform(key)
        out = transform(td)
        check_outputs(out, expected)
        for name, value in expected.items():
            # The gradient of D, I, B_H is written in the default dtype, as float64 is costly.
            gradient = isinstance(transform, FieldGradient) and hasattr(transform.field, "value_and_gradient")
            assert gradient or out[name].dtype == (value.dtype if value.dtype == torch.bool else dtype), name
        for name in given.keys(True, True):
            assert name in expected or torch.equal(out[name], given[name]), name
            assert torch.equal(tensors[name], given[name]), f"{name} was written in place"

    @data_cases
    def test_transform_compose(self, case: DataCase) -> None:
        for key in (flat, nested):
            td, expected = data_of(case, key)
            check_outputs(Compose(case.transform(key))(td), expected)

    @key_namers
    @data_cases
    def test_transform_model(self, case: DataCase, key: KeyNamer) -> None:
        td, expected = data_of(case, key)
        check_outputs(nn.Sequential(case.transform(key), nn.Identity())(td.clone()), expected)
        name = next(iter(expected))
        after = TensorDictModule(nn.Softplus(), in_keys=[name], out_keys=["after"])
        out = TensorDictSequential(case.transform(key), after)(td)
        torch.testing.assert_close(out["after"], torch.nn.functional.softplus(out[name]))
        check_outputs(out, expected)

    @data_cases
    def test_transform_rb(self, case: DataCase) -> None:
        for buffer, storage in itertools.product(
            (ReplayBuffer, TensorDictReplayBuffer), (LazyTensorStorage, ListStorage)
        ):
            td, expected = data_of(case, nested, (10,))
            td["row"] = torch.arange(10)
            rb = buffer(storage=storage(10), batch_size=7)
            rb.append_transform(case.transform(nested))
            rb.extend(td)
            for _ in range(2):  # the second sample shows that the first was not written back into the storage
                sample = rb.sample()
                check_outputs(sample, {name: value[sample["row"]] for name, value in expected.items()})

    @data_cases
    def test_transform_inverse(self, case: DataCase) -> None:
        """Entries that a transform has written stay as they are on the way in. MinMaxNorm has a test of its own."""
        for key in (flat, nested):
            transform = case.transform(key)
            td = transform(data_of(case, key)[0])
            assert (transform.inv(td.clone()) == td).all()

    @key_namers
    @data_cases
    def test_transform_compiled(self, case: DataCase, key: KeyNamer) -> None:
        """As one graph, without breaks. ``aot_eager`` traces as ``eager`` does, and checks the graph further."""
        td, expected = data_of(case, key)
        torch.compiler.reset()
        check_outputs(torch.compile(case.transform(key), fullgraph=True, backend="aot_eager")(td), expected)

    @data_cases
    def test_copies_do_the_same(self, case: DataCase) -> None:
        for copied in (Transform.clone, copy.deepcopy, copy.copy, lambda t: pickle.loads(pickle.dumps(t))):
            td, expected = data_of(case, flat)
            check_outputs(copied(case.transform(flat))(td), expected)

    @data_cases
    def test_a_missing_key_is_named(self, case: DataCase) -> None:
        for key in (flat, nested):
            transform = case.transform(key)
            td, _ = data_of(case, key)
            missing = transform.in_keys[-1]
            del td[missing]
            with pytest.raises(KeyError) as raised:
                transform(td)
            assert type(transform).__name__ in raised.value.args[0]
            assert repr(missing) in raised.value.args[0]

    @data_cases
    def test_a_missing_key_can_be_tolerated(self, case: DataCase) -> None:
        transform = case.transform(flat)
        td, _ = data_of(case, flat)
        del td[transform.in_keys[-1]]
        transform.set_missing_tolerance(True)
        given = td.clone()
        assert (transform(td) == given).all()


NOT_THERE = {
    "MinMaxNorm": lambda: MinMaxNorm(["nope"], ["y"]),
    "AngleVector": lambda: AngleVector(["nope"], ["y"]),
    "TargetDifference": lambda: TargetDifference(["field", "nope"]),
    "FieldGradient": lambda: FieldGradient(field(), ["nope"]),
    "GradientHeading": lambda: GradientHeading(["field", "target_field", "nope"]),
    "AlignmentReward": lambda: AlignmentReward(["heading", "nope"]),
    "TrackGradient": lambda: TrackGradient(["nope", "target_field", "move", "heading"]),
}


@pytest.mark.parametrize("name", NOT_THERE)
def test_a_key_that_the_env_lacks_is_named(name: str) -> None:
    env = TransformedEnv(nav(), NOT_THERE[name]())
    with pytest.raises(KeyError) as raised:
        _ = env.specs
    assert f"{name} reads 'nope'" in raised.value.args[0]


BAD_OPTIONS = {
    "low above high": (lambda: MinMaxNorm(["x"], bounds={"x": (2.0, 1.0)}), "'x'.*2.0.*1.0"),
    "low equal to high": (lambda: MinMaxNorm(["x"], bounds={"x": (3.5, 3.5)}), "'x'.*3.5.*3.5"),
    "one of two is degenerate": (
        lambda: MinMaxNorm(["x"], bounds={"x": (torch.tensor([0.0, 1.0]), torch.tensor([1.0, 1.0]))}),
        r"'x'.*\[0.0, 1.0\].*\[1.0, 1.0\]",
    ),
    "bound is NaN": (lambda: MinMaxNorm(["x"], bounds={"x": (float("nan"), 1.0)}), "'x'.*nan.*1.0"),
    "bound is infinite": (lambda: MinMaxNorm(["x"], bounds={"x": (0.0, float("inf"))}), "'x'.*0.0.*inf"),
    "bound of an open spec": (
        lambda: MinMaxNorm(["x"], bounds={"x": (torch.tensor(torch.finfo(torch.float32).min), torch.tensor(0.0))}),
        "'x'.*-3.4.*0.0",
    ),
    "action bound": (lambda: MinMaxNorm([], in_keys_inv=["a"], bounds={"a": (1.0, -1.0)}), "'a'.*1.0.*-1.0"),
    "unused key": (lambda: MinMaxNorm(["x"], bounds={"z": (0.0, 1.0)}), r"'z'.*\['x'\]"),
    "scaled name of a key": (lambda: MinMaxNorm(["x"], ["y"], bounds={"y": (0.0, 1.0)}), r"'y'.*\['x'\]"),
    "reversed interval": (lambda: MinMaxNorm(["x"], interval=(1.0, -1.0)), r"interval.*\(1.0, -1.0\)"),
    "empty interval": (lambda: MinMaxNorm(["x"], interval=(0.5, 0.5)), r"interval.*\(0.5, 0.5\)"),
    "infinite interval": (lambda: MinMaxNorm(["x"], interval=(0.0, float("inf"))), r"interval.*\(0.0, inf\)"),
    "two keys to one": (lambda: MinMaxNorm(["x", "y"], ["z"]), r"\['x', 'y'\].*\['z'\]"),
    "one action to two": (lambda: MinMaxNorm([], in_keys_inv=["x"], out_keys_inv=["y", "z"]), r"\['x'\].*\['y', 'z'\]"),
    "two angles to one": (lambda: AngleVector(["x", "y"], ["z"]), r"\['x', 'y'\].*\['z'\]"),
    "one of a difference": (lambda: TargetDifference(["x"], ["y"]), r"TargetDifference.*\['x'\]"),
    "no field": (lambda: FieldGradient("IGRF"), "value_and_gradient.*str"),
    "two positions": (lambda: FieldGradient(LinearField(), ["x", "y"], ["z"]), r"FieldGradient.*\['x', 'y'\]"),
    "unknown element": (lambda: GradientHeading(pair=("D", "Z")), "'Z'.*D, I, B_H"),
    "one element twice": (lambda: GradientHeading(pair=("I", "I")), r"\('I', 'I'\)"),
    "one element by name and index": (lambda: GradientHeading(pair=("D", 0)), r"\('D', 0\)"),
    "three elements": (lambda: GradientHeading(pair=("D", "I", "B_H")), "pair.*'B_H'"),
    "negative crossing": (lambda: GradientHeading(min_crossing_deg=-1.0), "min_crossing_deg.*-1.0"),
    "right-angle crossing": (lambda: GradientHeading(min_crossing_deg=90.0), "min_crossing_deg.*90.0"),
    "crossing is NaN": (lambda: GradientHeading(min_crossing_deg=float("nan")), "min_crossing_deg.*nan"),
    "two inputs of a heading": (lambda: GradientHeading(["x", "y"]), r"GradientHeading.*\['x', 'y'\]"),
    "heading without a mask": (lambda: GradientHeading(out_keys=["x"]), r"GradientHeading.*\['x'\]"),
    "angle without a reference": (lambda: AlignmentReward(["x"]), r"AlignmentReward.*\['x'\]"),
    "three rewards": (lambda: AlignmentReward(out_keys=["x", "y", "z"]), r"AlignmentReward.*\['x', 'y', 'z'\]"),
    "weight is NaN": (lambda: AlignmentReward(weight=float("nan")), "weight.*nan"),
    "offset is infinite": (lambda: AlignmentReward(offset=float("inf")), "offset.*inf"),
}


def test_bad_options_are_refused_with_their_value() -> None:
    for make, message in BAD_OPTIONS.values():
        with pytest.raises(ValueError, match=message):
            make()


WRONG_SHAPES = {
    "AngleVector": (lambda: AngleVector(["field"], ["y"]), r"\(2, 3\)"),
    "TargetDifference": (lambda: TargetDifference(["field", "move"]), r"\(2, 3\).*\(2, 2\)"),
    "FieldGradient": (lambda: FieldGradient(field(), ["field"]), r"\(2, 3\)"),
    "FieldGradient function": (
        lambda: FieldGradient(lambda position: position.sum(-1), out_keys=["slope"]),
        r"values \(E,\), got \(\)",
    ),
    "GradientHeading target": (lambda: GradientHeading(["field", "move", "field_gradient"]), r"\(2, 3\), \(2, 2\)"),
    "GradientHeading gradient": (lambda: GradientHeading(["field", "target_field", "field"]), r"\(2, 3\), \(2, 3\)$"),
    "GradientHeading element": (lambda: GradientHeading(pair=(0, 3)), r"\[0, 3\].*\(2, 3\)"),
}


@pytest.mark.parametrize("row", WRONG_SHAPES.values(), ids=WRONG_SHAPES.keys())
def test_wrong_shapes_are_refused_with_the_shapes(row: tuple[Callable[[], Transform], str]) -> None:
    make, message = row
    env = TransformedEnv(nav(), Compose(FieldGradient(field()), make()))
    with pytest.raises(ValueError, match=message):
        _ = env.specs


WOULD_BREAK_THE_STATE = {
    "in place": lambda: MinMaxNorm(["target_field"]),
    "onto another entry": lambda: MinMaxNorm(["field"], ["target_field"]),
    "angle in place": lambda: AngleVector(["heading"], ["heading"]),
}


@pytest.mark.parametrize("name", WOULD_BREAK_THE_STATE)
def test_writing_over_what_the_env_reads_back_is_refused(name: str) -> None:
    transform = WOULD_BREAK_THE_STATE[name]()
    env = TransformedEnv(nav(), transform)
    with pytest.raises(ValueError, match=f"{type(transform).__name__}.*{transform.out_keys[0]!r}.*state"):
        env.rollout(2)


# ---------------------------------------------------------------------------------------------------------------------
# MinMaxNorm


class TestMinMaxNorm:
    def test_env_values_come_from_the_spec_bounds(self) -> None:
        env = TransformedEnv(nav(5), MinMaxNorm(["field", "move"], ["f", "m"]))
        td = env.rollout(4)
        spec = env.base_env.observation_spec["field"].space
        low, high = spec.low[0], spec.high[0]
        assert low.shape == (3,)
        torch.testing.assert_close((td["f"] + 1) / 2 * (high - low) + low, td["field"], rtol=1e-5, atol=1e-3)
        distance, turn = td["next", "move"].unbind(-1)
        expected = torch.stack((distance / 25 - 1, turn / (math.pi / 2)), -1)
        torch.testing.assert_close(td["next", "m"], expected, rtol=1e-6, atol=1e-6)

    def test_scaled_specs_have_the_interval_for_bounds(self) -> None:
        env = TransformedEnv(nav(2), MinMaxNorm(["field"], ["f"], ["action"], interval=(0.0, 4.0)))
        for spec in (env.observation_spec["f"], env.action_spec):
            assert torch.equal(spec.space.low, torch.zeros(spec.shape))
            assert torch.equal(spec.space.high, torch.full(spec.shape, 4.0))

    def test_in_place_where_the_env_does_not_read_the_entry_back(self) -> None:
        env = TransformedEnv(PlaneEnv((2,)), MinMaxNorm([nested("obs")]))
        td = env.rollout(3)
        obs = torch.sigmoid(td["agents", "place"]) * 2 - 1
        torch.testing.assert_close(td["agents", "obs"], obs, rtol=1e-5, atol=1e-6)

    @pytest.mark.parametrize(
        ("key", "error", "says"),
        [
            ("objective", ValueError, "needs bounds for 'objective', but its spec is Unbounded"),
            ("nope", RuntimeError, "found no spec for 'nope'"),
        ],
    )
    def test_bounds_that_the_env_does_not_know(self, key: str, error: type[Exception], says: str) -> None:
        env = TransformedEnv(nav(2), MinMaxNorm([key], ["scaled"]))
        with pytest.raises(error, match=says):
            env.transform.normalize(key, torch.zeros(2, 1))

    def test_action_that_is_missing(self) -> None:
        norm = MinMaxNorm([], in_keys_inv=["action"], bounds={"action": (0.0, 1.0)})
        with pytest.raises(KeyError, match=r"'action', which is not among \['x'\]"):
            norm.inv(TensorDict({"x": torch.zeros(2)}, [2]))

    def test_actions_alone(self) -> None:
        """Nothing but actions to scale: the usual case of an env whose observations are left as they are."""
        env = TransformedEnv(nav(2), MinMaxNorm(in_keys_inv=["action"]))
        check_env_specs(env)
        assert torch.equal(env.action_spec.space.high, torch.ones(2, 2))

    def test_env_gets_physical_actions_and_the_data_keep_scaled_ones(self) -> None:
        env = TransformedEnv(nav(3), MinMaxNorm([], in_keys_inv=["action"]))
        scaled = torch.tensor([[-1.0, -1.0], [0.0, 0.5], [1.0, 1.0]])
        step = env.step(env.reset().set("action", scaled.clone()))
        assert torch.equal(step["action"], scaled)
        physical = torch.tensor([[0.0, -math.pi / 2], [25.0, math.pi / 4], [50.0, math.pi / 2]])
        torch.testing.assert_close(step["next", "move"], physical, rtol=1e-6, atol=0)

    def test_scaled_action_under_another_name(self) -> None:
        env = TransformedEnv(nav(3), MinMaxNorm([], in_keys_inv=["action"], out_keys_inv=["stick"]))
        assert env.action_keys == ["stick"]
        td = env.rollout(2)
        assert "stick" in td
        assert "action" not in td
        torch.testing.assert_close(td["next", "move"][..., 0], (td["stick"][..., 0] + 1) * 25, rtol=1e-5, atol=1e-5)

    def test_state_scaled_both_ways_leaves_the_env_as_it_was(self) -> None:
        """A stateless env that reads its state back: scaled on the way out, physical again on the way in."""
        keys = ["th", "thdot"]
        env = TransformedEnv(PendulumEnv(seed=0), MinMaxNorm(keys, in_keys_inv=keys))
        scaled, plain = (
            e.rollout(30, lambda td: td.set("action", torch.tensor([0.5]))) for e in (env, PendulumEnv(seed=0))
        )
        torch.testing.assert_close(scaled["next", "reward"], plain["next", "reward"], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(scaled["th"] * math.pi, plain["th"], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(scaled["thdot"] * 8, plain["thdot"], rtol=1e-4, atol=1e-4)

    def test_buffer_stores_physical_actions_and_samples_scaled_ones(self) -> None:
        norm = MinMaxNorm(["action"], ["scaled"], ["action"], bounds={"action": (0.0, 50.0)})
        rb = TensorDictReplayBuffer(storage=LazyTensorStorage(4), batch_size=4)
        rb.append_transform(norm)
        scaled = torch.tensor([[-1.0], [-0.5], [0.0], [1.0]])
        rb.extend(TensorDict(action=scaled, row=torch.arange(4), batch_size=4))
        assert rb._storage.get(slice(None))["action"].flatten().tolist() == [0.0, 12.5, 25.0, 50.0]
        sample = rb.sample()
        assert torch.equal(sample["scaled"], scaled[sample["row"]])

    @key_namers
    @pytest.mark.parametrize("dtype", DTYPES)
    @pytest.mark.parametrize("compiled", [False, True])
    def test_transform_inverse(self, key: KeyNamer, dtype: torch.dtype, compiled: bool) -> None:
        keys = [[key("x")], [key("y")]]
        norm = MinMaxNorm(*keys, *keys, bounds={key("x"): (torch.tensor([0.0, -2.0]), torch.tensor([10.0, 2.0]))})
        torch.compiler.reset()
        inv = torch.compile(norm.inv, fullgraph=True, backend="eager") if compiled else norm.inv
        scaled = 2 * torch.rand(3, 2, dtype=dtype) - 1
        td = inv(TensorDict({}, 3).set(key("y"), scaled))
        assert td[key("x")].dtype == dtype
        torch.testing.assert_close(td[key("x")], torch.stack((5 * scaled[:, 0] + 5, 2 * scaled[:, 1]), -1))
        torch.testing.assert_close(norm(td.exclude(key("y")))[key("y")], scaled)

    @pytest.mark.parametrize("interval", [(-1.0, 1.0), (0.0, 1.0), (-2.0, 6.0)])
    @pytest.mark.parametrize("dtype", DTYPES)
    def test_round_trip_is_exact_at_both_ends(self, dtype: torch.dtype, interval: tuple[float, float]) -> None:
        draws = torch.randn(1000, 2) * 10.0 ** torch.randint(-3, 5, (1000, 1))
        low, high = draws.amin(-1).to(dtype), draws.amax(-1).to(dtype)
        norm = MinMaxNorm(["x"], bounds={"x": (low, high)}, interval=interval)
        for end, value in zip(interval, (low, high), strict=True):
            assert (norm.normalize("x", value) == end).all()
            assert torch.equal(norm.denormalize("x", torch.full_like(value, end)), value)

    @pytest.mark.parametrize("interval", [(-1.0, 1.0), (0.1, 0.7)])
    def test_round_trip_between_the_ends(self, interval: tuple[float, float]) -> None:
        norm = MinMaxNorm(["x"], bounds={"x": (-3.0, 47.0)}, interval=interval)
        value = torch.linspace(-3.0, 47.0, 101)
        scaled = norm.normalize("x", value)
        torch.testing.assert_close(scaled, torch.linspace(*interval, 101), rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(norm.denormalize("x", scaled), value, rtol=1e-5, atol=1e-5)

    def test_beyond_the_bounds_the_line_goes_on(self) -> None:
        norm = MinMaxNorm(["x"], bounds={"x": (0.0, 50.0)})
        value, scaled = torch.tensor([-50.0, 75.0, 1000.0]), torch.tensor([-3.0, 2.0, 39.0])
        torch.testing.assert_close(norm.normalize("x", value), scaled)
        torch.testing.assert_close(norm.denormalize("x", scaled), value)

    def test_bounds_given_as_numbers_are_as_exact_as_the_data(self) -> None:
        norm = MinMaxNorm(["x"], bounds={"x": (0.1, 0.7)})
        value = torch.tensor([0.1, 0.4, 0.7], dtype=torch.float64)
        expected = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
        torch.testing.assert_close(norm.normalize("x", value), expected, rtol=0, atol=1e-12)

    def test_whole_numbers_are_scaled_to_fractions(self) -> None:
        """The count of moves, as a share of the episode, is an observation like others."""
        env = TransformedEnv(nav(2), MinMaxNorm(["step_count"], ["time"], bounds={"step_count": (0.0, 50.0)}))
        check_env_specs(env)
        assert env.rollout(6)["time"][0].flatten().tolist() == pytest.approx([-1, -0.96, -0.92, -0.88, -0.84, -0.8])

    def test_whole_numbers_with_fractional_bounds(self) -> None:
        norm = MinMaxNorm(["n"], bounds={"n": (0.5, 2.5)})
        torch.testing.assert_close(norm.normalize("n", torch.tensor([1, 2])), torch.tensor([-0.5, 0.5]))

    def test_given_bounds_win_over_those_of_the_spec(self) -> None:
        env = TransformedEnv(nav(2), MinMaxNorm([], in_keys_inv=["action"], bounds={"action": (0.0, 20.0)}))
        td = env.reset().set("action", torch.tensor([[-1.0, -1.0], [0.0, -0.9]]))
        torch.testing.assert_close(env.step(td)["next", "move"], torch.tensor([[0.0, 0.0], [10.0, 1.0]]))

    def test_bounds_may_differ_within_an_entry_but_not_by_the_batch(self) -> None:
        env = TransformedEnv(PlaneEnv((2, 3)), MinMaxNorm([nested("obs")], [nested("o")]))
        env.rollout(2)
        assert {name: value.tolist() for name, value in env.transform.state_dict().items()} == {
            "low_0": [0.0, -2.0],
            "high_0": [10.0, 2.0],
        }

    def test_unbounded_spec_is_refused(self) -> None:
        env = TransformedEnv(nav(2), MinMaxNorm(["objective"], ["o"]))
        with pytest.raises(ValueError, match=r"'objective'.*Unbounded"):
            _ = env.observation_spec

    def test_no_bounds_and_no_env(self) -> None:
        with pytest.raises(RuntimeError, match="'x'"):
            MinMaxNorm(["x"])(TensorDict(x=torch.zeros(1)))

    def test_specs_are_not_needed_for_the_first_reset(self) -> None:
        env = TransformedEnv(nav(2), MinMaxNorm(["field"], ["f"]))
        bounds = env.base_env.observation_spec["field"].space
        assert torch.equal(env.transform.normalize("field", bounds.high), torch.ones(2, 3))
        assert env.reset()["f"].abs().max() <= 1

    def test_state_dict_does_not_depend_on_the_number_of_envs(self) -> None:
        few, many = (TransformedEnv(nav(n), minmax_nav()) for n in (1, 7))
        for env in (few, many):
            env.rollout(1)
        a, b = few.transform.state_dict(), many.transform.state_dict()
        assert set(a) == set(b) == {f"{end}_{k}" for end in ("low", "high") for k in range(3)}
        assert all(torch.equal(a[name], b[name]) for name in a)

    def test_state_dict_is_whole_as_soon_as_the_transform_is_attached(self) -> None:
        for env in (
            TransformedEnv(nav(2), minmax_nav()),
            TransformedEnv(nav(2), Compose(AngleVector(["heading"], ["course"]), minmax_nav())),
            TransformedEnv(nav(2)).append_transform(minmax_nav()),
        ):
            assert len(env.transform.state_dict()) == 6

    @pytest.mark.parametrize("through", [lambda state: state, lambda state: pickle.loads(pickle.dumps(state))])
    def test_state_dict_loads_where_there_is_no_env(self, through: Callable[[dict], dict]) -> None:
        env = TransformedEnv(nav(4), minmax_nav())
        td = env.rollout(2)
        norm = minmax_nav()
        norm.load_state_dict(through(env.transform.state_dict()))
        alone = norm(td.exclude("f", "m"))
        assert torch.equal(alone["f"], td["f"])
        assert torch.equal(norm.inv(td)["action"], td["next", "move"])

    def test_loaded_bounds_are_kept_when_attached_elsewhere(self) -> None:
        """A policy goes on reading what it was trained on, in another region too."""
        env = TransformedEnv(nav(2), minmax_nav())
        env.rollout(1)
        norm = minmax_nav()
        norm.load_state_dict(env.transform.state_dict())
        elsewhere = TransformedEnv(nav(3, Scenario(region=Region((30, 40), (0, 10)))), norm)
        elsewhere.rollout(1)
        assert torch.equal(elsewhere.transform.low_0, env.transform.low_0)

    def test_loading_copies(self) -> None:
        source, norm = MinMaxNorm(["x"], bounds={"x": (0.0, 1.0)}), MinMaxNorm(["x"])
        norm.load_state_dict(source.state_dict())
        source.high_0.fill_(9.0)
        assert norm.high_0 == 1.0

    def test_an_unattached_clone_takes_the_bounds_of_its_own_env(self) -> None:
        norm = MinMaxNorm(["field"], ["f"])
        other = norm.clone()
        first = TransformedEnv(nav(2), norm)
        second = TransformedEnv(nav(2, Scenario(region=Region((30, 40), (0, 10)))), other)
        for env in (first, second):
            space = env.base_env.observation_spec["field"].space
            assert env.reset()["f"].abs().max() <= 1
            assert torch.equal(env.transform.low_0, space.low[0])

    def test_given_tensors_are_copied(self) -> None:
        low, high = torch.zeros(2), torch.ones(2)
        norm = MinMaxNorm(["x"], bounds={"x": (low, high)})
        high.fill_(float("nan"))
        assert torch.equal(norm.high_0, torch.ones(2))

    @pytest.mark.parametrize("keys", ["x", ["x"], ("x",)])
    def test_one_key_in_any_of_its_spellings(self, keys: str | list[str] | tuple[str]) -> None:
        norm = MinMaxNorm(keys, bounds={"x": (0.0, 1.0)})
        assert norm.in_keys == norm.out_keys == ["x"]
        assert norm.in_keys_inv == norm.out_keys_inv == []

    def test_a_tuple_of_names_is_one_nested_key(self) -> None:
        norm = MinMaxNorm(("agents", "x"), bounds={("agents", "x"): (0.0, 1.0)})
        assert norm.in_keys == [("agents", "x")]


# ---------------------------------------------------------------------------------------------------------------------
# AngleVector


def test_angle_vector_is_cosine_then_sine() -> None:
    degrees = torch.tensor([[0], [90], [180], [-90], [-180], [30]], dtype=torch.float64)
    vectors = [[1, 0], [0, 1], [-1, 0], [0, -1], [-1, 0], [math.sqrt(3) / 2, 0.5]]
    found = AngleVector("heading", "course")(TensorDict(heading=torch.deg2rad(degrees)))["course"]
    torch.testing.assert_close(found, torch.tensor(vectors, dtype=torch.float64), rtol=0, atol=1e-15)


def test_angle_vector_reads_several_angles() -> None:
    td = TensorDict(a=torch.zeros(3, 1), b=torch.full((3, 1), math.pi / 2), batch_size=3)
    out = AngleVector(["a", "b"], ["x", "y"])(td)
    torch.testing.assert_close(out["x"], torch.tensor([[1.0, 0.0]] * 3))
    torch.testing.assert_close(out["y"], torch.tensor([[0.0, 1.0]] * 3))


# ---------------------------------------------------------------------------------------------------------------------
# FieldGradient


def test_field_gradient_is_the_slope_between_neighbors() -> None:
    """Central differences over 2 km northward and eastward, on the ellipsoid."""
    env = TransformedEnv(nav(6), FieldGradient(field()))
    td = env.rollout(3)["next"]
    latitude, longitude = td["position"].unbind(-1)
    slopes = []
    for heading in (0.0, math.pi / 2):
        ends = [
            torch.stack(move(latitude, longitude, torch.full_like(latitude, h), torch.ones_like(latitude)), -1)
            for h in (heading, heading + math.pi)
        ]
        slopes.append((elements_at(field(), ends[0]) - elements_at(field(), ends[1])) / 2)
    torch.testing.assert_close(td["field_gradient"].double(), torch.stack(slopes, -1), rtol=1e-4, atol=1e-6)


def test_field_gradient_keeps_the_model_out_of_reach_of_float32() -> None:
    transform = FieldGradient(field()).float()
    assert transform.field.coefficients.dtype == torch.float64


# ---------------------------------------------------------------------------------------------------------------------
# GradientHeading


def way(
    here: list[float], there: list[float], gradient: list[list[float]], dtype: torch.dtype = torch.float64, **options
) -> tuple[float, bool]:
    """The heading in degrees and the mask, for one place."""
    names = ("field", "target_field", "field_gradient")
    td = TensorDict({n: torch.tensor(x, dtype=dtype) for n, x in zip(names, (here, there, gradient), strict=True)})
    out = GradientHeading(**options)(td)
    return math.degrees(out["gradient_heading"]), bool(out["gradient_heading_valid"])


def nav_with_gradient(spread: float) -> TensorDict:
    """64 places whose gradients point in random directions."""
    draw = torch.Generator().manual_seed(0)
    scale = torch.tensor([0.01, 0.02, 1.0])
    gradient = torch.randn(64, 3, 2, generator=draw) * scale.unsqueeze(-1)
    here = torch.tensor([8.0, -16.0, 35000.0]).expand(64, 3)
    there = here + spread * 100 * scale * torch.randn(64, 3, generator=draw)
    return TensorDict(field=here, target_field=there, field_gradient=gradient, batch_size=[64])


D_EAST_I_NORTH_B_SOUTH_EAST = [[0.0, 0.01], [0.02, 0.0], [-1.0, 1.0]]


class TestGradientHeading:
    @pytest.mark.parametrize(
        ("error", "degrees"),
        [
            ((0.0, 1.0), 0.0),
            ((1.0, 0.0), 90.0),
            ((0.0, -1.0), 180.0),
            ((-1.0, 0.0), -90.0),
            ((0.5, 1.0), 45.0),  # 50 km to the east and 50 to the north
            ((-0.5, -1.0), -135.0),
        ],
    )
    @pytest.mark.parametrize("dtype", DTYPES)
    def test_pair_of_angles(self, error: tuple[float, float], degrees: float, dtype: torch.dtype) -> None:
        there = [8 + error[0], -16 + error[1], 35000.0]
        heading, valid = way([8.0, -16.0, 35000.0], there, D_EAST_I_NORTH_B_SOUTH_EAST, dtype)
        assert valid
        assert heading == pytest.approx(degrees, abs=1e-3 if dtype == torch.float32 else 1e-9)

    @pytest.mark.parametrize("pair", [("I", "B_H"), ("B_H", "I"), (1, 2), ("I", 2)])
    def test_pair_of_inclination_and_intensity(self, pair: tuple[str | int, str | int]) -> None:
        """2 deg of I are 100 km north; 200 nT then ask for 300 km east. D, which asks for west, is not heard."""
        heading, valid = way([8.0, -16.0, 35000.0], [7.0, -14.0, 35200.0], D_EAST_I_NORTH_B_SOUTH_EAST, pair=pair)
        assert valid
        assert heading == pytest.approx(math.degrees(math.atan2(300, 100)), abs=1e-9)

    @pytest.mark.parametrize(
        ("gradient", "pair"),
        [
            ([[0.0, 0.01], [0.02, 0.0], [-1.0, 1.0]], ("D", "I")),
            ([[0.0, 0.01], [-0.001, 0.02], [-1.0, 0.1]], ("D", "B_H")),
            ([[0.0, 0.0], [0.02, 0.0], [-1.0, 1.0]], ("I", "B_H")),
        ],
    )
    def test_automatic_pair_is_the_one_that_crosses_best(self, gradient: list, pair: tuple[str, str]) -> None:
        here, there = [179.5, -16.0, 35000.0], [-180.0, -14.0, 35200.0]
        heading, valid = way(here, there, gradient, pair="auto")
        assert valid
        assert heading == way(here, there, gradient, pair=pair)[0]

    def test_automatic_pair_has_no_heading_where_no_two_gradients_cross(self) -> None:
        parallel = [[0.0, 0.01], [0.0, 0.02], [0.0, 1.0]]
        for gradient, there in (
            (parallel, [7.0, -14.0, 35200.0]),
            (D_EAST_I_NORTH_B_SOUTH_EAST, [8.0, -16.0, 35000.0]),
        ):
            assert way([8.0, -16.0, 35000.0], there, gradient, pair="auto") == (0.0, False)

    def test_automatic_pair_in_a_batch_is_chosen_place_by_place(self) -> None:
        td = nav_with_gradient(2.0)
        automatic = GradientHeading(pair="auto")(td.clone())
        fixed = [GradientHeading(pair=pair)(td.clone()) for pair in (("D", "I"), ("D", "B_H"), ("I", "B_H"))]
        names = ("gradient_heading", "gradient_heading_valid")
        heading, valid = (torch.stack([out[name] for out in (automatic, *fixed)]) for name in names)
        assert valid[0].all()
        same = heading[0] == heading[1:]
        assert same.any(0).all()
        assert [bool(same[k].any()) for k in range(3)] == [True, True, True]

    def test_by_index_on_two_elements_that_are_not_magnetic(self) -> None:
        env = TransformedEnv(PlaneEnv((4,), torch.float64), heading_plane())
        td = env.rollout(5)["agents"]
        expected = way_of(td["scent_there"] - td["scent"], td["slope"])
        assert td["way_valid"].all()
        torch.testing.assert_close(td["way"], expected, rtol=0, atol=1e-12)

    @pytest.mark.parametrize(
        ("here", "there", "degrees"), [(179.0, -179.0, 90.0), (-179.5, 179.5, -90.0), (-1.0, 1.0, 90.0)]
    )
    def test_declination_is_taken_the_short_way(self, here: float, there: float, degrees: float) -> None:
        gradient = [[0.0, 0.01], [0.02, 0.0]]
        heading, valid = way([here, 0.0], [there, 0.0], gradient)
        assert valid
        assert heading == pytest.approx(degrees, abs=1e-9)

    def test_an_index_is_taken_as_it_stands(self) -> None:
        heading, _ = way([179.0, 0.0], [-179.0, 0.0], [[0.0, 0.01], [0.02, 0.0]], pair=(0, 1))
        assert heading == pytest.approx(-90.0, abs=1e-9)

    @pytest.mark.parametrize(
        ("crossing_deg", "least_deg", "expected"),
        [(1.9, 2.0, False), (2.1, 2.0, True), (1.9, 0.0, True), (30, 45, False)],
    )
    @pytest.mark.parametrize("sign", [1, -1])
    def test_near_parallel_gradients_are_masked(
        self, crossing_deg: float, least_deg: float, expected: bool, sign: int
    ) -> None:
        turn = math.radians(sign * crossing_deg)
        gradient = [[3.0, 0.0], [5 * math.cos(turn), 5 * math.sin(turn)]]
        heading, valid = way([0.0, 0.0], [0.1, 0.2], gradient, pair=(0, 1), min_crossing_deg=least_deg)
        assert valid is expected
        assert valid or heading == 0.0

    @pytest.mark.parametrize(
        ("there", "gradient"),
        [
            ([1.0, 1.0], [[0.0, 0.0], [0.0, 1.0]]),
            ([1.0, 1.0], [[1.0, 2.0], [2.0, 4.0]]),
            ([0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]]),
        ],
        ids=["no gradient", "parallel", "on target"],
    )
    @pytest.mark.parametrize("least_deg", [0.0, 2.0])
    def test_no_direction_is_masked_and_not_nan(
        self, there: list[float], gradient: list[list[float]], least_deg: float
    ) -> None:
        assert way([0.0, 0.0], there, gradient, pair=(0, 1), min_crossing_deg=least_deg) == (0.0, False)

    def test_in_the_env_it_is_the_way_of_the_inverse_jacobian(self) -> None:
        td = guided(8).rollout(4)
        error = (td["target_field"] - td["field"])[..., :2]
        assert td["gradient_heading_valid"].all()
        expected = way_of(error, td["field_gradient"][..., :2, :])
        assert deviation(td["gradient_heading"], expected).max() < 1e-3


# ---------------------------------------------------------------------------------------------------------------------
# AlignmentReward


class TestAlignmentReward:
    def transition(self, **changes: object) -> TensorDict:
        """One step whose angles are all different, so that reading a wrong one gives another number."""
        entries = {"angle": 1.3, "reference": 0.1, "trusted": True}
        after = {"angle": 0.4, "reference": -0.8, "trusted": False, "reward": 7.0}
        after = {name: torch.tensor([value]) for name, value in after.items()}
        td = TensorDict({name: torch.tensor([value]) for name, value in entries.items()} | {"next": TensorDict(after)})
        return td.update(changes)

    @pytest.mark.parametrize("mask", [[], ["trusted"]])
    def test_angle_after_the_move_and_reference_and_mask_before_it(self, mask: list[str]) -> None:
        out = AlignmentReward(["angle", "reference", *mask])(self.transition())
        assert float(out["next", "reward"]) == pytest.approx(7 + 3 * (math.pi / 4 - 0.3), abs=1e-5)

    def test_masked_reference_earns_nothing_even_if_it_is_nan(self) -> None:
        td = self.transition(trusted=torch.tensor([False]), reference=torch.tensor([float("nan")]))
        assert float(AlignmentReward(["angle", "reference", "trusted"])(td)["next", "reward"]) == 7.0

    @pytest.mark.parametrize(("weight", "offset"), [(3.0, math.pi / 4), (1.0, 0.0), (-2.0, 1.0)])
    def test_weight_and_offset(self, weight: float, offset: float) -> None:
        out = AlignmentReward(["angle", "reference"], weight=weight, offset=offset)(self.transition())
        assert float(out["next", "reward"]) == pytest.approx(7 + weight * (offset - 0.3), abs=1e-5)

    @pytest.mark.parametrize(("angle", "reference", "apart"), [(3.0, -3.0, 2 * math.pi - 6), (-math.pi, math.pi, 0.0)])
    def test_deviation_is_wrapped(self, angle: float, reference: float, apart: float) -> None:
        td = self.transition(reference=torch.tensor([reference]))
        td["next", "angle"] = torch.tensor([angle])
        out = AlignmentReward(["angle", "reference"])(td)
        assert float(out["next", "reward"]) == pytest.approx(7 + 3 * (math.pi / 4 - apart), abs=1e-5)

    def test_reward_is_created_when_missing(self) -> None:
        out = AlignmentReward(["angle", "reference"], "alignment")(self.transition())
        assert float(out["next", "reward"]) == 7.0
        assert float(out["next", "alignment"]) == pytest.approx(3 * (math.pi / 4 - 0.3), abs=1e-5)
        assert "alignment" not in out

    @pytest.mark.parametrize("trusted", [True, False])
    def test_a_second_out_key_gets_the_term_alone(self, trusted: bool) -> None:
        td = self.transition(trusted=torch.tensor([trusted]))
        out = AlignmentReward(["angle", "reference", "trusted"], ["reward", "reward_alignment"])(td)
        term = 3 * (math.pi / 4 - 0.3) if trusted else 0.0
        assert float(out["next", "reward"]) == pytest.approx(7 + term, abs=1e-5)
        assert float(out["next", "reward_alignment"]) == pytest.approx(term, abs=1e-5)

    def test_in_the_env_the_second_out_key_is_what_the_first_one_gained(self) -> None:
        env = TransformedEnv(guided(4), alignment_twice())
        td = env.rollout(5)["next"]
        base = td["reward_destination"] + td["reward_proximity"]
        assert td["reward_alignment"].std() > 0.5
        torch.testing.assert_close(td["reward"] - base, td["reward_alignment"], rtol=0, atol=1e-4)
        assert set(env.reward_keys) >= {"reward", "reward_alignment"}
        assert isinstance(env.full_reward_spec["reward_alignment"], Unbounded)

    def test_without_next_the_error_says_what_is_needed(self) -> None:
        with pytest.raises(KeyError, match=r"AlignmentReward needs transitions.*'next'.*angle"):
            AlignmentReward(["angle", "reference"])(self.transition().exclude("next"))

    @pytest.mark.parametrize(("missing", "named"), [(("next", "angle"), "angle"), ("reference", "reference")])
    def test_a_missing_end_is_named(self, missing: NestedKey, named: str) -> None:
        with pytest.raises(KeyError) as raised:
            AlignmentReward(["angle", "reference"])(self.transition().exclude(missing))
        assert f"AlignmentReward reads '{named}'" in raised.value.args[0]

    def test_in_the_env_it_is_added_to_the_base_reward(self) -> None:
        """The same flight with and without the term."""
        actions = torch.rand(5, 4, 2) * torch.tensor([50.0, 1.5])
        flights = []
        for env in (guided(4), TransformedEnv(guided(4), AlignmentReward(weight=2.0))):
            td, steps = env.reset(), []
            for action in actions:
                steps.append(env.step(td.set("action", action)))
                td = env.step_mdp(steps[-1])
            flights.append(torch.stack(steps))
        plain, aligned = flights
        term = 2 * (math.pi / 4 - deviation(aligned["next", "heading"], aligned["gradient_heading"]))
        assert term.std() > 0.5
        got = aligned["next", "reward"].double() - plain["next", "reward"].double()
        torch.testing.assert_close(got, term, rtol=0, atol=1e-4)

    def test_a_key_pair_of_another_domain(self) -> None:
        env = TransformedEnv(PlaneEnv((3,), torch.float64), alignment_plane())
        td = env.rollout(6)
        now, after = td["agents"], td["next", "agents"]
        term = 3 * (math.pi / 4 - deviation(after["angle"], now["reference"]))
        expected = after["place"].sum(-1, keepdim=True) + now["trusted"] * term
        assert 0 < now["trusted"].double().mean() < 1
        torch.testing.assert_close(after["reward"], expected, rtol=0, atol=1e-7)

    def test_nothing_is_paid_at_reset(self) -> None:
        env = TransformedEnv(guided(), alignment_apart())
        assert {"reward", "alignment"}.isdisjoint(env.reset().keys())
        assert {"reward", "alignment"} <= set(env.rollout(1)["next"].keys())

    def test_reward_is_unbounded_once_the_term_is_on_it(self) -> None:
        class Paid(PlaneEnv):
            def __init__(self) -> None:
                super().__init__()
                self.reward_spec = Composite(agents=Composite(reward=Bounded(-99.0, 99.0, (1,))))

        env = TransformedEnv(Paid(), alignment_plane())
        assert not isinstance(env.full_reward_spec["agents", "reward"], Bounded)
        assert isinstance(env.base_env.full_reward_spec["agents", "reward"], Bounded)


# ---------------------------------------------------------------------------------------------------------------------
# Compose


def test_compose_runs_in_order() -> None:
    norm = MinMaxNorm(["x"], bounds={"x": (0.0, 180.0)}, interval=(0.0, math.pi))
    td = TensorDict(x=torch.tensor([90.0]))
    there = Compose(norm.clone(), AngleVector("x", "v"))(td.clone())["v"]
    back = Compose(AngleVector("x", "v"), norm.clone())(td.clone())["v"]
    torch.testing.assert_close(there, torch.tensor([0.0, 1.0]), rtol=0, atol=1e-6)
    torch.testing.assert_close(back, torch.tensor([math.cos(90.0), math.sin(90.0)]))


def test_compose_refuses_a_reader_before_its_writer() -> None:
    env = TransformedEnv(nav(), Compose(GradientHeading(), FieldGradient(field())))
    with pytest.raises(KeyError, match="GradientHeading reads 'field_gradient'"):
        _ = env.specs
    env = TransformedEnv(nav(), Compose(AlignmentReward(), FieldGradient(field()), GradientHeading()))
    with pytest.raises(KeyError, match="AlignmentReward reads 'gradient_heading'"):
        _ = env.specs


def test_compose_scales_what_another_transform_wrote() -> None:
    """Bounds of an entry that is not the env's own come from the spec that its writer declared."""
    base = nav(3)
    chain = Compose(FieldGradient(field()), GradientHeading(), MinMaxNorm(["gradient_heading"], ["g"], ["action"]))
    env = TransformedEnv(base, chain)
    check_env_specs(env)
    td = env.rollout(3)
    torch.testing.assert_close(td["g"] * math.pi, td["gradient_heading"], rtol=1e-5, atol=1e-5)


def test_scaling_a_reference_in_place_after_the_alignment_term_reads_it_is_refused() -> None:
    chain = Compose(FieldGradient(field()), GradientHeading(), AlignmentReward(), MinMaxNorm(["gradient_heading"]))
    with pytest.raises(ValueError, match=re.escape("MinMaxNorm would overwrite 'gradient_heading'")):
        TransformedEnv(nav(), chain).rollout(2)


def test_every_value_of_the_whole_chain() -> None:
    """One flight through every transform at once, each value from the equations or the base entries."""
    env = full_chain(3, start_heading="random")
    td = env.rollout(4, break_when_any_done=False)
    assert td["action"].abs().max() <= 1
    for now, after in ((td[..., k], td[..., k]["next"]) for k in range(4)):
        heading = after["heading"]
        torch.testing.assert_close(after["course"], torch.cat((heading.cos(), heading.sin()), -1))
        torch.testing.assert_close(after["field_difference"], after["target_field"] - after["field"])
        error = (after["target_field"] - after["field"])[..., :2]
        expected, _ = guidance.parallel_approach(
            torch.zeros_like(error), error, after["field_gradient"][..., :2, :], math.radians(2)
        )
        torch.testing.assert_close(after["gradient_heading"], expected)
        base = guidance.proximity_reward(now["objective"], after["objective"], 10.0)
        assert not after["success"].any()
        reward = base + guidance.alignment_reward(heading, now["gradient_heading"], 3.0)
        torch.testing.assert_close(after["reward"], reward, rtol=1e-4, atol=1e-3)
