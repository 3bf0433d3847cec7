"""Base of the errors: random numbers of seed, vehicle, episode and step, and what depends on them."""

import math
from functools import partial

import pytest
import torch
from support.errors import STD, actions, all_errors, assert_same, every_error, flown, nav, under
from tensordict import TensorDict
from torchrl.envs import EnvBase, SerialEnv

from magrl.envs.random_regions import planet_scenario
from magrl.errors import TRUE_KEYS, KnownPlace, MagneticNorth, NorthReferenceError, SensorErrors, TargetErrors
from magrl.errors.base import gauss_markov
from magrl.geodesy import geodesic
from magrl.named_tasks import anywhere_env
from magrl.random_numbers import advanced, counter_stream
from magrl.sensor_std import STD_KEYS

ERRORS = {"motion_error": 0, "weather_clock": 0, "sensor_error": 6, "north_error": 0}
"""Keys of the errors of an episode, and how many of their first numbers change with each reading."""


def test_errors_are_those_of_the_seeds_and_of_each_vehicle() -> None:
    """Whatever the batch; another seed of the errors or of the environment, vehicle or episode has others."""
    steps, env = actions(4, 3), all_errors(3)
    three = flown(env, steps)
    for one, other in zip(three, flown(all_errors(3), steps), strict=True):
        assert_same(one, other)
    two, again, other = flown(all_errors(2), steps[:, :2]), env.reset(), all_errors(3, seed=1).reset()
    env.set_seed(1)
    reseeded = env.reset()
    for key, changing in ERRORS.items():
        torch.testing.assert_close(two[-1][key], three[-1][key][:2], rtol=1e-4, atol=1e-4)
        first = three[0][key][:, changing:]
        for different in (*(state[key][:, changing:] for state in (again, other, reseeded)), first.roll(1, 0)):
            assert not (different == first).all(-1).any(), key
    env.set_seed(0)
    assert_same(env.reset(), three[0])


def test_numbers_are_those_of_the_counters() -> None:
    env = under(SensorErrors(STD, seed=7), num_envs=3)
    for episode in range(2):
        counters = torch.stack((torch.arange(3), torch.full((3,), episode)), -1)
        of_episode = torch.stack((counter_stream(0, counters), torch.full((3,), 2)), -1)
        for reading, state in enumerate(flown(env, actions(2, 3))):
            expected = advanced(counter_stream(7, of_episode), 6 + 7 * reading)
            assert torch.equal(state["sensor_stream"], expected.unsqueeze(-1))


def test_workers_have_noise_of_their_own() -> None:
    """Whoever makes and seeds the environments: all levels of noise differ, and a seed repeats them."""
    scenario = planet_scenario(1, seed=0, distance_range_km=(300, 500))
    make = partial(anywhere_env, max_steps=5, observation=["sensor_std"], scenario=scenario)

    def levels(env: EnvBase, seed: int | None) -> set[float]:
        if seed is not None:
            env.set_seed(seed)
        return {level for _ in range(2) for level in env.reset()["sensor_std"][..., 0].flatten().tolist() if level}

    seeded = [SerialEnv(2, [partial(make, seed=seed + k) for k in range(2)]) for seed in (0, 2)]
    batch = SerialEnv(2, make)
    found = [levels(batch, seed) for seed in (0, 0, 1)]
    for first, again, other in (found, [levels(seeded[0], None)] * 2 + [levels(seeded[1], None)]):
        assert len(first) >= 2  # 15 % of the 6 levels are 0
        assert first == again
        assert not first & other


def test_accuracy_adds_up_and_the_first_error_keeps_the_truth() -> None:
    """At each step once: sqrt(0.3^2 + 0.4^2) = 0.5."""
    env = under(SensorErrors((0.3, 0.1, 5.0)), NorthReferenceError(0.4, random_deg=0.4, fixed=True), num_envs=2000)
    for state, true in zip(flown(env, actions(4, 2000)), flown(nav(2000), actions(4, 2000)), strict=True):
        torch.testing.assert_close(state["sensor_std"][0], torch.tensor([0.5, 0.1, 5.0]))
        torch.testing.assert_close(state["bias_std"][0], torch.tensor([0.4, 0.0, 0.0]))
        assert torch.equal(state["true_field"], true["field"])
        error = state["field"] - true["field"] - torch.tensor([-0.4, 0.0, 0.0])
        torch.testing.assert_close(error.std(0), torch.tensor([0.5, 0.1, 5.0]), rtol=0.06, atol=0)


def test_a_known_place_has_its_root_mean_square_error() -> None:
    state = under(KnownPlace(5.0, 2.0), num_envs=4000).reset()
    for end, expected in (("start", 5.0), ("target", 2.0)):
        apart, _ = geodesic(*state[f"{end}_place"].mT, *state[f"{end}_position"].mT)
        assert apart.square().mean().sqrt().item() == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("north", [False, True])
def test_elements_at_the_destination_have_one_error_in_an_episode_and_the_episode_is_as_before(north: bool) -> None:
    """Whether D is measured or not; arrival and objective are the true ones."""
    compass, error = [MagneticNorth(), MagneticNorth()], TargetErrors((0.1, 0.05, 30.0))
    env, plain = (under(*compass[k : k + north], *[error][k:], num_envs=2000) for k in (0, 1))
    states, others = (flown(one, actions(3, 2000)) for one in (env, plain))
    error = states[0]["target_field"] - others[0]["target_field"]
    torch.testing.assert_close(error.std(0), torch.tensor([0.1, 0.05, 30.0]), rtol=0.06, atol=0)
    assert error.mean(0).abs().less(torch.tensor([0.01, 0.005, 3.0])).all()
    for state, other in zip(states, others, strict=True):
        assert torch.equal(state["target_field"], states[0]["target_field"])
        assert torch.equal(state["exact_target_field"], other["target_field"])
        assert_same(other.exclude("target_field"), state)


def test_true_keys_are_those_that_are_written() -> None:
    keys = {key for env in (all_errors(), under(MagneticNorth(), TargetErrors())) for key in env.reset().keys()}  # noqa: SIM118
    assert keys - set(nav(drift_km=0.0).reset().keys()) - set(STD_KEYS) == set(TRUE_KEYS)


def test_data_without_an_environment() -> None:
    """An episode begins in each row; a transition is a step from the state at its root."""
    env = all_errors(3)
    first = nav(3).reset()
    assert_same(every_error()(first.clone()), env.reset())
    noise, north = SensorErrors(STD), NorthReferenceError(0.5, 0.3, 0.2, drift_length_km=100.0)
    steps = flown(under(noise.clone(), north.clone(), num_envs=3), actions(1, 3))
    plain = nav(3)
    taken = plain.step(steps[0].clone().set("heading", steps[0]["true_heading"]).set("action", actions(1, 3)[0]))
    after = north(noise(steps[0].clone().set("next", taken["next"])))["next"]
    for key in ("field", "heading", "true_field", "north_error"):
        assert torch.equal(after[key], steps[1][key]), key


def test_an_inclination_beyond_the_vertical_is_read_as_by_a_magnetometer() -> None:
    """I of 91 degrees is 89 degrees, with the horizontal field reversed."""
    errors = SensorErrors(bias=(0.0, 2.0, 0.0), fixed=True)
    true = torch.tensor([[170.0, 89.0, 900.0], [-20.0, 89.0, 900.0], [10.0, 80.0, 900.0], [10.0, -92.0, 900.0]])
    read = torch.tensor([[-10.0, 89.0, 900.0], [160.0, 89.0, 900.0], [10.0, 82.0, 900.0], [10.0, -90.0, 900.0]])
    state = errors(TensorDict({"field": true, "leg": torch.zeros(4, 2), "heading": torch.zeros(4, 1)}, 4))
    torch.testing.assert_close(state["field"], read)
    noisy = SensorErrors((0.0, 5.0, 0.0), in_keys=["field"])(TensorDict({"field": true[:1].expand(500, 3)}, 500))[
        "field"
    ]
    folded = noisy[:, 0] == -10
    assert 100 < folded.sum() < 400
    assert (noisy[:, 1] <= 90).all()


def test_gauss_markov_does_not_depend_on_the_steps() -> None:
    draw = torch.Generator().manual_seed(0)
    start = torch.full((100_000,), 2.0, dtype=torch.float64)
    once, first, second = torch.randn(3, 100_000, generator=draw, dtype=torch.float64)
    one = gauss_markov(start, 0.5, 30.0, 100.0, once)
    two = gauss_markov(gauss_markov(start, 0.5, 10.0, 100.0, first), 0.5, 20.0, 100.0, second)
    for value in (one, two):
        assert value.mean().item() == pytest.approx(2 * math.exp(-0.3), abs=0.01)
        assert value.std().item() == pytest.approx(0.5 * math.sqrt(1 - math.exp(-0.6)), rel=0.01)
    assert torch.equal(gauss_markov(start, 0.5, math.inf, 100.0, once), 0.5 * once)


def test_bad_shapes_and_keys() -> None:
    with pytest.raises(ValueError, match=r"SensorErrors reads 'field' as \(\.\.\., 2\), got \(2, 3\)"):
        _ = under(SensorErrors((1.0, 1.0))).specs
    with pytest.raises(ValueError, match="would overwrite 'target_field', which the environment reads back"):
        _ = under(SensorErrors(STD, in_keys=["target_field"], out_keys=["target_field"])).specs
    with pytest.raises(TypeError, match="SensorErrors has no option foo"):
        SensorErrors(foo=1)
