"""The true way and the reward for a short path: by hand, over whole episodes, and as transforms."""

from __future__ import annotations

import math

import pytest
import torch
from support.errors import nav
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from magrl.evaluation import episode_measures
from magrl.geodesy import geodesic, move
from magrl.navigators import Secant
from magrl.transforms import DistanceCost, HighestSPL, ProgressReward, RandomStepPrice, SPLReward, TrueWay

pytestmark = pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped")


def rewarded(num_envs: int = 2, **options: object) -> TransformedEnv:
    return TransformedEnv(
        nav(num_envs, **options), Compose(RandomStepPrice((0.1, 1.0)), TrueWay(), HighestSPL(), SPLReward())
    )


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


def test_highest_spl_by_hand() -> None:
    """A task of 100 km: 60 km flown for 40 km of progress; then the arrival after 40 km more, or the end elsewhere."""
    start, target = torch.zeros(3, 2), torch.tensor([[0.0, 0.898315]]).expand(3, 2)
    flags = torch.tensor([[False], [True], [False]]), torch.tensor([[False], [True], [True]])
    after = TensorDict(
        true_way=torch.tensor([[60.0, 0.0], [3.0, 4.0], [60.0, 0.0]]),
        move=torch.tensor([[60.0, 0.1], [100.0, 0.0], [60.0, 0.0]]),
        start_position=start,
        target_position=target,
        success=flags[0],
        done=flags[1],
        step_price=torch.full((3, 1), 0.5),
        batch_size=[3],
    )
    before = {"true_way": torch.tensor([[0.0, 100.0]]).expand(3, 2), "highest_spl": torch.ones(3, 1)}
    step = SPLReward()(HighestSPL()(TensorDict({**before, "next": after}, [3])))["next"]
    torch.testing.assert_close(step["highest_spl"], torch.tensor([[100 / 120], [1.0], [0.0]]), rtol=0, atol=1e-4)
    torch.testing.assert_close(step["reward"], 10 * (step["highest_spl"] - 1) - 0.05)


def test_return_of_progress_depends_on_both_ends_alone() -> None:
    """Whatever the way between them: kilometers nearer over 50, 10 at the arrival, 0.1 for each step."""
    env = TransformedEnv(nav(64, max_steps=10), Compose(TrueWay(), ProgressReward()))
    rollout = env.rollout(10, Secant(), break_when_any_done=False, break_when_all_done=True)
    measures = episode_measures(rollout)
    within = torch.arange(rollout.shape[1]) < measures["steps"].unsqueeze(-1)
    returns = (rollout["next", "reward"].squeeze(-1) * within).sum(-1).double()
    nearer_km = measures["shortest_km"] - measures["navigation_error_km"]
    torch.testing.assert_close(
        returns, nearer_km / 50 + 10 * measures["success"] - 0.1 * measures["steps"], rtol=0, atol=1e-4
    )
    assert 10 < measures["success"].sum() < 60


def test_return_of_an_episode_is_its_spl_less_its_steps() -> None:
    env = rewarded(64, max_steps=10)
    rollout = env.rollout(10, Secant(), break_when_any_done=False, break_when_all_done=True)
    measures = episode_measures(rollout)
    within = torch.arange(rollout.shape[1]) < measures["steps"].unsqueeze(-1)
    returns = (rollout["next", "reward"].squeeze(-1) * within).sum(-1)
    price = rollout["step_price"][:, 0, 0]
    torch.testing.assert_close(
        returns.double(), 10 * (measures["spl"] - 1) - 0.1 * price * measures["steps"], rtol=0, atol=5e-3
    )
    assert 10 < measures["success"].sum() < 60


def test_prices_are_log_uniform_and_stay_for_an_episode() -> None:
    price = TransformedEnv(nav(2000), RandomStepPrice((0.1, 10.0), seed=3)).rollout(2)["step_price"]
    assert torch.equal(price[:, 0], price[:, 1])
    assert abs(price.log10().mean()) < 0.05
    assert price.log10().std() == pytest.approx(2 / 12**0.5, abs=0.02)


# Specs and errors


def test_what_is_missing_is_named() -> None:
    """Without the state before the move there is no reward, and that of the environment must not pass for it."""
    td = rewarded().rollout(2)[:, 0]
    with pytest.raises(KeyError, match=r"SPLReward reads its state .*highest_spl"):
        SPLReward()(td.exclude("highest_spl"))
    with pytest.raises(KeyError, match=r"HighestSPL reads .*success"):
        HighestSPL()(td.exclude(("next", "success")))


def long_move(td: TensorDict) -> TensorDict:
    return td.set("action", torch.tensor([30.0, 0.1]).expand(*td.shape, 2))


def test_distance_cost_is_paid_for_each_kilometer() -> None:
    env = TransformedEnv(nav(4), DistanceCost(0.05))
    costly = env.rollout(5, long_move)
    reward, move = costly["next", "reward"], costly["next", "move"]
    terms = costly["next", "reward_destination"] + costly["next", "reward_proximity"]
    torch.testing.assert_close(reward, terms - 0.05 * move[..., :1])
    assert (move[..., 0] == 30).all()
