"""Counts and running means of a training, and its best policy so far."""

from __future__ import annotations

import copy
import math
from collections import deque
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from magrl.checks import check_number

RETURN_TERMS = ("destination", "proximity", "alignment")
"""Terms of the reward whose sums over an episode are reported beside the return."""


class TrainingStatistics:
    """Counts of a training, and means over its last episodes.

    Args:
        window: number of episodes in ``return``, its terms and ``success_rate``, as in Figs. 4-2 and 4-3.

    Attributes:
        frames, episodes, iterations, updates: counts since the start of the training.
        losses: last value of each loss, by name.

    Example:
        >>> from tensordict import TensorDict
        >>> after = TensorDict(episode_reward=torch.tensor([[5.0], [230.0]]))
        >>> after["success"] = after["done"] = torch.tensor([[False], [True]])
        >>> statistics = TrainingStatistics()
        >>> statistics.add(TensorDict(next=after, batch_size=[2]))
        >>> statistics.frames, statistics.episodes, statistics.row()["return"]
        (2, 1, 230.0)
    """

    def __init__(self, window: int = 200) -> None:
        check_number(1, whole=True, window=window)
        self.frames = self.episodes = self.iterations = self.updates = 0
        self.losses: dict[str, Tensor] = {}
        keys = ("success_rate", "return", *(f"return_{term}" for term in RETURN_TERMS))
        self._windows: dict[str, deque[float]] = {key: deque(maxlen=window) for key in keys}

    def add(self, batch: TensorDictBase) -> None:
        """Count a batch of transitions.

        Args:
            batch: ``(B,)`` with ``next``: ``success``, ``done``, ``episode_reward`` and, as far as they are there,
                ``episode_reward_destination`` and the other terms, from TorchRL's ``RewardSum``.
        """
        after = batch["next"]
        ended = after["done"]
        self.iterations += 1
        self.frames += batch.numel()
        self.episodes += int(ended.sum())
        self._windows["success_rate"].extend((100 * after["success"][ended].double()).tolist())
        for name in ("", *(f"_{term}" for term in RETURN_TERMS)):
            value = after.get(f"episode_reward{name}", None)
            if value is not None:
                self._windows[f"return{name}"].extend(value[ended].tolist())

    def row(self) -> dict[str, float]:
        """Return the counts, the means over the window (NaN before the first episode ends) and the losses."""
        counts = {key: getattr(self, key) for key in ("frames", "episodes", "updates")}
        means = {key: sum(values) / len(values) if values else math.nan for key, values in self._windows.items()}
        return {**counts, **means, **{name: loss.item() for name, loss in self.losses.items()}}

    def state_dict(self) -> dict[str, Any]:
        """Return counts, windows and losses."""
        counts = {key: getattr(self, key) for key in ("frames", "episodes", "iterations", "updates")}
        losses = {name: loss.item() for name, loss in self.losses.items()}
        return {**counts, "losses": losses, "windows": {key: list(values) for key, values in self._windows.items()}}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore counts, windows and losses."""
        for key in ("frames", "episodes", "iterations", "updates"):
            setattr(self, key, int(state_dict[key]))
        self.losses = {name: torch.tensor(loss) for name, loss in state_dict["losses"].items()}
        for key, values in state_dict["windows"].items():
            self._windows[key].clear()
            self._windows[key].extend(values)


class BestPolicy:
    """The weights with the best score so far.

    Example:
        >>> best, layer = BestPolicy(), nn.Linear(1, 1)
        >>> for score in (90.0, 95.0, 80.0):
        ...     _ = nn.init.constant_(layer.weight, score)
        ...     best.offer(score, layer)
        >>> best.score, best.weights["weight"].item()
        (95.0, 95.0)
    """

    def __init__(self) -> None:
        self.score = float("-inf")
        self.weights: dict[str, Any] | None = None

    def offer(self, score: float, module: nn.Module) -> None:
        """Keep the weights of ``module`` if their score is the best so far.

        Raises:
            ValueError: for a score that is not finite: no later score could be compared with it.
        """
        check_number(score=score)
        if score > self.score:
            self.score, self.weights = score, copy.deepcopy(module.state_dict())

    def state_dict(self) -> dict[str, Any]:
        """Return the score and the weights."""
        weights = None if self.weights is None else {k: v for k, v in self.weights.items() if isinstance(v, Tensor)}
        return {"score": self.score, "weights": weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the score and the weights."""
        self.score, self.weights = state_dict["score"], state_dict["weights"]


def selection_score(spl: float, success: Tensor, steps: Tensor, max_steps: int) -> float:
    """Return the score by which the policy of a training is selected: SPL [%] minus the mean number of steps.

    A failed episode counts ``max_steps`` steps, however early it ended, so that failing is never worth a step.

    Args:
        spl: success weighted by path length [%].
        success: ``(M,)`` bool.
        steps: ``(M,)`` steps of each episode.
        max_steps: step limit of an episode.

    Example:
        >>> selection_score(50.0, torch.tensor([True, False]), torch.tensor([10, 3]), max_steps=50)
        20.0
    """
    check_number(spl=spl)
    check_number(1, whole=True, max_steps=max_steps)
    return spl - torch.where(success, steps, max_steps).double().mean().item()
