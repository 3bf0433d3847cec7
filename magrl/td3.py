"""TD3 on the navigation environment, from TorchRL's parts: what an agent observes, its networks, its loss.

Small builders with explicit arguments; the recipes put them together. A trained agent leaves here as a
:class:`FieldPolicy`, which reads the environment's public keys in physical units and writes a physical action, so
that it flies in the plain environment beside every other navigator.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import CatTensors, Compose, EnvBase, Transform
from torchrl.modules import MLP, TanhModule, ValueOperator
from torchrl.objectives import SoftUpdate, TD3Loss

from magrl.checkpoints import DamagedCheckpointError, check_finite, load_tensors, save_tensors
from magrl.checks import check_number, check_numbers, check_tensor, check_type
from magrl.env import GeomagneticNavEnv
from magrl.fields import elements_range
from magrl.transforms import AlignmentReward, AngleVector, FieldGradient, GradientHeading, MinMaxNorm, TargetDifference

PUBLIC_KEYS = ("field", "target_field", "move", "heading")
"""All that a policy reads."""
POLICY_FORMAT = 1


@dataclass(frozen=True)
class PolicyConfig:
    """What is needed to rebuild a policy: what it observes, how that is scaled, and the shape of its network.

    Args:
        num_cells: width of each hidden layer.
        layer_norm: whether hidden layers are normalised.
        observe_heading: the cosine and sine of the heading. Without it the state is the paper's eight numbers, from
            which a policy without memory cannot tell where it will go.
        observe_difference: the target's elements less those here, scaled to a journey.
        field_low: D [deg], I [deg], B_H [nT] that are scaled to -1.
        field_high: D [deg], I [deg], B_H [nT] that are scaled to 1.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for bounds that are not finite or do not rise, a move or a turn that is not positive, widths that
            are no positive whole numbers, or switches that are not bool.

    Example:
        >>> low, high = (8.0, -40.0, 33000.0), (12.0, -10.0, 37000.0)
        >>> PolicyConfig((32, 32), True, True, True, low, high, max_move_km=50.0, max_turn_rad=1.5).num_cells
        (32, 32)
    """

    num_cells: tuple[int, ...]
    layer_norm: bool
    observe_heading: bool
    observe_difference: bool
    field_low: tuple[float, float, float]
    field_high: tuple[float, float, float]
    max_move_km: float
    max_turn_rad: float

    def __post_init__(self) -> None:
        check_numbers(3, field_low=self.field_low, field_high=self.field_high)
        if not all(low < high for low, high in zip(self.field_low, self.field_high, strict=True)):
            raise ValueError(f"field_low {self.field_low} must lie below field_high {self.field_high}")
        check_number(0, above=True, max_move_km=self.max_move_km)
        check_number(0, math.pi, above=True, max_turn_rad=self.max_turn_rad)
        for name in ("layer_norm", "observe_heading", "observe_difference"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}")
        if not self.num_cells or not all(isinstance(n, int) and 1 <= n <= 65536 for n in self.num_cells):
            raise ValueError(f"num_cells must be positive whole numbers, got {self.num_cells}")


def policy_config(
    env: GeomagneticNavEnv,
    num_cells: Sequence[int],
    *,
    layer_norm: bool,
    observe_heading: bool = True,
    observe_difference: bool = True,
) -> PolicyConfig:
    """The configuration of a policy for an environment, scaled to the range of the field over its region.

    Example:
        >>> view = policy_config(GeomagneticNavEnv(seed=0), (32, 32), layer_norm=True)
        >>> [round(x, 1) for x in view.field_low], view.max_move_km
        ([7.3, -31.6, 34720.5], 50.0)
    """
    check_type(GeomagneticNavEnv, env=env)
    low, high = (tuple(x.tolist()) for x in elements_range(env.field, env.region.grid(81).to(env.device)))
    return PolicyConfig(
        tuple(num_cells),
        layer_norm,
        observe_heading,
        observe_difference,
        low,
        high,
        env.max_move_km,
        env.max_turn_rad,
    )


def check_fits(config: PolicyConfig, env: GeomagneticNavEnv) -> None:
    """Refuses an environment whose field is not one that a policy was trained in, and its observations scaled for.

    A quarter of the range to either side is let through: what a journey across half the region changes, and more than
    the field does in some years.

    Raises:
        ValueError: naming the element and both ranges.

    Example:
        >>> env = GeomagneticNavEnv(seed=0)
        >>> check_fits(policy_config(env, (8,), layer_norm=False), env)
    """
    check_type(PolicyConfig, config=config)
    check_type(GeomagneticNavEnv, env=env)
    there = (x.tolist() for x in elements_range(env.field, env.region.grid(81).to(env.device)))
    for name, unit, least, most, low, high in zip(
        ("D", "I", "B_H"), ("°", "°", " nT"), config.field_low, config.field_high, *there, strict=True
    ):
        slack = (most - least) / 4
        if low < least - slack or high > most + slack:
            raise ValueError(
                f"the policy was trained where {name} is {least:.1f} to {most:.1f}{unit}; here it is {low:.1f} to "
                f"{high:.1f}{unit}: train one for this region and date"
            )


def observation_transforms(config: PolicyConfig) -> list[Transform]:
    """From the public keys to ``observation``, the input of the networks.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> view = policy_config(env, (32, 32), layer_norm=True)
        >>> Compose(*observation_transforms(view))(env.reset())["observation"].shape
        torch.Size([2, 13])
    """
    check_type(PolicyConfig, config=config)
    low, high = torch.tensor(config.field_low), torch.tensor(config.field_high)
    keys = ["field", "target_field", "move"]
    move_high = torch.tensor((config.max_move_km, config.max_turn_rad))
    bounds = {"field": (low, high), "target_field": (low, high), "move": (move_high * torch.tensor((0, -1)), move_high)}
    steps: list[Transform] = []
    if config.observe_difference:
        # A quarter of the region's range is about what changes on a journey across half of it.
        bounds["field_difference"] = ((low - high) / 4, (high - low) / 4)
        keys.append("field_difference")
        steps.append(TargetDifference())
    scaled = [f"{key}_scaled" for key in keys]
    steps.append(MinMaxNorm(keys, scaled, bounds=bounds))
    if config.observe_heading:
        scaled.append("heading_vector")
        steps.append(AngleVector("heading", "heading_vector"))
    return [*steps, CatTensors(scaled, "observation", del_keys=False, sort=False)]


def action_transform(config: PolicyConfig) -> MinMaxNorm:
    """From the networks' action in [-1, 1] to kilometres and radians.

    Example:
        >>> view = policy_config(GeomagneticNavEnv(seed=0), (32, 32), layer_norm=True)
        >>> action_transform(view).denormalize("action", torch.tensor([0.0, 1.0]))
        tensor([25.0000,  1.5708])
    """
    check_type(PolicyConfig, config=config)
    high = torch.tensor((config.max_move_km, config.max_turn_rad))
    return MinMaxNorm(in_keys_inv=["action"], bounds={"action": (high * torch.tensor((0, -1)), high)})


def guidance_transforms(env: GeomagneticNavEnv, weight: float, offset: float) -> list[Transform]:
    """What makes TD3 gradient-guided: the theoretical heading, and the reward for holding it.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env = TransformedEnv(base, Compose(*guidance_transforms(base, weight=3.0, offset=0.0)))
        >>> env.rollout(3)["gradient_heading"].shape
        torch.Size([2, 3, 1])
    """
    check_type(GeomagneticNavEnv, env=env)
    return [FieldGradient(env.field), GradientHeading(), AlignmentReward(weight=weight, offset=offset)]


def observation_size(config: PolicyConfig) -> int:
    """Number of entries in ``observation``.

    Example:
        >>> observation_size(policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True))
        13
    """
    check_type(PolicyConfig, config=config)
    return 8 + 3 * config.observe_difference + 2 * config.observe_heading


def _mlp(inputs: int, outputs: int, config: PolicyConfig, device: torch.device | None) -> MLP:
    widths = {"norm_class": nn.LayerNorm, "norm_kwargs": [{"normalized_shape": n} for n in config.num_cells]}
    return MLP(
        in_features=inputs,
        out_features=outputs,
        num_cells=list(config.num_cells),
        activation_class=nn.ReLU,
        device=device,
        **(widths if config.layer_norm else {}),
    )


def make_actor(config: PolicyConfig, device: torch.device | None = None) -> TensorDictSequential:
    """The deterministic policy, ``observation`` ``(..., K)`` to ``action`` ``(..., 2)`` in [-1, 1].

    Its ``logits``, before the tanh, start at zero bias: half the longest move, no turn.

    Example:
        >>> view = policy_config(GeomagneticNavEnv(seed=0), (32, 32), layer_norm=True)
        >>> seen = TensorDict(observation=torch.zeros(5, 13), batch_size=[5])
        >>> make_actor(view)(seen)["action"].shape
        torch.Size([5, 2])
    """
    network = _mlp(observation_size(config), 2, config, device)
    nn.init.zeros_(network[-1].bias)
    spec = Bounded(-1.0, 1.0, (2,), device=device)
    return TensorDictSequential(
        TensorDictModule(network, in_keys=["observation"], out_keys=["logits"]),
        TanhModule(in_keys=["logits"], out_keys=["action"], spec=spec),
    )


def make_critic(config: PolicyConfig, device: torch.device | None = None) -> ValueOperator:
    """The value of an action, ``observation`` and ``action`` to ``state_action_value`` ``(..., 1)``.

    Example:
        >>> view = policy_config(GeomagneticNavEnv(seed=0), (32, 32), layer_norm=True)
        >>> seen = TensorDict(observation=torch.zeros(5, 13), action=torch.zeros(5, 2), batch_size=[5])
        >>> make_critic(view)(seen)["state_action_value"].shape
        torch.Size([5, 1])
    """
    return ValueOperator(_mlp(observation_size(config) + 2, 1, config, device), in_keys=["observation", "action"])


class LeanTD3Loss(TD3Loss):
    """TorchRL's TD3 loss with less around it: the same values and gradients at a lower cost.

    Its networks stand, each with its own parameters in it, where the parent fills one network anew with the parameters
    of each at every call; and the actor asks only the critic that its gradient comes from (Eq. 3-13), where the parent
    evaluates both and drops one. Parameters, targets and state are the parent's, and share its memory.

    Example:
        >>> view = policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True)
        >>> actor, critic = make_actor(view), make_critic(view)
        >>> spec = Bounded(-1.0, 1.0, (2,))
        >>> loss = LeanTD3Loss(actor, critic, action_spec=spec, loss_function="l2", deactivate_vmap=True)
        >>> value, extra = loss.actor_loss(TensorDict(observation=torch.zeros(5, 13), batch_size=[5]))
        >>> value.shape, extra["logits"].shape
        (torch.Size([]), torch.Size([5, 2]))
    """

    @cached_property
    def _standing(self) -> dict[str, list[Any]]:
        """The networks by their role; those of the critics that are trained have parameters to optimise."""
        networks: dict[str, list[Any]] = {}
        for role, network, params in (
            ("actor", self.actor_network, [self.actor_network_params]),
            ("target actor", self.actor_network, [self.target_actor_network_params.data]),
            ("critics", self.qvalue_network, self.qvalue_network_params.data.unbind(0)),
            ("target critics", self.qvalue_network, self.target_qvalue_network_params.data.unbind(0)),
            ("asked critic", self.qvalue_network, [self.qvalue_network_params.data[0]]),
        ):
            networks[role] = [copy.deepcopy(network) for _ in params]
            for holder, held in zip(networks[role], params, strict=True):
                held.to_module(holder)
            if network is self.qvalue_network:  # one tensor in, one out: no need to dress them
                networks[role] = [critic.module for critic in networks[role]]
        for critic in networks["critics"]:
            critic.requires_grad_()
        return networks

    def critic_parameters(self) -> list[Tensor]:
        """What the critics' optimiser trains: parts of the parent's stacked parameters, critic after critic."""
        return [weight for critic in self._standing["critics"] for weight in critic.parameters()]

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The critics' loss (Eqs. 3-9 to 3-11).

        Args:
            tensordict: ``(B,)`` with ``observation``, ``action``, and in ``next`` ``observation``, ``reward`` and
                ``terminated``.

        Returns:
            A scalar, and ``target_value`` ``(B, 1)``.
        """
        action, after = tensordict["action"], tensordict["next"]
        noise = (torch.randn_like(action) * self.policy_noise).clamp(-self.noise_clip, self.noise_clip)
        with torch.no_grad():
            (actor,) = self._standing["target actor"]
            seen = actor(after.select(*self.actor_network.in_keys))
            chosen = (seen["action"] + noise).clamp(self.min_action, self.max_action)
            there = torch.cat((after["observation"], chosen), -1)
            value = torch.minimum(*(critic(there) for critic in self._standing["target critics"]))
            target = after["reward"] + self.value_estimator.gamma * (~after["terminated"]).to(value.dtype) * value
        here = torch.cat((tensordict["observation"], action), -1)
        first, second = (critic(here) - target for critic in self._standing["critics"])
        return (first.square() + second.square()).mean(), {"target_value": target}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss.

        Args:
            tensordict: ``(B,)`` with ``observation``.

        Returns:
            A scalar, and ``logits`` ``(B, 2)``, the actor's outputs before the tanh, with their gradient.
        """
        (actor,), (critic,) = self._standing["actor"], self._standing["asked critic"]
        seen = actor(tensordict.select(*self.actor_network.in_keys))
        value = critic(torch.cat((seen["observation"], seen["action"]), -1))
        return -value.mean(), {"logits": seen["logits"]}


class LeanSoftUpdate(SoftUpdate):
    """TorchRL's soft update of all targets in one call.

    Example:
        >>> view = policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True)
        >>> loss = make_loss(make_actor(view), make_critic(view), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> source, target = loss.actor_network_params, loss.target_actor_network_params
        >>> update = LeanSoftUpdate(loss, tau=0.25)
        >>> for weights, value in ((source, 1.0), (target, 0.0)):
        ...     for weight in weights.data.values(True, True):
        ...         _ = weight.fill_(value)
        >>> update.step()
        >>> next(target.data.values(True, True)).unique()
        tensor([0.2500])
    """

    def step(self) -> None:
        """Moves each target by its share towards its source."""
        if not hasattr(self, "_pairs"):
            sources = {f"target_{key}": value for key, value in self._sources.flatten_keys(".").data.items()}
            targets = dict(self._targets.flatten_keys(".").data.items())
            self._pairs = list(targets.values()), [sources[key] for key in targets]
        torch._foreach_lerp_(*self._pairs, 1 - self.eps)


def make_loss(
    actor: TensorDictSequential, critic: ValueOperator, *, gamma: float, policy_noise: float, noise_clip: float
) -> LeanTD3Loss:
    """TorchRL's TD3 loss with twin critics, squared errors (Eq. 3-10) and one-step targets (Eqs. 3-9, 3-11).

    Raises:
        ValueError: for a discount outside [0, 1], or a noise that is negative.

    Example:
        >>> view = policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True)
        >>> loss = make_loss(make_actor(view), make_critic(view), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> seen, ended = torch.zeros(5, 13), torch.ones(5, 1, dtype=torch.bool)
        >>> after = TensorDict(observation=seen, reward=torch.ones(5, 1), terminated=ended)
        >>> batch = TensorDict(observation=seen, action=torch.zeros(5, 2), next=after, batch_size=[5])
        >>> loss.value_loss(batch)[1]["target_value"].T
        tensor([[1., 1., 1., 1., 1.]])
    """
    check_type(TensorDictSequential, actor=actor)
    check_type(ValueOperator, critic=critic)
    check_number(0, 1, gamma=gamma)
    check_number(0, policy_noise=policy_noise, noise_clip=noise_clip)
    loss = LeanTD3Loss(
        actor,
        critic,
        action_spec=Bounded(-1.0, 1.0, (2,), device=next(actor.parameters()).device),
        loss_function="l2",
        policy_noise=policy_noise,
        noise_clip=noise_clip,
        deactivate_vmap=True,  # the networks stand: there is nothing to map over
    )
    loss.make_value_estimator(gamma=gamma)
    return loss


def saturation_penalty(logits: Tensor) -> Tensor:
    """Mean square of the actor's outputs before the tanh.

    Early in training every move is a loss on average, whatever its direction; an actor that follows that into the
    flat end of the tanh stands still, and has no gradient left to learn better by. A small weight on this term keeps
    the outputs where the tanh still bends.

    Args:
        logits: ``(B, 2)``, of :meth:`LeanTD3Loss.actor_loss`.

    Returns:
        A scalar with a gradient for the actor.

    Example:
        >>> saturation_penalty(torch.tensor([[1.0, -3.0]]))
        tensor(5.)
    """
    check_tensor(logits=logits)
    return logits.square().mean()


class FieldPolicy(TensorDictModuleBase):
    """A trained agent as a navigator: public keys in physical units to an action in physical units.

    Args:
        config: what the policy observes and the shape of its network.
        actor: trained by a recipe; a fresh one by default.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> policy = FieldPolicy(policy_config(env, (32, 32), layer_norm=True))
        >>> env.rollout(2, policy)["action"].shape
        torch.Size([2, 2, 2])
    """

    in_keys: ClassVar[list[str]] = list(PUBLIC_KEYS)
    out_keys: ClassVar[list[str]] = ["action"]

    def __init__(self, config: PolicyConfig, actor: TensorDictSequential | None = None) -> None:
        super().__init__()
        check_type(PolicyConfig, config=config)
        self.config = config
        self.observe = Compose(*observation_transforms(config))
        self.act = action_transform(config)
        self.actor = make_actor(config) if actor is None else actor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` ``(..., 2)``: distance [km] and turn [rad]."""
        seen = self.observe(tensordict.select(*self.in_keys))
        return tensordict.set("action", self.act.denormalize("action", self.actor(seen)["action"]))


def save_policy(path: Path | str, policy: FieldPolicy) -> None:
    """Writes a policy: its configuration and its weights, as plain tensors and numbers.

    Example:
        >>> import tempfile
        >>> policy = FieldPolicy(policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True))
        >>> save_policy(Path(tempfile.mkdtemp()) / "policy.pt", policy)
    """
    check_type(FieldPolicy, policy=policy)
    weights = {key: value.cpu() for key, value in policy.actor.state_dict().items() if isinstance(value, Tensor)}
    save_tensors({"format": POLICY_FORMAT, "config": asdict(policy.config), "weights": weights}, Path(path))


def load_policy(path: Path | str, device: torch.device | str = "cpu") -> FieldPolicy:
    """Rebuilds a policy that :func:`save_policy` wrote.

    Args:
        path: the ``policy.pt`` of a run.
        device: where it shall act.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: for a file that is no policy, of another format, or with weights of other shapes.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "policy.pt"
        >>> save_policy(path, FieldPolicy(policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True)))
        >>> load_policy(path).config.num_cells
        (8,)
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no policy file at {path}")
    try:
        content = load_tensors(path)
    except DamagedCheckpointError as error:
        raise ValueError(f"{path} is not a policy file: {error}") from error
    if not isinstance(content, dict) or set(content) != {"format", "config", "weights"}:
        raise ValueError(f"{path} is not a policy file: it must hold format, config and weights")
    if content["format"] != POLICY_FORMAT:
        raise ValueError(f"{path} is a policy of format {content['format']!r}; this version reads {POLICY_FORMAT}")
    names = {field.name for field in fields(PolicyConfig)}
    if not isinstance(content["config"], dict) or set(content["config"]) != names:
        raise ValueError(f"{path}: the configuration of a policy must hold exactly {sorted(names)}")
    try:
        config, weights = PolicyConfig(**content["config"]), dict(content["weights"])
        check_finite(weights.items(), str(path))
        # Before anything is allocated: a few bytes may ask for any number of cells.
        held = sum(value.numel() for key, value in weights.items() if key.endswith(("weight", "bias")))
        if held != _number_of_weights(config):
            raise ValueError(f"its weights are not those of layers of {config.num_cells} cells")
        policy = FieldPolicy(config)
        policy.actor.load_state_dict(weights)
    except (TypeError, RuntimeError, ValueError, AttributeError, FloatingPointError) as error:
        raise ValueError(f"{path} holds a policy of another shape: {error}") from error
    return policy.to(device).eval()


def _number_of_weights(config: PolicyConfig) -> int:
    """Of the actor: a matrix and a bias for each layer, and two numbers a cell to normalise it."""
    sizes = (observation_size(config), *config.num_cells, 2)
    linear = sum((before + 1) * after for before, after in itertools.pairwise(sizes))
    return linear + 2 * sum(config.num_cells) * config.layer_norm


def evaluation_rollout(env: GeomagneticNavEnv, policy: TensorDictModuleBase) -> TensorDict:
    """Flies exactly one episode of each vehicle, without exploration or gradients.

    Returns:
        ``(num_envs, T)`` for :func:`magrl.metrics.episode_measures`: vehicles that are done stay as they were.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0, max_steps=3)
        >>> evaluation_rollout(env, FieldPolicy(policy_config(env, (8,), layer_norm=True))).shape
        torch.Size([2, 3])
    """
    check_type(EnvBase, env=env)
    if not callable(policy):
        raise TypeError(f"policy must be called with a TensorDict, got {policy!r}")
    with torch.no_grad():
        return env.rollout(env.max_steps, policy, break_when_any_done=False, break_when_all_done=True)
