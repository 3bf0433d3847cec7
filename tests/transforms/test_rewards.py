"""The true way and the reward for a short path: by hand, over whole episodes, and as transforms."""

from __future__ import annotations

import math

import pytest
import torch
from support.errors import nav
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from magrl.geodesy import geodesic, move
from magrl.navigators import Secant
from magrl.transforms import DetourReward, DistanceCost, TrueWay
from magrl.transforms.rewards import detour_reward

pytestmark = pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped")


def chain(**options: float) -> Compose:
    return Compose(TrueWay(), DetourReward(**options))


def rewarded(num_envs: int = 2, **options: object) -> TransformedEnv:
    return TransformedEnv(nav(num_envs, **options), chain())


# The way


@pytest.mark.parametrize("latitude", [-70.0, 0.0, 45.0])
def test_way_leads_to_the_target(latitude: float) -> None:
    """A vehicle that turns towards it and goes its length arrives, from any heading and across the antimeridian."""
    heading = torch.linspace(-math.pi, math.pi, 9, dtype=torch.float64).unsqueeze(-1)
    here = torch.tensor([[latitude, 179.5]], dtype=torch.float64).expand(9, 2)
    there = torch.tensor([[latitude + 2.0, -178.0]], dtype=torch.float64).expand(9, 2)
    way = TrueWay()(TensorDict(position=here, target_position=there, heading=heading))["true_way"]
    bearing = heading.squeeze(-1) + torch.atan2(way[:, 1], way[:, 0])
    arrived = torch.stack(move(*here.unbind(-1), bearing, way.norm(dim=-1)), -1)
    gap_km, _ = geodesic(*arrived.unbind(-1), *there.unbind(-1))
    assert gap_km.max() < 0.01
    assert way[4, 0] > 0  # heading north, to a target ahead
    assert way[4, 1] > 0  # and to the right


# The reward


def test_reward_by_hand() -> None:
    """50 km for 30 km of progress on a task of 400 km waste 5 %; then the same lost, and a move of length 0."""
    moved, progress, task = torch.tensor([50.0, 50.0, 0.0]), torch.tensor([30.0, 30.0, 0.0]), torch.tensor(400.0)
    arrived, lost = torch.tensor([True, False, False]), torch.tensor([False, True, False])
    found = detour_reward(moved, progress, task, arrived, lost)
    torch.testing.assert_close(found, torch.tensor([10 - 0.5 - 0.08, -5 - 0.5 - 0.08, -0.08]))
    weights = {"arrival": 1.0, "detour": 2.0, "step": 0.5, "lost_penalty": 3.0}
    found = detour_reward(moved, progress, task, arrived, lost, **weights)
    torch.testing.assert_close(found, torch.tensor([1 - 0.1 - 0.5, -3 - 0.1 - 0.5, -0.5]))


def test_return_of_an_episode_is_the_wasted_share_of_its_path() -> None:
    """10 - 10 waste / distance - 0.08 a step for those that arrive, with lengths computed from the positions."""
    env = rewarded(32, zeta=0.05)
    rollout = env.rollout(50, Secant(), break_when_any_done=False, break_when_all_done=True)
    after, returns, arrived = rollout["next"], [], 0
    for row in range(32):
        ended = after["done"][row, :, 0].nonzero()
        steps = int(ended[0]) + 1 if len(ended) else after.shape[1]
        places = torch.cat((rollout["position"][row, :1], after["position"][row, :steps]))
        target = after["target_position"][row, 0]
        path_km = geodesic(*places[:-1].T, *places[1:].T)[0].sum()
        first_km, last_km = (geodesic(*places[k], *target)[0] for k in (0, -1))
        success = bool(after["success"][row, steps - 1])
        lost = bool(after["terminated"][row, steps - 1]) and not success
        waste = (path_km - (first_km - last_km)) / first_km
        expected = 10 * success - 5 * lost - 10 * waste - 0.08 * steps
        assert after["reward"][row, :steps].sum().item() == pytest.approx(expected.item(), abs=2e-3)
        returns.append(expected.item())
        arrived += success
    assert arrived > 20
    assert max(returns) > 8
    assert len(set(returns)) == 32


def test_a_lost_vehicle_pays_once() -> None:
    """And no longer, where the environment goes on with other vehicles."""
    td = rewarded(1).rollout(2)[0, 0]["next"]
    flags = {"success": torch.tensor([False]), "terminated": torch.tensor([True])}
    lost = TensorDict(td.clone().update(flags))
    steps = TensorDict(true_way=lost["true_way"].clone(), next=lost)
    reward = DetourReward()(steps)["next", "reward"].item()
    waste = lost["move"][0] / geodesic(*lost["start_position"], *lost["target_position"])[0]
    assert reward == pytest.approx(-5 - 0.08 - 10 * waste.item(), abs=1e-3)


def test_reward_replaces_that_of_the_environment_or_stands_beside_it() -> None:
    torch.manual_seed(0)
    plain = nav().rollout(3)["next", "reward"]
    torch.manual_seed(0)
    beside = TransformedEnv(nav(), Compose(TrueWay(), DetourReward(out_keys=["detour"]))).rollout(3)["next"]
    torch.manual_seed(0)
    assert torch.equal(rewarded().rollout(3)["next", "reward"], beside["detour"])
    assert torch.equal(beside["reward"], plain)


# Specs and errors


def test_what_is_missing_is_named() -> None:
    """Without the way before the move there is no reward, and that of the environment must not pass for it."""
    td = rewarded().rollout(2)[:, 0]
    with pytest.raises(KeyError, match=r"DetourReward reads its state .*true_way"):
        DetourReward()(td.exclude("true_way"))
    with pytest.raises(KeyError, match=r"DetourReward reads .*success"):
        DetourReward()(td.exclude(("next", "success")))
    with pytest.raises(KeyError, match=r"DetourReward reads .*true_way"):
        _ = TransformedEnv(nav(), DetourReward()).specs


def long_move(td: TensorDict) -> TensorDict:
    return td.set("action", torch.tensor([30.0, 0.1]).expand(*td.shape, 2))


def test_distance_cost_is_paid_for_each_kilometer() -> None:
    env = TransformedEnv(nav(4), DistanceCost(0.05))
    costly = env.rollout(5, long_move)
    reward, move = costly["next", "reward"], costly["next", "move"]
    terms = costly["next", "reward_destination"] + costly["next", "reward_proximity"]
    torch.testing.assert_close(reward, terms - 0.05 * move[..., :1])
    assert (move[..., 0] == 30).all()


@pytest.mark.parametrize("reward", [lambda: DistanceCost(-1.0), lambda: DetourReward(step=-1.0)])
def test_a_negative_weight_is_refused(reward) -> None:
    with pytest.raises(ValueError, match=r"(cost|step) must be .*-1\.0"):
        reward()
