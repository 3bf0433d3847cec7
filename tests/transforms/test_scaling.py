"""Min-max scaling: values, bounds, and what is stored of them."""

from __future__ import annotations

import math

import pytest
import torch
from support.errors import nav
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import PendulumEnv, TransformedEnv

from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.envs.regions import Region
from magrl.transforms import MinMaxNorm

DTYPES = [torch.float32, torch.float64]


def minmax_nav() -> MinMaxNorm:
    return MinMaxNorm(["field", "move"], ["f", "m"], ["action"])


def elsewhere(norm: MinMaxNorm) -> TransformedEnv:
    return TransformedEnv(GeomagneticNavEnv(Scenario(region=Region((30, 40), (0, 10))), num_envs=3, seed=0), norm)


def test_env_values_come_from_the_spec_bounds() -> None:
    env = TransformedEnv(nav(5), MinMaxNorm(["field", "move"], ["f", "m"]))
    td = env.rollout(4)
    spec = env.base_env.observation_spec["field"].space
    low, high = spec.low[0], spec.high[0]
    assert low.shape == (3,)
    torch.testing.assert_close((td["f"] + 1) / 2 * (high - low) + low, td["field"], rtol=1e-5, atol=1e-3)
    distance, turn = td["next", "move"].unbind(-1)
    expected = torch.stack((distance / 25 - 1, turn / (math.pi / 2)), -1)
    torch.testing.assert_close(td["next", "m"], expected, rtol=1e-6, atol=1e-6)


def test_env_gets_physical_actions_and_the_data_keep_scaled_ones() -> None:
    env = TransformedEnv(nav(3), MinMaxNorm([], in_keys_inv=["action"]))
    scaled = torch.tensor([[-1.0, -1.0], [0.0, 0.5], [1.0, 1.0]])
    step = env.step(env.reset().set("action", scaled.clone()))
    assert torch.equal(step["action"], scaled)
    physical = torch.tensor([[0.0, -math.pi / 2], [25.0, math.pi / 4], [50.0, math.pi / 2]])
    torch.testing.assert_close(step["next", "move"], physical, rtol=1e-6, atol=0)


def test_state_scaled_both_ways_leaves_the_env_as_it_was() -> None:
    """A stateless env that reads its state back: scaled on the way out, physical again on the way in."""
    keys = ["th", "thdot"]
    env = TransformedEnv(PendulumEnv(seed=0), MinMaxNorm(keys, in_keys_inv=keys))
    scaled, plain = (
        e.rollout(30, lambda td: td.set("action", torch.tensor([0.5]))) for e in (env, PendulumEnv(seed=0))
    )
    torch.testing.assert_close(scaled["next", "reward"], plain["next", "reward"], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(scaled["th"] * math.pi, plain["th"], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(scaled["thdot"] * 8, plain["thdot"], rtol=1e-4, atol=1e-4)


def test_buffer_stores_physical_actions_and_samples_scaled_ones() -> None:
    norm = MinMaxNorm(["action"], ["scaled"], ["action"], bounds={"action": (0.0, 50.0)})
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(4), batch_size=4)
    rb.append_transform(norm)
    scaled = torch.tensor([[-1.0], [-0.5], [0.0], [1.0]])
    rb.extend(TensorDict(action=scaled, row=torch.arange(4), batch_size=4))
    assert rb._storage.get(slice(None))["action"].flatten().tolist() == [0.0, 12.5, 25.0, 50.0]
    sample = rb.sample()
    assert torch.equal(sample["scaled"], scaled[sample["row"]])


@pytest.mark.parametrize("interval", [(-1.0, 1.0), (0.0, 1.0), (-2.0, 6.0)])
@pytest.mark.parametrize("dtype", DTYPES)
def test_round_trip_is_exact_at_both_ends(dtype: torch.dtype, interval: tuple[float, float]) -> None:
    draws = torch.randn(1000, 2) * 10.0 ** torch.randint(-3, 5, (1000, 1))
    low, high = draws.amin(-1).to(dtype), draws.amax(-1).to(dtype)
    norm = MinMaxNorm(["x"], bounds={"x": (low, high)}, interval=interval)
    for end, value in zip(interval, (low, high), strict=True):
        assert (norm.normalize("x", value) == end).all()
        assert torch.equal(norm.denormalize("x", torch.full_like(value, end)), value)


def test_beyond_the_bounds_the_line_goes_on() -> None:
    norm = MinMaxNorm(["x"], bounds={"x": (0.0, 50.0)})
    value, scaled = torch.tensor([-50.0, 75.0, 1000.0]), torch.tensor([-3.0, 2.0, 39.0])
    torch.testing.assert_close(norm.normalize("x", value), scaled)
    torch.testing.assert_close(norm.denormalize("x", scaled), value)


def test_bounds_given_as_numbers_are_as_exact_as_the_data() -> None:
    norm = MinMaxNorm(["x"], bounds={"x": (0.1, 0.7)})
    value = torch.tensor([0.1, 0.4, 0.7], dtype=torch.float64)
    expected = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(norm.normalize("x", value), expected, rtol=0, atol=1e-12)


def test_loaded_bounds_are_kept_when_attached_elsewhere() -> None:
    """A policy goes on reading what it was trained on, in another region too."""
    env = TransformedEnv(nav(2), minmax_nav())
    env.rollout(1)
    norm = minmax_nav()
    norm.load_state_dict(env.transform.state_dict())
    there = elsewhere(norm)
    there.rollout(1)
    assert torch.equal(there.transform.low_0, env.transform.low_0)


def test_an_unattached_clone_takes_the_bounds_of_its_own_env() -> None:
    norm = MinMaxNorm(["field"], ["f"])
    other = norm.clone()
    first = TransformedEnv(nav(2), norm)
    second = elsewhere(other)
    for env in (first, second):
        space = env.base_env.observation_spec["field"].space
        assert env.reset()["f"].abs().max() <= 1
        assert torch.equal(env.transform.low_0, space.low[0])


def test_a_state_dict_loads_where_there_is_no_env() -> None:
    """Whatever the number of vehicles."""
    env, few = TransformedEnv(nav(4), minmax_nav()), TransformedEnv(nav(1), minmax_nav())
    td, norm = env.rollout(2), minmax_nav()
    norm.load_state_dict(few.transform.state_dict())
    alone = norm(td.exclude("f", "m"))
    assert torch.equal(alone["f"], td["f"])
    assert torch.equal(norm.inv(td)["action"], td["next", "move"])


def test_bounds_that_are_not_known() -> None:
    with pytest.raises(ValueError, match=r"no bounds for 'x': give bounds=\{'x': \(low, high\)\}"):
        MinMaxNorm(["x"])(TensorDict(x=torch.zeros(1)))
    with pytest.raises(ValueError, match="no bounds for 'objective'"):
        _ = TransformedEnv(nav(), MinMaxNorm(["objective"], ["o"])).specs
    with pytest.raises(ValueError, match=r"does not scale 'y': its keys are \['x'\]"):
        MinMaxNorm(["x"]).normalize("y", torch.zeros(1))
    with pytest.raises(KeyError, match="MinMaxNorm reads 'nope'"):
        _ = TransformedEnv(nav(), MinMaxNorm(["nope"], ["y"])).specs


def test_bounds_of_another_size_name_the_remedy() -> None:
    base = nav(4, arrival="declared")
    view = base.observation_view()
    norm = MinMaxNorm(["x"], bounds={"x": (torch.zeros(2), torch.ones(2))})
    with pytest.raises(ValueError, match=r"shape \(2,\) for 'x', which has \(4, 3\)$"):
        norm(TensorDict(x=torch.zeros(4, 3)))
    with pytest.raises(ValueError, match=r"shape \(2,\) for 'action', which has \(4, 3\): view.*declared=True"):
        _ = TransformedEnv(base, view.action_transform()).specs
    assert TransformedEnv(nav(4, arrival="declared"), view.action_transform(declared=True)).action_spec.shape == (4, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bounds": {"x": (2.0, 1.0)}}, "'x'.*2.0.*1.0"),
        ({"bounds": {"x": (0.0, math.inf)}}, "'x'.*0.0.*inf"),
        ({"bounds": {"x": (torch.zeros(2), torch.ones(3))}}, r"'x' must .*have one shape, got \(2,\) and \(3,\)"),
        ({"bounds": {"z": (0.0, 1.0)}}, r"'z'.*\['x'\]"),
        ({"out_keys": ["y", "z"]}, r"\['x'\].*\['y', 'z'\]"),
    ],
)
def test_bad_options(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MinMaxNorm(["x"], **options)
