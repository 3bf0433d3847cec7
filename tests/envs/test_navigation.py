"""The navigation environment behind the transforms of the recipes."""

import math
from collections.abc import Callable
from functools import partial

import pytest
import td3_gradient_guided as recipe
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import CatTensors, Compose, StepCounter, Transform, TransformedEnv

from magrl.envs import PAPER_REGION, Region, Scenario
from magrl.envs.navigation import navigation_env
from magrl.errors import NorthReferenceError, SensorErrors
from magrl.evaluation import evaluation_rollout
from magrl.evaluation.episodes import first_episode_mask
from magrl.named_tasks import no_go_env
from magrl.navigators import Geodesic
from magrl.pilot import Rules
from magrl.transforms import DeclareArrival, GradientHeading, TrackField


def test_rewards() -> None:
    states = [navigation_env(3, seed=1).reset()]
    states += [navigation_env(3, reward=reward, seed=1).reset() for reward in ("paper", "base", "spl")]
    assert ["gradient_heading" in state for state in states] == [False, True, False, False]
    assert ["true_displacement" in state for state in states] == [True, False, False, True]
    assert all(torch.equal(states[0]["observation"], state["observation"]) for state in states)


def test_the_papers_pair_guides_in_its_region_alone() -> None:
    """Elsewhere the gradients of D and I may be parallel."""
    for region, pair in ((PAPER_REGION, [0, 1]), (Region((4, 14), (66, 76)), None)):
        scenario = Scenario(region=region)
        trained = recipe.make_env(scenario, recipe.Config(num_envs=1))
        for env in (trained, navigation_env(scenario=scenario, reward="paper")):
            assert [step.pair for step in env.transform if isinstance(step, GradientHeading)] == [pair]


def returns(env: TransformedEnv, policy: Callable[[TensorDict], TensorDict]) -> tuple[Tensor, Tensor]:
    """Return of the first episode of each vehicle, and whether it has arrived, ``(N,)``."""
    rollout = evaluation_rollout(env, policy)["next"]
    counted = first_episode_mask(rollout["done"])
    return (rollout["reward"].squeeze(-1) * counted).sum(1), (rollout["success"].squeeze(-1) & counted).any(1)


def test_a_failure_earns_less_than_half_of_the_best_arrival() -> None:
    """Standing still and turning on the spot earn nothing, no constant action much, and arrivals their SPL."""
    grid = torch.cartesian_prod(torch.linspace(-1, 1, 5), torch.linspace(-1, 1, 17))
    constant = navigation_env(2 * len(grid), seed=0)
    earned, lucky = returns(constant, lambda state: state.set("action", grid.repeat(2, 1)))
    env = navigation_env(64, seed=1, scale_actions=False)
    best, arrived = returns(env, Geodesic.for_env(env.base_env))
    assert arrived.all()
    assert best.min() > 9.9
    assert (~lucky).sum() > 150
    assert earned[~lucky].max() < 5
    torch.testing.assert_close(earned[grid[:, 0].repeat(2) == -1], torch.zeros(34), rtol=0, atol=1e-5)  # stands still


def test_guidance_is_by_the_truth_and_a_compose_is_the_list_of_its_parts() -> None:
    """Whatever the errors of the readings are."""
    errors = [SensorErrors((0.2, 0.2, 20.0), seed=0), NorthReferenceError(2.0, fixed=True, seed=0)]
    clean, listed, composed = (
        navigation_env(20, transforms=transforms, reward="paper", seed=0, scale_actions=False)
        for transforms in ((), errors, [Compose(*errors)])
    )
    action = torch.tensor([[30.0, 0.0]]).expand(20, 2)
    true, erring, same = (env.step(env.reset().set("action", action))["next"] for env in (clean, listed, composed))
    assert (true["field"] != erring["field"]).all()
    assert (true["heading"] != erring["heading"]).all()
    for key in ("field", "heading", "reward"):
        torch.testing.assert_close(erring[key], same[key], rtol=0, atol=0)
    for key in ("gradient_heading", "reward"):
        torch.testing.assert_close(true[key], erring[key], rtol=0, atol=0)


def test_the_observation_of_the_recipes_is_added_to_own_ones() -> None:
    joined = CatTensors(["field", "leg"], "both", del_keys=False)
    state = navigation_env(2, transforms=[joined], seed=0).reset()
    assert (state["observation"].shape, state["both"].shape) == ((2, 13), (2, 5))


class Twice(Transform):
    """Half of each action, whose bounds are twice as wide; it names no keys."""

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", tensordict["action"] / 2)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        space = input_spec["full_action_spec", "action"].space
        input_spec["full_action_spec", "action"] = Bounded(2 * space.low, 2 * space.high)
        return input_spec


def test_actions_are_scaled_to_the_bounds_that_transforms_leave() -> None:
    rules = Rules(arrival="declared")
    declared = navigation_env(2, seed=0, arrival="declared", transforms=[TrackField(rules), DeclareArrival(rules)])
    for env in (navigation_env(2, seed=0), navigation_env(2, seed=0, transforms=[Twice()]), declared):
        assert env.action_spec.shape == (2, 2)
        assert (env.action_spec.space.low == -1).all()
        assert (env.action_spec.space.high == 1).all()
        state = env.reset().set("action", torch.tensor([[1.0, 0.5]]).expand(2, 2))
        assert env.step(state)["next", "leg"][0].tolist() == pytest.approx([50, math.pi / 4])


@pytest.mark.parametrize("make", [navigation_env, partial(navigation_env, observation="legs"), no_go_env])
def test_the_view_is_there_behind_further_transforms(make: Callable[..., TransformedEnv]) -> None:
    env = make(2, seed=0)
    outer = TransformedEnv(env, StepCounter(), auto_unwrap=True)
    assert outer.view == env.view
    assert outer.view.size == outer.observation_spec["observation"].shape[-1]
