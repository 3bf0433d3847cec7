"""Policies of any algorithm: exported with the transforms that they need, compared, saved, loaded and refused."""

import copy
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.envs import CatTensors, Compose, ObservationNorm, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal

from magrl.agents import ExportedPolicy, load_policy, save_policy
from magrl.agents.program import TensorProgram, trace_program
from magrl.envs import GeomagneticNavEnv
from magrl.files import load_tensors, save_tensors
from magrl.transforms import (
    AlignmentReward,
    AngleVector,
    FieldGradient,
    GradientHeading,
    MinMaxNorm,
    SensorNoise,
    TargetDifference,
)


def training_env() -> TransformedEnv:
    """Return a noisy environment with privileged rewards and an observation that no view of the library has."""
    base = GeomagneticNavEnv(num_envs=5, seed=3)
    guidance = [FieldGradient(base.field), GradientHeading(), AlignmentReward(weight=3.0), RewardSum()]
    observed = ["move_scaled", "field_difference", "course"]
    steps = [
        SensorNoise((0.05, 0.05, 5.0), seed=1),
        MinMaxNorm(["move"], ["move_scaled"]),
        TargetDifference(),
        AngleVector("heading", "course"),
        CatTensors(observed, "own", del_keys=False, sort=False),
        ObservationNorm(loc=torch.full((7,), 0.1), scale=torch.full((7,), 3.0), in_keys=["own"], standard_normal=True),
        MinMaxNorm(in_keys_inv=["action"]),
    ]
    return TransformedEnv(base, Compose(*guidance, *steps))


def stochastic_actor(env: TransformedEnv) -> ProbabilisticActor:
    torch.manual_seed(0)
    layers = {"norm_class": nn.LayerNorm, "norm_kwargs": [{"normalized_shape": 16}]}
    network = nn.Sequential(MLP(7, 4, num_cells=[16], **layers), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(network, ["own"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec_unbatched,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """The file of a stochastic actor, whose export changes neither the actor nor random numbers nor the environment."""
    path = tmp_path_factory.mktemp("policies") / "own.pt"
    env, other = training_env(), training_env()
    actor = stochastic_actor(env)
    state, weights = torch.get_rng_state(), copy.deepcopy(actor.state_dict())
    save_policy(path, actor, env)
    assert torch.equal(torch.get_rng_state(), state)
    assert actor.training
    assert all(torch.equal(value, weights[key]) for key, value in actor.state_dict().items())
    assert torch.equal(env.reset()["field"], other.reset()["field"])
    return path


# Save and load


def test_a_policy_acts_alike_after_saving(saved: Path) -> None:
    """Any network, distribution and observation; on the readings that the noisy sensors of the training gave."""
    env, policy = training_env(), load_policy(saved)
    assert isinstance(policy, ExportedPolicy)
    assert policy.in_keys == ["field", "target_field", "move", "heading"]
    assert policy.view == env.base_env.observation_view()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        flown = env.rollout(12, stochastic_actor(env), break_when_any_done=False)
    wanted = env.transform[-1].inv(flown)["action"]
    seen = flown.select(*policy.in_keys)
    torch.testing.assert_close(policy(seen)["action"], wanted, rtol=1e-5, atol=1e-5)
    assert wanted.std(0).min() > 1e-3
    assert torch.equal(policy(seen[0, 0])["action"], policy(seen[:1, 0])["action"][0])


class Functions(nn.Module):
    """The usual activations, and functions of several tensors, whose parts PyTorch rounds otherwise."""

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        x, y = inputs
        names = ("silu", "celu", "elu", "selu", "gelu", "softplus", "mish", "logsigmoid", "leaky_relu", "hardswish")
        activated = [getattr(nn.functional, name)(x) for name in names]
        several = [torch.lerp(x, y, 0.3), torch.hypot(x, y), torch.addcmul(x, x, y), torch.logaddexp(x, y), x.std(-1)]
        return (*activated, *several, nn.functional.cosine_similarity(x, y.roll(1, 0), -1), x.norm(dim=-1))


def test_programs_compute_usual_functions_to_the_bit() -> None:
    x, y = torch.randn(2, 200, 7, generator=torch.Generator().manual_seed(0)).unbind(0)
    program = trace_program(Functions(), (x[:3], y[:3]))
    for found, expected in zip(program(x, y), Functions()(x, y), strict=True):
        assert torch.equal(found, expected)


# Refusals at save time


def acting(function: Callable, *keys: str) -> TensorDictModule:
    return TensorDictModule(function, list(keys), ["action"])


def squashed(x: torch.Tensor) -> torch.Tensor:
    return x[..., :2].sigmoid()


class Counter(nn.Module):
    """A module that counts its calls, which is a state outside the TensorDict."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.count += 1
        return squashed(x) / self.count


@pytest.mark.parametrize(
    ("actor", "transforms", "message"),
    [
        (acting(squashed, "position"), [], "'position', which a vehicle that navigates by the field does not know"),
        (acting(squashed, "sonar"), [], "'sonar', which no transform writes; it may read field, target_field, move"),
        (TensorDictModule(lambda x, m: (squashed(x + m), m), ["field", "m"], ["action", ("next", "m")]), [], "TensorD"),
        (acting(Counter(), "field"), [], "it changes .*count as it acts"),
        (acting(lambda x: squashed(x + torch.rand_like(x)), "field"), [], "rand.* draws random numbers"),
        (acting(lambda x: squashed(x.sort(0)[0] / 9), "field"), [], "from step 0 on the actions differ by up"),
        (acting(lambda x: squashed(x) if x.sum() > 0 else squashed(-x), "field"), [], "PyTorch cannot export it: "),
        (acting(lambda x: torch.linalg.inv(x.unsqueeze(-1) @ x.unsqueeze(-2))[..., :2, 0], "field"), [], "linalg_inv"),
    ],
    ids=["privileged", "unknown", "first", "state", "random", "batch", "branch", "operation"],
)
def test_what_cannot_be_saved_is_refused_with_its_reason(actor, transforms, message: str, tmp_path: Path) -> None:
    base = GeomagneticNavEnv(num_envs=5, seed=3)
    env = TransformedEnv(base, Compose(SensorNoise((0.0, 0.0, 1.0)), *transforms))
    with pytest.raises(ValueError, match=f"^the policy cannot be exported: .*{message}"):
        save_policy(tmp_path / "own.pt", actor, env)
    assert not list(tmp_path.iterdir())


def test_a_policy_needs_its_environment(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"is saved with the transforms of its environment: save_policy\(path, policy"):
        save_policy(tmp_path / "own.pt", acting(squashed, "field"))
    with pytest.raises(TypeError, match="policy must be a TensorDictModuleBase"):
        save_policy(tmp_path / "own.pt", squashed)


# Refusals at load time


def step(name: object, *args: object, **named: object) -> Callable:
    """Return a change that puts one more operation behind a program."""
    return lambda c: c["program"]["steps"].append([name, list(args), named])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (step("from_file.default", 1), "'from_file.default' is not one of PyTorch's core operations"),
        (step("add_.Tensor", {"value": 0}, 1), "'add_.Tensor' is not one of"),
        (step("rand.default", [2]), "rand.default draws random numbers"),
        (step("__class__.mro"), "is no operation of PyTorch"),
        (step(7), "7 is no operation of PyTorch"),
        (step("neg.default", {"value": 9999}), "an earlier value or a list of these, got {'value': 9999}"),
        (lambda c: c["program"]["steps"].append("neg"), "must be a name, arguments and named arguments, got 'neg'"),
        (lambda c: c["program"]["tensors"].__setitem__(0, torch.tensor(torch.nan)), "tensor 0 is not finite"),
        (lambda c: c["program"]["tensors"].__setitem__(0, 5), "tensor 0 must be a Tensor, got 5"),
        (lambda c: c["program"].update(outputs=[10**6]), "outputs must be numbers of values"),
        (lambda c: c.update(in_keys=["position"]), "in_keys must be among field, target_field"),
        (lambda c: c.update(in_keys=["field"]), "a program for 1 keys and 0 tensors of state must take 1 inputs"),
        (lambda c: c.update(view={"field_low": 1}), "does not hold a valid policy"),
        (lambda c: c.update(more=1), "unexpected keyword argument 'more'"),
        (step("_native_batch_norm_legit.default", *[{"value": 0}] * 5, True, 0.1, 1e-5), "is not one of"),
        (step("full.default", [10**9], 1.0), "full.default makes more numbers than 1000"),
    ],
)
def test_damaged_and_foreign_content_is_refused(saved: Path, tmp_path: Path, change, message: str) -> None:
    content = load_tensors(saved)
    change(content["exported"])
    save_tensors(content, tmp_path / "own.pt")
    with pytest.raises(ValueError, match=message) as error:
        load_policy(tmp_path / "own.pt")
    assert str(tmp_path / "own.pt") in str(error.value)


X = {"value": 0}
LARGE = [
    [["arange.start_step", [0, 10**9], {}]],
    [["constant_pad_nd.default", [X, [0, 10**9]], {}]],
    [["expand.default", [X, [10**9, 2]], {}]],
    [["repeat.default", [X, [10**9, 1]], {}]],
    [["cat.default", [[{"value": index}] * 2], {}] for index in range(40)],
]
HUGE_SIZES = [
    [["mul", [[X], 10**9], {}]],
    [["sym_size.int", [X, 1], {}], *[["mul", [{"value": index}] * 2, {}] for index in range(1, 40)]],
]


@pytest.mark.parametrize(
    ("steps", "message"),
    [(steps, "makes more numbers than 10000000") for steps in LARGE] + [(steps, "takes sizes") for steps in HUGE_SIZES],
)
def test_a_program_that_takes_any_memory_is_refused(steps: list, message: str, tmp_path: Path) -> None:
    """Before it runs, by the shapes of one vehicle; also of a file."""
    program = TensorProgram(1, steps, [], [0])
    with pytest.raises(ValueError, match=message):
        ExportedPolicy(["move"], program)
    content = {"in_keys": ["move"], "view": None, "first_state": [], "declares": False, "program": program.content()}
    save_tensors({"format": 3, "exported": content}, tmp_path / "own.safetensors")
    with pytest.raises(ValueError, match=f"does not hold a valid policy: .*{message}"):
        load_policy(tmp_path / "own.safetensors")
