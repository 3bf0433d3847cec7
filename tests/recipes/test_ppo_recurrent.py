"""The recipe of the agent with a memory and without a filter: what its agent may not know, and what it trains on."""

from __future__ import annotations

from functools import partial

import ppo_recurrent as recipe
import pytest
import torch
from support.recipes import small
from tensordict.nn import TensorDictSequential
from torchrl.envs.utils import check_env_specs

from magrl.agents import load_policy
from magrl.envs import GeomagneticNavEnv, planet_scenario
from magrl.evaluation import evaluation_rollout
from magrl.transforms import RandomSensorNoise, SensorNoise

CONFIG = recipe.Config(memory_size=8, num_cells=(16,))
SIZE = 20


def training_env(config: recipe.Config = CONFIG):
    """A small training environment and the memory of its agent."""
    torch.manual_seed(0)
    base = GeomagneticNavEnv(planet_scenario(8, seed=3, **config.regions), num_envs=6, start_heading="random", seed=5)
    memory = recipe.make_memory(SIZE, config)
    return recipe.make_env(base, memory, config), memory


def test_specs_of_the_training_environment() -> None:
    for noise, kind in (((0.0, 0.0, 0.0), RandomSensorNoise), ((0.05, 0.05, 5.0), SensorNoise)):
        env, _ = training_env(CONFIG.replace(noise=noise))
        check_env_specs(env, break_when_any_done="both")
        assert env.observation_spec["observation"].shape == (6, SIZE)
        assert type(env.transform[0]) is kind


def test_the_agent_reads_its_readings_alone() -> None:
    spread = recipe.Spread(0.3)
    memory, correction = recipe.make_memory(SIZE, CONFIG), recipe.make_correction(SIZE, spread, CONFIG)
    actor = TensorDictSequential(memory, correction)
    assert set(actor.in_keys) == {"observation", "hidden", "is_init"}


def test_the_estimate_of_the_true_way_has_no_loss() -> None:
    """Wherever the vehicles head; a way that is shorter than the longest move is its own length."""
    env, memory = training_env()
    sequences = env.rollout(4, break_when_any_done=False).select(*recipe.REMEMBERED, "position", "target_position")
    sequences["true_way"][:3] /= 100
    sequences["heading"][0] = 0.0

    class Exact(torch.nn.Module):
        def forward(self, td):
            way, heading = td["true_way"].double(), td["heading"].double()
            turned = torch.view_as_real(torch.view_as_complex(way) * torch.exp(1j * heading.squeeze(-1)))
            return td.set("way_estimate", (turned / turned.norm(dim=-1, keepdim=True).clamp_min(50.0)).float())

    assert recipe.loss_way(sequences, Exact(), 50.0) < 1e-10
    assert sequences["way_estimate"][:3].norm(dim=-1).max() < 0.2
    torch.testing.assert_close(sequences["way_estimate"][3:].norm(dim=-1), torch.ones(3, 4))
    ahead = Exact()(sequences.clone().set("heading", 0 * sequences["heading"]))["way_estimate"]
    in_their_frame = sequences.exclude("heading").set("way_estimate", ahead)
    assert recipe.loss_way(in_their_frame, lambda _: None, 50.0) < 1e-10
    loss = recipe.loss_way(sequences, memory, 50.0)
    loss.backward()
    assert loss > 0.01
    assert all(weight.grad.any() for weight in memory.parameters())


def test_a_vehicle_moves_along_its_estimate() -> None:
    """Northward and eastward; a correction is added to it; what is too far or behind is cut."""
    command = recipe.Command(50.0, torch.pi / 2)
    estimate, correction = torch.tensor([[0.0, 0.5], [0.0, 0.5], [2.0, 0.0], [-1.0, 0.1]]), torch.zeros(4, 2)
    correction[1] = torch.tensor([0.5, 0.0])
    heading = torch.tensor([[0.25 * torch.pi], [0.0], [0.0], [0.0]])
    expected = torch.tensor([[0.0, 0.5], [2 * 0.5**0.5 - 1, 0.5], [1.0, 0.0], [-1.0, 1.0]])
    torch.testing.assert_close(command(estimate, correction, heading), expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(command(estimate, correction), command(estimate, correction, 0 * heading))


@pytest.mark.slow
@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("compass", [True, False])
def test_the_saved_policy_flies_as_the_trained_actor(tmp_path, monkeypatch, compass: bool) -> None:
    """The test tasks, whose sensors err; it is given readings, moves and, with a compass, headings."""
    plain, flown = [], []

    def noted_env(*args, **options):
        plain.append(partial(make_env, *args, **options))
        return plain[-1]()

    def noted_rollout(env, policy):
        flown.append(evaluation_rollout(env, policy))
        return flown[-1]

    make_env = recipe.evaluation_env
    monkeypatch.setattr(recipe, "evaluation_env", noted_env)
    monkeypatch.setattr("magrl.training.run.evaluation_rollout", noted_rollout)
    recipe.train(small(recipe, tmp_path / "run", noise=(0.05, 0.05, 5.0), observe_heading=compass))
    policy = load_policy(tmp_path / "run" / "policy.safetensors")
    assert policy.in_keys == ["field", "target_field", "move", *["heading"] * compass, "elapsed_steps"]
    found = evaluation_rollout(plain[-1](), policy)
    assert torch.equal(found["next", "position"], flown[-1]["next", "position"])
