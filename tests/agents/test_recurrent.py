"""The recurrent agent: its observations, its state, the replay of slices, and its loss."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import Bounded, LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import TD3Loss as StockTD3Loss

from magrl.agents import (
    FieldPolicy,
    PolicyConfig,
    RecurrentTD3Loss,
    SoftUpdate,
    make_critic,
    make_recurrent_actor,
    recurrent_transforms,
)
from magrl.agents.recurrent import STATE_KEYS, LastMove
from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.transforms import ObservationView

CELLS = (16, 16)


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=6, seed=3, max_steps=7)


@pytest.fixture(scope="module")
def view(env) -> ObservationView:
    return env.observation_view(observe_heading=False)


@pytest.fixture
def actor(view) -> TensorDictSequential:
    torch.manual_seed(0)
    return make_recurrent_actor(view, CELLS, 8)


def make_policy(view: ObservationView, actor: TensorDictSequential | None = None) -> FieldPolicy:
    return FieldPolicy(PolicyConfig(view, CELLS, memory_size=8), actor)


def training_env(env: GeomagneticNavEnv, view: ObservationView, actor) -> TransformedEnv:
    base = GeomagneticNavEnv(Scenario(field=env.field), num_envs=6, seed=3, max_steps=7)
    return TransformedEnv(base, Compose(*recurrent_transforms(view, actor), view.action_transform()))


def make_loss(view: ObservationView, actor) -> RecurrentTD3Loss:
    critic = make_critic(view.size + 2, CELLS, observation_keys=("observation", "heading_vector"))
    loss = RecurrentTD3Loss(actor, critic, gamma=0.9, policy_noise=0.1, noise_clip=0.5)
    SoftUpdate(loss, tau=0.1)
    return loss


@pytest.fixture
def collected(env, view, actor):
    """Return an actor, 24 steps that it took in episodes of at most 7, and slices of those."""
    frames = {"frames_per_batch": 6 * 24, "total_frames": 6 * 24}
    collector = Collector(training_env(env, view, actor), actor, **frames, auto_register_policy_transforms=False)
    (steps,) = list(collector)
    collector.shutdown()
    sampler = SliceSampler(slice_len=4, end_key=("next", "done"), strict_length=False)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1000, ndim=2), sampler=sampler, batch_size=40)
    buffer.extend(steps.clone())
    return actor, steps, buffer.sample()


# Observation and state


def test_last_move() -> None:
    """A turn of 30 degrees, a third of the largest, after a move of three quarters of the longest."""
    moves = torch.tensor([[0.5, 1 / 3], [-1.0, 0.0]])
    expected = torch.tensor([[0.5, 1 / 3, math.sqrt(3) / 2, 0.5], [-1.0, 0.0, 1.0, 0.0]])
    torch.testing.assert_close(LastMove(math.pi / 2)(moves), expected)


def test_memory_is_reset_in_collected_steps(collected) -> None:
    _, steps, _ = collected
    begins = steps["is_init"].squeeze(-1)
    assert torch.equal(begins, steps["step_count"].squeeze(-1) == 0)
    assert begins.sum() > 6, "no vehicle was reset on the way"
    for key in STATE_KEYS:
        assert (steps[key][begins] == 0).all()
        assert (steps[key][~begins] != 0).any(-1).all()
        inside = ~begins[:, 1:]
        assert torch.equal(steps[key][:, 1:][inside], steps["next", key][:, :-1][inside])


def test_unrolled_slices_give_what_was_collected(collected) -> None:
    actor, _, slices = collected
    with torch.no_grad(), set_recurrent_mode(True):
        again = actor(slices.select(*actor.in_keys))
    for key in ("memory", "heading_estimate", "action"):
        torch.testing.assert_close(again[key], slices[key], rtol=0, atol=1e-6)


# Loss


def states_at_next_observations(actor, slices: TensorDict) -> list[TensorDict]:
    """Return the states at the next observations: each slice unrolled step by step from its stored state."""
    starts = slices["is_init"].squeeze(-1).nonzero().squeeze(-1).tolist()
    written = []
    for start, stop in zip(starts, [*starts[1:], len(slices)], strict=True):
        inputs = {
            key: torch.cat((slices[key][start : start + 1], slices["next", key][start:stop]))
            for key in ("observation", "move_scaled")
        }
        state = {key: slices[key][start] for key in STATE_KEYS}
        for index in range(stop - start + 1):
            inputs_now = {key: value[index] for key, value in inputs.items()}
            step = actor(TensorDict({**inputs_now, "is_init": torch.tensor([False]), **state}))
            if index:
                written.append(TensorDict(state))
            state = {key: step["next", key] for key in STATE_KEYS}
    return written


def test_loss_is_that_of_torchrl(view, collected) -> None:
    """Values and gradients, to rounding; the stock loss gets the recurrent state with which each slice continues.

    Stored states after the first step are not read, since they are of older weights.
    """
    actor, _, slices = collected
    ours = make_loss(view, actor)
    # It gives critics what the actor writes, so that the heading must pass by it
    beside = TensorDictModule(torch.nn.Identity(), ["heading_vector"], ["heading_vector"])
    spec = {"action_spec": Bounded(-1.0, 1.0, (2,)), "loss_function": "l2", "policy_noise": 0.1, "noise_clip": 0.5}
    stock = StockTD3Loss(TensorDictSequential(actor, beside), ours.qvalue_network, deactivate_vmap=True, **spec)
    stock.make_value_estimator(gamma=0.9)
    SoftUpdate(stock, tau=0.1)
    for name in ("qvalue_network_params", "target_qvalue_network_params"):
        getattr(stock, name).data.update_(getattr(ours, name).data)
    prepared, begins = slices.clone(), slices["is_init"].squeeze(-1)
    with torch.no_grad():
        unrolled = states_at_next_observations(actor, slices)
    prepared["next", "is_init"] = prepared["is_init"]
    for key in STATE_KEYS:
        states = torch.stack([step[key] for step in unrolled])
        prepared["next", key] = torch.where(begins[:, None, None], states, prepared["next", key])
        slices["next", key] = torch.randn_like(slices["next", key])

    torch.manual_seed(1)
    value, actor_value = ours.value_loss(slices.clone())[0], ours.actor_loss(slices.clone())[0]
    torch.manual_seed(1)
    with set_recurrent_mode(True):
        stock_value, stock_actor_value = stock.value_loss(prepared.clone())[0], stock.actor_loss(prepared.clone())[0]
    torch.testing.assert_close(value, stock_value)
    torch.testing.assert_close(actor_value, stock_actor_value)

    gradients = torch.autograd.grad(value, ours.critic_parameters())
    half = len(gradients) // 2
    mine = [torch.stack(pair) for pair in zip(gradients[:half], gradients[half:], strict=True)]
    theirs = list(torch.autograd.grad(stock_value, list(stock.qvalue_network_params.parameters())))
    for loss_value, loss, found in ((actor_value, ours, mine), (stock_actor_value, stock, theirs)):
        weights = [p for p in loss.actor_network_params.parameters() if p.requires_grad]
        found += torch.autograd.grad(loss_value, weights)
    for one, other in zip(mine, theirs, strict=True):
        assert one.abs().sum() > 0
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-7)


def test_gradients_reach_their_parameters_only(view, collected) -> None:
    actor, _, slices = collected
    loss = make_loss(view, actor)
    memory, others = loss.memory_parameters(), loss.actor_parameters()
    assert len(memory) + len(others) == len(list(actor.parameters()))
    assert sum(p.numel() for p in memory) == 4 * 8 * (4 + 8 + 2)
    _, outputs = loss.actor_loss(slices)
    (outputs["heading_estimate"] - slices["heading_vector"]).square().mean().backward()
    assert all(p.grad.abs().sum() > 0 for p in memory)
    loss.actor_loss(slices)[0].backward()
    assert all(p.grad.abs().sum() > 0 for p in others)
    assert all(p.grad is None for p in loss.critic_parameters())
    before = [p.grad.clone() for p in (*memory, *others)]
    loss.value_loss(slices)[0].backward()
    assert all(p.grad is not None for p in loss.critic_parameters())
    assert all(torch.equal(p.grad, old) for p, old in zip((*memory, *others), before, strict=True))


# Environment and policy


def test_policy_acts_alike_in_the_plain_and_in_the_training_environment(env, view, actor) -> None:
    plain = GeomagneticNavEnv(Scenario(field=env.field), num_envs=6, seed=3, max_steps=7)
    one = plain.rollout(14, make_policy(view, actor), break_when_any_done=False)
    other = training_env(env, view, actor).rollout(14, actor, break_when_any_done=False)
    assert one["next", "done"].any()
    torch.testing.assert_close(one["next", "position"], other["next", "position"], rtol=0, atol=1e-7)
