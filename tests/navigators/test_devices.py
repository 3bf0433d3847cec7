"""Navigators on another device than the processor."""

from __future__ import annotations

import pytest
import torch
from support.conformance import check_one_device
from tensordict import TensorDict

from magrl.envs import GeomagneticNavEnv
from magrl.navigators import NAVIGATORS
from magrl.navigators.metaheuristics import Metaheuristic
from magrl.sensor_std import STD_KEYS
from magrl.tracking import earth_model


@pytest.mark.parametrize("name", sorted({*NAVIGATORS} - {"kalman"}))  # which is in anywhere
def test_a_navigator_stays_on_the_device_of_what_it_sees(name: str, monkeypatch) -> None:
    """In a decision, without the choice of rows in a batch, whose number depends on values."""
    arrival = "declared" if name in ("anywhere", "dead_reckoning") else "objective"
    env = GeomagneticNavEnv(num_envs=2, seed=0, arrival=arrival)
    small = {"generations": 2, "population_size": 3} if issubclass(NAVIGATORS[name], Metaheuristic) else {}
    navigator = NAVIGATORS[name].for_env(env, **small)
    if name == "dead_reckoning":
        navigator = navigator.fitted(env, {"model": earth_model("IGRF-13", "2022-01-01")})
    seen = env.reset().update({key: torch.zeros(2, 3) for key in STD_KEYS})
    seen = seen.select(*navigator.in_keys, *navigator.optional_keys, strict=False)

    def decide(moved) -> None:
        there = moved(seen)
        step = there["elapsed_steps"].squeeze(-1)
        memory = {"decided_at": step, "field_readings": step, "action": there["heading"]}
        navigator.decide(there, TensorDict(memory | navigator.first_memory(there), 2))

    check_one_device(monkeypatch, navigator, decide)
