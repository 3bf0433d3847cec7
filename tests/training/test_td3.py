"""TD3: the loss beside TorchRL's and by hand, target networks and gradient steps."""

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.objectives import SoftUpdate as StockSoftUpdate
from torchrl.objectives import TD3Loss as StockTD3Loss

from magrl.navigators import make_actor, make_critic
from magrl.training import SoftUpdate, TD3Loss, optimize

CELLS = (16, 16)


def make_loss(size: int = 13, *, policy_noise: float = 0.1, **options: str) -> TD3Loss:
    actor, critic = make_actor(size, CELLS), make_critic(size, CELLS)
    return TD3Loss(actor, critic, gamma=0.9, policy_noise=policy_noise, noise_clip=1.2, **options)


def transitions(size: int = 13, count: int = 32) -> TensorDict:
    """Return random transitions, of which every fourth ends its episode."""
    ended = (torch.arange(count) % 4 == 0).unsqueeze(-1)
    following = {"observation": torch.randn(count, size), "reward": torch.randn(count, 1), "done": ended}
    return TensorDict(
        observation=torch.randn(count, size),
        action=torch.rand(count, 2) * 2 - 1,
        next=TensorDict(following | {"terminated": ended.clone()}, [count]),
        batch_size=[count],
    )


def test_loss_is_that_of_torchrl() -> None:
    """Values and gradients of both losses, to rounding, after updates of weights and targets.

    The noise is so large that it is clipped, and takes the action of the target actor out of its bounds.
    """
    torch.manual_seed(0)
    ours = make_loss(policy_noise=1.0)
    update = SoftUpdate(ours, tau=0.1)
    optimizer = torch.optim.Adam([*ours.actor_parameters(), *ours.critic_parameters()], lr=1e-2)
    for _ in range(3):
        batch = transitions()
        optimize(ours.value_loss(batch)[0] + ours.actor_loss(batch)[0], optimizer)
        update.step()
    spec = {"action_spec": Bounded(-1.0, 1.0, (2,)), "loss_function": "l2", "policy_noise": 1.0, "noise_clip": 1.2}
    stock = StockTD3Loss(make_actor(13, CELLS), make_critic(13, CELLS), deactivate_vmap=True, **spec)
    stock.make_value_estimator(gamma=0.9)
    StockSoftUpdate(stock, tau=0.1)  # as TorchRL expects of every loss
    for params, networks in (("actor_network", ours.actor), ("target_actor_network", ours.target_actor)):
        getattr(stock, f"{params}_params").data.update_(TensorDict.from_module(networks).data)
    for params, networks in (("qvalue_network", ours.critics), ("target_qvalue_network", ours.target_critics)):
        weights = torch.stack([TensorDict.from_module(critic).data for critic in networks])
        getattr(stock, f"{params}_params").data.update_(TensorDict(module=weights, batch_size=[2]))
    batch, computed = transitions(), []
    for loss in (ours, stock):
        torch.manual_seed(1)
        values = loss(batch.clone())
        actor, value = values["loss_actor"], values["loss_qvalue"]
        if loss is ours:
            policy, weights = loss.actor_parameters(), loss.critic_parameters()
            critics = torch.autograd.grad(value, weights)
            critics = [torch.stack(pair) for pair in zip(critics[:10], critics[10:], strict=True)]
        else:
            policy = [p for p in loss.actor_network_params.parameters() if p.requires_grad]
            critics = torch.autograd.grad(value, list(loss.qvalue_network_params.parameters()))
        computed.append([value, actor, values["target_value"].flatten(), *critics, *torch.autograd.grad(actor, policy)])
    assert len(computed[0]) == 3 + 10 + 10  # two hidden layers with their normalization, and the last
    for mine, theirs in zip(*computed, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("used", [False, True])
def test_a_copy_and_another_type_train_all_weights_and_leave_the_targets(used: bool) -> None:
    """By an optimizer of all parameters, as of TorchRL's trainer, before or after the first use; no loss of another."""
    loss = make_loss()
    if used:
        loss(transitions())
    before = {name: value.detach().clone() for name, value in loss.named_parameters()}
    for trained in (copy.deepcopy(loss), pickle.loads(pickle.dumps(loss)), copy.deepcopy(loss)):
        optimizer = torch.optim.SGD([p for p in trained.parameters() if p.requires_grad], lr=1.0)
        trained.double()
        values = trained(transitions().apply(lambda x: x.double() if x.is_floating_point() else x))
        optimize(values["loss_actor"] + values["loss_qvalue"], optimizer)
        for name, value in trained.named_parameters():
            assert value.dtype == torch.float64
            assert torch.equal(value.float(), before[name]) == name.startswith("target"), name
    assert all(torch.equal(value, before[name]) for name, value in loss.named_parameters())


def test_actor_loss_has_no_gradient_of_the_critics() -> None:
    loss = make_loss()
    loss.actor_loss(transitions())[0].backward()
    assert all(p.grad.abs().sum() > 0 for p in loss.actor_parameters())
    assert all(p.grad is None for p in (*loss.critics.parameters(), *loss.target_critics.parameters()))


def test_soft_update_moves_the_targets_by_tau() -> None:
    loss = make_loss()
    update, before = SoftUpdate(loss, tau=0.25), copy.deepcopy(dict(loss.named_parameters()))
    with torch.no_grad():
        for weight in (*loss.critic_parameters(), *loss.actor_parameters()):
            weight += 1
    update.step()
    for name, weight in loss.named_parameters():
        assert torch.equal(before[name], before[name.removeprefix("target_")])
        torch.testing.assert_close(weight, before[name] + (0.25 if name.startswith("target") else 1.0))


def test_optimize_clips_the_gradient_of_some_parameters() -> None:
    clipped, free = (torch.nn.Parameter(torch.zeros(2)) for _ in range(2))
    optimizers = [torch.optim.SGD([weight], lr=1.0) for weight in (clipped, free)]
    optimize((torch.tensor([30.0, 40.0]) * (clipped + free)).sum(), *optimizers, clip=[clipped], max_norm=5.0)
    torch.testing.assert_close(clipped.detach(), torch.tensor([-3.0, -4.0]))
    torch.testing.assert_close(free.detach(), torch.tensor([-30.0, -40.0]))
    assert clipped.grad is None
    assert free.grad is None


def test_a_step_limit_may_count_as_the_end() -> None:
    """No value is expected after it."""
    loss, batch = make_loss(policy_noise=0.0, terminated="done"), transitions()
    batch["next"].update({"done": torch.ones(32, 1).bool(), "terminated": torch.zeros(32, 1).bool()})
    assert torch.equal(loss.value_loss(batch)[1]["target_value"], batch["next", "reward"])


def test_bad_options_of_the_loss_are_refused() -> None:
    good = {"actor": make_actor(3, (4,)), "critic": make_critic(3, (4,)), "gamma": 0.9}
    good |= {"policy_noise": 0.1, "noise_clip": 0.5}
    for name, value, message in (
        ("gamma", 1.5, "gamma"),
        ("policy_noise", -1.0, "policy_noise"),
        ("noise_clip", math.nan, "noise_clip"),
        ("actor", None, "actor must be"),
        ("critic", None, "critic must be"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            TD3Loss(**good | {name: value})
