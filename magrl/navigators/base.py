"""Base class of navigators (policies without training), and what they share.

A navigator reads keys of the plain :class:`magrl.envs.GeomagneticNavEnv` in physical units and writes ``action``
``(N, 2)``: distance [km] and turn [rad]. A navigator that reads privileged keys, or the field at places where the
vehicle has not been, has ``oracle = True``; ``needs`` states what it knows beside its own readings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, TensorDictPrimer, Transform, TransformedEnv

from magrl.checks import check_number
from magrl.envs import PUBLIC_KEYS, GeomagneticNavEnv
from magrl.pilot import Rules
from magrl.sensor_std import PERFECT, STD_KEYS, SensorStd
from magrl.transforms import DeclareArrival, TrackField
from magrl.transforms.track import known_keys

MEMORY = "memory"
"""Key of what a policy remembers of its episode."""


class Navigator(TensorDictModuleBase):
    """Base class of untrained policies: action bounds, and a memory of the episode in the TensorDict.

    A subclass chooses the next leg in :meth:`decide`. A navigator that remembers returns its memory at the start of an
    episode (``elapsed_steps`` 0) in :meth:`first_memory`; it reads ``("memory", ...)`` and writes
    ``("next", "memory", ...)``, as recurrent modules of TorchRL do, so that its actions depend on the TensorDict alone.
    :func:`policy_env` adds these keys to an environment. With the class attributes below, and a place in the list of
    :data:`magrl.navigators.NAVIGATORS`, commands, tables and figures know it by its name.

    Args:
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for a bound out of its range.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.geodesy import steer
        >>> class DueEast(Navigator):
        ...     def decide(self, seen, memory):
        ...         heading = seen["heading"]
        ...         east, distance = torch.full_like(heading, math.pi / 2), torch.full_like(heading, 30.0)
        ...         return steer(heading, east, distance, self.max_leg_km, self.max_turn_rad)
        >>> GeomagneticNavEnv(num_envs=1, seed=0).rollout(2, DueEast())["action"].round(decimals=2)
        tensor([[[30.0000,  1.5700],
                 [30.0000,  0.0000]]])
    """

    in_keys: Any
    """Keys that it reads; by default, the public keys and ``elapsed_steps``."""
    name: str
    """Name in commands; by default, that of the class."""
    label: str
    """Label in figures; by default, the name."""
    description: str
    """Label in tables; by default, the label in figures."""
    oracle: bool = False
    """Whether the navigator reads privileged keys, or the field where the vehicle has not been."""
    needs: str = "nothing"
    """What it needs beside its readings and the standard deviations of the sensors, such as ``"the position"``."""
    trained_on: str = "nothing"
    """What it was trained on."""
    optional_keys: ClassVar[tuple[str, ...]] = STD_KEYS
    """Keys that :meth:`decide` reads where an environment has them."""
    action_size = 2
    """Numbers of the action: 3 with a declaration of the arrival."""
    readings_per_step = 0
    """Readings of the field at places where the vehicle has not been, in each step."""
    options: tuple[str, ...] = ()
    """Further options of :meth:`for_env` that a command has: ``seed``."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        own = vars(cls)
        if "name" in own or not hasattr(cls, "name"):  # otherwise it has those of the class that it changes
            cls.name = own.get("name", cls.__name__)
            cls.label = own.get("label", cls.name)
            cls.description = own.get("description", cls.label)

    def __init__(self, max_leg_km: float = 50.0, max_turn_rad: float = math.pi / 2) -> None:
        super().__init__()
        check_number(0, above=True, max_leg_km=max_leg_km)
        check_number(0, math.pi, above=True, max_turn_rad=max_turn_rad)
        self.max_leg_km, self.max_turn_rad = float(max_leg_km), float(max_turn_rad)
        self.in_keys = list(getattr(self, "in_keys", (*PUBLIC_KEYS, "elapsed_steps")))
        self.out_keys = ["action"]

    @property
    def declares(self) -> bool:
        """Whether its action has a third number, which declares the arrival."""
        return self.action_size > 2

    @property
    def remembers(self) -> bool:
        """Whether it has a memory."""
        return type(self).first_memory is not Navigator.first_memory

    @classmethod
    def for_env(
        cls, env: GeomagneticNavEnv, *, sensor_std: SensorStd | Sequence[float] = PERFECT, **options: Any
    ) -> Self:
        """Return the navigator of an environment.

        Args:
            env: environment to navigate in.
            sensor_std: accuracy of the sensors; three numbers are white noise of D [deg], I [deg], B_H [nT].
            options: further options of the class.

        Raises:
            ValueError: for an option out of its range, or an environment that the navigator cannot navigate in.
        """
        return cls(**cls.bounds(env) | cls.env_options(env, SensorStd.of(sensor_std)) | options)

    @staticmethod
    def bounds(env: GeomagneticNavEnv) -> dict[str, Any]:
        """Return the limits of an environment as the constructor names them."""
        return {"max_leg_km": env.max_leg_km, "max_turn_rad": env.max_turn_rad}

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: SensorStd) -> dict[str, Any]:  # noqa: ARG004
        """Return the options of the constructor, beside bounds, that follow from an environment and its sensors."""
        return {}

    def check_fits(self, env: EnvBase) -> None:
        """Raise a ValueError where an environment is none that it was made for."""

    def fitted(self, env: GeomagneticNavEnv, rules: Mapping[str, Any]) -> Navigator:  # noqa: ARG002
        """Return it for an environment, with rules of :class:`~magrl.pilot.Rules` that say what a vehicle knows."""
        self.check_fits(env)
        return self

    def transforms(self, env: EnvBase, **rules: Any) -> list[Transform]:
        """Return what an environment needs for it: see :func:`policy_env`."""
        base, there = getattr(env, "base_env", env), MEMORY in env.observation_spec.keys()  # noqa: SIM118
        declared = base.scenario.declared and not self.declares
        primer = [self.make_tensordict_primer(env)] if self.remembers and not there else []
        return primer + (track_transforms(env, Rules(**base.limits | rules)) if declared else [])

    def make_tensordict_primer(self, env: EnvBase) -> TensorDictPrimer:
        """Return the transform that adds its memory to an environment."""
        observed = env.observation_spec.zero()
        seen = observed.select(*self.in_keys, *self.optional_keys, strict=False)
        return memory_primer(self.first_memory(seen), env)

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:  # noqa: ARG002
        """Return the memory of vehicles at the start of an episode: tensors ``(N, ...)``; none by default."""
        return {}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor] | Tensor:
        """Return distance [km] and turn [rad], each ``(N,)`` or ``(N, 1)``, or the whole action ``(N, A)``; set what
        changes in the memory."""
        raise NotImplementedError(f"{type(self).__name__} has no method decide(seen, memory), which chooses its legs")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` ``(N, 2)``: distance [km] and turn [rad]; with a declaration, ``(N, 3)``."""
        try:
            seen = tensordict.select(*self.in_keys).update(tensordict.select(*self.optional_keys, strict=False))
            memory = recalled(tensordict, partial(self.first_memory, seen)) if self.remembers else seen.empty()
            chosen = self.decide(seen, memory)
        except KeyError as error:
            reads = f"{type(self).__name__} reads {self.in_keys}, its in_keys"
            remedy = "policy_env(env, policy) returns an environment with a memory, or with a track"
            raise KeyError(f"{reads}: {error.args[0]}; {remedy}") from error
        columns = [chosen] if isinstance(chosen, Tensor) else [each.reshape(*tensordict.shape, 1) for each in chosen]
        tensordict.set("action", torch.cat(columns, -1).to(torch.float32))
        return tensordict.set(("next", MEMORY), memory) if self.remembers else tensordict


def recalled(tensordict: TensorDictBase, first: Callable[[], Mapping[str, Tensor]]) -> TensorDictBase:
    """Return a copy of the memory of a policy; in each row that starts an episode it is the ``first`` one ``(N, ...)``.

    Raises:
        KeyError: for a TensorDict without the memory.

    Example:
        >>> steps, memory = torch.tensor([[0], [4]]), TensorDict({"path": [30.0, 90.0]}, 2)
        >>> state = TensorDict({"elapsed_steps": steps, "memory": memory}, 2)
        >>> recalled(state, lambda: {"path": torch.zeros(2)})["path"]
        tensor([ 0., 90.])
    """
    memory, begins = tensordict[MEMORY], tensordict["elapsed_steps"].squeeze(-1) == 0
    if not begins.any():
        return memory.copy()
    start = TensorDict(dict(first()), batch_size=begins.shape, device=begins.device)
    return start if begins.all() else torch.where(begins, start, memory)


def memory_primer(first: Mapping[str, Tensor], env: EnvBase) -> TensorDictPrimer:
    """Return the transform that adds a memory, such as ``first`` ``(N, ...)``, to an environment of N vehicles."""
    leaves = {key: Unbounded(value.shape, dtype=value.dtype, device=env.device) for key, value in first.items()}
    spec = Composite(leaves, shape=env.batch_size, device=env.device)
    whole = Composite({MEMORY: spec}, shape=env.batch_size, device=env.device)
    return TensorDictPrimer(whole, reset_key="_reset")


def track_transforms(env: EnvBase, rules: Rules) -> list[Transform]:
    """Return the track of a vehicle, and where it must declare its arrival, the declaration; a track that is there is
    used."""
    known, keys = known_keys(env.observation_spec), env.observation_spec.keys()
    track = [] if "track" in keys else [TrackField(rules, known, out_keys=["track"])]
    declare = [] if rules.signaled or "arrival_probability" in keys else [DeclareArrival(rules, known)]
    return [*track, *declare]


def policy_env(env: EnvBase, policy: nn.Module, **rules: Any) -> EnvBase:
    """Return an environment with what a policy reads beside observations: its memory, or the track of its vehicle.

    Where vehicles must declare their arrival and a navigator does not, the track declares it
    (:class:`~magrl.transforms.DeclareArrival`).

    Args:
        env: navigation environment, with transforms or without.
        policy: navigator, recurrent module of TorchRL, or a module that holds them; others need nothing.
        **rules: values of :class:`~magrl.pilot.Rules` beside the limits of the environment, such as ``confidence``.

    Raises:
        ValueError: for a navigator in an environment with scaled actions.

    Example:
        >>> from magrl.navigators import Secant
        >>> env, secant = GeomagneticNavEnv(num_envs=2, seed=0), Secant()
        >>> policy_env(env, secant).rollout(5, secant)["memory", "visited"].shape
        torch.Size([2, 5, 24, 2])
    """
    steps: list[Transform] = []
    modules: Any = policy.modules() if isinstance(policy, nn.Module) else ()
    for module in modules:
        if isinstance(module, Navigator):
            if "observation" not in module.in_keys and env.action_spec.space.low[..., 0].min() < 0:
                raise ValueError(f"{module.name} acts in km and rad: take an environment with scale_actions=False")
            steps += module.transforms(env, **rules)
        elif hasattr(module, "make_tensordict_primer") and "is_init" not in env.observation_spec.keys():  # noqa: SIM118
            steps += [InitTracker(), module.make_tensordict_primer()]
    return TransformedEnv(env, Compose(*steps), auto_unwrap=True) if steps else env
