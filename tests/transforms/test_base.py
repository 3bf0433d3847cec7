"""TorchRL's conformance list for all transforms in environments."""

import copy
import pickle
from collections.abc import Callable
from functools import partial

import pytest
import torch
from support.environments import paper_field, parallel
from support.errors import all_errors, every_error, nav, sensor_errors
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.testing import assert_close
from torchrl.envs import Compose, EnvBase, PendulumEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from magrl.envs import GeomagneticNavEnv
from magrl.errors import KnownPlace, MagneticNorth, SensorErrors, TargetErrors, sensor_levels
from magrl.pilot import Rules
from magrl.sensor_std import STD_KEYS
from magrl.transforms import (
    AlignmentReward,
    AngleVector,
    DeclareArrival,
    DistanceCost,
    EpisodeSum,
    FieldGradient,
    GradientHeading,
    HighestSPL,
    MinMaxNorm,
    NoGoAreas,
    RandomStepPrice,
    ReadingObservation,
    Shield,
    SPLReward,
    TargetDifference,
    TrackField,
    TrueDisplacement,
)
from magrl.transforms.base import ObservationTransform, key_list

pytestmark = pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped")


def guided() -> Transform:
    """Every transform of a guided agent at once, in the order of use."""
    return Compose(
        FieldGradient(paper_field()),
        GradientHeading(pair="auto"),
        AlignmentReward(out_keys=["reward", "reward_alignment"]),
        DistanceCost(0.01),
        SensorErrors(levels=sensor_levels),
        TargetDifference(),
        AngleVector(["heading"], ["course"]),
        MinMaxNorm(["leg"], ["m"], ["action"]),
    )


def rewarded() -> Transform:
    """Rewards of agents without a map, with what a policy with a memory sees."""
    rewards = RandomStepPrice((0.1, 1.0)), TrueDisplacement(), HighestSPL(), SPLReward(), NoGoAreas(), Shield()
    others = KnownPlace(5.0, 2.0), ReadingObservation(), EpisodeSum(["reward_proximity", "leg"])
    return Compose(*rewards, *others)


def declared() -> Transform:
    """A track of readings by the compass, and declarations from it."""
    rules = Rules(arrival="declared")
    return Compose(sensor_errors(), MagneticNorth(), TrackField(rules, STD_KEYS), DeclareArrival(rules, STD_KEYS))


def pendulum() -> Transform:
    return MinMaxNorm(["th", "thdot"], ["a", "b"], ["action"], ["torque"])


ENV_CASES: dict[str, tuple[Callable[[], EnvBase], Callable[[], Transform]]] = {
    "guided": (nav, guided),
    "rewarded": (nav, rewarded),
    "every error": (nav, every_error),
    "compass": (nav, lambda: Compose(sensor_errors(), MagneticNorth(), TargetErrors((0.1, 0.05, 30.0)))),
    "declared": (partial(nav, arrival="declared"), declared),
    "scaled pendulum": (PendulumEnv, pendulum),
}


def assert_same(one: TensorDictBase, other: TensorDictBase, rows: Tensor | slice = slice(None)) -> None:
    for key in other.keys(True, True):
        assert_close(one[key][rows], other[key][rows], rtol=0, atol=0, equal_nan=True, msg=str(key))


@pytest.mark.parametrize(("base", "make"), ENV_CASES.values(), ids=ENV_CASES)
class TestConformance:
    def test_specs(self, base: Callable[[], EnvBase], make: Callable[[], Transform]) -> None:
        """Of an environment, whose own specs stay as they are."""
        plain = base()
        before = plain.specs.clone()
        env = TransformedEnv(plain, make())
        check_env_specs(env, break_when_any_done="both")
        assert env.specs != before
        assert plain.specs == before

    def test_copies(self, base: Callable[[], EnvBase], make: Callable[[], Transform]) -> None:
        """They fly as their original does, which has flown or not."""

        def flown(env: EnvBase) -> TensorDictBase:
            torch.manual_seed(env.set_seed(0))
            return env.rollout(1)

        env = TransformedEnv(base(), make())
        copied, expected = copy.deepcopy(env), flown(env)
        assert_same(flown(copied), expected)
        for part in (env.transform.clone(), pickle.loads(pickle.dumps(make()))):
            assert_same(flown(TransformedEnv(base(), part)), expected)

    def test_a_partial_reset_leaves_the_others_alone(self, base: Callable, make: Callable) -> None:
        env, again = TransformedEnv(base(), make()), TransformedEnv(base(), make())
        if not isinstance(env.base_env, GeomagneticNavEnv):
            pytest.skip("the environment keeps no state of some")
        state = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
        chosen = torch.tensor([True, False])
        after = env.reset(state.clone().set("_reset", chosen.unsqueeze(-1)), set_state=False)
        begun = [again.reset() for _ in range(2)][1]  # the second episode of all
        assert_same(after, state.select(*begun.keys(True, True)), ~chosen)
        assert_same(after, begun, chosen)


def test_specs_over_several_environments() -> None:
    check_env_specs(TransformedEnv(SerialEnv(2, nav), every_error()))


@pytest.mark.parametrize("make", [guided, every_error])
def test_a_step_traces_as_one_graph(make: Callable[[], Transform]) -> None:
    """Without breaks, and with the same numbers."""
    env = TransformedEnv(nav(), make())
    state = env.rand_action(env.reset())
    after = env.base_env._step(env.transform.inv(state))
    traced = torch.compile(env.transform._step, fullgraph=True, backend="eager")
    assert_same(traced(state, after.clone()), env.transform._step(state, after.clone()))


def test_a_step_in_another_process_starts_from_the_state_that_it_is_sent() -> None:
    """And not from the last one there."""
    env = parallel(all_errors)
    try:
        state = env.rand_action(env.reset())
        one, _, other = (env.step(step.clone())["next"].clone() for step in (state, env.rand_action(state), state))
        assert (one == other).all()
    finally:
        env.close()


@pytest.mark.parametrize("make", [lambda: AngleVector(["heading"], ["heading"]), lambda: MinMaxNorm(["target_field"])])
def test_writing_over_the_state_of_the_env_is_refused(make: Callable[[], Transform]) -> None:
    transform = make()
    with pytest.raises(ValueError, match=f"{type(transform).__name__}.*{transform.out_keys[0]!r}.*state"):
        TransformedEnv(nav(), transform).rollout(2)


def test_a_reader_before_its_writer_is_refused() -> None:
    for reader in (GradientHeading(), AlignmentReward(["heading", "gradient_heading"])):
        with pytest.raises(KeyError, match=rf"{type(reader).__name__} reads '(field_gradient|gradient_heading)'"):
            _ = TransformedEnv(nav(), Compose(reader, FieldGradient(paper_field()), GradientHeading())).specs


@pytest.mark.parametrize(
    "transform", [AngleVector(["th"], ["v"]), SensorErrors((0.1,), in_keys=["th"], out_keys=["v"])]
)
def test_a_value_without_its_last_dimension_is_refused(transform: Transform) -> None:
    message = rf"{type(transform).__name__} reads 'th' as \(..., 1\), got \(\): UnsqueezeTransform\(-1, \['th'\]"
    with pytest.raises(ValueError, match=message):
        transform(TensorDict(th=torch.tensor(0.0)))
    with pytest.raises(ValueError, match=message):
        TransformedEnv(PendulumEnv(), transform.clone()).rollout(2)


@pytest.mark.parametrize(
    ("own", "error", "message"),
    [
        ({}, NotImplementedError, r"Own has no method _compute\(values\)"),
        ({"_compute": lambda _, values: 2 * values}, ValueError, r"Own._compute must return a list.* \['x'\]$"),
        ({"_compute": lambda _, values: values[0]}, ValueError, r"Own._compute must return a list"),
    ],
)
def test_what_a_transform_of_ones_own_lacks_is_named(own: dict, error: type[Exception], message: str) -> None:
    kind = type("Own", (ObservationTransform,), own | {"out_sizes": {"x": (1,)}})
    with pytest.raises(error, match=message):
        TransformedEnv(nav(1), kind(["heading"], ["x"])).rollout(1)


def test_keys_are_lists_in_the_order_of_the_names() -> None:
    """As in TorchRL; optional ones may be left out at the end."""
    for keys in ("x", ["x"], [("x",)]):
        assert key_list(keys) == ["x"]
    assert key_list([("agents", "x"), "y"]) == [("agents", "x"), "y"]
    assert AlignmentReward(["a", "b"]).in_names == ["heading", "gradient_heading"]
    assert AlignmentReward().out_keys == ["reward"]
    for wrong in (5, [5], {"heading": "a"}):
        with pytest.raises(TypeError, match="keys must be a list of names"):
            AlignmentReward(wrong)
    for wrong in ([], ["a"], ["a", "b", "c", "d"]):
        with pytest.raises(ValueError, match=r"in the order heading, .* \(gradient_heading_valid may be left out\)"):
            AlignmentReward(wrong)


def test_all_errors_are_deterministic_in_a_chain() -> None:
    """Scaled actions reach the errors of motion as kilometers and radians."""
    norm = MinMaxNorm(in_keys_inv=["action"], bounds={"action": ((0.0, -1.5), (50.0, 1.5))})
    scaled, plain = TransformedEnv(nav(), Compose(*every_error(), norm)), all_errors()
    action = torch.tensor([[0.0, 0.5], [1.0, -1.0]])
    one = scaled.step(scaled.reset().set("action", action))["next"]
    other = plain.step(plain.reset().set("action", torch.tensor([[25.0, 0.75], [50.0, -1.5]])))["next"]
    assert_close(one["position"], other["position"])
