"""Pilots: dual control by a belief of the field, and the agent that corrects its plan."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase, Transform

from magrl.envs import GeomagneticNavEnv
from magrl.navigators.base import Navigator, track_transforms
from magrl.pilot.network import load_pilot, pretrained
from magrl.pilot.step import Rules, act
from magrl.transforms.track import KNOWN_KEYS, READ_KEYS, reading_of, track_of

LIMITS = ("max_leg_km", "max_turn_deg")


class Kalman(Navigator):
    """Dual control by a belief of the field around the vehicle; see :mod:`magrl.pilot.step`.

    It reads the ``track`` of a :class:`~magrl.transforms.TrackField`, which :func:`~magrl.navigators.policy_env` adds
    with its rules.

    Args:
        rules: what the vehicle knows before it starts.
        network: from an observation of the track to a correction of its plan; None to fly as planned.
        changes: values of :class:`~magrl.pilot.Rules` that replace those.

    Source:
        A. A. Feldbaum, Dual control theory, Automation and Remote Control 21 (1960): an action both steers and probes.

    Example:
        >>> from magrl.navigators import policy_env
        >>> env, kalman = GeomagneticNavEnv(num_envs=2, seed=0), Kalman()
        >>> flown = policy_env(env, kalman).rollout(15, kalman, break_when_any_done=False)
        >>> bool(flown["next", "success"].any(1).all())
        True
    """

    name = "kalman"
    label = "Kalman"
    description = "Kalman (dual control)"
    needs = "the field's spectrum"
    in_keys = (*READ_KEYS, "track")
    optional_keys: ClassVar[tuple[str, ...]] = KNOWN_KEYS

    def __init__(self, rules: Rules | None = None, network: nn.Module | None = None, **changes: Any) -> None:
        chosen = (rules or Rules()).replace(**changes)
        super().__init__(chosen.max_leg_km, chosen.max_turn_rad)
        self.rules, self.network = chosen, network

    def fitted(self, env: GeomagneticNavEnv, rules: Mapping[str, Any]) -> Self:
        """Return it within the limits of an environment, or its own where these are shorter."""
        shorter = {key: min(env.limits[key], getattr(self.rules, key)) for key in LIMITS}
        return type(self)(self.rules.replace(**env.limits | dict(rules) | shorter), self.network)

    @staticmethod
    def bounds(env: GeomagneticNavEnv) -> dict[str, Any]:
        """Return the rules that a vehicle knows."""
        return env.limits

    def transforms(self, env: EnvBase, **rules: Any) -> list[Transform]:
        """Return the track by its rules, and where these ask for it, the declaration of the arrival."""
        return track_transforms(env, self.rules.replace(**rules))

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:  # noqa: ARG002
        """Return distance [km] and turn [rad]."""
        return act(self.rules, track_of(seen["track"]), reading_of(seen), self.network)


class Anywhere(Kalman):
    """The agent that corrects the plan of :class:`Kalman` by a network, which was trained on random planets.

    Args:
        rules: as of :class:`Kalman`; the training's by default.
        source: file of ``save_pilot``, or a network from the observation to a correction; the
            pretrained agent by default.
        changes: values of :class:`~magrl.pilot.Rules` that replace those.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: for a file that is no pilot.

    Example:
        >>> Anywhere(max_steps=80).rules.max_steps
        80
    """

    name = "anywhere"
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
        super().__init__(rules or trained, network, **changes)
