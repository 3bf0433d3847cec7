"""The dual-control navigator: what it predicts, how it chooses, and how it arrives."""

from __future__ import annotations

import math

import pytest
import torch
from support.tracks import STD, f64
from torchrl.envs import TransformedEnv

from magrl.envs import GeomagneticNavEnv, Scenario, task_set
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.navigators import Kalman
from magrl.tracking import dipole_prior
from magrl.transforms import SensorNoise


@pytest.mark.parametrize(
    ("std", "success", "spl"), [((0.0, 0.0, 0.0), 99.0, 97.0), (STD, 97.0, 86.0), ((0.1, 0.1, 10.0), 93.0, 83.0)]
)
def test_it_arrives_without_a_map_with_and_without_noise(std: tuple[float, ...], success: float, spl: float) -> None:
    scenario = Scenario(tasks=task_set(100, seed=93))
    base = GeomagneticNavEnv(scenario, num_envs=100, seed=0, start_heading="random")
    env = TransformedEnv(base, SensorNoise(std)) if any(std) else base
    found = summarize(episode_measures(evaluation_rollout(env, Kalman(sensor_std=std))))
    assert found["success_rate"] > success
    assert found["spl"] > spl


def test_without_the_learned_prior_it_has_that_of_a_dipole() -> None:
    reading, target = f64((8.0, -16.0, 35000.0)), f64((9.0, -20.0, 34500.0))
    learned, dipole = (Kalman(prior=prior).prior(reading, target) for prior in ("learned", "dipole"))
    torch.testing.assert_close(tuple(dipole), tuple(dipole_prior(reading)))
    assert not torch.allclose(learned[0], dipole[0])


def test_bad_options_are_refused() -> None:
    bad = {"sensor_std": (0.1, -0.1, 1.0), "max_steps": 0, "zeta": math.nan, "range_km": 0.0, "caution": -1.0}
    for name, value in (bad | {"step_price": 0.0, "prior": "igrf"}).items():
        with pytest.raises(ValueError, match=name):
            Kalman(**{name: value})
