"""Fixes by a map of the field, and what they say of the last legs."""

from __future__ import annotations

import math

import pytest
import torch
from support.environments import paper_env
from torch import Tensor
from torch.testing import assert_close
from torchrl.envs import Compose, TransformedEnv

from magrl.envs import GeomagneticNavEnv, Region, Regions
from magrl.errors import MotionError
from magrl.field.model import elements_at
from magrl.field.spherical import SphericalHarmonicField
from magrl.geodesy import geodesic
from magrl.named_tasks import eddies_env
from magrl.transforms import Fix, RecentLegs

BASE = paper_env(1)
MAP = Fix(BASE.field, BASE.region.expanded(5.0))
PUBLIC = ["field", "target_field", "leg", "heading", "elapsed_steps"]


def off_km(places: Tensor, fixes: Tensor) -> Tensor:
    return geodesic(*places.unbind(-1), *fixes.unbind(-1))[0]


def placed(count: int, beyond_deg: float = 0.0) -> Tensor:
    """Places in the region, and around it."""
    unit = torch.rand(count, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    low = torch.tensor((-10.0, 160.0), dtype=torch.float64) - beyond_deg
    return low + (10 + 2 * beyond_deg) * unit


def test_a_fix_inverts_the_map_in_the_region_and_beyond_it() -> None:
    """As far as a vehicle may stray from it."""
    places = placed(1000, beyond_deg=5.0)
    elements = elements_at(BASE.field, places)
    assert off_km(places, MAP._compute([elements, elements])[1]).max() < 0.01


def test_elements_count_by_their_accuracy() -> None:
    places, std = placed(1000), torch.tensor((0.1, 0.01, 1.0), dtype=torch.float64)
    noise = std * torch.randn(1000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    read = elements_at(BASE.field, places) + noise
    plain, weighed = (off_km(places, MAP._compute([read, read, *more])[0]) for more in ([], [std.expand_as(read)]))
    assert weighed.square().mean().sqrt() < 0.2 * plain.square().mean().sqrt()
    partly = MAP._compute([read, read, (std * torch.tensor((1.0, 1.0, 0.0))).expand_as(read)])[0]
    assert_close(off_km(places, partly), plain)


def test_a_map_in_which_two_places_look_alike_is_refused() -> None:
    """Along a parallel of a dipole, all do."""
    dipole = torch.zeros(2, 2, dtype=torch.complex128)
    dipole[1, 0] = -30000.0
    region = Regions.of(Region((-10.0, 0.0), (160.0, 170.0)))
    field = SphericalHarmonicField(dipole)
    with pytest.raises(ValueError, match=r"the map is ambiguous: \(-.*\) and \(-.*\) have the same elements; give a"):
        Fix(field, region)
    with pytest.raises(ValueError, match="a map is of one region, got 2"):
        Fix(field, Regions.of([*region, *region]))


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
    seen = steps.select(*PUBLIC, "fix", "legs", *(("next", key) for key in PUBLIC))
    assert_close(legs[0](seen["next"])["fix"], steps["next", "fix"])
    assert_close(legs[1](seen)["next", "recent_legs"], steps["next", "recent_legs"])
    assert_close(steps["next", "observation"], steps["next", "recent_legs"])
