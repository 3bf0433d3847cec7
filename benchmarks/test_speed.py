"""Absolute times, for whoever watches them over commits: `python -m pytest benchmarks --benchmark-autosave`."""

from __future__ import annotations

import pytest
import torch

from benchmarks import env, update
from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.field import IGRF, FieldModel


@pytest.fixture(params=["IGRF", "RegionalField"], scope="module")
def field(request: pytest.FixtureRequest) -> FieldModel:
    return IGRF("2022-01-01", 13) if request.param == "IGRF" else Scenario().build_field()


@pytest.fixture(scope="module")
def places() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(2, 10_000, generator=generator, dtype=torch.float64)
    return -10 * unit[0], 160 + 10 * unit[1]


def test_field(benchmark, field: FieldModel, places) -> None:
    assert benchmark(field, *places).shape == (10_000, 3)


def test_field_and_gradient(benchmark, field: FieldModel, places) -> None:
    assert benchmark(field.value_and_gradient, *places)[1].shape[0] == 10_000


@pytest.mark.parametrize("vehicles", [64, 1024, 16384])
def test_step(benchmark, vehicles: int) -> None:
    stepper = env.Stepper(GeomagneticNavEnv(num_envs=vehicles, seed=0))
    benchmark(stepper)
    assert stepper.state.shape == (vehicles,)


@pytest.mark.parametrize("vehicles", [64, 1024])
def test_guided_collection(benchmark, vehicles: int) -> None:
    collecting = env.Collecting(vehicles)
    benchmark(collecting)
    assert next(collecting.batches).numel() == vehicles


def test_gradient_step(benchmark) -> None:
    recipe = update.Recipe(update.OBSERVATION_SIZE)
    benchmark(recipe.update, update.transitions(update.OBSERVATION_SIZE))
    assert recipe.updates > 0
