"""Navigators by a belief of the field: dual control, and the agent that corrects its plan."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from magrl.envs import GeomagneticNavEnv
from magrl.navigators.base import Navigator
from magrl.sensor_std import STD_KEYS
from magrl.tracking.network import load_pilot, pretrained
from magrl.tracking.pilot import Reading, Rules, State, Track, act, advance, begin, blank, declaring, step
from magrl.transforms.errors.known import PLACE_KEYS
from magrl.transforms.track import READ_KEYS, reading_of


class Kalman(Navigator):
    """Dual control by a belief of the field around the vehicle; see :mod:`magrl.tracking.pilot`.

    It reads the accuracy of the readings and what is known at the start, where the environment has them. Where the
    arrival must be declared, it declares, and writes the probability of being right as ``arrival_probability``.

    Args:
        rules: what the vehicle knows before it starts.
        changes: values of :class:`~magrl.tracking.Rules` that replace those.

    Source:
        A. A. Feldbaum, Dual control theory, Automation and Remote Control 21 (1960): an action both steers and probes.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> bool(env.rollout(15, Kalman(), break_when_any_done=False)["next", "success"].any(1).all())
        True
    """

    name = "kalman"
    label = "Kalman"
    description = "Kalman (dual control)"
    needs = "the field's spectrum"
    optional_keys: ClassVar[tuple[str, ...]] = (*STD_KEYS, *PLACE_KEYS)

    def __init__(self, rules: Rules | None = None, **changes: Any) -> None:
        chosen = (rules or Rules()).replace(**changes)
        super().__init__(chosen.max_move_km, chosen.max_turn_rad)
        self.in_keys = list(READ_KEYS)
        self.network: nn.Module | None = None
        self._follow(chosen)

    def _follow(self, rules: Rules) -> None:
        self.rules, self.action_size = rules, 2 if rules.signaled else 3
        self.out_keys = ["action"] if rules.signaled else ["action", "arrival_probability"]

    def adapted(self, **changes: Any) -> Self:
        """Return the navigator by other rules, with the same network and no memory.

        Example:
            >>> Kalman().adapted(step_price=1.0).rules.step_price
            1.0
        """
        other = copy.copy(self)
        other._modules, other.memory = dict(self._modules), None
        other._follow(self.rules.replace(**changes))
        return other

    def fitted(self, env: GeomagneticNavEnv, rules: Mapping[str, Any]) -> Self:
        """Return it within the limits of an environment, or its own where these are shorter."""
        shorter = {key: min(env.limits[key], getattr(self.rules, key)) for key in LIMITS}
        return self.adapted(**env.limits | dict(rules) | shorter)

    @staticmethod
    def bounds(env: GeomagneticNavEnv) -> dict[str, Any]:
        """Return the rules that a vehicle knows."""
        return env.limits

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        """Return an empty state."""
        probability = {} if self.rules.signaled else {"arrival_probability": torch.zeros_like(seen["heading"])}
        return blank(reading_of(seen))._asdict() | probability

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:
        """Return the action after the track has taken in the reading."""
        reading, state = reading_of(seen), State(*(memory[name] for name in State._fields))
        first = memory["decided_at"] < 0  # of an episode, or of a batch that it has not seen
        if first.all():
            track = begin(self.rules, reading)
        else:
            track = step(self.rules, state, reading) if first.any() else advance(self.rules, state, reading)
        memory.update(track.state._asdict())
        action, probability = self._act(track, reading, seen)
        if probability is not None:
            memory["arrival_probability"] = probability.unsqueeze(-1).to(action)
        return action

    def _act(self, track: Track, reading: Reading, seen: TensorDictBase) -> tuple[Tensor, Tensor | None]:  # noqa: ARG002
        action, decision = act(self.rules, track, reading, self.network)
        return action, None if decision is None else decision.probability


class Anywhere(Kalman):
    """The agent that corrects the plan of :class:`Kalman` by a network, which was trained on random planets.

    Args:
        rules: as of :class:`Kalman`; the training's by default.
        source: file of :func:`magrl.tracking.save_pilot`, or a network from the observation to a correction; the
            pretrained agent by default.
        changes: values of :class:`~magrl.tracking.Rules` that replace those.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: for a file that is no pilot.

    Example:
        >>> Anywhere(max_steps=80).rules.max_steps
        80
    """

    name = "anywhere"
    label = "anywhere"
    description = "anywhere (PPO)"
    trained_on = "random planets"

    def __init__(
        self, rules: Rules | None = None, source: nn.Module | Path | str | None = None, **changes: Any
    ) -> None:
        if isinstance(source, nn.Module):
            trained, network = Rules(), source
        else:
            trained, network = load_pilot(pretrained("anywhere") if source is None else source)
            changes |= {key: min(changes[key], getattr(trained, key)) for key in LIMITS if key in changes}
        super().__init__(rules or trained, **changes)
        self.network = network


LIMITS = ("max_move_km", "max_turn_deg")


class Declaring(Kalman):
    """Another navigator, whose arrival is declared from a track of its own readings.

    Args:
        navigator: navigator or policy of the plain environment, which writes distance and turn.
        rules: as of :class:`Kalman`.

    Example:
        >>> from magrl.navigators import Secant
        >>> env = GeomagneticNavEnv(num_envs=2, arrival="declared", seed=0)
        >>> env.rollout(3, Declaring(Secant(), **env.limits))["action"].shape
        torch.Size([2, 3, 3])
    """

    def __init__(self, navigator: TensorDictModuleBase, rules: Rules | None = None, **changes: Any) -> None:
        super().__init__(rules, **changes | {"arrival": "declared"})
        self.navigator = navigator
        keys = [*self.in_keys, *getattr(navigator, "in_keys", ())]
        self.in_keys = list(dict.fromkeys(keys))
        self.oracle, self.needs = (getattr(navigator, name, getattr(Navigator, name)) for name in ("oracle", "needs"))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` ``(N, 3)``."""
        wanted = self.navigator(tensordict.copy())["action"][..., :2]
        written = super().forward(tensordict.copy().set("wanted", wanted))
        return tensordict.update(written.select(*self.out_keys))

    def _act(self, track: Track, reading: Reading, seen: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        action, decision = declaring(self.rules, track, reading, seen["wanted"])
        return action, decision.probability

    @property
    def optional_keys(self) -> tuple[str, ...]:  # type: ignore[override]
        """Keys that it reads where an environment has them."""
        return (*Kalman.optional_keys, "wanted")

    @property
    def field_readings(self) -> Tensor:
        """``(N,)`` int64: readings of the navigator at places where the vehicle has not been."""
        return getattr(self.navigator, "field_readings", super().field_readings)
