"""Evaluation rollouts: every task once, errors that repeat, and policies without exploration."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor, TanhNormal

from magrl import Anywhere
from magrl.agents import FieldPolicy, PolicyConfig
from magrl.envs import GeomagneticNavEnv, Scenario, Tasks, named_tasks
from magrl.evaluation import episode_measures, evaluate, evaluation_rollout, summarize
from magrl.evaluation.navigators import fitted
from magrl.evaluation.scenarios import choose_tasks, first_tasks
from magrl.navigators import Secant
from magrl.transforms import SensorErrors


def test_every_task_is_flown_once_however_many_vehicles_fly() -> None:
    tasks = named_tasks("paper-100")
    together, batches = (evaluate("secant", tasks, num_envs=number) for number in (None, 30))
    assert together.shape == batches.shape == (100,)
    for key in ("shortest_km", "length_km", "spl"):
        torch.testing.assert_close(together[key], batches[key])
    assert torch.equal(together["steps"], batches["steps"])
    assert together["shortest_km"].unique().numel() == 100
    recipe = summarize(together)
    assert recipe["num_tasks"] == 100
    assert recipe["success_rate"] > 98


def test_batches_have_errors_of_their_own_that_repeat() -> None:
    """The same task in three batches has other noise and another start heading; the same call has the same."""
    tasks = named_tasks("figure-4-1")
    thrice = Scenario().with_tasks(Tasks(tasks.start.repeat(3, 1), tasks.target.repeat(3, 1)))
    for options in ({"errors": (0.05, 0.05, 5.0)}, {"start_heading": "random"}):
        one, again = (
            evaluate("secant", thrice, num_envs=1, max_steps=5, **options)["smoothness_deg"] for _ in range(2)
        )
        assert torch.equal(one, again)
        assert one.unique().numel() == 3
    perfect = evaluate("secant", thrice, num_envs=1, max_steps=5)
    torch.testing.assert_close(perfect["length_km"], perfect["length_km"][:1].expand(3))
    ship = evaluate("secant", thrice, errors="ship", max_steps=5)
    assert (ship["steps"] <= 5).all()


def test_a_stochastic_policy_is_evaluated_without_exploration() -> None:
    """Twice with the same actions, those of the mode of its distribution."""
    network = TensorDictModule(lambda move: (0 * move, 0 * move + 2.0), ["move"], ["loc", "scale"])
    policy = ProbabilisticActor(
        network,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        default_interaction_type=ExplorationType.RANDOM,
        distribution_kwargs={"low": torch.tensor([0.0, -1.0]), "high": torch.tensor([50.0, 1.0])},
    )
    env = GeomagneticNavEnv(num_envs=3, seed=0, max_steps=4)
    assert env.rollout(4, policy)["action"].unique().numel() > 4
    actions = evaluation_rollout(env, policy)["action"]
    assert torch.equal(actions, torch.tensor([25.0, 0.0]).expand_as(actions))
    episodes = [evaluate(policy, "figure-4-1", max_steps=4)["length_km"] for _ in range(2)]
    assert torch.equal(*episodes)


def test_what_cannot_be_evaluated_is_refused() -> None:
    agent = FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (8,)))
    elsewhere = Scenario(region={"latitude": (40, 50), "longitude": (0, 10)}, objective_floors=None)
    elsewhere = elsewhere.with_tasks(elsewhere.random_tasks(2, seed=0))
    for call, error, message in (
        (lambda: evaluate("secant", Scenario()), ValueError, "the scenario has no tasks to fly"),
        (
            lambda: evaluate("secant", "figure-4-1", errors="yacht"),
            ValueError,
            "conditions must be one of 'laboratory'",
        ),
        (lambda: evaluate("secant", "figure-4-1", known_start=(0, 0, 0)), ValueError, "needs conditions"),
        (lambda: evaluate(agent, elsewhere), ValueError, "trained"),
        (lambda: evaluate(agent, "figure-4-1", max_turn_deg=20), ValueError, "up to 90°, the environment .* and 20°"),
        (lambda: evaluate(5, "figure-4-1"), TypeError, "policy must be callable"),
    ):
        with pytest.raises(error, match=message):
            call()


@pytest.mark.parametrize("options", [{"arrival": "declared"}, {"max_move_km": 20, "zeta": 0.02}])
def test_a_pretrained_policy_flies_as_by_its_name(options: dict) -> None:
    """Within the limits of the environment, which it gets from `evaluate`, or from a loop of one's own."""
    scenario = first_tasks(choose_tasks(None, "paper-100"), 3)
    policy, options = Anywhere(), {"max_steps": 6, **options}
    flights = (evaluate(agent, scenario, errors=(0.05, 0.05, 5.0), **options) for agent in ("anywhere", policy))
    named, given = flights
    assert all(torch.equal(named[key], given[key]) for key in named.keys())  # noqa: SIM118
    base = GeomagneticNavEnv(scenario, num_envs=3, seed=0, **options)
    env = TransformedEnv(base, SensorErrors((0.05, 0.05, 5.0)))
    with torch.no_grad():
        own = env.rollout(6, fitted(policy, base), break_when_any_done=False, break_when_all_done=True)
    assert torch.equal(episode_measures(own)["length_km"], named["length_km"])


def test_a_vehicle_without_a_finite_action_fails_alone() -> None:
    """The others fly as they do without it."""

    def broken(tensordict: TensorDict) -> TensorDict:
        hurt = (tensordict["elapsed_steps"] == 2) & (tensordict["target_position"] == target).all(-1, keepdim=True)
        action = secant(tensordict)["action"]
        return tensordict.set("action", torch.where(hurt, math.nan, action))

    secant, target = Secant(), named_tasks("paper-100").target[3]
    with pytest.warns(UserWarning, match=r"not finite: vehicles \[3\] stopped"):
        episodes = evaluate(broken, "paper-100")
    sound, others = evaluate("secant", "paper-100"), torch.arange(100) != 3
    assert not episodes["success"][3]
    for key in ("success", "length_km", "steps"):
        assert torch.equal(episodes[key][others], sound[key][others]), key
