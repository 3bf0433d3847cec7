"""A check of modules on another device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode


def check_one_device(monkeypatch: pytest.MonkeyPatch, module: nn.Module, step: Callable[[Callable], Any]) -> None:
    """Run a step of a module on another device than the processor; raise where tensors of two devices meet.

    Fake tensors have a device and no values, so that no accelerator is needed. It is "meta", as torch for processors
    alone knows no "cuda". A branch on values is taken.

    Args:
        monkeypatch: of pytest.
        module: module, which moves to the device.
        step: called with a function that moves a TensorDict there.
    """
    module.to("meta")

    def moved(td: TensorDictBase) -> TensorDictBase:
        return td.apply(lambda value: torch.empty_like(value, device="meta"), device=torch.device("meta"))

    with monkeypatch.context() as patch, FakeTensorMode(allow_non_fake_inputs=True):  # constants move by themselves
        patch.setattr(torch.Tensor, "__bool__", lambda _: True)
        step(moved)
