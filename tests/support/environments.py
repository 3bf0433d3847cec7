"""Environments that several packages share: the paper's, and other processes."""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Callable
from functools import cache

import torch
from torchrl.envs import EnvBase, ParallelEnv

from magrl.envs import GeomagneticNavEnv, Scenario, Trips
from magrl.field import FieldModel
from magrl.geodesy import move


@cache
def paper_field() -> FieldModel:
    """The field of the paper's region, also where legs with errors of motion lead."""
    return Scenario().build_field(80.0)


def paper_env(num_envs: int = 2, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(field=paper_field()), num_envs=num_envs, **({"seed": 0} | options))


def near(*distances_km: float, rule: str = "declared", **options: object) -> GeomagneticNavEnv:
    """Vehicles whose targets are some distances northward; a radius of 10 km."""
    start = torch.tensor([[-5.0, 165.0]], dtype=torch.float64).expand(len(distances_km), 2)
    reach = torch.tensor(distances_km, dtype=torch.float64)
    target = torch.stack(move(*start.unbind(-1), torch.zeros_like(reach), reach), -1)
    scenario = Scenario(field=paper_field(), trips=Trips(start, target))
    return GeomagneticNavEnv(scenario, num_envs=len(reach), arrival=rule, radius_km=10.0, seed=0, **options)


def parallel(factory: Callable[[], EnvBase]) -> ParallelEnv:
    """Two processes, forked where that is possible because it is ten times as fast as to spawn them."""
    method = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
    return ParallelEnv(2, pickle.loads(pickle.dumps(factory)), mp_start_method=method)
