"""Environments and episodes on which the tests of the errors stand."""

from __future__ import annotations

import torch
from support.environments import paper_env
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import step_mdp

from magrl.envs import GeomagneticNavEnv
from magrl.errors import ERRORS, Conditions, MotionError, SensorErrors

STD = (0.05, 0.05, 5.0)


def nav(num_envs: int = 2, **options: object) -> GeomagneticNavEnv:
    return paper_env(num_envs, **{"drift_km": 30.0} | options)


def under(*errors: Transform, num_envs: int = 2) -> TransformedEnv:
    return TransformedEnv(nav(num_envs), Compose(*errors))


SENSORS = {
    "noise": STD,
    "bias": (0.1, 0.1, 20.0),
    "scale": (0.0, 0.0, 1e-3),
    "drift": (0.05, 0.05, 10.0),
    "resolution": (0.01, 0.01, 1.0),
    "outage_rate": 0.2,
    "vector": {"hard_iron_nt": (50.0,) * 3, "soft_iron": ((1e-3,) * 3,) * 3, "attitude_deg": (0.1, 0.1)},
}
MOTION = {"log_scale": 0.02, "log_noise": 0.01, "compass_deg": 3.0, "current_km_h": 2.0, "eddies_km_h": 0.5}
SIZES = {
    "motion": MOTION,
    "weather": {"span_h": 100.0},
    "sensors": SENSORS,
    "spikes": {"sizes": (1.0, 1.0, 100.0), "rate": 0.1},
    "north": "marine",
}


def sensor_errors(**options: object) -> SensorErrors:
    return SensorErrors(**SENSORS | options)


def motion_error(**options: object) -> MotionError:
    return MotionError(**MOTION, speed_km_h=30.0, **options)


def every_error(seed: int = 0) -> Compose:
    """All errors of the table; one that :data:`SIZES` lacks has the sizes of its defaults."""
    errors = {name: SIZES.get(name, {}) for name in ERRORS}
    return Compose(*Conditions("every", 30.0, errors).transforms(seed))


def all_errors(num_envs: int = 2, seed: int = 0) -> TransformedEnv:
    return TransformedEnv(nav(num_envs), every_error(seed))


def actions(steps: int, num_envs: int) -> Tensor:
    draws = torch.rand(steps, num_envs, 2, generator=torch.Generator().manual_seed(0))
    return draws * torch.tensor([50.0, 1.5])


def flown(env: EnvBase, steps: Tensor) -> list[TensorDict]:
    """States of some legs, the first included."""
    states = [env.reset()]
    for action in steps:
        states.append(step_mdp(env.step(states[-1].clone().set("action", action))))
    return states


def assert_same(one: TensorDict, other: TensorDict, rows: Tensor | slice = slice(None)) -> None:
    for key in one.keys(True, True):
        assert torch.equal(one[key][rows], other[key][rows]), key
