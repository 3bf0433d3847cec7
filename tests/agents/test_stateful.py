"""Policies with a state, of three numbers and of standard deviations: the same actions after saving and loading."""

import math
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.data import Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, TensorDictPrimer, Transform, TransformedEnv
from torchrl.modules import MLP, GRUModule, LSTMModule

from magrl.agents import ExportedPolicy, export_policy, load_policy, save_policy
from magrl.envs import GeomagneticNavEnv
from magrl.evaluation import evaluate
from magrl.evaluation.rollout import evaluation_rollout
from magrl.transforms import SensorNoise, TrackView
from magrl.transforms.base import StatefulTransform
from magrl.vehicle.onboard import Onboard

NOISE = (0.05, 0.05, 5.0)


class Path2d(StatefulTransform):
    """The length of the path [km] and the longest move, which are a state."""

    default_in_keys, default_out_keys = ("move",), ("path", "path_km", "longest_km")
    out_sizes = (2,), (1,), (1,)

    def _begin(self, tensordict, values, mask) -> None:  # noqa: ARG002
        self._advance(tensordict, values, [torch.ones_like(values[0][..., :1])] * 2)

    def _advance(self, tensordict, values, state) -> None:
        path, longest = state[0] + values[0][..., :1], state[1].maximum(values[0][..., :1])
        tensordict.update({"path": torch.cat((path, longest), -1) / 300, "path_km": path, "longest_km": longest})


class Add(nn.Module):
    def forward(self, memory: torch.Tensor, heading: torch.Tensor) -> torch.Tensor:
        return memory + 0.1 * heading + 0.01


def head(size: int, key: str) -> TensorDictModule:
    return TensorDictModule(nn.Sequential(MLP(size, 2, num_cells=[16]), nn.Tanh()), [key], ["action"])


def lstm() -> list[TensorDictModuleBase]:
    keys = {"in_keys": ["observation", "hidden", "cell"], "out_keys": ["memory", ("next", "hidden"), ("next", "cell")]}
    return [LSTMModule(input_size=11, hidden_size=8, **keys), head(8, "memory")]


def gru() -> list[TensorDictModuleBase]:
    keys = {"in_keys": ["observation", "hidden"], "out_keys": ["memory", ("next", "hidden")]}
    return [GRUModule(input_size=11, hidden_size=8, num_layers=2, **keys), head(8, "memory")]


def own() -> list[TensorDictModuleBase]:
    add = TensorDictModule(Add(), ["memory", "heading"], ["summed"])
    return [add, TensorDictModule(nn.Identity(), ["summed"], [("next", "memory")]), head(1, "summed")]


def path() -> list[TensorDictModuleBase]:
    return [head(2, "path")]


def plain_env(**options: object) -> EnvBase:
    return TransformedEnv(GeomagneticNavEnv(num_envs=5, seed=3, **options), SensorNoise(NOISE, seed=1))


def training_env(parts: list[TensorDictModuleBase]) -> EnvBase:
    """Return the environment of a training, with the first state of its policy."""
    env = plain_env()
    view = env.base_env.observation_view(observe_heading=False)
    first: list[Transform] = [
        part.make_tensordict_primer() for part in parts if hasattr(part, "make_tensordict_primer")
    ]
    first = first or [TensorDictPrimer({"memory": Unbounded(1)}, default_value=0.5, expand_specs=True)]
    transforms = [InitTracker(), *first, Path2d(), *view.observation_transforms(), view.action_transform()]
    return TransformedEnv(env, Compose(*transforms), auto_unwrap=True)


@pytest.fixture(scope="module", params=[lstm, own, path], ids=lambda make: make.__name__)
def flight(request, tmp_path_factory) -> tuple[ExportedPolicy, TensorDictModuleBase, EnvBase, Path]:
    """A loaded policy with a state, the policy before saving, its environment, and its file."""
    torch.manual_seed(0)
    parts = request.param()
    actor, env, file = TensorDictSequential(*parts), training_env(parts), tmp_path_factory.mktemp("own") / "own.pt"
    save_policy(file, actor, env)
    policy = load_policy(file)
    assert isinstance(policy, ExportedPolicy)
    return policy, actor, env, file


def test_a_policy_with_a_state_flies_alike_after_saving(flight) -> None:
    """Bit for bit, over episodes that begin at different steps, under noise; a second call changes nothing."""
    policy, actor, env, _ = flight
    wanted = evaluation_rollout(env, actor)
    got = evaluation_rollout(plain_env(), lambda state: policy(policy(state)))
    assert torch.equal(got["next", "position"], wanted["next", "position"])
    assert got["action"].std(1).min() > 1e-4
    singles = [policy(state)["action"] for state in got[:1].select(*policy.in_keys).split(1, 1)]
    torch.testing.assert_close(torch.cat(singles, 1), got[:1]["action"], atol=1e-4, rtol=1e-4)


def test_a_policy_with_a_state_stands_in_tables(flight) -> None:
    """By the name of its file, several episodes in turn."""
    policy, *_, file = flight
    episodes = evaluate(f"policy={file}", "paper-100", num_envs=40, errors=NOISE, max_steps=4)
    alike = evaluate(policy, "paper-100", num_envs=100, errors=NOISE, max_steps=4)
    assert episodes.shape == (100,)
    torch.testing.assert_close(episodes["length_km"][:40], alike["length_km"][:40], atol=0.1, rtol=1e-4)


def test_a_policy_with_a_state_flies_on_board(flight, tmp_path: Path) -> None:
    """The commands of a vehicle that is stopped and resumed are the actions of the policy in the environment."""
    policy, *_ = flight
    env = GeomagneticNavEnv(num_envs=1, seed=3)
    state, vehicle = env.reset(), Onboard(policy, max_steps=50, arrival_km=5.0)
    vehicle.start(state["target_field"][0].tolist())
    for step in range(6):
        seen = *state["field"][0].tolist(), math.degrees(state["heading"].item()), state["move"][0, 0].item()
        command = vehicle.step(*seen)
        distance, turn = policy(state)["action"][0].tolist()
        assert (command.distance_km, math.radians(command.turn_deg)) == pytest.approx((distance, turn), abs=1e-3)
        state = env.step(state)["next"]
        if step == 3:
            vehicle.save(tmp_path / "way.pt")
            vehicle = Onboard(load_policy(flight[3]), max_steps=50, arrival_km=5.0)
            vehicle.restore(tmp_path / "way.pt")


def test_a_state_needs_neither_tracker_nor_primer_in_the_environment() -> None:
    """Collectors add both themselves."""
    torch.manual_seed(0)
    parts = gru()
    env = plain_env()
    view = env.base_env.observation_view(observe_heading=False)
    bare = Compose(*view.observation_transforms(), view.action_transform())
    policy = export_policy(TensorDictSequential(*parts), TransformedEnv(env, bare, auto_unwrap=True))
    wanted = evaluation_rollout(training_env(parts), TensorDictSequential(*parts))
    assert torch.equal(evaluation_rollout(plain_env(), policy)["next", "position"], wanted["next", "position"])


@pytest.mark.slow  # PyTorch traces the filter for half a minute
def test_a_network_of_ones_own_observes_its_track() -> None:
    torch.manual_seed(0)
    view = TrackView(zeta=0.01, max_steps=50, max_move_km=50.0, max_turn_rad=math.pi / 2)
    network = nn.GRUCell(19, 2)
    actor = TensorDictModule(network, ["observation"], ["action"])

    def env() -> EnvBase:
        steps = Compose(*view.observation_transforms(), view.action_transform())
        return TransformedEnv(plain_env(start_heading="random"), steps, auto_unwrap=True)

    wanted = evaluation_rollout(env(), actor)
    got = evaluation_rollout(plain_env(start_heading="random"), export_policy(actor, env()))
    assert torch.equal(got["next", "position"], wanted["next", "position"])


# Declared arrivals, standard deviations


def declaring(observation: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Fly straight ahead, and declare after three moves."""
    return torch.cat(
        (observation[..., :1].sigmoid(), 0 * observation[..., :1], step.to(observation.dtype) / 3.5 - 1), -1
    )


def test_a_policy_declares_its_arrival(tmp_path: Path) -> None:
    base = GeomagneticNavEnv(num_envs=5, seed=3, arrival="declared")
    view = base.observation_view()
    transforms = [*view.observation_transforms(), view.action_transform(declared=True)]
    actor = TensorDictModule(declaring, ["observation", "elapsed_steps"], ["action"])
    save_policy(tmp_path / "own.pt", actor, TransformedEnv(base, Compose(*transforms)))
    policy = load_policy(tmp_path / "own.pt")
    episodes = evaluate(policy, "paper-100", arrival="declared")
    assert (episodes["steps"] == 5).all()
    with pytest.raises(ValueError, match=r"declares its arrival: fly it with arrival 'declared', not 'objective'"):
        evaluate(f"policy={tmp_path / 'own.pt'}", "paper-100")
    state, vehicle = base.reset(), Onboard(policy, arrival_km=5.0)
    vehicle.start(state["target_field"][0].tolist())
    reading = state["field"][0].tolist()
    commands = [vehicle.step(*(value + 1e-3 * step for value in reading), heading=0.0) for step in range(5)]
    assert [command.stop for command in commands] == [None] * 4 + ["arrived"]
    assert commands[-1].reason == "the policy declares its arrival"


def test_a_policy_of_two_numbers_declares_by_its_own_estimate() -> None:
    """As navigators do."""
    network = TensorDictModule(lambda field: field[..., :2].sigmoid(), ["field"], ["action"])
    policy = export_policy(network, GeomagneticNavEnv(num_envs=5, seed=3))
    assert evaluate(policy, "paper-100", arrival="declared", max_steps=3).shape == (100,)


def test_a_policy_reads_the_standard_deviations_of_the_sensors() -> None:
    """Where the environment states none, they are 0, as for the policies of the library."""
    read = TensorDictModule(lambda std, bias: std[..., :2] + bias[..., :2] + 1, ["sensor_std", "bias_std"], ["action"])
    policy = export_policy(read, plain_env())
    for env, value in ((plain_env(), 1.05), (GeomagneticNavEnv(num_envs=5, seed=3), 1.0)):
        assert torch.equal(policy(env.reset())["action"], torch.full((5, 2), value))


# Parts of other libraries


class Caching(nn.Module):
    """A network that keeps what it computed last, as the distributions of stable-baselines3 do."""

    def __init__(self, kept: Callable[[torch.Tensor], object]) -> None:
        super().__init__()
        self.layer, self.kept, self.last = nn.Linear(3, 2), kept, None

    def forward(self, field: torch.Tensor) -> torch.Tensor:
        action = self.layer(field / 1e5).sigmoid()
        self.last = self.kept(action)
        return action


def test_a_network_that_keeps_its_results_can_be_saved() -> None:
    network = Caching(lambda action: [action])
    network(torch.zeros(1, 3))
    policy = export_policy(TensorDictModule(network, ["field"], ["action"]), plain_env())
    assert policy.in_keys == ["field"]
    assert not network.last[0].is_leaf


def test_a_module_that_cannot_be_copied_is_refused_with_a_remedy() -> None:
    network = Caching(lambda _: threading.Lock())
    network(torch.zeros(1, 3))
    with pytest.raises(
        ValueError, match=r"cannot be exported: it cannot be copied \(.*lock.*\): give the network alone"
    ):
        export_policy(TensorDictModule(network, ["field"], ["action"]), plain_env())
