"""Sensor noise: TorchRL's conformance list, the numbers drawn, and what depends on the noise and what does not."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial

import pytest
import torch
from scipy import stats
from support.conformance import Conformance
from support.environments import PlaneEnv, nested, parallel
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from magrl.agents import FieldPolicy
from magrl.agents.policy import PolicyConfig
from magrl.counters import advanced, counter_stream, split
from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.field import FieldModel
from magrl.navigators import Secant
from magrl.transforms import (
    FieldGradient,
    GradientHeading,
    MinMaxNorm,
    RandomSensorNoise,
    SensorNoise,
    sensor_levels,
    with_sensor_noise,
)

pytestmark = pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped")
STD = (0.05, 0.05, 5.0)


@cache
def field() -> FieldModel:
    return Scenario().build_field()


def nav(num_envs: int = 2, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(field=field()), num_envs=num_envs, **({"seed": 0} | options))


def noisy(num_envs: int = 2, **options: object) -> TransformedEnv:
    return TransformedEnv(nav(num_envs), SensorNoise(STD, **options))


def plane_noise() -> Transform:
    return SensorNoise((0.5, 0.0), in_keys=[nested("scent")], out_keys=[nested("smelled")], true_key=None)


def in_place_and_scaled() -> Transform:
    """The noise before other readers of the field, one of which scales it by bounds that its spec no longer has."""
    norm = MinMaxNorm(["field"], ["f"], ["action"], bounds={"field": (0.0, 4e4)})
    return Compose(FieldGradient(field()), GradientHeading(), SensorNoise(STD), norm)


CASES: dict[str, tuple[Callable[[], EnvBase], Callable[[], Transform]]] = {
    "nav": (nav, partial(SensorNoise, STD)),
    "nav without noise": (nav, partial(SensorNoise, (0.0, 0.0, 0.0))),
    "nav random": (nav, RandomSensorNoise),
    "nav chain": (nav, in_place_and_scaled),
    "plane": (partial(PlaneEnv, (3,), torch.float64), plane_noise),
    "plane scalar": (PlaneEnv, plane_noise),
}
cases = pytest.mark.parametrize(("base", "make"), CASES.values(), ids=CASES.keys())


@cases
class TestConformance(Conformance):
    """Of each case."""


@pytest.mark.parametrize("inside", [True, False])
def test_parallel_env_check(inside: bool) -> None:
    """Inside each process and outside of all."""
    env = parallel(noisy) if inside else TransformedEnv(parallel(nav), SensorNoise(STD))
    try:
        check_env_specs(env)
    finally:
        env.close()


def test_a_step_in_another_process_starts_from_the_state_that_it_is_sent() -> None:
    """And not from the last one there: three steps from one state measure with the same random numbers."""
    env = parallel(noisy)
    try:
        state = env.rand_action(env.reset())
        after = [env.step(state.clone())["next", "sensor_stream"].clone() for _ in range(3)]
    finally:
        env.close()
    assert torch.equal(after[0], after[1])
    assert torch.equal(after[0], after[2])


def readings(stream: Tensor, std: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Tensor:
    """The noise of some streams, by the transform as a module."""
    zeros = torch.zeros(*stream.shape[:-1], len(std), dtype=torch.float64)
    td = TensorDict(field=zeros, sensor_std=zeros + torch.tensor(std), sensor_stream=stream)
    return SensorNoise(std)(td)["field"]


def stream_of(seed: int, vehicle: Tensor | int, episode: Tensor | int, reading: Tensor | int) -> Tensor:
    """The state of the random numbers of a reading of three elements, ``(..., 1)``."""
    rows = torch.broadcast_tensors(*(torch.as_tensor(x) for x in (vehicle, episode, reading)))
    of_vehicle = counter_stream(seed, torch.stack((rows[0], torch.ones_like(rows[0])), -1))
    return advanced(split(advanced(of_vehicle, rows[1])), 3 * rows[2]).unsqueeze(-1)


def streams(count: int, column: int = 0, seed: int = 0) -> Tensor:
    rows = [5, 5, 5]
    return stream_of(seed, *(torch.arange(count) if k == column else x for k, x in enumerate(rows)))


@pytest.mark.parametrize("column", [0, 1, 2], ids=["vehicle", "episode", "reading"])
def test_noise_is_white_and_normal_along_each_counter(column: int) -> None:
    count = 50_000
    drawn = readings(streams(count, column))
    torch.testing.assert_close(drawn.std(0), torch.ones(3, dtype=torch.float64), atol=0.008, rtol=0)
    for element in drawn.unbind(-1):
        assert stats.kstest(element, "norm").pvalue > 1e-3
    joint = torch.cat((drawn[1:], drawn[:-1]), -1)  # six columns: three elements, now and one earlier
    correlation = torch.corrcoef(joint.T) - torch.eye(6)
    assert correlation.abs().max() < 4.5 / math.sqrt(count)


def test_noise_is_finite_at_both_ends(monkeypatch) -> None:
    ends = torch.tensor([[0.0, 0.5, 1 - 2.0**-53]], dtype=torch.float64)
    monkeypatch.setattr("magrl.transforms.errors.noise.stream_uniform", lambda *_: ends)
    low, middle, high = readings(streams(1))[0].tolist()
    assert low == -high
    assert 8 < high < 9
    assert middle == pytest.approx(0, abs=1e-15)


def test_noise_of_a_row_does_not_depend_on_other_rows() -> None:
    stream = streams(1000, seed=3)
    assert torch.equal(readings(stream)[[7, 400]], readings(stream[[7, 400]]))
    assert not torch.isclose(readings(stream), readings(streams(1000, seed=4))).any()
    assert torch.equal(readings(stream, (1.0, 0.0, 2.0))[:, 1], torch.zeros(1000, dtype=torch.float64))
    torch.testing.assert_close(readings(stream, (1.0, 0.0, 2.0))[:, 2], 2 * readings(stream)[:, 2])


def test_noise_is_not_that_of_the_tasks() -> None:
    """A seed is shared with the env, whose tasks are drawn by the counters (vehicle, episode, attempt)."""
    env = noisy(2000)
    state = env.reset()
    z = (state["field"] - state["true_field"]).double() / torch.tensor(STD)
    both = torch.cat((z, state["position"], state["target_position"]), -1)
    assert torch.corrcoef(both.T)[:3, 3:].abs().max() < 4.5 / math.sqrt(2000)


def test_in_the_env_readings_are_truth_plus_noise_and_nothing_else_changes() -> None:
    plain, env = nav(400), noisy(400)
    actions = torch.rand(4, 400, 2) * torch.tensor([50.0, 1.5])
    states = [(plain.reset(), env.reset())]
    for action in actions:
        states.append(
            tuple(
                step_mdp(e.step(s.clone().set("action", action))) for e, s in zip((plain, env), states[-1], strict=True)
            )
        )
    noise = []
    for number, (true, measured) in enumerate(states):
        assert torch.equal(measured["true_field"], true["field"])
        for key in ("position", "objective", "success", "move", "target_field", "done"):
            assert torch.equal(measured[key], true[key])
        assert measured["sensor_std"].unique(dim=0).tolist() == [pytest.approx(STD)]
        assert torch.equal(measured["sensor_stream"], stream_of(0, torch.arange(400), 0, number))
        noise.append((measured["field"] - true["field"]) / torch.tensor(STD))
    torch.testing.assert_close(torch.stack(noise).std((0, 1)), torch.ones(3), atol=0.06, rtol=0)
    assert torch.corrcoef(torch.stack(noise).flatten(1)).triu(1).abs().max() < 0.15  # new at each step


def test_without_noise_the_reading_is_the_value_to_the_bit() -> None:
    env = TransformedEnv(nav(3), SensorNoise((0.0, 0.0, 0.0)))
    plain = nav(3)
    td, expected = env.rollout(3, Secant()), plain.rollout(3, Secant())
    assert torch.equal(td["field"], td["true_field"])
    assert torch.equal(td["next", "field"], expected["next", "field"])
    assert torch.equal(td["action"], expected["action"])
    base = nav(3)
    assert with_sensor_noise(base, (0.0, 0.0, 0.0)) is base
    assert isinstance(with_sensor_noise(base, (0.0, 0.0, 1.0)), TransformedEnv)


def test_guidance_before_the_noise_uses_the_truth() -> None:
    base = nav(5)
    guidance = [FieldGradient(base.field), GradientHeading()]
    plain = TransformedEnv(nav(5), Compose(FieldGradient(base.field), GradientHeading())).reset()
    state = TransformedEnv(base, Compose(*guidance, SensorNoise((1.0, 1.0, 100.0)))).reset()
    assert torch.equal(state["gradient_heading"], plain["gradient_heading"])
    assert not torch.equal(state["field"], plain["field"])


# Episodes


def test_partial_reset_starts_an_episode_and_leaves_the_others_alone() -> None:
    env = noisy(4)
    td = step_mdp(env.rollout(3, break_when_any_done=False)[:, -1])
    kept, chosen = td.clone(), torch.tensor([False, True, True, False])
    after = env.reset(td.set("_reset", chosen.unsqueeze(-1)))
    for key in ("field", "true_field", "sensor_std", "sensor_stream"):
        assert torch.equal(after[key][~chosen], kept[key][~chosen]), key
    vehicle = torch.arange(4)
    episode, reading = torch.tensor([0, 1, 1, 0]), torch.tensor([3, 0, 0, 3])
    assert torch.equal(after["sensor_stream"], stream_of(0, vehicle, episode, reading))
    assert (after["field"] != after["true_field"]).all()
    last = torch.tensor([True, True, False, False])
    again = env.reset(after.set("_reset", last.unsqueeze(-1)))
    episode, reading = torch.tensor([1, 2, 1, 0]), torch.tensor([0, 0, 0, 3])
    assert torch.equal(again["sensor_stream"], stream_of(0, vehicle, episode, reading))


def test_each_episode_has_its_noise_and_a_restart_repeats_it() -> None:
    env = noisy(3)

    def errors() -> Tensor:
        td = env.reset()
        return td["field"] - td["true_field"]

    first, second = errors(), errors()
    assert not torch.isclose(first, second, rtol=1e-3).any()
    env.transform.restart()
    env.set_seed(0)
    assert torch.equal(errors(), first)


def test_two_steps_from_one_state_measure_the_same_noise() -> None:
    """A step depends on its input alone, so that states can be stored and stepped from again."""
    env = noisy(2)
    state = env.reset().set("action", torch.tensor([[10.0, 0.1], [20.0, -0.1]]))
    one, other = env.step(state.clone())["next"], env.step(state.clone())["next"]
    assert torch.equal(one["field"], other["field"])


def test_state_holds_the_streams_of_the_next_episodes() -> None:
    """What a checkpoint saves: with it, another env goes on with the same noise."""
    env, other = noisy(3), noisy(3)
    for _ in range(3):
        env.reset()
    other.load_state_dict(env.state_dict())
    other.base_env.episode = env.base_env.episode
    assert torch.equal(env.reset()["field"], other.reset()["field"])
    empty = noisy(3)
    other.load_state_dict(empty.state_dict())
    assert torch.equal(other.reset()["sensor_stream"], stream_of(0, torch.arange(3), 0, 0))


# Levels of each episode


def test_levels_by_hand() -> None:
    #                       none  common  own factors        D poor  by
    uniform = torch.tensor(
        [
            [0.1499, 0.0, 0.5, 0.5, 0.5, 0.0, 0.5],  # perfect sensors
            [0.15, 0.5 ** (2 / 3), 0.5, 0.5, 0.5, 0.3, 0.5],  # a tenth of the largest
            [0.99, 1.0, 0.0, 1.0, 0.5, 0.9, 0.5],  # a hundredth, with factors 0.398, 2.512, 1
            [0.99, 0.0, 0.5, 0.5, 0.5, 0.29, 0.5],  # a poor north reference: 1 + 6 / 2
        ],
        dtype=torch.float64,
    )
    factor = 10**0.4
    expected = [[0, 0, 0], [0.02, 0.02, 2.0], [0.002 / factor, 0.002 * factor, 0.2], [0.8, 0.2, 20]]
    torch.testing.assert_close(sensor_levels(uniform), torch.tensor(expected, dtype=torch.float64))
    uniform[1, 1] = 0.5
    torch.testing.assert_close(sensor_levels(uniform, 1.0), torch.tensor(expected, dtype=torch.float64))


def test_random_noise_has_the_level_of_its_episode() -> None:
    env = TransformedEnv(nav(2000), RandomSensorNoise(seed=3))
    steps = [env.reset()]
    for _ in range(6):
        steps.append(step_mdp(env.step(env.rand_action(steps[-1]))))
    td = torch.stack([s.select("field", "true_field", "sensor_std") for s in steps])
    std = td["sensor_std"]
    assert torch.equal(std, std[:1].expand_as(std))
    assert (std[0] == 0).all(-1).double().mean() == pytest.approx(0.15, abs=0.03)
    silent = (std == 0).all(-1)
    assert torch.equal(td["field"][silent], td["true_field"][silent])
    loud = std[..., 2] > 0.05  # above the rounding of float32
    z = ((td["field"] - td["true_field"])[..., 2] / std[..., 2])[loud]
    assert stats.kstest(z.double(), "norm").pvalue > 1e-3
    again = env.reset()["sensor_std"]
    assert ((again != std[0]).any(-1) | (again == 0).all(-1)).double().mean() > 0.95


def test_levels_and_readings_take_different_random_numbers() -> None:
    state = TransformedEnv(nav(1000), RandomSensorNoise(lambda u: 100 + u, draws=3)).reset()
    z = (state["field"] - state["true_field"]) / state["sensor_std"]
    both = torch.cat((z, state["sensor_std"] - 100), -1)
    assert torch.corrcoef(both.T)[:3, 3:].abs().max() < 4.5 / math.sqrt(1000)


def test_errors_continue_on_another_device() -> None:
    """As after a resume: a checkpoint gives the streams on its own device."""
    env = TransformedEnv(nav(3), RandomSensorNoise(seed=3))
    env.reset()
    noise, other = env.transform, torch.device("meta")
    assert noise._next_episode(TensorDict(), torch.Size([3]), other).device == noise.streams.device == other


def test_own_levels() -> None:
    env = TransformedEnv(nav(3), RandomSensorNoise(lambda u: torch.cat((u, u + 1, 0 * u), -1), draws=1))
    std = env.reset()["sensor_std"]
    torch.testing.assert_close(std[:, 1] - std[:, 0], torch.ones(3))
    assert std[:, 2].eq(0).all()
    assert std[:, 0].unique().numel() == 3
    table = torch.eye(3)
    chosen = TransformedEnv(nav(9), RandomSensorNoise(lambda u: table[(3 * u[..., 0]).long()], draws=1))
    assert (chosen.reset()["sensor_std"].sum(1) == 1).all()


# Data without an env, and errors


def data(count: int = 6) -> TensorDict:
    stream = streams(count)
    return TensorDict(
        field=torch.ones(count, 3), sensor_std=torch.ones(count, 3), sensor_stream=stream, batch_size=[count]
    )


def test_replay_buffer_draws_the_noise_of_each_row() -> None:
    td = data().set("row", torch.arange(6))
    expected = SensorNoise((1.0, 1.0, 1.0))(td.clone())["field"]
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(6), batch_size=4)
    buffer.append_transform(SensorNoise((1.0, 1.0, 1.0)))
    buffer.extend(td)
    sample = buffer.sample()
    assert torch.equal(sample["field"], expected[sample["row"]])


def test_compiled() -> None:
    td = data()
    expected = SensorNoise((1.0, 1.0, 1.0))(td.clone())["field"]
    torch.compiler.reset()
    compiled = torch.compile(SensorNoise((1.0, 1.0, 1.0)), fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(td)["field"], expected)


@pytest.mark.parametrize("missing", ["field", "sensor_std", "sensor_stream"])
def test_a_missing_key_is_named(missing: str) -> None:
    with pytest.raises(KeyError, match=f"SensorNoise reads .*'{missing}'"):
        SensorNoise((1.0, 1.0, 1.0))(data().exclude(missing))
    tolerant = SensorNoise((1.0, 1.0, 1.0))
    tolerant.set_missing_tolerance(True)
    given = data().exclude("field")
    assert (tolerant(given.clone()) == given).all()


def test_a_step_without_the_state_of_the_numbers_is_refused() -> None:
    env = noisy()
    state = env.rand_action(env.reset())
    with pytest.raises(KeyError, match="reads 'sensor_stream', which its reset writes: step from what reset"):
        env.transform._step(state.exclude("sensor_stream"), state)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SensorNoise((0.1, -0.1, 1.0)), r"std must be .* from 0 on, .*got \(0.1, -0.1, 1.0\)"),
        (lambda: SensorNoise((0.1, math.nan, 1.0)), "std .*nan"),
        (lambda: SensorNoise(()), r"std .*\(\)"),
        (lambda: SensorNoise(0.1), "std .*0.1"),
        (lambda: SensorNoise("abc"), "std .*'abc'"),
        (lambda: SensorNoise(STD, seed=0.5), "seed .*0.5"),
        (lambda: SensorNoise(STD, in_keys=["a", "b"]), r"SensorNoise.*\['a', 'b'\]"),
        (lambda: RandomSensorNoise(draws=0), "draws .*0"),
        (lambda: RandomSensorNoise(draws=3), r"\(3,\)"),
    ],
)
def test_bad_options_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_another_number_of_elements_and_the_state_are_refused() -> None:
    with pytest.raises(ValueError, match=r"has 2 standard deviations, one for each element; 'field' is \(2, 3\)"):
        _ = TransformedEnv(nav(), SensorNoise((1.0, 1.0))).specs
    with pytest.raises(ValueError, match="would overwrite 'target_field', which the environment reads back"):
        _ = TransformedEnv(nav(), SensorNoise(STD, in_keys="target_field", out_keys="target_field")).specs
    with pytest.raises(KeyError, match="SensorNoise reads 'nope'"):
        _ = TransformedEnv(nav(), SensorNoise(STD, in_keys="nope")).specs


# Policies and evaluations


def policies(env: GeomagneticNavEnv) -> list:
    torch.manual_seed(0)
    return [Secant(), FieldPolicy(PolicyConfig(env.observation_view(), (16,)))]


@pytest.mark.parametrize("index", [0, 1], ids=["secant", "trained"])
def test_policies_read_what_is_measured_and_not_the_truth(index: int) -> None:
    """The actions do not change if the true field is scrambled, and do change if the reading is."""
    states = evaluation_rollout(noisy(4), policies(nav())[index])[:, :5]

    def actions(change: Callable[[TensorDictBase], object]) -> Tensor:
        policy, flown = policies(nav())[index], []
        for state in states.unbind(1):
            change(state := state.clone())
            flown.append(policy(state)["action"])
        return torch.stack(flown)

    plain = actions(lambda _: None)
    assert torch.equal(actions(lambda state: state["true_field"].fill_(math.nan)), plain)
    assert not torch.equal(actions(lambda state: state["field"].mul_(1.01)), plain)


def test_evaluation_flies_the_same_noise_in_every_call() -> None:
    """So that navigators are compared on equal terms, and a table does not depend on their order."""
    env = TransformedEnv(nav(50, start_heading="random"), SensorNoise(STD))
    one, other = (evaluation_rollout(env, Secant()) for _ in range(2))
    assert torch.equal(one["next", "field"], other["next", "field"])
    assert torch.equal(one["heading"][:, 0], other["heading"][:, 0])
    assert torch.equal(env.reset()["sensor_stream"], stream_of(0, torch.arange(50), 1, 0))
    perfect = evaluation_rollout(nav(50, start_heading="random"), Secant())
    assert torch.equal(one["position"][:, 0], perfect["position"][:, 0])
    noise_costs = episode_measures(perfect)["spl"].mean() - episode_measures(one)["spl"].mean()
    assert noise_costs > 0.05
