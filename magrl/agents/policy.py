"""Trained policies as navigators, and the files of policies of any kind.

A policy reads public keys of the plain environment and writes an action, both in physical units, so that it needs no
transforms and is used like every other navigator.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import Compose, EnvBase

from magrl.agents.exported import ExportedPolicy, TrainedPolicy, rebuild
from magrl.agents.networks import Device, make_actor, make_correcting_actor
from magrl.agents.pipeline import export_policy
from magrl.checks import check_finite, check_type, short
from magrl.files import load_tensors, save_tensors
from magrl.sensor_std import STD_KEYS
from magrl.transforms import ObservationView, TrackView
from magrl.transforms.errors.known_start import START_KEYS
from magrl.transforms.track import TRACK_KEYS

POLICY_FORMAT = 3
VIEWS: dict[str, type[ObservationView] | type[TrackView]] = {"region": ObservationView, "track": TrackView}
"""What policies observe, by the kind that their files name."""
LIMITS = ("max_move_km", "max_turn_rad")


@dataclass(frozen=True)
class PolicyConfig:
    """All that is needed to rebuild a policy, except its weights.

    Args:
        view: what the policy observes, and its scaling: values scaled to a region, or estimates of its own track.
        num_cells: width of each hidden layer; None for a plan without a network, of a :class:`TrackView`.
        layer_norm: whether hidden layers are normalized.

    Raises:
        TypeError: for a view of another type.
        ValueError: for widths that are not positive whole numbers.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> view = GeomagneticNavEnv(seed=0).observation_view()
        >>> PolicyConfig(view, (32, 32)).layer_norm
        True
    """

    view: ObservationView | TrackView
    num_cells: tuple[int, ...] | None
    layer_norm: bool = True

    def __post_init__(self) -> None:
        check_type((ObservationView, TrackView), view=self.view)
        self.make_actor("meta")  # checks the sizes

    def make_actor(self, device: Device = None) -> TensorDictSequential:
        """Return an actor of this shape, with new weights."""
        if isinstance(self.view, TrackView):
            return make_correcting_actor(self.view, self.num_cells, device=device)
        if self.num_cells is None:
            raise ValueError(
                f"num_cells must be the widths of the hidden layers with {type(self.view).__name__}, got None"
            )
        return make_actor(self.view.size, self.num_cells, layer_norm=self.layer_norm, device=device)


class FieldPolicy(TrainedPolicy):
    """A trained agent as a navigator of the plain environment, in physical units.

    A policy that reads its own track (:class:`~magrl.transforms.TrackView`) keeps its own state for each vehicle from
    the start of an episode (``elapsed_steps`` 0) on. Another call in the same step begins with the same state as the
    first, so that calling it twice on one state changes nothing. Such a policy reads the accuracy of the readings
    (:data:`magrl.sensor_std.STD_KEYS`); without these keys it is perfect. Where the environment has a
    :class:`~magrl.transforms.TrackField`, it reads that belief and computes none of its own.

    Args:
        config: what the policy observes, and the shape of its network.
        actor: trained actor of that shape; one with new weights by default.

    Raises:
        TypeError: for a configuration of another type.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> policy = FieldPolicy(PolicyConfig(env.observation_view(), (32, 32)))
        >>> env.rollout(2, policy)["action"].shape
        torch.Size([2, 2, 2])
    """

    def __init__(self, config: PolicyConfig, actor: TensorDictModuleBase | None = None) -> None:
        super().__init__()
        check_type(PolicyConfig, config=config)
        self.config, self.view = config, config.view
        self.in_keys = list(config.view.in_keys)
        self.observe = Compose(*config.view.observation_transforms())
        if isinstance(config.view, TrackView):
            self.observe_tracked = Compose(*config.view.observation_transforms(tracked=True))
        self.act = config.view.action_transform()
        self.actor = config.make_actor().float() if actor is None else actor  # environments write float32
        self.state_keys = config.view.state_keys

    def adapted(self, **changes: Any) -> FieldPolicy:
        """Return the policy with other options of its view, such as ``search`` or ``step_price``; it shares weights.

        Args:
            changes: options of the view.

        Raises:
            TypeError: for an option that the view does not have.
            ValueError: for another longest move or largest turn, where the policy does not correct a plan.

        Example:
            >>> from magrl.agents import load_pretrained
            >>> load_pretrained("anywhere").adapted(step_price=1.0).config.view.step_price
            1.0
        """
        config = replace(self.config, view=replace(self.config.view, **changes))
        limits = [(name, getattr(self.view, name), getattr(config.view, name)) for name in LIMITS]
        if changed := [f"{name} is {old:g}, not {new:g}" for name, old, new in limits if new != old]:
            if not isinstance(self.view, TrackView):
                raise ValueError(f"the actions of this policy are scaled to the limits of its training: {changed[0]}")
            actor = config.make_actor()
            actor.load_state_dict(self.actor.state_dict(), assign=True)
            return FieldPolicy(config, actor)
        return FieldPolicy(config, self.actor)

    def for_env(self, env: EnvBase) -> FieldPolicy:
        """Return the policy on the device of an environment, for its limits: those of a plan are adapted.

        Example:
            >>> from magrl import GeomagneticNavEnv, load_pretrained
            >>> load_pretrained("anywhere").for_env(GeomagneticNavEnv(max_steps=80, seed=0)).view.max_steps
            80
        """
        policy, base = self, getattr(env, "base_env", env)
        if isinstance(self.view, TrackView):
            limits = {name: min(getattr(self.view, name), getattr(base, name)) for name in LIMITS}
            limits |= {"zeta": base.zeta, "max_steps": base.max_steps}
            limits["radius_km"] = base.arrival.radius_km if base.arrival.rule == "distance" else None
            searches = self.view.search and not base.arrival.declared
            policy = self.adapted(**limits, search=searches).to(base.device)
        policy.check_fits(base)
        return policy

    def check_fits(self, env: EnvBase) -> None:
        """Raise unless an environment has the field of the policy, allows its moves and turns, and is as it plans.

        Raises:
            ValueError: naming the element and both ranges, or both limits.

        Example:
            >>> from magrl import GeomagneticNavEnv, load_pretrained
            >>> load_pretrained("anywhere").check_fits(GeomagneticNavEnv(seed=0))
            Traceback (most recent call last):
            ValueError: the policy plans for max_steps 120, the environment has 50: fly policy.for_env(env)
        """
        super().check_fits(env)
        view, base = self.view, getattr(env, "base_env", env)
        for name in ("zeta", "max_steps") if isinstance(view, TrackView) else ():
            planned, limit = getattr(view, name), getattr(base, name)
            if planned != limit:
                difference = f"{name} {planned:g}, the environment has {limit:g}"
                raise ValueError(f"the policy plans for {difference}: fly policy.for_env(env)")
        (move, turn), (longest, largest) = (
            (round(part.max_move_km, 3), round(math.degrees(part.max_turn_rad), 3)) for part in (view, base)
        )
        if move > longest or turn > largest:
            raise ValueError(
                f"the policy was trained for moves up to {move:g} km and turns up to {turn:g}°, the environment allows "
                f"{longest:g} km and {largest:g}°: evaluate with max_move_km={move:g} and max_turn_deg={turn:g}, or "
                "train one for these limits"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` ``(..., 2)``: distance [km] and turn [rad]."""
        seen = tensordict.select(*self.in_keys)
        if not self.state_keys:
            action = self.actor(self.observe(seen))["action"]
            return tensordict.set("action", self.act.denormalize("action", action))
        before, starts = self._state_before(seen)
        observed = self._track(
            seen.update(tensordict.select(*STD_KEYS, *START_KEYS, *TRACK_KEYS, strict=False)), before, starts
        )
        action = self.actor(observed)["action"]
        self._keep_state(seen, before, starts, observed.select(*self.state_keys).detach())
        return tensordict.set("action", self.act.denormalize("action", action))

    def _track(self, seen: TensorDictBase, state: TensorDictBase | None, starts: Tensor) -> TensorDictBase:
        """Return the observation after the last move."""
        tracked = all(key in seen.keys() for key in TRACK_KEYS)  # noqa: SIM118 - a TensorDict is no mapping
        observe = self.observe_tracked if tracked else self.observe
        for key in STD_KEYS:
            seen[key] = seen.get(key, torch.zeros_like(seen["field"]))
        if state is None or starts.all():
            return observe(seen)
        observed = observe(state.copy().set("next", seen.copy()))["next"]
        return torch.where(starts.squeeze(-1), observe(seen), observed) if starts.any() else observed


def kalman(**options: Any) -> FieldPolicy:
    """Return dual control by the belief of the field: the policy that flies as planned, without a network.

    Args:
        options: options of :class:`~magrl.transforms.TrackView` other than its defaults: moves up to 50 km, turns up to
            90 degrees, 50 steps, and the arrival threshold 0.01.

    Source:
        A. A. Feldbaum, Dual control theory, Automation and Remote Control 21 (1960): an action both steers and probes.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> bool(env.rollout(50, kalman(), break_when_any_done=False)["next", "success"].any(1).all())
        True
    """
    usual: dict[str, Any] = {"zeta": 0.01, "max_steps": 50, "max_move_km": 50.0, "max_turn_rad": math.pi / 2}
    return FieldPolicy(PolicyConfig(TrackView(**usual | options), num_cells=None))


def save_policy(path: Path | str, policy: TensorDictModuleBase, env: EnvBase | None = None) -> None:
    """Write a policy as numbers, text and tensors, for :func:`load_policy`.

    A policy of another class is exported first, with the transforms that it needs, and compared with its export in
    flight (:func:`export_policy`).

    Args:
        path: path of the file; an existing file is replaced.
        policy: policy of any algorithm; a stochastic one is saved with its deterministic sample.
        env: environment of the training, with its transforms; not needed for a :class:`FieldPolicy` or an
            :class:`ExportedPolicy`.

    Raises:
        TypeError: for a policy that is no TensorDict module, or of another class without an environment.
        ValueError: for a policy that cannot be exported, with the reason.
        OSError: if the file cannot be written.

    Example:
        >>> import tempfile
        >>> from magrl.envs import GeomagneticNavEnv
        >>> policy = FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (8,)))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_policy(Path(folder) / "policy.safetensors", policy)
    """
    check_type(TensorDictModuleBase, policy=policy)
    if not isinstance(policy, (FieldPolicy, ExportedPolicy)):
        if env is None:
            raise TypeError(
                f"a {type(policy).__name__} is saved with the transforms of its environment: "
                "save_policy(path, policy, env)"
            )
        policy = export_policy(policy, env)
    if isinstance(policy, ExportedPolicy):
        save_tensors({"format": POLICY_FORMAT, "exported": policy.content()}, Path(path))
        return
    weights = {key: value for key, value in policy.actor.state_dict().items() if isinstance(value, Tensor)}
    kind = next(name for name, view in VIEWS.items() if isinstance(policy.config.view, view))
    config = asdict(policy.config) | {"kind": kind}
    save_tensors({"format": POLICY_FORMAT, "config": config, "weights": weights}, Path(path))


def load_policy(path: Path | str, device: torch.device | str = "cpu") -> FieldPolicy | ExportedPolicy:
    """Read a policy that :func:`save_policy` wrote. Reading a file runs no code from it.

    Args:
        path: ``policy.safetensors`` of a run, or another file of :func:`save_policy`.
        device: device on which the policy acts.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for a file that is not a policy, of another format, or with weights of other shapes.

    Example:
        >>> from magrl.agents import pretrained
        >>> load_policy(Path(pretrained.__file__).parent / "anywhere.safetensors").config.num_cells
        (128, 128, 128)
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no policy file at {path}")
    content = load_tensors(path)
    version = content.pop("format", None) if isinstance(content, dict) else None
    if version != POLICY_FORMAT:
        raise ValueError(
            f"{path} is a policy of format {short(version)}; this version reads format {POLICY_FORMAT}: train it again"
        )
    try:
        policy = rebuild(**content) if "exported" in content else _rebuild(**content)
        return policy.to(device).eval()
    except Exception as error:  # whatever foreign content raises
        raise ValueError(f"{path} does not hold a valid policy: {' '.join(str(error).split())}") from error


def _rebuild(config: Any, weights: Any) -> FieldPolicy:
    view = VIEWS[config.pop("kind")](**config.pop("view"))
    rebuilt = PolicyConfig(view, **config)
    # Compares the shapes before anything is allocated: a few bytes may ask for any number of cells
    rebuilt.make_actor("meta").load_state_dict(weights, assign=True)
    check_finite(weights.items(), "weights")
    policy = FieldPolicy(rebuilt)
    policy.actor.load_state_dict(weights)
    return policy
