"""Rewards and what they need: the true displacement, short paths, the gradient of the field, and alignment with it."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from support.environments import paper_field
from support.errors import nav
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import Compose, Transform, TransformedEnv

from magrl.envs import GeomagneticNavEnv, planet_scenario
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.evaluation.episodes import episode_scores
from magrl.evaluation.scores import flown
from magrl.field.elements import elements_gradient
from magrl.field.model import elements_at
from magrl.geodesy import geodesic, move
from magrl.named_tasks import NAMED_TASKS
from magrl.navigators import Secant
from magrl.transforms import (
    AlignmentReward,
    DistanceCost,
    FieldGradient,
    GradientHeading,
    HighestSPL,
    RandomStepPrice,
    SPLReward,
    TrueDisplacement,
)

pytestmark = pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped")


# The displacement


@pytest.mark.parametrize("latitude", [-70.0, 0.0, 45.0])
def test_displacement_leads_to_the_target(latitude: float) -> None:
    """A vehicle that turns towards it and goes its length arrives, from any heading and across the antimeridian."""
    heading = torch.linspace(-math.pi, math.pi, 9, dtype=torch.float64).unsqueeze(-1)
    here = torch.tensor([[latitude, 179.5]], dtype=torch.float64).expand(9, 2)
    there = torch.tensor([[latitude + 2.0, -178.0]], dtype=torch.float64).expand(9, 2)
    td = TensorDict(position=here, target_position=there, heading=heading)
    displacement = TrueDisplacement()(td)["true_displacement"]
    bearing = heading.squeeze(-1) + torch.atan2(displacement[:, 1], displacement[:, 0])
    arrived = torch.stack(move(*here.unbind(-1), bearing, displacement.norm(dim=-1)), -1)
    gap_km, _ = geodesic(*arrived.unbind(-1), *there.unbind(-1))
    assert gap_km.max() < 0.01
    assert displacement[4, 0] > 0  # heading north, to a target ahead
    assert displacement[4, 1] > 0  # and to the right


# The reward


def test_earned_spl_by_hand() -> None:
    """A trip of 100 km, after 20 km and a leg more: on the way, arrived, failed, carried by a current, and beyond."""
    after = TensorDict(
        true_displacement=torch.tensor([[60.0, 0.0], [3.0, 4.0], [60.0, 0.0], [0.0, 50.0], [120.0, 160.0]]),
        leg=torch.tensor([[40.0, 0.1], [180.0, 0.0], [40.0, 0.0], [20.0, 0.0], [30.0, 0.0]]),
        success=torch.tensor([[False], [True], [False], [False], [False]]),
        done=torch.tensor([[False], [True], [True], [False], [False]]),
        step_price=torch.full((5, 1), 0.5),
        batch_size=[5],
    )
    before = {
        "highest_spl": torch.ones(5, 1),
        "earned_spl": torch.full((5, 1), 0.1),
        "path_km": torch.full((5, 1), 20.0),
        "trip_km": torch.full((5, 1), 100.0),
    }
    step = HighestSPL()(TensorDict(before | {"next": after}, [5]))
    highest, earned = [100 / 120, 0.5, 0.0, 1.0, 0.4], [100 / 120 * 0.2, 0.5, 100 / 120 * 0.2, 0.25, -0.2]
    found = torch.cat([step["next", key] for key in ("highest_spl", "earned_spl", "path_km")], -1)
    wanted = torch.tensor([highest, earned, [60.0, 200.0, 60.0, 40.0, 50.0]]).T
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)
    torch.testing.assert_close(SPLReward()(step)["next", "reward"], 10 * (wanted[:, 1:2] - 0.1), rtol=0, atol=1e-3)
    old = SPLReward(["highest_spl", "step_price"])(step)["next", "reward"]
    torch.testing.assert_close(old, 10 * (wanted[:, :1] - 1) - 0.05, rtol=0, atol=1e-3)


def test_a_trip_of_no_length_has_an_spl() -> None:
    """As :func:`magrl.envs.measures.spl` has it: 1 for who stays, 0 for who comes back."""
    flag = torch.ones(2, 1, dtype=torch.bool)
    legs = {"leg": torch.tensor([[0.0, 0.0], [50.0, 0.0]]), "true_displacement": torch.zeros(2, 2)}
    after = TensorDict(success=flag, done=flag, **legs, batch_size=[2])
    start = HighestSPL()(after.clone())
    step = HighestSPL()(start.set("next", after))["next"]
    torch.testing.assert_close(step["earned_spl"], torch.tensor([[1.0], [0.0]]), rtol=0, atol=1e-6)


def test_returns_depend_on_both_ends_alone() -> None:
    """With the highest SPL and prices: SPL less those of the steps."""
    rewards = RandomStepPrice((0.1, 1.0)), TrueDisplacement(), HighestSPL(), SPLReward(["highest_spl", "step_price"])
    rollout = evaluation_rollout(TransformedEnv(nav(64, max_steps=10), Compose(*rewards)), Secant())
    measures, price = episode_measures(rollout), rollout["step_price"][:, 0, 0]
    expected = 100 * (measures["spl"] - 1) - price * measures["steps"]
    torch.testing.assert_close(episode_scores(rollout), expected, rtol=0, atol=1e-4)
    assert 10 < measures["success"].sum() < 60


@pytest.mark.parametrize("task", NAMED_TASKS)
def test_the_score_is_spl_for_arrivals_and_below_a_half_for_failures(task: str) -> None:
    """Of a rule, a network and random actions, also where currents carry vehicles: the path is through the water."""
    successes, random = [], torch.Generator().manual_seed(0)

    def at_random(seen: np.ndarray) -> np.ndarray:
        return (2 * torch.rand(len(seen), 2, generator=random) - 1).numpy()

    for agent in ("secant", "eddies" if task == "eddies" else "memory", at_random):
        rollout = flown(agent, task, episodes=12)
        measures, scores = episode_measures(rollout), episode_scores(rollout)
        arrived = measures["success"]
        torch.testing.assert_close(scores[arrived], 100 * measures["spl"][arrived], rtol=0, atol=1e-4)
        assert (scores[~arrived] < 50).all()
        successes.append(arrived)
    assert torch.cat(successes).any()
    assert not torch.cat(successes).all()


def test_prices_are_log_uniform_and_stay_for_an_episode() -> None:
    price = TransformedEnv(nav(2000), RandomStepPrice((0.1, 10.0), seed=3)).rollout(2)["step_price"]
    assert torch.equal(price[:, 0], price[:, 1])
    assert abs(price.log10().mean()) < 0.05
    assert price.log10().std() == pytest.approx(2 / 12**0.5, abs=0.02)


# Specs and errors


def test_what_is_missing_is_named() -> None:
    """Without the state before the leg there is no reward, and that of the environment must not pass for it."""
    td = TransformedEnv(nav(), Compose(TrueDisplacement(), HighestSPL(), SPLReward())).rollout(1)
    with pytest.raises(KeyError, match=r"SPLReward reads its state .*earned_spl"):
        SPLReward()(td.exclude("earned_spl"))


def test_distance_cost_is_paid_for_each_kilometer() -> None:
    env = TransformedEnv(nav(4), DistanceCost(0.05))
    action = torch.tensor([30.0, 0.1]).expand(4, 2)
    costly = env.rollout(2, lambda td: td.set("action", action))
    reward, leg = costly["next", "reward"], costly["next", "leg"]
    terms = costly["next", "reward_destination"] + costly["next", "reward_proximity"]
    torch.testing.assert_close(reward, terms - 0.05 * leg[..., :1])
    assert (leg[..., 0] == 30).all()


def test_field_gradient_is_the_slope_between_neighbors() -> None:
    """Central differences over 2 km northward and eastward, on the ellipsoid."""
    env = TransformedEnv(nav(6), FieldGradient(paper_field()))
    td = env.rollout(3)["next"]
    latitude, longitude = td["position"].unbind(-1)
    slopes = []
    for heading in (0.0, math.pi / 2):
        ends = [
            torch.stack(move(latitude, longitude, torch.full_like(latitude, h), torch.ones_like(latitude)), -1)
            for h in (heading, heading + math.pi)
        ]
        slopes.append((elements_at(paper_field(), ends[0]) - elements_at(paper_field(), ends[1])) / 2)
    torch.testing.assert_close(td["field_gradient"].double(), torch.stack(slopes, -1), rtol=1e-4, atol=1e-6)


def test_field_gradient_of_a_bank_is_that_of_each_region() -> None:
    base = GeomagneticNavEnv(planet_scenario(4, seed=0), num_envs=12, seed=0)
    guided = Compose(FieldGradient(base.field), GradientHeading(pair="auto"), AlignmentReward())
    td = TransformedEnv(base, guided).rollout(3)["next"]
    assert len(td["region"].unique()) > 2
    place = td["position"].unbind(-1)
    for number in range(4):
        here = td["region"].squeeze(-1) == number
        index = torch.full_like(td["region"].squeeze(-1), number)
        gradient = elements_gradient(*base.field.value_and_gradient(*place, index)).float()
        assert torch.equal(td["field_gradient"][here], gradient[here])


def heading_of(
    here: list[float], there: list[float], gradient: list[list[float]], **options: object
) -> tuple[float, bool]:
    """The heading in degrees and the mask, for one place."""
    names = ("field", "target_field", "field_gradient")
    td = TensorDict(
        {n: torch.tensor(x, dtype=torch.float64) for n, x in zip(names, (here, there, gradient), strict=True)}
    )
    out = GradientHeading(**options)(td)
    return math.degrees(out["gradient_heading"]), bool(out["gradient_heading_valid"])


@pytest.mark.parametrize(
    ("gradient", "pair"),
    [
        ([[0.0, 0.01], [0.02, 0.0], [-1.0, 1.0]], ("D", "I")),
        ([[0.0, 0.01], [-0.001, 0.02], [-1.0, 0.1]], ("D", "B_H")),
        ([[0.0, 0.0], [0.02, 0.0], [-1.0, 1.0]], ("I", "B_H")),
    ],
)
def test_automatic_pair_is_the_one_that_crosses_best(gradient: list, pair: tuple[str, str]) -> None:
    here, there = [179.5, -16.0, 35000.0], [-180.0, -14.0, 35200.0]
    heading, valid = heading_of(here, there, gradient, pair="auto")
    assert valid
    assert heading == heading_of(here, there, gradient, pair=pair)[0]


@pytest.mark.parametrize(
    ("here", "there", "degrees"), [(179.0, -179.0, 90.0), (-179.5, 179.5, -90.0), (-1.0, 1.0, 90.0)]
)
def test_declination_is_taken_the_short_way(here: float, there: float, degrees: float) -> None:
    gradient = [[0.0, 0.01], [0.02, 0.0]]
    heading, valid = heading_of([here, 0.0], [there, 0.0], gradient)
    assert valid
    assert heading == pytest.approx(degrees, abs=1e-9)


def transition(**changes: object) -> TensorDict:
    """One step whose angles are all different, so that reading a wrong one gives another number."""
    entries = {"angle": 1.3, "reference": 0.1, "trusted": True}
    after = {"angle": 0.4, "reference": -0.8, "trusted": False, "reward": 7.0}
    after = {name: torch.tensor([value]) for name, value in after.items()}
    td = TensorDict({name: torch.tensor([value]) for name, value in entries.items()} | {"next": TensorDict(after)})
    return td.update(changes)


def test_masked_reference_earns_nothing_even_if_it_is_nan() -> None:
    td = transition(trusted=torch.tensor([False]), reference=torch.tensor([float("nan")]))
    assert float(AlignmentReward(["angle", "reference", "trusted"])(td)["next", "reward"]) == 7.0


def test_reward_is_created_when_missing() -> None:
    out = AlignmentReward(["angle", "reference"], "alignment")(transition())
    assert float(out["next", "reward"]) == 7.0
    assert float(out["next", "alignment"]) == pytest.approx(3 * (math.pi / 4 - 0.3), abs=1e-5)
    assert "alignment" not in out


def test_in_the_env_the_second_out_key_is_what_the_first_one_gained() -> None:
    alignment = AlignmentReward(out_keys=["reward", "reward_alignment"])
    env = TransformedEnv(nav(4), Compose(FieldGradient(paper_field()), GradientHeading(), alignment))
    td = env.rollout(5)["next"]
    base = td["reward_destination"] + td["reward_proximity"]
    assert td["reward_alignment"].std() > 0.5
    torch.testing.assert_close(td["reward"] - base, td["reward_alignment"], rtol=0, atol=1e-4)
    assert env.reward_key == "reward"
    assert isinstance(env.observation_spec["reward_alignment"], Unbounded)
    assert (env.reset()["reward_alignment"] == 0).all()


def guided(transform: Transform) -> TransformedEnv:
    return TransformedEnv(nav(), Compose(FieldGradient(paper_field()), transform))


MISTAKES: dict[str, Callable[[], object]] = {
    "AlignmentReward needs transitions, with 'next'": lambda: AlignmentReward(["angle", "reference"])(
        transition().exclude("next")
    ),
    "value_and_gradient.*str": lambda: FieldGradient("IGRF"),
    "region for a bank of fields": lambda: FieldGradient(paper_field(), ["position", "region"]),
    "'Z'.*D, I, B_H": lambda: GradientHeading(pair=("D", "Z")),
    r"got \(2, 3\)": lambda: guided(FieldGradient(paper_field(), ["field"])).specs,
    r"values \(E,\), got \(\)": lambda: guided(FieldGradient(lambda position: position.sum(-1))).specs,
    r"\(2, 3\), \(2, 2\)": lambda: guided(GradientHeading(["field", "leg", "field_gradient"])).specs,
    r"\[0, 3\].*have 3$": lambda: guided(GradientHeading(pair=(0, 3))).specs,
    r"\[0, 7\].*have 2$": lambda: heading_of([0.0, 0.0], [1.0, 1.0], [[0.0, 1.0], [1.0, 0.0]], pair=(0, 7)),
}


@pytest.mark.parametrize("message", MISTAKES)
def test_mistakes_of_guidance(message: str) -> None:
    with pytest.raises((ValueError, KeyError), match=message):
        MISTAKES[message]()
