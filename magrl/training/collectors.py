"""TorchRL's collectors in one process, in several processes, or on a Ray cluster."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase

from magrl import paper

CollectorBackend = Literal["process", "ray"]


def make_collector(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    workers: Sequence[Callable[[], EnvBase]] = (),
    backend: CollectorBackend = "process",
    **options: Any,
) -> BaseCollector:
    """Return a collector of ``env`` in this process, or of ``workers`` if there are several.

    Args:
        env: environment; its device is that of the batches.
        policy: policy with its exploration.
        workers: makers of environments, one for each process; with one or none, ``env`` is used.
        backend: ``"process"`` or ``"ray"``, for several workers.
        **options: options of TorchRL's ``Collector``, such as ``frames_per_batch`` and ``total_frames``.

    Example:
        >>> from torchrl.modules import RandomPolicy
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> collector = make_collector(env, RandomPolicy(env.action_spec), frames_per_batch=4, total_frames=8)
        >>> next(iter(collector)).shape
        torch.Size([2, 2])
        >>> collector.shutdown()
    """
    if len(workers) <= 1:
        options |= {"track_traj_ids": False, "auto_register_policy_transforms": False}
        return Collector(env, policy, return_same_td=True, **options)  # a batch is used before the next one is made
    options = {"device": env.device, **options}
    if backend == "ray":
        options |= {"backend_options": _ray_options(env, len(workers))}
    return Collector(list(workers), policy, backend=backend, sync=True, **options)


def _ray_options(env: EnvBase, workers: int) -> dict[str, Any]:
    """Return options for one CPU and a share of the GPUs per worker, and the path on which workers find the recipe."""
    path = os.pathsep.join(filter(None, (*sys.path[:1], os.environ.get("PYTHONPATH"))))
    cluster = {"log_to_driver": False, "include_dashboard": False, "runtime_env": {"env_vars": {"PYTHONPATH": path}}}
    on_gpu = env.device is not None and env.device.type == "cuda"
    gpus = min(1.0, torch.cuda.device_count() / workers) if on_gpu else 0
    return {"remote_configs": {"num_cpus": 1, "num_gpus": gpus}, "ray_init_config": cluster}


def worker_seed(seed: int, index: int) -> int:
    """Return the seed of the tasks of one of several collectors.

    Example:
        >>> worker_seed(0, 1)
        2000006
    """
    return (seed + 1_000_003 * (index + 1)) % paper.FIRST_RESERVED_SEED
