"""What published numbers rest on is frozen: trips, readings under errors, and what environments answer to actions.

Other processors change the last bits of a number. So digests hold six digits of the largest of a column, which come
from float64; four of readings with errors, which are added in float32; and the observations of networks are compared as
means. All were seen to agree under ATEN_CPU_CAPABILITY=default, avx2 and avx512, and MKL_CBWR=COMPATIBLE.
"""

import hashlib
import json
import random

import gymnasium
import numpy as np
import pytest
import torch

import magrl  # noqa: F401 - registers the environments
from magrl.envs import PUBLIC_KEYS, TRIP_SETS, named_trips
from magrl.evaluation import evaluation_rollout
from magrl.evaluation.tracks import SEED, TRACKS, digest
from magrl.named_tasks import NAMED_TASKS, PLANET_REGIONS, task_name
from magrl.sensor_std import STD_KEYS

NEW_VERSION = "published numbers would change: keep this track as it is, and make a new version for the change"
TRACK_DIGESTS = {
    "box-v2": ("e532e868b7a49993", "b5d8da9cb6d53bea"),
    "earth-v2": ("49f64964da2779f5", "eb6505220e03610b"),
    "alone-v2": ("9d5691e12866b3c3", "eb6505220e03610b"),
    "vehicles-v4": ("c293a315e0fae9c6", "cf36aa8dd95f3638"),
    "north-v1": ("e35c4d00c50322a3", "bcb45c2e6536f22e"),
}
"""Of the declaration and trips, and of readings."""
SETS = {"test-1000": "a86aacd1afedb688", "paper-100": "82cb3cd8bee75af2", "paper-example": "a7aac085136a6d62"}
TASK_DIGESTS = {
    "magrl/GeomagneticNavigation-v1": ("db358c00e517c132", -5.373),
    "magrl/GeomagneticNavigationAnywhere-v2": ("cfb5b2950f361556", 59.611),
    "magrl/GeomagneticNavigationReadings-v2": ("cfb5b2950f361556", 169.094),
    "magrl/GeomagneticNavigationStorm-v2": ("b5326d98869b964b", 152.084),
    "magrl/GeomagneticNavigationNoGo-v1": ("6e38ee89a111935e", -4.402),
    "magrl/GeomagneticNavigationEddies-v2": ("4fe5c87e60c06f19", 527.46),
}
"""By id: of eight starts, fields and the ends of a leg; observations and rewards of ten, in one number."""
FIRST, SIZE = np.array([1, 0]), np.array([25, 1.5])  # of actions in km and rad, from those in [-1, 1]
IDS = sorted(name for name in gymnasium.registry if name.startswith("magrl/"))


def actions(count: int, steps: int) -> np.ndarray:
    """Actions in [-1, 1], from a generator that Python promises to keep: ``(steps, count, 2)``."""
    draw = random.Random(0)
    return np.array([[[draw.uniform(-1, 1) for _ in "dt"] for _ in range(count)] for _ in range(steps)], np.float32)


@pytest.mark.parametrize("name", TRACKS)
def test_declaration_and_trips_of_a_track_are_frozen(name: str) -> None:
    """As they were declared when they were frozen, with four keys of other names and two more options."""
    record = {key.replace("trip", "task"): value for key, value in TRACKS[name].record().items()}
    record = json.dumps(record | {"signal_km": None, "task_seed": SEED}, sort_keys=True)
    record = record.replace('"elapsed_steps"', '"step_count"').replace('"leg"', '"move"')
    assert hashlib.sha256(record.encode()).hexdigest()[:16] == TRACK_DIGESTS[name][0], NEW_VERSION


@pytest.mark.parametrize("name", TRACKS)
def test_readings_of_a_track_are_frozen(name: str) -> None:
    """What four vehicles read in 8 legs that do not depend on it, and the accuracy that they know, at each level."""
    track, parts = TRACKS[name], []
    for errors in track.errors.values():
        flight = track.flight(errors, num_envs=4)
        legs = iter(torch.from_numpy((actions(4, 8) + FIRST) * SIZE).float())

        def act(seen, legs=legs, declares=flight.base.scenario.declared):
            return seen.set("action", torch.nn.functional.pad(next(legs), (0, int(declares)), value=-1))

        flight.base.max_steps = 8
        after = evaluation_rollout(flight.env, act)["next"]
        values = [after[key] for key in (*PUBLIC_KEYS, "position", "success")]
        values += [after.get(key, torch.zeros_like(after["field"])) for key in STD_KEYS]
        parts.append(torch.cat([value.double().nan_to_num(posinf=-1) for value in values], -1).flatten(0, -2))
    assert digest(torch.cat(parts), digits=4)[:16] == TRACK_DIGESTS[name][1], NEW_VERSION


@pytest.mark.parametrize("name", TRIP_SETS)
def test_trip_sets_are_frozen(name: str) -> None:
    assert digest(torch.cat(named_trips(name)[:2], -1))[:16] == SETS[name], NEW_VERSION


def test_the_trainings_have_as_many_planets_as_ever() -> None:
    """Tests have fewer."""
    assert PLANET_REGIONS == 1024, NEW_VERSION


@pytest.mark.parametrize("name", IDS)
def test_a_task_that_changes_gets_a_new_version(name: str) -> None:
    """The message of a failure has the digest of the new version."""
    raw = NAMED_TASKS[task_name(name)].make(8, seed=0, observation="dict", scale_actions=False)
    begin = raw.reset()
    after = raw.step(begin.clone().set("action", torch.tensor([[20.0, 0.5]]).expand(8, 2)))["next"]
    keys = ["field", "target_field", "position", "target_position", "done", *{*begin.keys()} & {"no_go_areas"}]
    rows = torch.cat([state[key].double() for state in (begin, after) for key in keys], -1)
    envs = gymnasium.make_vec(name, num_envs=8, autoreset_mode="SameStep")
    envs.reset(seed=0)
    seen = [np.concatenate([(out := envs.step(action))[0], out[1][:, None]], 1) for action in actions(8, 10)]
    mean = np.stack(seen).mean((0, 1), dtype=float)
    found = digest(rows, digits=4)[:16], round(float(mean @ range(1, 1 + len(mean))), 3)
    kept, number = TASK_DIGESTS.get(name, ("", 0.0))
    assert found == (kept, pytest.approx(number, abs=2e-3)), f"give the task a new version, {found}"
