"""Trained policies that come with the library; beside each file is a card with its training, figures and limits."""

from __future__ import annotations

from pathlib import Path

import torch

from magrl.agents.policy import FieldPolicy, load_policy
from magrl.checks import check_choice

_FOLDER = Path(__file__).parent


def load_pretrained(name: str, device: torch.device | str = "cpu") -> FieldPolicy:
    """Return a trained policy that comes with the library.

    It plans for the 120 steps of its training until another number is given: :func:`magrl.evaluate` and
    :class:`magrl.vehicle.onboard.Onboard` give theirs, and in a loop of one's own :meth:`FieldPolicy.for_env` does.

    Args:
        name: ``"anywhere"``, which navigates without a map (``recipes/ppo_anywhere.py``).
        device: device on which the policy acts.

    Raises:
        ValueError: for an unknown name, listing the known ones.

    Example:
        >>> load_pretrained("anywhere").config.num_cells
        (128, 128, 128)
    """
    names = sorted(path.stem for path in _FOLDER.glob("*.safetensors"))
    check_choice(names, pretrained_policy=name)
    return load_policy(_FOLDER / f"{name}.safetensors", device)
