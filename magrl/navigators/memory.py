"""The agent with a memory: a recurrent network over readings, without a map, a filter or a model of errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from magrl.checks import check_number
from magrl.geodesy import polar, steer
from magrl.navigators.base import Navigator
from magrl.pilot.network import correction_network, pretrained
from magrl.policy_files import PolicyFile, read_policy, reading
from magrl.transforms.sequences import ACCURACY_KEYS, READING_SIZE, observed_reading

LIMITS = {"max_leg_km": 50.0, "max_turn_rad": math.pi / 2}
"""Longest leg, the unit of the outputs, and largest turn, in training."""


class MemoryNetwork(nn.Module):
    """A gated recurrent unit (GRU), an estimate of the displacement to the destination, and its correction.

    Args:
        size: width of the memory and of the hidden layers.
        device: device of the parameters.

    Example:
        >>> network = MemoryNetwork(8)
        >>> leg, hidden = network(torch.zeros(5, READING_SIZE), torch.zeros(5, 1, 8))
        >>> leg.shape, hidden.shape
        (torch.Size([5, 2]), torch.Size([5, 1, 8]))
    """

    def __init__(self, size: int = 128, device: torch.device | str | None = None) -> None:
        super().__init__()
        check_number(1, 65536, whole=True, size=size)
        self.size = size
        self.encode = nn.Sequential(nn.Linear(READING_SIZE, size, device=device), nn.SiLU())
        self.gru = nn.GRU(size, size, batch_first=True, device=device)
        self.estimate = correction_network((size,), device, inputs=size + READING_SIZE)
        self.correct = correction_network((size,), device, inputs=size + READING_SIZE + 2)

    def forward(self, observation: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Return the next leg, northward and eastward in longest legs ``(N, 2)``, and the next memory.

        Args:
            observation: ``(N, 26)``; see :func:`magrl.transforms.sequences.observed_reading`.
            hidden: ``(N, 1, size)`` memory, 0 at the start of an episode.
        """
        output, after = self.gru(self.encode(observation).unsqueeze(1), hidden.transpose(0, 1).contiguous())
        known = torch.cat((output.squeeze(1), observation), -1)
        estimate = self.estimate(known)
        return estimate + self.correct(torch.cat((known, estimate), -1)), after.transpose(0, 1)


def action_of(leg: Tensor, heading: Tensor, max_leg_km: float, max_turn_rad: float) -> Tensor:
    """Return distance [km] and turn [rad] of a leg.

    Args:
        leg: ``(..., 2)`` northward and eastward [longest legs of the training].
        heading: ``(..., 1)`` [rad].
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].

    Example:
        >>> action_of(torch.tensor([0.5, 0.0]), torch.zeros(1), 50.0, 1.5)
        tensor([25.,  0.])
    """
    distance, bearing = polar(leg)
    limits = max_leg_km, max_turn_rad
    return torch.stack(steer(heading.squeeze(-1), bearing, LIMITS["max_leg_km"] * distance, *limits), -1)


class Memory(Navigator):
    """The agent with a memory, which ``recipes/ppo_memory.py`` trains on random planets.

    It reads what its sensors measure, their stated accuracy, and its own legs. An accuracy outside of its training's
    range is taken as the nearest one in it.

    Args:
        source: file of :meth:`save`, or a :class:`MemoryNetwork`; the pretrained agent by default, of *Storm*.
        accuracy: least and largest standard deviations of the training, six each: of errors that are new in each
            reading, and of all others. Those of the file by default; any, with a network.
        limits: longest leg [km] and largest turn [rad]: at most the training's limits.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: for a file of another kind, or a limit or an accuracy out of its range.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.navigators import policy_env
        >>> env, memory = GeomagneticNavEnv(num_envs=2, seed=0), Memory(MemoryNetwork(8))
        >>> policy_env(env, memory).rollout(3, memory)["action"].shape
        torch.Size([2, 3, 2])
    """

    name = "memory"
    description = "memory (recurrent PPO)"
    trained_on = "random planets"
    optional_keys = ACCURACY_KEYS

    accuracy: Tensor

    def __init__(
        self,
        source: MemoryNetwork | Path | str | None = None,
        accuracy: Sequence[Sequence[float]] | None = None,
        **limits: float,
    ) -> None:
        super().__init__(**{name: min(limits.get(name, limit), limit) for name, limit in LIMITS.items()})
        network, known = (source, None) if isinstance(source, MemoryNetwork) else self._read(source)
        self.network = network.float()  # environments write float32
        self.register_buffer("accuracy", _ends(accuracy or known), persistent=False)

    @classmethod
    def _read(cls, path: Path | str | None) -> tuple[MemoryNetwork, Sequence[Sequence[float]] | None]:
        file = read_policy(path or pretrained(cls.name), "memory")
        with reading(path or cls.name):
            accuracy = file.config["accuracy"]
            _ends(accuracy)
            return file.network(partial(MemoryNetwork, file.config["size"])), accuracy

    def save(self, path: Path | str) -> None:
        """Write the network, for the argument ``source``.

        Raises:
            OSError: if the file cannot be written.
        """
        ends = self.accuracy.flatten(1).tolist() if self.accuracy.isfinite().all() else None
        config = {"size": self.network.size, "accuracy": ends}
        PolicyFile("memory", config, dict(self.network.state_dict())).write(path)

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        """Return an empty memory, and the first reading."""
        hidden = torch.zeros(len(seen), 1, self.network.size, dtype=torch.float32, device=seen.device)
        return {"hidden": hidden, "before": seen["field"].clone()}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:
        """Return distance [km] and turn [rad]."""
        reading, heading = seen["field"], seen["heading"]
        stated = [seen.get(key, torch.zeros_like(reading)) for key in ACCURACY_KEYS]
        accuracy = [std.clamp(*ends) for std, ends in zip(stated, self.accuracy.unbind(1), strict=True)]
        observed = observed_reading(
            reading, seen["target_field"], seen["leg"][..., :1], heading, accuracy, memory["before"]
        )
        leg, hidden = self.network(observed, memory["hidden"])
        memory.update({"hidden": hidden, "before": reading})
        return action_of(leg, heading, self.max_leg_km, self.max_turn_rad)


def _ends(accuracy: Sequence[Sequence[float]] | None) -> Tensor:
    """Return the least and largest accuracy ``(2, 2, 3)`` by key of :data:`ACCURACY_KEYS`; raise for another range."""
    low, high = ([0.0] * 6, [math.inf] * 6) if accuracy is None else accuracy
    if len(low) != 6 or len(high) != 6 or not all(0 <= least <= most for least, most in zip(low, high, strict=True)):
        raise ValueError(f"accuracy must be six standard deviations and six that are not less, got {accuracy}")
    return torch.tensor((low, high), dtype=torch.float32).reshape(2, len(ACCURACY_KEYS), 3)
