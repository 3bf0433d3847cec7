"""Rules of arrival in the environment: by distance, and declared by the third number of the action."""

import math

import pytest
import torch
from support.environments import near, paper_env
from torchrl.envs.utils import step_mdp

from magrl.envs import GeomagneticNavEnv


def declared(num_envs: int = 2, radius_km: float = 25.0, **options: object) -> GeomagneticNavEnv:
    return paper_env(num_envs, arrival="declared", radius_km=radius_km, **options)


def test_actions() -> None:
    """Of three numbers, where they declare."""
    env = declared(3)
    for wrong, size, message in (
        (env, 2, "must be 3 numbers, distance, turn and declare, got 2: for a policy that does not declare"),
        (paper_env(3), 3, "must be 2 numbers, distance and turn, got 3$"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong.step(wrong.reset().set("action", torch.zeros(3, size)))
    assert env.action_spec.shape == (3, 3)
    assert env.action_spec.space.low[0].tolist() == pytest.approx([0.0, -math.pi / 2, -1.0])
    assert env.action_spec.space.high[0].tolist() == pytest.approx([50.0, math.pi / 2, 1.0])
    assert env.observation_spec["leg"].shape == (3, 2)
    assert set(env.observation_spec.keys()) - set(paper_env().observation_spec.keys()) == {"declared"}


@pytest.mark.parametrize("rule", ["declared", "distance"])
def test_an_arrival_within_the_radius_is_a_success_and_a_declaration_elsewhere_a_false_one(rule: str) -> None:
    """Legs of 20 km northward to targets 9.9, 10.1, 29.9 and 30.1 km away: 10.1, 9.9, 9.9 and 10.1 km are left."""
    env = near(9.9, 10.1, 29.9, 30.1, 29.9, 20.0, rule=rule)
    declare = torch.tensor([1.0, 0.5, 1.0, 0.001, 0.0, -1.0])
    action = torch.stack((torch.full((6,), 20.0), torch.zeros(6), declare), -1)[:, : env.action_spec.shape[-1]]
    after = env.step(env.reset().set("action", action))["next"]
    signaled = rule == "distance"
    success = torch.tensor([False, True, True, False, signaled, signaled]).unsqueeze(-1)
    end = success if signaled else (declare > 0).unsqueeze(-1)
    assert ("declared" in after.keys()) != signaled  # noqa: SIM118 - a TensorDict is no mapping
    assert torch.equal(after.get("declared", end), end)
    assert torch.equal(after["success"], success)
    assert torch.equal(after["terminated"], end)
    assert torch.equal(after["done"], end)
    assert torch.equal(after["reward_destination"], 200.0 * success)
    assert torch.equal(after["leg"], action[:, :2])


def test_the_objective_ends_no_episode() -> None:
    """A vehicle on its target goes on until it declares, by the step limit at the latest."""
    env = near(20.0, max_steps=3)
    stay, go = torch.tensor([[0.0, 0.0, -1.0]]), torch.tensor([[20.0, 0.0, -1.0]])
    state = step_mdp(env.step(env.reset().set("action", go)))
    assert state["objective"].item() < env.zeta
    state = step_mdp(env.step(state.set("action", stay)))
    assert not state["done"].any()
    for action, success in ((stay, False), (stay.abs(), True)):
        last = env.step(state.clone().set("action", action))["next"]
        assert [bool(last[key]) for key in ("success", "terminated", "truncated")] == [success, success, not success]


def test_a_lost_vehicle_arrives_nowhere() -> None:
    env = declared(1, max_steps=1000, radius_km=1e5)
    state = env.reset()
    action = torch.tensor([[50.0, 0.0, -1.0]])
    while not state["terminated"].any():
        before = state
        state = step_mdp(env.step(state.clone().set("action", action)))
    lost = env.step(before.set("action", action.abs()))["next"]
    assert lost["declared"].all()
    assert not lost["success"].any()
