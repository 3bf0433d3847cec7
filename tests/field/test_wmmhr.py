"""WMMHR-2025 against its published coefficients and values."""

from __future__ import annotations

import gzip
import hashlib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

import magrl.field
from magrl.field import WMMHR, FieldBank, RegionalField, wmmhr_coefficients
from magrl.field.wmmhr import WMMHR_SHA256

DATA = Path(__file__).parent.parent / "data"
BOX = (-10.0, 0.0), (160.0, 170.0)


@cache
def wmmhr(date: float) -> WMMHR:
    return WMMHR(date)


def test_coefficients_are_those_of_the_published_file() -> None:
    path = Path(magrl.field.__file__).parent / "wmmhr2025.cof.gz"
    assert hashlib.sha256(gzip.decompress(path.read_bytes())).hexdigest() == WMMHR_SHA256
    table = wmmhr_coefficients(2025.0)
    assert complex(table[1, 0]) == -29351.7976
    assert complex(table[133, 133]) == 0.01 + 0.0005j
    assert (table != 0).sum() == 9044
    assert not table.triu(1).any()


def test_wmmhr_gives_its_published_values() -> None:
    """At heights of 3 to 93 km, at its epoch and 4.5 years later; its change in time is linear."""
    table = torch.from_numpy(np.loadtxt(DATA / "wmmhr2025_test_values.txt"))
    years, altitude_km, latitude, longitude = table[:, :4].T
    early, late = (wmmhr(year)(latitude, longitude, altitude_km) for year in (2025.0, 2029.5))
    found = torch.where(years.unsqueeze(-1) == 2025.0, early, late)
    assert table.shape == (16, 10)
    assert (found - table[:, 4:7]).abs().max() < 1e-3
    assert ((late - early) / 4.5 - table[:, 7:]).abs().max() < 1e-5


@pytest.mark.parametrize("date", ["2024-12-31", "2030-01-02", 2024.9])
def test_dates_outside_the_model_raise(date) -> None:
    with pytest.raises(ValueError, match="is outside WMMHR-2025, which is valid from 2025-01-01 to 2030-01-01"):
        WMMHR(date)


def test_expansions_of_wmmhr() -> None:
    """A region and a bank agree with the model and its gradient; too low a degree raises."""
    with pytest.raises(ValueError, match="degree 16 misses the field"):
        RegionalField(wmmhr(2025.0), *BOX, degree=16)
    region = RegionalField(wmmhr(2025.0), *BOX, degree=24)
    assert region.error_nt < 1e-4
    latitude, longitude = torch.tensor([-9.7, -3.0, -0.1]).double(), torch.tensor([160.2, 164.0, 169.0]).double()
    value, gradient = wmmhr(2025.0).value_and_gradient(latitude, longitude)
    assert (region.value_and_gradient(latitude, longitude)[1] - gradient).abs().max() < 1e-5
    edges = (torch.tensor([x], dtype=torch.float64) for x in BOX)
    gauss, zero = wmmhr_coefficients(2025.0).unsqueeze(0), torch.zeros(1, dtype=torch.int64)
    bank = FieldBank.build(gauss, zero, *edges, degree=24)
    assert (bank(latitude, longitude, zero) - value).abs().max() < 1e-4
