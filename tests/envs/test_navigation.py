"""The navigation environment behind the transforms of the recipes."""

import torch
from torchrl.envs import CatTensors, Compose

from magrl.envs.navigation import navigation_env
from magrl.transforms import NorthReferenceError, SensorNoise


def test_rewards() -> None:
    guided, base = (navigation_env(3, reward=reward, seed=1).reset() for reward in ("guided", "base"))
    assert "gradient_heading" in guided
    assert "gradient_heading" not in base
    assert torch.equal(guided["observation"], base["observation"])


def test_guidance_is_by_the_truth_and_a_compose_is_the_list_of_its_parts() -> None:
    """Whatever the errors of the readings are."""
    errors = [SensorNoise((0.2, 0.2, 20.0), seed=0), NorthReferenceError(2.0, fixed=True, seed=0)]
    clean, listed, composed = (
        navigation_env(20, transforms=transforms, seed=0, scale_actions=False)
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
    joined = CatTensors(["field", "move"], "both", del_keys=False)
    state = navigation_env(2, transforms=[joined], seed=0).reset()
    assert (state["observation"].shape, state["both"].shape) == ((2, 13), (2, 5))
