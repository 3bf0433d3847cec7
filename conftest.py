"""Fixtures of all tests and doctests."""

import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache

import pytest


@pytest.fixture(scope="session", autouse=True)
def temporary_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Use a folder that pytest removes as the temporary folder of this process and of those that it starts."""
    folder = str(tmp_path_factory.mktemp("temporary"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", folder)
        patch.setattr(tempfile, "tempdir", folder)
        yield


@pytest.fixture(scope="session", autouse=True)
def one_onnx_registry() -> Iterator[None]:
    """Register the operators of ONNX once, not in each export, where this takes half of the time."""
    with (
        pytest.MonkeyPatch.context() as patch,
        suppress(ImportError, AttributeError),
    ):  # private
        from torch.onnx._internal.exporter._registration import ONNXRegistry

        patch.setattr(ONNXRegistry, "from_torchlib", staticmethod(cache(ONNXRegistry.from_torchlib)))
        yield
