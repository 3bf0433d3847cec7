"""Gradient guidance: slopes, headings and the alignment reward, by hand and by other ways of computing them."""

from __future__ import annotations

import math

import pytest
import torch
from support.errors import field, nav
from tensordict import TensorDict
from torchrl.data import Unbounded
from torchrl.envs import Compose, TransformedEnv

from magrl.envs import GeomagneticNavEnv, planet_scenario
from magrl.field.elements import elements_gradient
from magrl.field.model import elements_at
from magrl.geodesy import move
from magrl.transforms import AlignmentReward, FieldGradient, GradientHeading

D_EAST_I_NORTH_B_SOUTH_EAST = [[0.0, 0.01], [0.02, 0.0], [-1.0, 1.0]]


def test_field_gradient_is_the_slope_between_neighbors() -> None:
    """Central differences over 2 km northward and eastward, on the ellipsoid."""
    env = TransformedEnv(nav(6), FieldGradient(field()))
    td = env.rollout(3)["next"]
    latitude, longitude = td["position"].unbind(-1)
    slopes = []
    for heading in (0.0, math.pi / 2):
        ends = [
            torch.stack(move(latitude, longitude, torch.full_like(latitude, h), torch.ones_like(latitude)), -1)
            for h in (heading, heading + math.pi)
        ]
        slopes.append((elements_at(field(), ends[0]) - elements_at(field(), ends[1])) / 2)
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


@pytest.mark.parametrize(
    ("there", "gradient"),
    [
        ([1.0, 1.0], [[0.0, 0.0], [0.0, 1.0]]),
        ([1.0, 1.0], [[1.0, 2.0], [2.0, 4.0]]),
        ([0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]]),
    ],
    ids=["no gradient", "parallel", "on target"],
)
def test_no_direction_is_masked_and_not_nan(there: list[float], gradient: list[list[float]]) -> None:
    assert heading_of([0.0, 0.0], there, gradient, pair=(0, 1)) == (0.0, False)


def guided() -> TransformedEnv:
    return TransformedEnv(nav(4), Compose(FieldGradient(field()), GradientHeading()))


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
    env = guided().append_transform(AlignmentReward(out_keys=["reward", "reward_alignment"]))
    td = env.rollout(5)["next"]
    base = td["reward_destination"] + td["reward_proximity"]
    assert td["reward_alignment"].std() > 0.5
    torch.testing.assert_close(td["reward"] - base, td["reward_alignment"], rtol=0, atol=1e-4)
    assert env.reward_key == "reward"
    assert isinstance(env.observation_spec["reward_alignment"], Unbounded)
    assert (env.reset()["reward_alignment"] == 0).all()


def test_without_next_the_error_says_what_is_needed() -> None:
    with pytest.raises(KeyError, match="AlignmentReward needs transitions, with 'next'"):
        AlignmentReward(["angle", "reference"])(transition().exclude("next"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FieldGradient("IGRF"), "value_and_gradient.*str"),
        (lambda: FieldGradient(field(), ["position", "region"]), "region for a bank of fields"),
        (lambda: GradientHeading(pair=("D", "Z")), "'Z'.*D, I, B_H"),
    ],
)
def test_bad_options(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FieldGradient(field(), ["field"]), r"\(2, 3\)"),
        (lambda: FieldGradient(lambda position: position.sum(-1)), r"values \(E,\), got \(\)"),
        (lambda: GradientHeading(["field", "move", "field_gradient"]), r"\(2, 3\), \(2, 2\)"),
        (lambda: GradientHeading(pair=(0, 3)), r"\[0, 3\].*\(2, 3\)"),
    ],
)
def test_wrong_shapes(make, message: str) -> None:
    env = TransformedEnv(nav(), Compose(FieldGradient(field()), make()))
    with pytest.raises(ValueError, match=message):
        _ = env.specs
