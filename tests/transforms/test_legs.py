"""Fixes by a map of the field, and what they say of the last legs."""

from __future__ import annotations

import math

import pytest
import torch
from support.environments import paper_env
from tensordict import TensorDict
from torch import Tensor
from torch.testing import assert_close
from torchrl.envs import Compose, TransformedEnv

from magrl.envs import GeomagneticNavEnv, Region, Regions
from magrl.errors import MotionError, SensorErrors
from magrl.errors.motion import EDDIES, eddy_velocity, eddy_waves
from magrl.field.elements import elements_gradient
from magrl.field.model import elements_at
from magrl.field.spherical import SphericalHarmonicField
from magrl.geodesy import geodesic, move_place
from magrl.named_tasks import EDDY_MOTION, eddies_env
from magrl.transforms import ExpectedCurrents, Fix, RecentLegs
from magrl.transforms.areas import turned
from magrl.transforms.currents import eddy_covariance
from magrl.transforms.sequences import per_nanotesla
from magrl.transforms.views import LegsView

BASE = paper_env(1)
MAP = Fix(BASE.field, BASE.region.expanded(5.0))
PUBLIC = ["field", "target_field", "leg", "heading", "elapsed_steps"]


def off_km(places: Tensor, fixes: Tensor) -> Tensor:
    return geodesic(*places.unbind(-1), *fixes.unbind(-1))[0]


def fixes(elements: Tensor, *std: Tensor) -> Tensor:
    return MAP._fix(elements, [elements, elements, *std])


def placed(count: int, beyond_deg: float = 0.0) -> Tensor:
    """Places in the region, and around it."""
    unit = torch.rand(count, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    low = torch.tensor((-10.0, 160.0), dtype=torch.float64) - beyond_deg
    return low + (10 + 2 * beyond_deg) * unit


def test_a_fix_inverts_the_map_in_the_region_and_beyond_it() -> None:
    """As far as a vehicle may stray from it."""
    places = placed(1000, beyond_deg=5.0)
    assert off_km(places, fixes(elements_at(BASE.field, places))).max() < 0.01


def test_elements_count_by_their_accuracy() -> None:
    places, std = placed(1000), torch.tensor((0.1, 0.01, 1.0), dtype=torch.float64)
    noise = std * torch.randn(1000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    read = elements_at(BASE.field, places) + noise
    plain, weighed = (off_km(places, fixes(read, *more)) for more in ([], [std.expand_as(read)]))
    assert weighed.square().mean().sqrt() < 0.2 * plain.square().mean().sqrt()
    partly = fixes(read, (std * torch.tensor((1.0, 1.0, 0.0))).expand_as(read))
    assert_close(off_km(places, partly), plain)


def test_a_map_in_which_two_places_look_alike_is_refused() -> None:
    """Along a parallel of a dipole, all do."""
    dipole = torch.zeros(2, 2, dtype=torch.complex128)
    dipole[1, 0] = -30000.0
    region = Regions.of(Region((-10.0, 0.0), (160.0, 170.0)))
    field = SphericalHarmonicField(dipole)
    with pytest.raises(ValueError, match=r"the map is ambiguous: the elements at .*; give a smaller"):
        Fix(field, region)
    with pytest.raises(ValueError, match="a map is of one region, got 2"):
        Fix(field, Regions.of([*region, *region]))


def test_a_map_that_gives_wrong_fixes_without_a_word_is_refused() -> None:
    """No two places of a grid looked alike there, and 12 of 256 vehicles had a fix up to 4.4 degrees off."""
    region = Region((-4.4, 5.6), (26.2, 36.2))
    base = GeomagneticNavEnv(num_envs=256, seed=0, region=region)
    with pytest.raises(ValueError, match="the map is ambiguous"):
        Fix(base.field, base.scenario.edge)


def test_the_fix_of_the_destination_is_kept() -> None:
    env = eddies_env(4, seed=0)
    state = env.rollout(3, break_when_any_done=False)["next"][:, -1]
    assert off_km(state["target_position"], state["target_fix"]).max() < 0.01
    state = env.reset(state.set("_reset", torch.tensor([[True], [False], [False], [True]])), set_state=False)
    assert off_km(state["target_position"], state["target_fix"]).max() < 0.01
    assert off_km(state["position"], state["fix"]).max() < 0.01


def test_the_current_is_that_at_the_place() -> None:
    """From the first step on, in the frame of the heading, and within the rounding of readings."""
    env = eddies_env(64, seed=0)
    states = env.rollout(4, break_when_any_done=False)
    for state in (states[:, 0], states["next"][:, -1]):
        assert_close(turned(state["current"], state["heading"]), state["true_current"], atol=0.01, rtol=0)


def test_a_current_has_the_errors_of_the_readings() -> None:
    """Of two white ones; what is constant cancels."""
    std = torch.tensor((0.02, 0.02, 2.0))
    biased = eddies_env(2000, seed=0, transforms=[SensorErrors(bias=(0.1, 0.1, 20.0))]).reset()
    assert_close(turned(biased["current"], biased["heading"]), biased["true_current"], atol=0.15, rtol=0)
    state = eddies_env(2000, seed=0, transforms=[SensorErrors(std.tolist())]).reset()
    error = turned(state["current"], state["heading"]) - state["true_current"]
    value, gradient = BASE.field.value_and_gradient(*state["position"].unbind(-1))
    slopes = elements_gradient(value, gradient) / per_nanotesla(elements_at(BASE.field, state["position"])).unsqueeze(
        -1
    )
    inverse = torch.linalg.pinv(slopes)  # [km/nT]
    noise = std.double() / per_nanotesla(elements_at(BASE.field, state["position"]))
    expected = math.sqrt(2) / 2.0 * (inverse * noise.unsqueeze(-2)).square().sum((-1, -2)).mean().sqrt()
    assert_close(error.double().square().sum(-1).mean().sqrt(), expected, rtol=0.06, atol=0)


@pytest.mark.parametrize("heading", [0.0, -1.2])
def test_the_set_of_a_current_is_seen_from_the_heading(heading: float) -> None:
    """A current of half the speed, northward: its direction is the third number of the errors."""
    motion = MotionError(current_km_h=0.5, speed_km_h=1.0)
    base = GeomagneticNavEnv(num_envs=3, seed=0, max_leg_km=20.0, drift_km=12.0)
    env = TransformedEnv(base, Compose(motion, Fix(base.field, base.region), RecentLegs(2)))
    state = env.reset()
    state["motion_error"][:, 2] = 0.0
    for turn in (heading, 0.0, 0.0):
        state = env.step(state.set("action", torch.tensor([[20.0, turn]] * 3)))["next"]
    *about, back, beside, north, east, known = state["recent_legs"][:, :10].unbind(-1)
    ahead, right = 0.5 * math.cos(heading), -0.5 * math.sin(heading)
    assert_close(torch.stack((north, east, known), -1), torch.tensor([[ahead, right, 1.0]] * 3), atol=2e-3, rtol=0)
    assert_close(back, torch.full((3,), (10 + 10 * ahead) / 100), atol=1e-3, rtol=0)
    assert_close(beside, torch.full((3,), 10 * right / 100), atol=1e-3, rtol=0)
    bearing = torch.atan2(about[1], about[0]) + state["heading"].squeeze(-1)
    distance, expected = geodesic(*state["position"].unbind(-1), *state["target_position"].unbind(-1))
    assert_close(torch.cos(bearing - expected.float()), torch.ones(3), atol=1e-5, rtol=0)
    assert_close(400 * about[2], distance.float(), atol=0.1, rtol=0)
    assert_close(about[4], torch.full((3,), 3 / 50))


def test_an_episode_begins_without_legs_and_the_others_keep_theirs() -> None:
    env = eddies_env(4, seed=0)
    state = env.rollout(3, break_when_any_done=False)["next"][:, -1]
    again = env.reset(state.clone().set("_reset", torch.tensor([[True], [False], [False], [True]])), set_state=False)
    assert (again["recent_legs"][[0, 3], 5:] == 0).all()
    assert_close(again["recent_legs"][1:3], state["recent_legs"][1:3])
    assert (again["legs"][1:3, :3, -1] == 1).all()
    assert (again["legs"][1:3, 3] == 0).all()


def test_the_observation_follows_from_readings_and_legs_alone() -> None:
    env = eddies_env(4, seed=0)
    steps = env.rollout(4, break_when_any_done=False)
    legs = Compose(*(part.clone() for part in env.transform if isinstance(part, Fix | RecentLegs)))
    seen = steps.select(*PUBLIC, "fix", "target_fix", "legs", *(("next", key) for key in PUBLIC))
    assert_close(legs[0](seen)["next", "fix"], steps["next", "fix"])
    assert_close(legs[1](seen)["next", "recent_legs"], steps["next", "recent_legs"])
    expected = ExpectedCurrents()(steps["next"].select("recent_legs", "current"))["expected_currents"]
    parts = steps["next", "recent_legs"], steps["next", "current"], expected
    assert_close(steps["next", "observation"], torch.cat(parts, -1))


def test_a_mirror_image_is_an_episode_of_the_task() -> None:
    """Places and currents that are mirrored in the meridian of a dipole: the observation is that of the signs."""
    env = eddies_env(4, seed=0)
    recent, view = RecentLegs(3, 60), LegsView(count=3, max_steps=60, max_leg_km=25.0, max_turn_rad=1.5)
    state = env.reset()
    east = torch.tensor([1.0, -1.0], dtype=torch.float64)

    def flown(sign: Tensor) -> Tensor:
        fix, target, heading = (torch.tensor(x, dtype=torch.float64) for x in ([1.0, 2.0], [3.0, -1.0], [0.4]))
        step = TensorDict(
            fix=fix * sign, target_fix=target * sign, leg=torch.tensor([9.0, 0.1]), heading=heading * sign[1:]
        )
        step["elapsed_steps"] = torch.tensor([1])
        step = recent(step)
        after = step.clone().set("fix", (fix + 0.1) * sign).set("heading", (heading + 0.3) * sign[1:])
        return recent(step.set("next", after))["next", "recent_legs"]

    assert state["observation"].shape[-1] == env.view.size == len(env.view.mirror)
    mirror = view.mirror[:20, :20].double()
    assert_close(flown(east), flown(torch.ones(2, dtype=torch.float64)) @ mirror, atol=1e-9, rtol=0)
    seen = env.rollout(5, break_when_any_done=False)["observation"]  # expected currents, too
    image = (seen @ env.view.mirror.T)[..., :47]
    expected = ExpectedCurrents()(TensorDict(recent_legs=image[..., :45], current=image[..., 45:], batch_size=[4, 5]))
    assert_close(expected["expected_currents"], (seen @ env.view.mirror.T)[..., 47:], atol=1e-4, rtol=0)


# The currents to expect


def test_the_covariance_of_eddies_is_that_of_their_currents() -> None:
    """Of 20 000 fields of random waves, at two places 60 km apart; theirs have a mean square of 1 for both axes."""
    numbers = torch.rand(20_000, 3 * EDDIES, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    phases, directions = numbers.tensor_split([EDDIES], -1)
    waves, phases = eddy_waves(directions, 250.0), 2 * math.pi * phases
    place = torch.tensor([5.0, 30.0], dtype=torch.float64)
    distance, bearing = torch.tensor([60.0, 0.7], dtype=torch.float64)
    here, there = (
        eddy_velocity(at.expand(20_000, 2), waves, phases) for at in (place, move_place(place, bearing, distance))
    )
    apart = distance * torch.stack((bearing.cos(), bearing.sin())) * 2 * math.pi / 250
    assert_close(2 * here.T @ there / 20_000, eddy_covariance(apart), atol=0.03, rtol=0)


def test_expected_currents_are_near_the_true_ones() -> None:
    """Their error is below .15 of the root mean square 15 km away after eleven legs, and grows with the distance."""
    steps = eddies_env(64, seed=0).rollout(12, break_when_any_done=False)[:, -1]
    phases, directions = steps["motion_error"].double()[:, 3:].tensor_split([EDDIES], -1)
    target = torch.atan2(*steps["recent_legs"].double()[:, :2].flip(-1).unbind(-1)) + steps["heading"].double()[:, 0]
    expected, errors = steps["expected_currents"].double().unflatten(-1, (4, 8, 2)), []
    for ring, distance in enumerate((15.0, 40.0, 75.0, 120.0)):
        for number in range(8):
            place = move_place(steps["position"], target + number * math.pi / 4, torch.full_like(target, distance))
            true = 0.9 * eddy_velocity(place, eddy_waves(directions, 250.0), phases)
            errors.append((turned(true, -target.unsqueeze(-1)) - expected[:, ring, number]).square().sum(-1))
    near, *others = torch.stack(errors).unflatten(0, (4, 8)).mean((1, 2)).sqrt() / 0.9
    assert near < 0.15
    assert near < others[0] < others[1] < others[2] < 0.8


def test_the_wavelength_is_the_task_s() -> None:
    assert ExpectedCurrents().eddy_km == EDDY_MOTION["eddy_km"]
