"""TD3 on the navigation environment, from TorchRL's parts: what an agent observes, its networks, its loss.

Small builders with explicit arguments; the recipes put them together. A trained agent leaves here as a
:class:`FieldPolicy`, which reads the environment's public keys in physical units and writes a physical action, so
that it flies in the plain environment beside every other navigator.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import CatTensors, Compose, Transform
from torchrl.modules import MLP, TanhModule, ValueOperator
from torchrl.objectives import TD3Loss

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
        numbers = (*self.field_low, *self.field_high, self.max_move_km, self.max_turn_rad)
        if len(self.field_low) != 3 or len(self.field_high) != 3 or not all(math.isfinite(x) for x in numbers):
            raise ValueError(f"the bounds of a policy must be finite, three to an end: {self}")
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
    """The configuration of a policy for an environment, scaled to the range of the field over its region."""
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


def observation_transforms(config: PolicyConfig) -> list[Transform]:
    """From the public keys to ``observation``, the input of the networks."""
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
    """From the networks' action in [-1, 1] to kilometres and radians."""
    high = torch.tensor((config.max_move_km, config.max_turn_rad))
    return MinMaxNorm(in_keys_inv=["action"], bounds={"action": (high * torch.tensor((0, -1)), high)})


def guidance_transforms(env: GeomagneticNavEnv, weight: float, offset: float) -> list[Transform]:
    """What makes TD3 gradient-guided: the theoretical heading, and the reward for holding it."""
    return [FieldGradient(env.field), GradientHeading(), AlignmentReward(weight=weight, offset=offset)]


def observation_size(config: PolicyConfig) -> int:
    """Number of entries in ``observation``."""
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
    """
    network = _mlp(observation_size(config), 2, config, device)
    nn.init.zeros_(network[-1].bias)
    spec = Bounded(-1.0, 1.0, (2,), device=device)
    return TensorDictSequential(
        TensorDictModule(network, in_keys=["observation"], out_keys=["logits"]),
        TanhModule(in_keys=["logits"], out_keys=["action"], spec=spec),
    )


def make_critic(config: PolicyConfig, device: torch.device | None = None) -> ValueOperator:
    """The value of an action, ``observation`` and ``action`` to ``state_action_value`` ``(..., 1)``."""
    return ValueOperator(_mlp(observation_size(config) + 2, 1, config, device), in_keys=["observation", "action"])


def make_loss(
    actor: TensorDictSequential, critic: ValueOperator, *, gamma: float, policy_noise: float, noise_clip: float
) -> TD3Loss:
    """TorchRL's TD3 loss with twin critics, squared errors (Eq. 3-10) and one-step targets (Eqs. 3-9, 3-11)."""
    loss = TD3Loss(
        actor,
        critic,
        action_spec=Bounded(-1.0, 1.0, (2,), device=next(actor.parameters()).device),
        loss_function="l2",
        policy_noise=policy_noise,
        noise_clip=noise_clip,
        deactivate_vmap=True,  # two critics in a Python loop cost less than one vmap over them
    )
    loss.make_value_estimator(gamma=gamma)
    return loss


def saturation_penalty(loss: TD3Loss, batch: TensorDictBase) -> Tensor:
    """Mean square of the actor's outputs before the tanh.

    Early in training every move is a loss on average, whatever its direction; an actor that follows that into the
    flat end of the tanh stands still, and has no gradient left to learn better by. A small weight on this term keeps
    the outputs where the tanh still bends.

    Args:
        loss: the TD3 loss that holds the actor's parameters.
        batch: ``(B,)`` with ``observation``.

    Returns:
        A scalar with a gradient for the actor.
    """
    with loss.actor_network_params.to_module(loss.actor_network):
        return loss.actor_network[0](batch.select("observation"))["logits"].square().mean()


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
        self.config = config
        self.observe = Compose(*observation_transforms(config))
        self.act = action_transform(config)
        self.actor = make_actor(config) if actor is None else actor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = self.observe(tensordict.select(*self.in_keys))
        return tensordict.set("action", self.act.denormalize("action", self.actor(seen)["action"]))


def save_policy(path: Path | str, policy: FieldPolicy) -> None:
    """Writes a policy: its configuration and its weights, as plain tensors and numbers."""
    weights = {key: value.cpu() for key, value in policy.actor.state_dict().items() if isinstance(value, Tensor)}
    torch.save({"format": POLICY_FORMAT, "config": asdict(policy.config), "weights": weights}, path)


def load_policy(path: Path | str, device: torch.device | str = "cpu") -> FieldPolicy:
    """Rebuilds a policy that :func:`save_policy` wrote.

    Args:
        path: the ``policy.pt`` of a run.
        device: where it shall act.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: for a file that is no policy, of another format, or with weights of other shapes.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no policy file at {path}")
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever a damaged archive raises
        raise ValueError(f"{path} is not a policy file: {error}") from error
    if not isinstance(content, dict) or set(content) != {"format", "config", "weights"}:
        raise ValueError(f"{path} is not a policy file: it must hold format, config and weights")
    if content["format"] != POLICY_FORMAT:
        raise ValueError(f"{path} is a policy of format {content['format']!r}; this version reads {POLICY_FORMAT}")
    names = {field.name for field in fields(PolicyConfig)}
    if not isinstance(content["config"], dict) or set(content["config"]) != names:
        raise ValueError(f"{path}: the configuration of a policy must hold exactly {sorted(names)}")
    try:
        policy = FieldPolicy(PolicyConfig(**content["config"]))
        policy.actor.load_state_dict(content["weights"])
    except (TypeError, RuntimeError, ValueError) as error:
        raise ValueError(f"{path} holds a policy of another shape: {error}") from error
    return policy.to(device).eval()


def evaluation_rollout(env: GeomagneticNavEnv, policy: TensorDictModuleBase) -> TensorDict:
    """Flies exactly one episode of each vehicle, without exploration or gradients.

    Returns:
        ``(num_envs, T)`` for :func:`magrl.metrics.episode_measures`: vehicles that are done stay as they were.
    """
    with torch.no_grad():
        return env.rollout(env.max_steps, policy, break_when_any_done=False, break_when_all_done=True)
