"""The network that corrects a plan, and the files of pilots: rules, and weights of a network."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import nn

from magrl.checks import check_choice, check_number, check_type
from magrl.pilot.observation import OBSERVATION_SIZE
from magrl.pilot.step import Rules
from magrl.policy_files import PolicyFile, read_policy, reading

_PRETRAINED = Path(__file__).parent.parent / "navigators" / "pretrained"


def correction_network(
    num_cells: Sequence[int], device: torch.device | str | None = None, *, inputs: int = OBSERVATION_SIZE
) -> nn.Sequential:
    """Return a perceptron from an observation ``(..., K)`` to a correction ``(..., 2)`` of the plan, which is 0 at
    first.

    Args:
        num_cells: width of each hidden layer, with layer normalization and ReLU.
        device: device of the parameters.
        inputs: size K of the observation.

    Raises:
        ValueError: for a size that is not a whole number from 1 to 65536.

    Example:
        >>> correction_network((32, 32))(torch.zeros(5, 19))[0]
        tensor([0., 0.], grad_fn=<SelectBackward0>)
    """
    check_type(Sequence, num_cells=num_cells)
    layers: list[nn.Module] = []
    width = inputs
    for cells in num_cells:
        check_number(1, 65536, whole=True, num_cells=cells)
        layers += [nn.Linear(width, cells, device=device), nn.LayerNorm(cells, device=device), nn.ReLU()]
        width = cells
    last = nn.Linear(width, 2, device=device)
    for parameter in last.parameters():
        if device != "meta":
            nn.init.zeros_(parameter)
    return nn.Sequential(*layers, last)


def save_pilot(path: Path | str, rules: Rules, network: nn.Module | None) -> None:
    """Write the rules of a pilot and its network, one of :func:`correction_network`, for :func:`load_pilot`.

    Raises:
        TypeError: for another network.
        OSError: if the file cannot be written.
    """
    if not isinstance(network, nn.Sequential):
        raise TypeError(f"the network of a pilot must be one of correction_network, got {type(network).__name__}")
    num_cells = [layer.out_features for layer in network if isinstance(layer, nn.Linear)][:-1]
    plain = rules.model_dump(exclude={"model", "start_km", "target_km", "target_std"})
    PolicyFile("pilot", {"rules": plain, "num_cells": num_cells}, dict(network.state_dict())).write(path)


def load_pilot(path: Path | str) -> tuple[Rules, nn.Sequential]:
    """Read the rules and the network of :func:`save_pilot`. Reading a file runs no code from it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for a file that is not a pilot, of another format, or with weights of other shapes.

    Example:
        >>> rules, network = load_pilot(pretrained("anywhere"))
        >>> rules.max_steps, len(network)
        (120, 10)
    """
    file = read_policy(path, "pilot")
    with reading(path):
        rules = Rules(**file.config["rules"])
        return rules, file.network(partial(correction_network, file.config["num_cells"]))


def pretrained(name: str) -> Path:
    """Return the file of a pretrained agent, such as ``"anywhere"`` or ``"nogo-TD3"``, of the table of scores.

    Raises:
        ValueError: for an unknown name, listing the known ones.

    Example:
        >>> pretrained("anywhere").name
        'anywhere.safetensors'
    """
    files = {path.stem: path for path in sorted(_PRETRAINED.iterdir()) if path.suffix in (".onnx", ".safetensors")}
    check_choice(files, pretrained_policy=name)
    return files[name]


def pilot_of(navigator: str | Path | nn.Module) -> tuple[Rules, nn.Module | None] | None:
    """Return the rules and the network of a pilot, None for any other navigator.

    Args:
        navigator: ``"kalman"``, which has no network; ``"anywhere"``; a file; or a module, which is copied.

    Example:
        >>> pilot_of("kalman")[1], pilot_of("secant")
        (None, None)
    """
    rules: Any = getattr(navigator, "rules", None)
    if navigator == "kalman":
        return Rules(), None
    if isinstance(rules, Rules):
        return rules, copy.deepcopy(getattr(navigator, "network", None))
    path = pretrained("anywhere") if navigator == "anywhere" else navigator
    if isinstance(path, Path) or (str(path).endswith(".safetensors") and read_policy(str(path)).kind == "pilot"):
        return load_pilot(str(path))
    return None
