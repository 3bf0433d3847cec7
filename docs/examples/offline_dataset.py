"""Write offline datasets in the format of Minari: flights at random, of `secant` and of `kalman`, with noise.

    python docs/examples/offline_dataset.py                                  # 1000 episodes each, in runs/minari
    python docs/examples/offline_dataset.py --field planets --seed 1 --out runs/planets
    MINARI_DATASETS_PATH=runs/minari minari list local

Takes two minutes on one core, and needs the extra `minari`. There is one dataset for each policy and level of white
noise, such as `magrl/earth-kalman-0_05-v0`, where the standard deviation of D is 0.05 deg. At one level, all policies
fly the same trips with the same errors, in random regions of the Earth or of random planets, with an arrival signal.
Observations are `field`, `target_field`, `leg` and `heading`; actions are distance [km] and turn [rad]; the reward is
`SPLReward`. The metadata holds mean returns as references (`ref_min_score` of random actions, `ref_max_score` of
`kalman`), the command, and the call that makes the environment: after `reset(seed=seed)` with the seed of an episode,
vehicle i of it flies episode i.
"""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import magrl
from magrl import paper
from magrl.checks import CheckedModel
from magrl.envs import PUBLIC_KEYS, earth_scenario, planet_scenario
from magrl.envs.gymnasium import ANYWHERE_ID, GeomagneticNavVectorEnv
from magrl.errors import SensorErrors
from magrl.evaluation import evaluation_rollout
from magrl.evaluation.episodes import first_episode_mask
from magrl.evaluation.tracks import LEVELS
from magrl.navigators.names import make_navigator
from magrl.sensor_std import Noise
from magrl.training import UsageError, command, parse
from magrl.training.config import Count, Rising, Seed

import numpy as np
import torch
from tensordict import TensorDictBase

RECIPE = "offline_dataset.py"
POLICIES = ("random", "secant", "kalman")
SCENARIOS = {"earth": earth_scenario, "planets": planet_scenario}


class Config(CheckedModel):
    """Settings of the datasets."""

    field: Literal["earth", "planets"] = "earth"
    """Field of the regions: of the Earth on 2025-01-01 (IGRF-14), or of random planets."""
    episodes: Count = 1000
    """Episodes of each dataset."""
    regions: Count = 128
    """Number of random regions."""
    distance_range_km: Rising = paper.DISTANCE_KM
    """Shortest and longest distance from start to destination [km]."""
    max_steps: Count = 50
    """Legs after which an episode is truncated."""
    seed: Seed = 0
    """Random seed of regions, trips, start headings, noise and random actions, below those of evaluations."""
    out: Path = Path("runs/minari")
    """Folder of Minari datasets, MINARI_DATASETS_PATH of their readers; datasets in it are not replaced."""


def dataset_id(config: Config, policy: str, noise: Noise) -> str:
    """Return the name of a dataset; Minari allows no point in it."""
    return f"magrl/{config.field}-{policy}-{noise[0]:g}-v0".replace(".", "_")


def command_line(config: Config) -> str:
    """Return the command of the settings, without the folder."""
    values = config.model_dump(exclude={"out"}).items()
    words = (f"--{key.replace('_', '-')} {str(value).strip('()').replace(',', '')}" for key, value in values)
    return " ".join((f"python docs/examples/{RECIPE}", *words))


def make_envs(config: Config, noise: Noise) -> tuple[GeomagneticNavVectorEnv, str]:
    """Return one vehicle for each episode, and the call that makes them."""
    region: dict[str, Any] = {"distance_range_km": config.distance_range_km, "max_latitude": 70.0}
    region |= {"start_heading": "random", "max_steps": config.max_steps}
    scenario = SCENARIOS[config.field](config.regions, config.seed, **region)
    options: dict[str, Any] = {"observation": "dict", "scale_actions": False, "seed": config.seed}
    errors = [SensorErrors(noise)]
    envs = GeomagneticNavVectorEnv(config.episodes, task="anywhere", scenario=scenario, transforms=errors, **options)
    parts = f"scenario=magrl.envs.{config.field}_scenario({config.regions}, {config.seed}, **{region})"
    parts += f", transforms=[magrl.errors.SensorErrors({noise})], **{options}"
    return envs, f"gymnasium.make_vec({ANYWHERE_ID!r}, num_envs={config.episodes}, {parts})"


def fly(policy: str, envs: GeomagneticNavVectorEnv, noise: Noise, seed: int) -> TensorDictBase:
    """Return the first episode of each vehicle."""
    env = envs.torchrl_env
    torch.manual_seed(seed)  # of random actions
    navigator = env.rand_action if policy == "random" else make_navigator(policy, env.base_env, sensor_std=noise)
    return evaluation_rollout(env, navigator)


def episodes(rollout: TensorDictBase) -> Iterator[dict[str, Any]]:
    """Yield the arrays of each episode: T + 1 observations, T of all else."""
    rollout = rollout.select(*PUBLIC_KEYS, "action", "next")
    for steps, mask in zip(rollout, first_episode_mask(rollout["next", "done"]), strict=True):
        steps = steps[mask]
        after, both = steps["next"], {key: (steps[key][:1], steps["next", key]) for key in PUBLIC_KEYS}
        names = {"rewards": "reward", "terminations": "terminated", "truncations": "truncated"}
        values = {name: after[key].squeeze(-1).numpy() for name, key in names.items()}
        observations = {key: torch.cat(pair).numpy().astype(np.float32) for key, pair in both.items()}
        yield values | {"observations": observations, "actions": steps["action"].numpy().astype(np.float32)}


def prepare(config: Config) -> None:
    """Let Minari write to the folder of the datasets.

    Raises:
        UsageError: without Minari, or for a dataset that exists.
    """
    if find_spec("minari") is None:
        raise UsageError("minari is not installed: pip install -c constraints.txt -e '.[minari]'")
    for noise, policy in itertools.product(LEVELS, POLICIES):
        if (path := config.out / dataset_id(config, policy, noise)).exists():
            raise UsageError(f"{path} exists: choose another --out")
    os.environ["MINARI_DATASETS_PATH"] = str(config.out)


def write(config: Config, noise: Noise) -> dict[str, float]:
    """Fly all policies at one level of noise, write their datasets, and return their mean returns."""
    import minari
    from minari.data_collector import EpisodeBuffer

    envs, call = make_envs(config, noise)
    flown = {policy: list(episodes(fly(policy, envs, noise, config.seed))) for policy in POLICIES}
    returns = {policy: float(np.mean([x["rewards"].sum() for x in data])) for policy, data in flown.items()}
    notes: dict[str, Any] = {"environment": call, "command": command_line(config), "magrl": magrl.__version__}
    notes |= {"ref_min_score": returns["random"], "ref_max_score": returns["kalman"]}
    spaces = {"observation_space": envs.single_observation_space, "action_space": envs.single_action_space}
    for policy, data in flown.items():
        buffers = [EpisodeBuffer(seed=config.seed, **values) for values in data]
        about = {"algorithm_name": policy, "description": f"Noise of D, I, B_H: {noise} [deg, deg, nT]", **spaces}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of names and addresses that are left out
            made = minari.create_dataset_from_buffers(dataset_id(config, policy, noise), buffers, **about)
        made.storage.update_metadata(notes)
    return {dataset_id(config, policy, noise): mean for policy, mean in returns.items()}


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line, write the datasets and print their mean returns."""
    config = parse(Config, RECIPE, __doc__, args)
    prepare(config)
    for noise in LEVELS:
        for name, mean in write(config, noise).items():
            print(f"{name:32} mean return {mean:7.2f}")


if __name__ == "__main__":
    command(RECIPE, main)
