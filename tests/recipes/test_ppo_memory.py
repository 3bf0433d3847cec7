"""The recipe of the agent with a memory: its environment, what its estimate learns, and that it acts as trained."""

from __future__ import annotations

import math

import ppo_memory as recipe
import pytest
import torch
from support.recipes import small
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs.utils import check_env_specs

from magrl import load_policy, save_policy
from magrl.envs import GeomagneticNavEnv
from magrl.evaluation import evaluation_rollout
from magrl.navigators import policy_env
from magrl.navigators.memory import Memory, MemoryNetwork
from magrl.pilot.network import pretrained
from magrl.random_numbers import FIRST_RESERVED_SEED
from magrl.transforms.sequences import ACCURACY_KEYS, READING_SIZE

CONFIG = recipe.Config(num_envs=6, memory_size=8, steps_per_batch=4, batch_size=8)


def training_env():
    return recipe.make_env(CONFIG.replace(task="storm", seed=5, num_regions=8))


def network() -> MemoryNetwork:
    """One whose outputs are not 0, as a trained one."""
    torch.manual_seed(0)
    made = MemoryNetwork(8)
    for weight in made.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    return made


def test_specs_of_the_training_environment() -> None:
    env = training_env()
    check_env_specs(env, break_when_any_done="both")
    assert env.observation_spec["observation"].shape == (6, READING_SIZE)
    assert recipe.JUDGED == ("observation", "true_displacement_scaled", "highest_spl")


def test_an_agent_acts_as_it_was_trained() -> None:
    """The parts that a training runs, without exploration, and the policy that is saved move alike."""
    trained = network()
    mean = TensorDictModule(recipe.Joined(trained.correct), list(recipe.KNOWN), ["correction"])
    leg = TensorDictModule(recipe.Leg(), ["estimate", "correction", "heading"], ["action"])
    env = training_env()
    wanted = env.rollout(4, TensorDictSequential(recipe.make_memory(trained), mean, leg), break_when_any_done=False)
    plain = recipe.task_env(env.base_env.scenario, CONFIG, num_envs=6, seed=5, observation="dict", scale_actions=False)
    flown = policy_env(plain, Memory(trained)).rollout(4, Memory(trained), break_when_any_done=False)
    assert wanted["action"].std() > 0.1
    torch.testing.assert_close(flown["next", "field"], wanted["next", "field"], rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(flown["next", "leg"], wanted["next", "leg"], rtol=1e-4, atol=1e-2)


def test_the_estimate_of_the_true_displacement_has_no_loss() -> None:
    """Wherever the vehicles head; a displacement that is shorter than the longest leg is its own length."""
    env, memory = training_env(), recipe.make_memory(network())
    sequences = env.rollout(4, break_when_any_done=False)
    sequences["true_displacement"][:3] /= 100

    def exact(td: TensorDict) -> None:
        displacement, heading = td["true_displacement"].double(), td["heading"].double()
        turned = torch.view_as_real(torch.view_as_complex(displacement) * torch.exp(1j * heading.squeeze(-1)))
        td["estimate"] = (turned / turned.norm(dim=-1, keepdim=True).clamp_min(50.0)).float()

    assert recipe.loss_memory(sequences, exact) < 1e-10
    assert sequences["estimate"][:3].norm(dim=-1).max() < 0.2
    torch.testing.assert_close(sequences["estimate"][3:].norm(dim=-1), torch.ones(3, 4))
    loss = recipe.loss_memory(sequences, memory)
    loss.backward()
    assert loss > 0.01
    assert all(weight.grad.any() for weight in memory.parameters())


def test_a_vehicle_moves_along_its_estimate() -> None:
    """Northward and eastward; a correction is added to it; what is too far or behind is cut."""
    estimate, correction = torch.tensor([[0.0, 0.5], [0.0, 0.5], [2.0, 0.0], [-1.0, 0.1]]), torch.zeros(4, 2)
    correction[1] = torch.tensor([0.5, 0.0])
    heading = torch.tensor([[0.25 * torch.pi], [0.0], [0.0], [0.0]])
    expected = torch.tensor([[0.0, 0.5], [2 * 0.5**0.5 - 1, 0.5], [1.0, 0.0], [-1.0, 1.0]])
    torch.testing.assert_close(recipe.Leg()(estimate, correction, heading), expected, atol=1e-6, rtol=0)


@pytest.mark.usefixtures("without_figures")
def test_a_training_writes_its_agent(tmp_path) -> None:
    """Both of its optimizers have changed weights, and the file holds them."""
    sizes = {"num_envs": 8, "total_frames": 64, "memory_size": 8, "sequences": 4, "memory_batches": 1, "batch_size": 8}
    recipe.train(small(recipe, tmp_path / "run", task="readings", **sizes))
    saved = load_policy(tmp_path / "run" / "policy.safetensors")
    assert isinstance(saved, Memory)
    assert (saved.accuracy[0] <= saved.accuracy[1]).all()
    assert saved.accuracy[1].isfinite().all()
    for part in (saved.network.correct, saved.network.estimate):
        assert all(weight.any() for weight in part[-1].parameters())


def test_it_takes_an_accuracy_as_the_nearest_one_of_its_training(tmp_path) -> None:
    """Of Storm, the only one; the range is in its file, and a training writes it."""
    saved, ends = network(), [[0.05, 0.05, 5.0, 0.0, 0.0, 0.0]] * 2
    Memory(saved, ends).save(tmp_path / "memory.safetensors")
    fits, free = Memory(tmp_path / "memory.safetensors"), Memory(saved)
    env = policy_env(GeomagneticNavEnv(num_envs=4, seed=0), fits)
    state = env.reset()
    for key, std in zip(ACCURACY_KEYS, ([0.05, 0.05, 5.0], [0.0] * 3), strict=True):
        state[key] = torch.tensor(std).expand(4, 3)
    hidden = "next", "memory", "hidden"
    wanted = free(state.clone())[hidden]
    state["sensor_std"], state["bias_std"] = torch.rand(4, 3), 9 * torch.ones(4, 3)
    assert torch.equal(fits(state.clone())[hidden], wanted)
    assert not torch.equal(free(state)[hidden], wanted)
    assert recipe.accuracy_range(training_env().reset()) == [pytest.approx(end) for end in ends]
    assert Memory().accuracy.flatten(1).tolist() == [pytest.approx(end) for end in ends]
    for wrong in ([[0.0] * 6, [0.0] * 5], [[1.0] * 6, [0.0] * 6], [[-1.0] * 6, [0.0] * 6], [[0.0] * 6, [math.nan] * 6]):
        with pytest.raises(ValueError, match="accuracy must be"):
            Memory(saved, wrong)


def test_it_flies_where_the_default_is_float64() -> None:
    env = GeomagneticNavEnv(num_envs=2, seed=0)
    flown = policy_env(env, Memory()).rollout(2, Memory())["action"]
    torch.set_default_dtype(torch.float64)
    try:
        again = GeomagneticNavEnv(num_envs=2, seed=0)
        for memory in (Memory(), Memory(network())):
            action = policy_env(again, memory).rollout(2, memory)["action"]
        again.set_seed(0)
        torch.testing.assert_close(policy_env(again, Memory()).rollout(2, Memory())["action"], flown)
        assert action.dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


def test_a_file_of_an_agent_holds_its_network_and_no_other(tmp_path) -> None:
    saved = network()
    save_policy(tmp_path / "memory.safetensors", Memory(saved))
    found = Memory(tmp_path / "memory.safetensors").network.state_dict()
    assert all(torch.equal(weight, found[name]) for name, weight in saved.state_dict().items())
    with pytest.raises(ValueError, match=r"anywhere\.safetensors .* of the kind .pilot., expected is memory"):
        Memory(pretrained("anywhere"))
    with torch.no_grad():
        saved.gru.weight_hh_l0[0, 0] = torch.nan
    save_policy(tmp_path / "broken.safetensors", Memory(saved))
    with pytest.raises(ValueError, match=r"broken\.safetensors does not hold a valid policy: .*weight_hh_l0"):
        Memory(tmp_path / "broken.safetensors")


def test_a_memory_keeps_to_shorter_limits() -> None:
    env = GeomagneticNavEnv(num_envs=4, seed=0, start_heading="random", max_steps=4)
    for limit in (7.0, 90.0):
        agent = Memory(network(), max_leg_km=limit)
        assert agent.max_leg_km == min(limit, 50.0)
        assert evaluation_rollout(env, agent)["action"][..., 0].max() <= min(limit, 50.0) + 1e-4


def test_a_training_validates_on_storms_of_the_training(tmp_path, monkeypatch) -> None:
    """Not on the record of evaluations."""
    seeds = []

    def start(_, validation, **__) -> None:
        seeds.append(validation.base_env.seed)
        raise RuntimeError("started")

    monkeypatch.setattr(recipe.Run, "start", start)
    with pytest.raises(RuntimeError, match="started"):
        recipe.train(small(recipe, tmp_path / "run", task="storm"))
    assert seeds[0] < FIRST_RESERVED_SEED
