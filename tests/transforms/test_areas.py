"""No-go areas."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import CatTensors, Compose, TransformedEnv

from magrl.envs import GeomagneticNavEnv
from magrl.envs.navigation import no_go_env
from magrl.evaluation.navigators import make_navigator
from magrl.transforms import NoGoAreas, TrueWay
from magrl.transforms.areas import distance_km, turned


def flown(**options: object) -> TensorDict:
    env = no_go_env(64, observation="dict", scale_actions=False, seed=3, **options)
    return env.rollout(20, make_navigator("geodesic", env.base_env), break_when_any_done=False)["next"]


def test_a_leg_that_meets_an_area_ends_the_episode_without_success() -> None:
    """Straight to the destination, an episode succeeds where the straight line is free, but for the last part of it."""
    steps = flown()
    start = TransformedEnv(GeomagneticNavEnv(num_envs=64, seed=3), Compose(TrueWay(), NoGoAreas())).reset()
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
    expected = torch.tensor([[2 / 3 / 2**0.5, 2 / 3 / 2**0.5, 0.5, *[0.0] * 6]])
    torch.testing.assert_close(seen, expected)


def test_observation_of_the_task() -> None:
    env = no_go_env(8, seed=0)
    state = env.rollout(3)
    assert state["observation"].shape[-1] == 13 + state["areas"].shape[-1]
    assert (state["observation"][..., 13:] == state["areas"]).all()


def test_areas_join_the_observation_alone() -> None:
    """Not what other transforms concatenate."""
    joined = [CatTensors(["move", "heading"], "own", del_keys=False)]
    state = no_go_env(2, seed=0, transforms=joined).reset()
    assert state["observation"].shape == (2, 22)
    assert "observation" not in no_go_env(2, seed=0, transforms=joined, observation="dict").reset()


@pytest.mark.parametrize("options", [{"reward": "paper"}, {"reward": "base"}])
def test_rewards_that_would_pay_for_an_arrival_through_an_area_are_refused(options: dict) -> None:
    with pytest.raises(ValueError, match="reward"):
        no_go_env(**options)
    assert no_go_env(reward="spl", seed=0).reset()["observation"].shape == (1, 22)


def test_no_area_covers_a_start_or_a_destination() -> None:
    """Of the shortest tasks, too."""
    env = no_go_env(64, seed=0, distance_range_km=(30.0, 120.0))
    centers, radii = NoGoAreas.discs(env.reset()["no_go_areas"])
    assert (centers.norm(dim=-1) > radii).all()
