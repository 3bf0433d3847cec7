"""The track in the TensorDict: that of the pure functions, its specs and its state; declarations from it."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from support.environments import parallel
from support.tracks import STD
from tensordict import TensorDictBase
from torch import Tensor
from torch.utils._pytree import tree_leaves
from torchrl.envs import Compose, RenameTransform, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from magrl.envs import GeomagneticNavEnv
from magrl.evaluation import evaluation_rollout
from magrl.field import elements_gradient_at
from magrl.geodesy import geodesic
from magrl.navigators import Declaring, Secant
from magrl.tracking import Rules, Track, advance, begin, observation
from magrl.transforms import DeclareArrival, KnownPlace, SensorErrors, TrackField
from magrl.transforms.track import KNOWN_KEYS, READ_KEYS, known_keys, reading_of, track_of

BIAS = (0.5, 0.3, 60.0)
close = partial(torch.testing.assert_close, equal_nan=True)
RULES = Rules(range_km=350.0, max_steps=5)


def tracked(num_envs: int = 4, *errors, rules: Rules = RULES, **options: object) -> TransformedEnv:
    """The environment with errors of sensors, and with what its rules and errors make known."""
    env = TransformedEnv(GeomagneticNavEnv(num_envs=num_envs, **{"seed": 0, "max_steps": 5} | options))
    for error in errors:
        env.append_transform(error)
    env.append_transform(TrackField(rules, known_keys(env.observation_spec)))
    return env


def erring(num_envs: int = 4, **options: object) -> TransformedEnv:
    return tracked(num_envs, SensorErrors(STD, bias=BIAS, seed=3), KnownPlace(5.0), **options)


def declaring(num_envs: int = 2) -> TransformedEnv:
    rules = RULES.replace(arrival="declared")
    env = tracked(num_envs, SensorErrors(STD, bias=BIAS, seed=3), rules=rules, arrival="declared")
    return env.append_transform(DeclareArrival(rules, known_keys(env.observation_spec))) or env


def flown(env: TransformedEnv, steps: int = 5) -> TensorDictBase:
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


def assert_equal(found: Track | list[Tensor], expected: Track | list[Tensor]) -> None:
    """Bit for bit; an unknown coordinate of the place is NaN."""
    close(tree_leaves(found), tree_leaves(expected), rtol=0, atol=0)


@pytest.mark.parametrize("make", [tracked, erring])
def test_the_track_is_that_of_the_pure_functions(make) -> None:
    """Bit for bit over 7 steps, in which each vehicle begins twice again."""
    rollout, before = flown(make(start_heading="random", max_steps=3), 7), None
    for row in rollout.unbind(1):
        now, after, found = reading_of(row), reading_of(row["next"]), track_of(row["track"])
        if (now.step == 0).all():
            before = begin(RULES, now)
        assert_equal(found, before)
        before = advance(RULES, found.state, after)
        assert_equal(track_of(row["next", "track"]), before)
        assert torch.equal(row["next", "observation"], observation(RULES, before, after))
    assert (rollout["elapsed_steps"] == 0).sum() == 12


def test_specs_hold_in_other_processes() -> None:
    env = parallel(declaring)
    try:
        check_env_specs(env, break_when_any_done="both")
        assert env.action_spec.shape[-1] == 2
    finally:
        env.close()


def test_a_step_depends_on_what_is_in_the_tensordict_alone() -> None:
    """As stored data are stepped again, by another environment and by the transform itself."""
    rollout = flown(erring())
    transform = TrackField(RULES, [key for key in KNOWN_KEYS if key in rollout.keys()])  # noqa: SIM118
    known = rollout.select(("track", "state"), *(("next", key) for key in transform.in_keys))
    again = transform(known)["next", "track"]
    close(tree_leaves(track_of(again)), tree_leaves(track_of(rollout["next", "track"])), rtol=1e-6, atol=1e-6)
    state = step_mdp(rollout[:, -2].clone()).set("action", torch.tensor([30.0, 0.5]).expand(4, 2))
    one, two = (tracked().step(state.clone())["next"] for _ in range(2))
    assert_equal(track_of(one["track"]), track_of(two["track"]))
    with pytest.raises(KeyError, match=r"TrackField reads its state .*track.*state.*mean"):
        tracked().step(state.exclude("track"))


def test_keys_may_have_other_names() -> None:
    renamed = RenameTransform(["field"], ["reading"], create_copy=True)
    track = TrackField(RULES, in_keys=["reading", *READ_KEYS[1:]], out_keys=["map", "seen"])
    env = TransformedEnv(GeomagneticNavEnv(num_envs=4, seed=0, max_steps=5), Compose(renamed, track))
    torch.testing.assert_close(flown(env)["next", "seen"], flown(tracked())["next", "observation"])


def test_without_noise_it_finds_gradient_and_destination() -> None:
    after = flown(tracked(64, rules=Rules(), max_steps=50), 12)[:, -1]["next"]
    env = GeomagneticNavEnv(num_envs=64, seed=0)
    true, local = elements_gradient_at(env.field, after["position"]), after["track", "local"]
    error = (local["gradient"] - true) / torch.tensor((0.004, 0.015, 4.0)).unsqueeze(-1)
    assert error.norm(dim=(-2, -1)).median() < 0.05
    way_km, bearing = geodesic(*after["position"].T, *after["target_position"].T)
    true_way = (way_km * torch.stack((bearing.cos(), bearing.sin()))).T.float()
    assert ((after["track", "way", "displacement"] - true_way).norm(dim=-1) / way_km).median() < 0.05


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"in_keys": ["move", *READ_KEYS[1:]]}, r"reads 'move' as .*3\), got \(3, 2\)"),
        ({"optional": ["readings"]}, "optional must be one of 'sensor_std', .*'readings'"),
    ],
)
def test_wrong_keys_are_named(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _ = TransformedEnv(GeomagneticNavEnv(num_envs=3, seed=0), TrackField(RULES, **options)).specs


# Declarations


def test_the_transform_declares_as_the_navigator() -> None:
    base = GeomagneticNavEnv(num_envs=20, seed=0, arrival="declared", max_steps=12)
    plain = TransformedEnv(base, SensorErrors(STD, bias=BIAS, seed=3))
    rules = RULES.replace(arrival="declared", max_steps=12)
    wanted = evaluation_rollout(plain, Declaring(Secant(), rules))
    env = tracked(20, SensorErrors(STD, bias=BIAS, seed=3), rules=rules, arrival="declared", max_steps=12)
    env.append_transform(DeclareArrival(rules, known_keys(env.observation_spec)))
    found = evaluation_rollout(env, Secant())
    assert torch.equal(found["next", "position"], wanted["next", "position"])
    assert torch.equal(found["next", "declared"], wanted["next", "declared"])
    assert found["next", "declared"].any()


def test_declaring_needs_a_third_number_and_a_track() -> None:
    rules = RULES.replace(arrival="declared")
    with pytest.raises(ValueError, match=r"third number .*\(2, 2\)"):
        _ = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), DeclareArrival(rules)).specs
    env = GeomagneticNavEnv(num_envs=2, seed=0, arrival="declared")
    with pytest.raises(KeyError, match=r"reads 'track', .*add a TrackField"):
        _ = TransformedEnv(env, DeclareArrival(rules)).specs
