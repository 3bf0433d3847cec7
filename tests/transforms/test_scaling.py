"""Min-max scaling: values, bounds, and what is stored of them."""

import math
from collections.abc import Callable

import pytest
import torch
from support.errors import nav
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import PendulumEnv, TransformedEnv

from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.envs.regions import Region
from magrl.transforms import MinMaxNorm


def minmax_nav() -> MinMaxNorm:
    return MinMaxNorm(["field", "leg"], ["f", "m"], ["action"])


def test_env_values_come_from_the_spec_bounds() -> None:
    env = TransformedEnv(nav(5), MinMaxNorm(["field", "leg"], ["f", "m"]))
    td = env.rollout(4)
    spec = env.base_env.observation_spec["field"].space
    low, high = spec.low[0], spec.high[0]
    assert low.shape == (3,)
    torch.testing.assert_close((td["f"] + 1) / 2 * (high - low) + low, td["field"], rtol=1e-5, atol=1e-3)
    distance, turn = td["next", "leg"].unbind(-1)
    expected = torch.stack((distance / 25 - 1, turn / (math.pi / 2)), -1)
    torch.testing.assert_close(td["next", "m"], expected, rtol=1e-6, atol=1e-6)


def test_env_gets_physical_actions_and_the_data_keep_scaled_ones() -> None:
    env = TransformedEnv(nav(3), MinMaxNorm([], in_keys_inv=["action"]))
    scaled = torch.tensor([[-1.0, -1.0], [0.0, 0.5], [1.0, 1.0]])
    step = env.step(env.reset().set("action", scaled.clone()))
    assert torch.equal(step["action"], scaled)
    physical = torch.tensor([[0.0, -math.pi / 2], [25.0, math.pi / 4], [50.0, math.pi / 2]])
    torch.testing.assert_close(step["next", "leg"], physical, rtol=1e-6, atol=0)


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


@pytest.mark.parametrize("name", ["scaled", ("agents", "action")], ids=str)
def test_buffer_stores_physical_actions_and_samples_scaled_ones(name: NestedKey) -> None:
    key = ("agents", "action")
    norm = MinMaxNorm([key], [name], [key], bounds={key: (0.0, 50.0)})
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(4), batch_size=4)
    rb.append_transform(norm)
    scaled = torch.tensor([[-1.0], [-0.5], [0.0], [1.0]])
    rb.extend(TensorDict(row=torch.arange(4), batch_size=4).set(key, scaled))
    assert rb._storage.get(slice(None))[key].flatten().tolist() == [0.0, 12.5, 25.0, 50.0]
    sample = rb.sample()
    assert torch.equal(sample[name], scaled[sample["row"]])


def test_a_buffer_scales_what_follows_by_the_same_bounds() -> None:
    """Of a nested key, too, and unless what follows has bounds of its own."""
    keys = ["x", ("a", "y"), "z", ("next", "x"), ("next", "a", "y"), ("next", "z")]
    bounds = {"x": (0.0, 4.0), ("a", "y"): (0.0, 8.0), ("next", "z"): (0.0, 2.0), "z": (0.0, 16.0)}
    rb = TensorDictReplayBuffer(storage=LazyTensorStorage(1), batch_size=1, transform=MinMaxNorm(keys, bounds=bounds))
    values = TensorDict(x=torch.tensor([2.0]), a=TensorDict(y=torch.tensor([2.0])), z=torch.tensor([2.0]))
    rb.extend(values.clone().set("next", values).auto_batch_size_())
    sample = rb.sample()
    assert [float(sample[key]) for key in keys] == [0.0, -0.5, -0.75, 0.0, -0.5, 1.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_round_trip_is_exact_at_both_ends(dtype: torch.dtype) -> None:
    """And bounds that are given as numbers are as exact as the data."""
    draws = torch.randn(1000, 2) * 10.0 ** torch.randint(-3, 5, (1000, 1))
    low, high = draws.amin(-1).to(dtype), draws.amax(-1).to(dtype)
    for interval in ((-1.0, 1.0), (0.0, 1.0), (-2.0, 6.0)):
        norm = MinMaxNorm(["x"], bounds={"x": (low, high)}, interval=interval)
        for end, value in zip(interval, (low, high), strict=True):
            assert (norm.normalize("x", value) == end).all()
            assert torch.equal(norm.denormalize("x", torch.full_like(value, end)), value)
    scaled = MinMaxNorm(["x"], bounds={"x": (0.1, 0.7)}).normalize("x", torch.tensor([0.1, 0.4, 0.7], dtype=dtype))
    assert (scaled - torch.tensor([-1.0, 0.0, 1.0])).abs().max() < 4 * torch.finfo(dtype).eps


def test_loaded_bounds_are_kept_elsewhere_and_those_of_a_clone_are_of_its_own_env() -> None:
    """A policy goes on reading what it was trained on, in another region, number of vehicles, or without any."""
    norm = minmax_nav()
    other, alone, env = norm.clone(), norm.clone(), TransformedEnv(nav(4), norm)
    td = env.rollout(2)
    loaded = minmax_nav()
    for each in (loaded, alone):
        each.load_state_dict(norm.state_dict())
    assert torch.equal(alone(td.exclude("f", "m"))["f"], td["f"])
    assert torch.equal(alone.denormalize("action", td["action"]), td["next", "leg"])
    for part in (loaded, other):
        base = GeomagneticNavEnv(Scenario(region=Region((30, 40), (0, 10))), num_envs=3, seed=0)
        assert (TransformedEnv(base, part).reset()["f"].abs().max() <= 1) == (part is other)
        low = (env if part is loaded else part.parent).base_env.observation_spec["field"].space.low[0]
        assert torch.equal(part.low_0, low)


def action_transform(**declared: bool) -> TransformedEnv:
    base = nav(4, arrival="declared")
    return TransformedEnv(base, base.observation_view().action_transform(**declared))


def test_an_action_may_declare() -> None:
    assert action_transform(declared=True).action_spec.shape == (4, 3)


TWO = (torch.zeros(2), torch.ones(2))
MISTAKES: dict[str, Callable[[], object]] = {
    r"no bounds for 'x': give bounds=\{'x': \(low, high\)\}": lambda: MinMaxNorm(["x"])(TensorDict(x=torch.zeros(1))),
    "no bounds for 'objective'": lambda: TransformedEnv(nav(), MinMaxNorm(["objective"], ["o"])).specs,
    r"does not scale 'y': its keys are \['x'\]": lambda: MinMaxNorm(["x"]).normalize("y", torch.zeros(1)),
    r"shape \(2,\) for 'x', which has \(4, 3\)$": lambda: MinMaxNorm(["x"], bounds={"x": TWO})(
        TensorDict(x=torch.zeros(4, 3))
    ),
    r"shape \(2,\) for 'action', which has \(4, 3\): view.*declared=True": lambda: action_transform().specs,
    "'x'.*2.0.*1.0": lambda: MinMaxNorm(["x"], bounds={"x": (2.0, 1.0)}),
    "'x'.*0.0.*inf": lambda: MinMaxNorm(["x"], bounds={"x": (0.0, math.inf)}),
    r"'x' must .*have one shape, got \(2,\) and \(3,\)": lambda: MinMaxNorm(
        ["x"], bounds={"x": (torch.zeros(2), torch.ones(3))}
    ),
    r"'z'.*\['x'\]": lambda: MinMaxNorm(["x"], bounds={"z": (0.0, 1.0)}),
    r"store \['x'\] in units": lambda: MinMaxNorm([], in_keys_inv=["x"]).inv(TensorDict()),
    r"\['x'\].*\['y', 'z'\]": lambda: MinMaxNorm(["x"], ["y", "z"]),
}


@pytest.mark.parametrize("message", MISTAKES)
def test_mistakes(message: str) -> None:
    with pytest.raises((ValueError, KeyError), match=message):
        MISTAKES[message]()
