"""No-go areas."""

import math
from dataclasses import replace
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from support.environments import parallel
from tensordict import TensorDict
from torchrl.envs import CatTensors, Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from magrl.envs import GeomagneticNavEnv
from magrl.envs.navigation import guidance, navigation_env
from magrl.geodesy import geodesic, move_place
from magrl.named_tasks import no_go_env
from magrl.navigators import FieldPolicy, PolicyConfig
from magrl.navigators.names import make_navigator
from magrl.navigators.networks import Geometry
from magrl.transforms import NoGoAreas, Shield, TrueDisplacement
from magrl.transforms.areas import CLEAR_KM, NUMBER, distance_km, outlines, shielded, turned


def flown(**options: object) -> TensorDict:
    env = no_go_env(64, observation="dict", scale_actions=False, seed=3, **options)
    return env.rollout(
        options.get("max_steps", 12), make_navigator("geodesic", env.base_env), break_when_any_done=False
    )["next"]


def test_a_leg_that_meets_an_area_ends_the_episode_without_success() -> None:
    """Straight to the destination, an episode succeeds where the straight line is free, but for the last part of it."""
    steps = flown()
    start = TransformedEnv(GeomagneticNavEnv(num_envs=64, seed=3), Compose(TrueDisplacement(), NoGoAreas())).reset()
    centers, radii = NoGoAreas.discs(start["no_go_areas"])
    free = (distance_km(centers, start["no_go_areas"][:, -2:], torch.zeros(64, 2)) > radii).all(-1)
    ended = steps["done"].squeeze(-1)
    length = (ended.cumsum(1) == 0).sum(1)
    success = steps["success"].squeeze(-1)[torch.arange(64), length]
    assert 0 < free.sum() < 32
    assert (success == free).double().mean() > 0.95  # the earth is no plane
    assert steps["terminated"].squeeze(-1)[torch.arange(64), length].all()
    assert not (steps["success"] & ~steps["terminated"]).any()


def test_areas_are_seen_only_from_nearby() -> None:
    """Ahead to the right, at a third of the sight: two thirds of the unit vector, and the share of the radius."""
    relative = turned(torch.tensor([[[45 / 2**0.5, 45 / 2**0.5]]]), torch.tensor([[[0.7]]]))
    discs = torch.cat((relative, 3 * relative.expand(1, 3, 2)), 1), torch.full((1, 4), 20.0)
    seen = NoGoAreas()._seen(*discs, torch.tensor([[0.7]]))
    expected = torch.tensor([[2 / 3 / 2**0.5, 2 / 3 / 2**0.5, 0.5, *[0.0] * 9]])
    torch.testing.assert_close(seen, expected)


def test_all_four_areas_within_sight_are_seen() -> None:
    seen = NoGoAreas()._seen(*around(60.0), torch.zeros(1, 1)).unflatten(-1, (4, 3))
    assert (seen[..., 2] == 1).all()


def test_an_episode_that_meets_an_area_in_its_last_step_is_not_truncated() -> None:
    after = flown(max_steps=3)
    assert (after["terminated"] & (after["elapsed_steps"] == 3)).any()
    assert not (after["terminated"] & after["truncated"]).any()
    assert (after["done"] == after["terminated"] | after["truncated"]).all()


def test_distance_is_that_from_a_leg_between_its_ends() -> None:
    points = torch.tensor([[5.0, 4.0], [13.0, 4.0], [-3.0, 4.0]])
    assert distance_km(points, torch.zeros(2), torch.tensor([10.0, 0.0])).tolist() == [4.0, 5.0, 5.0]


@pytest.mark.parametrize(("observation", "size"), [("flat", 13), ("track", 19), ("readings", 20), ("dict", 0)])
def test_every_observation_has_the_areas(observation: str, size: int) -> None:
    """As its last numbers, within the bounds of the space."""
    name = "magrl/GeomagneticNavigationNoGo-v1"
    envs = gymnasium.make_vec(name, num_envs=8, observation=observation, autoreset_mode="SameStep")
    envs.reset(seed=0)
    for _ in range(2):
        found, *_ = envs.step(np.tile(np.float32([[1, 0]]), (8, 1)))
    areas = found["areas"] if observation == "dict" else found[:, size:]
    space = envs.single_observation_space
    space = space["areas"] if observation == "dict" else space
    assert areas.any()
    assert np.abs(areas).max() <= 1
    assert (space.low[-12:] == -1).all()
    assert (space.high[-12:] == 1).all()
    check_env_specs(envs.unwrapped.torchrl_env)


# Shield


def around(distance: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return centers in the four directions, of discs of 40 km."""
    return distance * torch.tensor([[[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]]), torch.full((1, 4), 40.0)


def clearance(action: torch.Tensor, centers: torch.Tensor, radii: torch.Tensor) -> torch.Tensor:
    """Return how far legs stay from discs [km]."""
    length, turn = action.unbind(-1)
    end = torch.stack((length * torch.cos(turn), length * torch.sin(turn)), -1)
    return (distance_km(centers, torch.zeros_like(end), end) - radii).amin(-1)


def test_the_shield_clears_areas_and_leaves_other_legs_alone() -> None:
    """It takes the least turn of a fine grid that clears them."""
    uniform = torch.rand(500, 4, 3, generator=torch.Generator().manual_seed(0))
    radii = 15 + 25 * uniform[..., 2]
    ahead = (radii + 2 + 60 * uniform[..., 0]).unsqueeze(-1) * torch.tensor([1.0, 0.0])
    discs = turned(ahead, 2 * math.pi * uniform[..., 1:2]), radii
    action = torch.stack((50 * uniform[:, 1, 2] ** 0.5, 0.8 * math.pi * (uniform[:, 2, 2] - 0.5)), -1)
    shield = shielded(action, NoGoAreas()._seen(*discs, torch.zeros(500, 1)))
    before, after = clearance(action, *discs), clearance(shield, *discs)
    assert torch.equal(shield[before > CLEAR_KM + 0.01], action[before > CLEAR_KM + 0.01])
    degrees = torch.arange(-720, 721) / 4
    offset = torch.deg2rad(degrees)
    legs = torch.stack(torch.broadcast_tensors(action[:, :1], action[:, 1:] + offset), -1)
    free = clearance(legs, *(part.unsqueeze(1) for part in discs)) > CLEAR_KM
    clears = (before < 0) & (free & (degrees % 1 == 0)).any(-1)
    assert clears.sum() > 40
    assert (after[clears] > CLEAR_KM - 0.05).all()
    flies, least = clears & (shield[:, 0] > 0), offset.abs().where(free, math.inf).amin(-1)
    torch.testing.assert_close((shield - action)[flies, 1].abs(), least[flies], atol=math.radians(1.2), rtol=0)


def test_the_shield_keeps_the_largest_turn() -> None:
    """Between discs that leave no gap, it takes the middle; behind its largest turn, it turns and stays."""
    areas, action = NoGoAreas()._seen(*around(45.0), torch.zeros(1, 1)), torch.tensor([[50.0, 0.5]])
    torch.testing.assert_close(shielded(action, areas), torch.tensor([[50.0, math.pi / 4]]), atol=0.01, rtol=0)
    alone = torch.tensor([[0.8, 0.0, 1.0, *[0.0] * 9]])
    torch.testing.assert_close(shielded(torch.tensor([[50.0, 0.1]]), alone, 0.3), torch.tensor([[0.0, 0.3]]))


def test_the_shield_of_an_environment_acts_as_the_last_layer_of_a_policy() -> None:
    """The data keep the action of the policy."""
    make = partial(no_go_env, 64, observation="dict", scale_actions=False, seed=3)
    torch.manual_seed(0)
    network = PolicyConfig(no_go_env(1).view, (8,))
    actor = network.make_actor()
    plain, with_shield = (FieldPolicy(replace(network, shield=shield), actor) for shield in (False, True))
    inside, outside = make(transforms=[Shield()]).rollout(4, plain), make().rollout(4, with_shield)
    assert torch.equal(inside["next", "position"], outside["next", "position"])
    assert torch.equal(inside["action"], plain(inside.clone())["action"])
    assert not torch.equal(inside["action"], outside["action"])


def test_a_vehicle_behind_its_shield_meets_no_area() -> None:
    steps, shield = flown(), flown(transforms=[Shield()])
    assert (steps["terminated"] & ~steps["success"]).any(1).sum() > 32
    assert (shield["terminated"] & ~shield["success"]).sum() == 0


def test_a_shield_reads_the_areas_that_a_step_is_sent() -> None:
    """In another process, which keeps those of a reset."""
    env = parallel(partial(no_go_env, 64, seed=0, scale_actions=False, transforms=[Shield()]))
    ahead = torch.tensor([50.0, 0.0]).expand(2, 64, 2)
    state = env.reset()
    for _ in range(4):
        state = step_mdp(env.step(state.set("action", ahead)))
    env.reset()
    leg = env.step(state.set("action", ahead))["next", "leg"].clone()
    env.close()
    torch.testing.assert_close(leg, shielded(ahead, state["areas"]))
    assert not torch.equal(leg, ahead)
    with pytest.raises(KeyError, match="Shield reads 'areas', which no_go_env has"):
        navigation_env(4, seed=0, transforms=[Shield()]).rollout(2)


def test_pictures_show_the_areas() -> None:
    env = gymnasium.make("magrl/GeomagneticNavigationNoGo-v1", render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    assert not np.array_equal(env.render(), env.torchrl_env.base_env.render([0]))


def test_areas_join_the_observation_alone() -> None:
    """Not what other transforms concatenate."""
    joined = [CatTensors(["leg", "heading"], "own", del_keys=False)]
    state = no_go_env(2, seed=0, transforms=joined).reset()
    assert state["observation"].shape == (2, 25)
    assert "observation" not in no_go_env(2, seed=0, transforms=joined, observation="dict").reset()


def test_a_policy_sees_the_geometry_of_what_is_observed() -> None:
    plain = navigation_env(2, observe_difference=False)
    for geometry, env in ((True, no_go_env(2)), (True, navigation_env(2)), (False, plain)):
        actor = PolicyConfig(env.view, (8,)).make_actor()
        assert any(isinstance(layer, Geometry) for layer in actor.modules()) == geometry


def test_rewards_that_would_pay_for_an_arrival_through_an_area_are_refused() -> None:
    for reward in ("paper", "base", guidance):
        with pytest.raises(ValueError, match="reward"):
            no_go_env(reward=reward)


def test_areas_of_the_shortest_trips() -> None:
    """None covers an end, they lie on both sides, and a leg through one that ends at the destination is no success."""
    env = no_go_env(256, seed=0, distance_range_km=(30.0, 60.0), scale_actions=False, observation="dict")
    steps = env.rollout(4, make_navigator("geodesic", env.base_env), break_when_any_done=False)
    before, after = (each["no_go_areas"] for each in (steps, steps["next"]))
    (centers, radii), start = NoGoAreas.discs(before), before[:, :1, None, -2:]
    assert (centers.norm(dim=-1) > radii).all()
    right = (centers[..., 1] * start[..., 0] > centers[..., 0] * start[..., 1])[:, 0]
    assert right.double().mean() == pytest.approx(0.5, abs=0.1)
    met = (distance_km(centers, before[..., -2:], after[..., -2:]) < radii).any(-1)
    success = steps["next", "success"].squeeze(-1)
    assert (met & (after[..., -2:].norm(dim=-1) < 3)).any()
    assert not (success & met).any()
    assert success.any()


def test_an_outline_is_a_circle_on_the_map() -> None:
    """Around a point 100 km north of the destination; without a radius, it is the center."""
    place = torch.tensor([-5.0, 165.0])
    ring, center = (outlines(torch.tensor([100.0, 0.0, km] * NUMBER + [0.0, 0.0]), place) for km in (30.0, 0.0))
    apart, _ = geodesic(*center.unbind(-1), *ring.unbind(-1))
    torch.testing.assert_close(apart, torch.full_like(apart, 30.0), rtol=0.01, atol=0)
    torch.testing.assert_close(center, move_place(place, torch.zeros(()), torch.tensor(100.0)).expand_as(center))
