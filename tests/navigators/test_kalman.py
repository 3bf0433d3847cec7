"""The dual-control navigator: what it predicts, how it chooses, and how it arrives."""

from __future__ import annotations

import pytest
from support.tracks import STD
from torchrl.envs import TransformedEnv

from magrl.envs import GeomagneticNavEnv, Scenario, task_set
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.navigators import Kalman
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


def test_bad_options_are_refused() -> None:
    for options in ({"bias_std": (0.1, -0.1, 1.0)}, {"max_steps": 0}, {"prior": "igrf"}, {"range_km": 0.0}):
        with pytest.raises(ValueError, match=next(iter(options))):
            Kalman(**options)
