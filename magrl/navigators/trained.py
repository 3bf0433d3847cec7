"""Trained policies as navigators, and the files of policies of any kind.

A policy reads public keys of the plain environment and writes an action, both in physical units, so that it needs no
transforms and is used like every other navigator.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import Compose, EnvBase, Transform

from magrl.checks import check_device, check_type
from magrl.envs import GeomagneticNavEnv
from magrl.envs.scenario import rule_settings
from magrl.files import write_atomically
from magrl.navigators.base import Navigator
from magrl.navigators.kalman import Anywhere
from magrl.navigators.memory import Memory
from magrl.navigators.networks import Device, make_actor
from magrl.navigators.onnx import OnnxNetwork, description_of, exported, with_description
from magrl.pilot.network import pretrained, save_pilot
from magrl.policy_files import PolicyFile, read_policy, reading
from magrl.transforms import LegsView, ObservationView, ReadingView
from magrl.transforms.areas import shielded

View = ObservationView | LegsView | ReadingView
_Std = Annotated[float, Field(ge=0)]
VIEWS: dict[str, type[View]] = {"region": ObservationView, "legs": LegsView, "readings": ReadingView}
"""What policies observe, by the kind that their files name."""


@dataclass(frozen=True)
class PolicyConfig:
    """All that is needed to rebuild a policy, except its weights.

    Args:
        view: what the policy observes, and its scaling: values scaled to a region, or plain readings.
        num_cells: width of each hidden layer; None for a network of another kind.
        layer_norm: whether hidden layers are normalized.
        shield: whether the last layer is fixed: it turns legs that would meet a no-go area in sight
            (:func:`~magrl.transforms.areas.shielded`). The agent is the network and its shield.

    Raises:
        TypeError: for a view of another type.
        ValueError: for widths that are not positive whole numbers, or a shield without areas in the view.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> view = GeomagneticNavEnv(seed=0).observation_view()
        >>> PolicyConfig(view, (32, 32)).layer_norm
        True
    """

    view: View
    num_cells: tuple[int, ...] | None
    layer_norm: bool = True
    shield: bool = False

    def __post_init__(self) -> None:
        check_type(tuple(VIEWS.values()), view=self.view)
        check_type(bool, shield=self.shield)
        if self.shield and "areas" not in self.view.in_keys:
            raise ValueError("shield True needs a view with no-go areas: take observe_areas=True, or leave it out")
        if self.num_cells is not None:
            self.make_actor("meta")  # checks the sizes

    def make_actor(self, device: Device = None) -> TensorDictSequential:
        """Return an actor of this shape, with new weights."""
        if self.num_cells is None:
            raise ValueError(
                f"num_cells must be the widths of the hidden layers with {type(self.view).__name__}, got None"
            )
        norm, geometry = self.layer_norm, self.view.geometry
        return make_actor(self.view.size, self.num_cells, layer_norm=norm, geometry=geometry, device=device)


class TrainingSettings(rule_settings("zeta", "start_heading")):  # type: ignore[misc]
    """Settings of a training that an evaluation shares, as the file of its policy holds them; see ``RunConfig``.

    Raises:
        ValueError: naming each setting that is wrong.

    Example:
        >>> TrainingSettings(noise=(-1.0, 0.0, 0.0))
        Traceback (most recent call last):
        ValueError: noise.0 must be greater than or equal to 0, got -1.0
    """

    guided: bool | None = None
    task: str = "box"
    scenario: str | None = None
    noise: Annotated[tuple[_Std, _Std, _Std], Field(strict=False)] = (0.0, 0.0, 0.0)


class FieldPolicy(Navigator):
    """A trained agent as a navigator of the plain environment, in physical units.

    Args:
        config: what the policy observes, and the shape of its network.
        actor: trained actor of that shape; one with new weights by default.

    Attributes:
        training: settings of the training that an evaluation shares, which its file holds.

    Raises:
        TypeError: for a configuration of another type.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> policy = FieldPolicy(PolicyConfig(env.observation_view(), (32, 32)))
        >>> env.rollout(2, policy)["action"].shape
        torch.Size([2, 2, 2])
    """

    trained_on, optional_keys = "tasks of its own", ()

    def __init__(self, config: PolicyConfig, actor: TensorDictModuleBase | OnnxNetwork | None = None) -> None:
        check_type(PolicyConfig, config=config)
        super().__init__(config.view.max_leg_km, config.view.max_turn_rad)
        self.config, self.view = config, config.view
        self.in_keys = list(dict.fromkeys((*config.view.in_keys, "elapsed_steps")))
        self.observe = Compose(*config.view.observation_transforms())
        self.actor = config.make_actor().float() if actor is None else actor  # environments write float32
        self.action_size = getattr(self.actor, "action_size", 2)
        self.act = config.view.action_transform(declared=self.declares)
        self.training: dict[str, Any] = {}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``; raise a ValueError in an environment without the areas that the policy observes."""
        if "areas" in self.in_keys and "areas" not in tensordict.keys():  # noqa: SIM118
            raise ValueError("the policy observes no-go areas, the environment has none: fly it in no_go_env")
        return super().forward(tensordict)

    def transforms(self, env: EnvBase, **rules: Any) -> list[Transform]:
        """Return what an environment needs for it: also what its view needs, with the map of the environment."""
        there = {*self.view.in_keys} <= {*env.observation_spec.keys()}
        needed = [] if there else self.view.needed(env)
        return [*needed, *super().transforms(env, **rules)]

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:  # noqa: ARG002
        """Return distance [km] and turn [rad], and the declaration if the network has one."""
        observed = self.observe(seen.select(*self.view.in_keys))
        network = isinstance(self.actor, OnnxNetwork)
        action = self.actor(observed["observation"]) if network else self.actor(observed)["action"]
        action = self.act.denormalize("action", action)
        return shielded(action, seen["areas"], self.view.max_turn_rad) if self.config.shield else action

    def check_actor(self) -> None:
        """Raise unless the weights of the actor are those of the configuration, from which a file makes it again.

        Raises:
            ValueError: for another network.
        """
        if isinstance(self.actor, OnnxNetwork):
            return
        actors = self.config.make_actor("meta"), self.actor  # the first one draws no random weights
        made, given = (
            {name: values.shape for name, values in actor.state_dict().items() if isinstance(values, Tensor)}
            for actor in actors
        )
        if made != given:
            other = ", ".join(sorted({*made} ^ {*given}) or sorted(given))[:200]
            raise ValueError(
                f"the actor has other weights than PolicyConfig.make_actor(), which a file makes again ({other}): "
                "write save_policy('policy.onnx', actor, view) for a network of your own"
            )

    def check_fits(self, env: EnvBase) -> None:
        """Raise unless an environment has the field of the policy, and allows its legs and turns.

        Raises:
            ValueError: naming the element and both ranges, or both limits.
        """
        view, base = self.view, getattr(env, "base_env", env)
        check_type(GeomagneticNavEnv, env=base)
        if self.declares and not base.scenario.declared:
            raise ValueError(f"the policy declares its arrival: fly it with arrival 'declared', not {base.arrival!r}")
        if isinstance(view, ObservationView):
            view.check_covers(base.field, base.region.grid(81).to(base.device))
        (leg, turn), (longest, largest) = (
            (round(part.max_leg_km, 3), round(math.degrees(part.max_turn_rad), 3)) for part in (view, base)
        )
        if leg > longest or turn > largest:
            raise ValueError(
                f"the policy was trained for legs up to {leg:g} km and turns up to {turn:g}°, the environment allows "
                f"{longest:g} km and {largest:g}°: evaluate with max_leg_km={leg:g} and max_turn_deg={turn:g}, or "
                "train one for these limits"
            )


def export_policy(actor: nn.Module | Path | str, view: View) -> FieldPolicy:
    """Return a network of any algorithm or library as a policy, run by onnxruntime (extra ``onnx``).

    Args:
        actor: network from an observation ``(N, K)`` of the view to the action in [-1, 1], ``(N, 2)``, or ``(N, 3)``
            with the declaration of the arrival: a module of PyTorch or TensorDict
            (:func:`magrl.navigators.onnx.exported`), or the path of an ONNX file
            (:class:`magrl.navigators.onnx.OnnxNetwork`).
        view: what it observes, and its scaling and limits.

    Raises:
        ImportError: without the extra ``onnx``.
        ValueError: for a network that cannot be exported, or takes or returns something else.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> network = nn.Sequential(nn.Linear(13, 2), nn.Tanh())
        >>> env.rollout(3, export_policy(network, env.observation_view()))["action"].shape
        torch.Size([2, 3, 2])
    """
    check_type((nn.Module, Path, str), actor=actor)
    check_type(tuple(VIEWS.values()), view=view)
    if isinstance(actor, nn.Module):
        network = exported(actor, view.size)
    else:
        with reading(actor):
            network = OnnxNetwork(Path(actor).read_bytes(), view.size)
    return FieldPolicy(PolicyConfig(view, None), network)


def save_policy(path: Path | str, policy: nn.Module | Path | str, view: View | None = None) -> None:
    """Write a policy as numbers, text and tensors, for :func:`load_policy`.

    Args:
        path: path of the file: ``.onnx`` for a network of any algorithm or library; an existing file is replaced.
        policy: :class:`FieldPolicy`, :class:`~magrl.Anywhere`, :class:`~magrl.navigators.Memory`, or a network, as
            :func:`export_policy` takes it.
        view: what such a network observes.

    Raises:
        TypeError: for a network without what it observes.
        ImportError: for a network without the extra ``onnx``.
        ValueError: for a network that cannot be exported, or a path of another kind of file.
        OSError: if the file cannot be written.

    Example:
        >>> import tempfile
        >>> from magrl.envs import GeomagneticNavEnv
        >>> policy = FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (8,)))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_policy(Path(folder) / "policy.safetensors", policy)
    """
    if isinstance(policy, Anywhere):
        assert isinstance(policy.network, nn.Sequential)
        save_pilot(path, policy.rules, policy.network)
        return
    if isinstance(policy, Memory):
        policy.save(path)
        return
    if not isinstance(policy, FieldPolicy):
        if view is None:
            raise TypeError(f"{policy!r:.80} is saved with what it observes: save_policy('policy.onnx', network, view)")
        policy = export_policy(policy, view)
    network, config = isinstance(policy.actor, OnnxNetwork), asdict(policy.config)
    if network != (Path(path).suffix == ".onnx"):
        kind = "an exported network ends with .onnx, another policy does not"
        raise ValueError(f"the file of {kind}, got {str(path)!r}")
    kind = next(name for name, kind in VIEWS.items() if isinstance(policy.view, kind))
    if network:
        description = {"kind": kind, "view": config["view"], "shield": config["shield"]}
        write_atomically(Path(path), with_description(policy.actor.content, description))
        return
    policy.check_actor()
    weights = {key: value for key, value in policy.actor.state_dict().items() if isinstance(value, Tensor)}
    PolicyFile(kind, config, weights, policy.training).write(path)


def load_policy(path: Path | str, device: torch.device | str = "cpu") -> FieldPolicy | Anywhere | Memory:
    """Read a policy that :func:`save_policy` wrote. Reading a file runs no code from it.

    Args:
        path: ``policy.safetensors`` of a run, another file of :func:`save_policy`, or the name of an agent, such as
            ``"box-TD3"``.
        device: device on which the policy acts.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: for a file ``.onnx`` without the extra ``onnx``.
        ValueError: for a file that is not a policy, of another format, or with weights of other shapes.

    Example:
        >>> load_policy("policy.safetensors")
        Traceback (most recent call last):
        FileNotFoundError: there is no policy file at policy.safetensors
    """
    check_device(device)
    with suppress(ValueError):
        path = pretrained(str(path))
    if Path(path).suffix == ".onnx" and Path(path).is_file():
        return _load_onnx(path).to(device).eval()
    file = read_policy(path, "pilot", "memory", *VIEWS)
    if file.kind in ("pilot", "memory"):
        return (Anywhere if file.kind == "pilot" else Memory)(source=path).to(device).eval()
    with reading(path):
        config = _config(file.kind, **file.config)
        policy = FieldPolicy(config, file.network(config.make_actor))
        policy.training = TrainingSettings(**file.training).model_dump(exclude_unset=True)
    return policy.to(device).eval()


def _config(kind: str, view: Any, num_cells: Any = None, **shape: Any) -> PolicyConfig:
    ranges: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in view.items()}
    return PolicyConfig(VIEWS[kind](**ranges), num_cells, **shape)


def _load_onnx(path: Path | str) -> FieldPolicy:
    """Return the policy of an ONNX file."""
    content = Path(path).read_bytes()
    with reading(path):
        config = _config(**description_of(content))
        return FieldPolicy(config, OnnxNetwork(content, config.view.size))
