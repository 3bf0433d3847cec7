"""The observation of an agent without a map: its 19 numbers, its frame, its state, and the policy that reads it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from support.readings import first_reading
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from magrl.agents import FieldPolicy, PolicyConfig, load_policy, save_policy
from magrl.envs import GeomagneticNavEnv
from magrl.guidance import OBJECTIVE_FLOORS
from magrl.sensor_std import STD_KEYS
from magrl.transforms import ObservationView, SensorNoise, TrackField, TrackView
from magrl.transforms.views import track_observation

VIEW = TrackView(zeta=0.01, max_steps=50, max_move_km=50.0, max_turn_rad=math.pi / 2)
STD = (0.05, 0.1, 5.0)
float64 = partial(torch.tensor, dtype=torch.float64)
nav = partial(GeomagneticNavEnv, num_envs=4, seed=0)


def observing(base: GeomagneticNavEnv | None = None) -> TransformedEnv:
    """The environment that an agent is trained in, without what is for training alone."""
    steps = (SensorNoise(STD, seed=1), *VIEW.observation_transforms(), VIEW.action_transform())
    return TransformedEnv(base or nav(), Compose(*steps))


def policy() -> FieldPolicy:
    torch.manual_seed(0)
    return FieldPolicy(PolicyConfig(VIEW, (16, 16)))


def by_hand(**change: Tensor) -> Tensor:
    values = {
        "aim": float64([30.0, 40.0]),
        "way_covariance": float64([[400.0, 100.0], [100.0, 1600.0]]),
        "estimated_gradient": float64([[0.01, 0.0], [0.0, 0.02], [1.0, 1.0]]),
        "remaining": float64([0.1, -0.2, 3.0]),
        "weights": float64([100.0, 25.0, 0.01]),
        "sensor_std": float64([0.1, 0.0, 5.0]),
        "time": float64([0.3]),
        "planned_move": float64([-12.0, 16.0]),
        "step_price": float64([0.4]),
    }
    return track_observation(values | change)


def test_the_numbers_by_hand() -> None:
    """A way of 50 km; standard deviations of 20 and 40 km; the ellipse [[.02, .01], [.01, .02]]; F of 2.09."""
    expected = [
        *(0.6, 0.8),  # direction
        *(math.log(3.5) - 2, 50 / 400 - 0.5),  # length
        *(0.0, math.log(2) / 2, 100 / 800),  # standard deviations over 20 km, and their correlation
        *[math.log(20 * math.sqrt(0.02)) / 2] * 2,  # axes of the ellipse
        0.5,  # their correlation
        math.log(2.1) / 3 - 0.5,  # F over the threshold
        0.3,  # time
        *(math.log(0.1) / 2 + 2, math.log(0.002) / 2 + 2, math.log(0.05) / 2 + 2),  # noise
        *(-0.6, 0.8, math.log(2) - 1),  # plan
        math.log(4) / 2,  # price
    ]
    torch.testing.assert_close(by_hand(), float64(expected))
    assert len(expected) == VIEW.size


def test_numbers_at_the_extremes() -> None:
    """No way, no uncertainty, no gradient; and a way beyond all measure, whose direction is still seen."""
    flat = by_hand(aim=torch.zeros(2), way_covariance=torch.zeros(2, 2), estimated_gradient=torch.zeros(3, 2))
    assert flat.isfinite().all()
    assert flat[:2].tolist() == [0.0, 0.0]
    far = by_hand(aim=float64([0.0, -1e6]))
    assert (far[1], far[3]) == (-1.0, 2500 / 400 - 0.5)


def test_a_turn_of_world_and_vehicle_is_not_observed() -> None:
    """D turns with the world, and passes 180 degrees; a turn of the vehicle alone is observed."""
    *estimate, observe = VIEW.observation_transforms()
    seen = first_reading().set("elapsed_steps", torch.zeros(4, 1, dtype=torch.int64))
    seen.update({key: float64(STD if key == "sensor_std" else (0.0,) * 3).expand(4, 3) for key in STD_KEYS})
    seen = Compose(*estimate)(seen)
    plain, other = observe(seen.clone())["observation"], seen.clone()
    other["heading"] = seen["heading"] + 3.0
    assert not torch.allclose(observe(other.clone())["observation"], plain)
    turn = float64([[math.cos(3.0), -math.sin(3.0)], [math.sin(3.0), math.cos(3.0)]])
    for key in ("field", "target_field", "estimated_field"):
        other[key][:, 0] = torch.remainder(seen[key][:, 0] + math.degrees(3.0) + 180, 360) - 180
    for key in ("aim", "planned_move", "estimated_gradient"):
        other[key] = seen[key] @ turn.mT
    other["way_covariance"] = turn @ seen["way_covariance"] @ turn.mT
    torch.testing.assert_close(observe(other)["observation"], plain, rtol=1e-5, atol=1e-5)


def test_weights_are_those_of_the_first_reading_of_each_row() -> None:
    env = observing()
    td = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
    chosen = torch.tensor([True, False, False, True])
    after = env.reset(td.clone().set("_reset", chosen.unsqueeze(-1)))
    first = Compose(*VIEW.observation_transforms())(after.select(*VIEW.in_keys, *STD_KEYS))
    for key in ("observation", "first_field"):
        assert torch.equal(after[key][~chosen], td[key][~chosen]), key
        torch.testing.assert_close(after[key][chosen], first[key][chosen], rtol=1e-5, atol=1e-4, msg=key)
    nexts = env.step(env.rand_action(after))["next"]
    assert torch.equal(nexts["first_field"], torch.where(chosen.unsqueeze(-1), after["field"], td["first_field"]))
    least, remaining = torch.tensor(OBJECTIVE_FLOORS), nexts["target_field"] - nexts["estimated_field"]
    weights = (nexts["first_field"] - nexts["target_field"]).abs().maximum(least).square().reciprocal() / VIEW.zeta
    expected = torch.log((weights * remaining.square()).sum(-1) + 1e-2) / 3 - 0.5
    torch.testing.assert_close(nexts["observation"][:, 10], expected, rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(nexts["observation"][:, 11], torch.where(chosen, 1, 4) / 50)


def test_policy_starts_again_where_the_batch_is_another(tmp_path: Path) -> None:
    """In the middle of an episode, too: what it kept is of other vehicles. So does one from a file."""
    agent, middle = policy(), nav(num_envs=2).rollout(3)[:, -1]
    save_policy(tmp_path / "policy.pt", agent)
    nav(num_envs=5).rollout(3, agent)
    expected = policy()(middle.clone())["action"]
    for found in (agent, load_policy(tmp_path / "policy.pt")):
        found.check_fits(nav())
        assert torch.equal(found(middle.clone())["action"], expected)


def test_a_policy_flies_by_the_belief_of_its_environment_as_by_its_own() -> None:
    noise = SensorNoise(STD, seed=1)
    own, given = (
        TransformedEnv(nav(), Compose(noise.clone(), *track)).rollout(6, policy())["action"]
        for track in ([], [TrackField(std_keys=STD_KEYS)])
    )
    torch.testing.assert_close(given, own)
    other = TrackField(sensor_std=[20 * std for std in STD])
    assert not torch.allclose(TransformedEnv(nav(), Compose(noise.clone(), other)).rollout(6, policy())["action"], own)


@pytest.mark.parametrize(
    ("option", "error"),
    [
        ({"zeta": 0.0}, ValueError),
        ({"max_steps": 0}, ValueError),
        ({"range_km": math.nan}, ValueError),
        ({"radius_km": -1.0}, ValueError),
        ({"step_price": 0.0}, ValueError),
        ({"caution": -0.1}, ValueError),
        ({"crust_nt": -1.0}, ValueError),
        ({"search": 1}, TypeError),
    ],
)
def test_bad_options_of_a_track_view_are_refused(option: dict, error: type[Exception]) -> None:
    with pytest.raises(error, match=next(iter(option))):
        replace(VIEW, **option)


def test_bad_bounds_of_a_view_are_refused() -> None:
    options = {"observe_heading": True, "observe_difference": True, "max_move_km": 50.0, "max_turn_rad": 1.5}
    with pytest.raises(ValueError, match=r"field_low \(1.0, 0.0, 0.0\) must lie below field_high"):
        ObservationView(**options, field_low=(1.0, 0.0, 0.0), field_high=(1.0, 1.0, 1.0))
