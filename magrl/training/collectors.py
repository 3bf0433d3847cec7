"""Collectors: one environment in this process, or environments in actors of a Ray cluster."""

from __future__ import annotations

import copy
import os
import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from magrl.checks import library
from magrl.commands import UsageError
from magrl.jobs import connected
from magrl.random_numbers import FIRST_RESERVED_SEED

OPTIONS: dict[str, Any] = {"track_traj_ids": False, "auto_register_policy_transforms": False}


class LostCollectorError(UsageError):
    """A remote collector ended before its training.

    Example:
        >>> raise LostCollectorError("a collector ended")
        Traceback (most recent call last):
        magrl.training.collectors.LostCollectorError: a collector ended
    """


def make_collector(env: EnvBase, policy: TensorDictModuleBase, **options: Any) -> Collector:
    """Return a collector whose batches are used before the next one is made.

    Args:
        env: environment; its device holds the batches.
        policy: policy with its exploration.
        **options: options of TorchRL's ``Collector``, such as ``frames_per_batch`` and ``total_frames``.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> collector = make_collector(env, env.rand_action, frames_per_batch=4, total_frames=8)
        >>> next(iter(collector)).shape
        torch.Size([2, 2])
        >>> collector.shutdown()
    """
    return Collector(env, policy, return_same_td=True, **options, **OPTIONS)


class RemoteCollector:
    """Batches of ``config.collectors`` environments in Ray actors, each with an equal share of the vehicles.

    Collection is synchronous, with the newest weights. The actors start with the first batch, with consecutive seeds
    from the random numbers of this process, so that episodes differ from those before a resume. They use the processor;
    batches are on the device of the training, without the vehicles' tracks, which are 98 % of their bytes.

    Args:
        make_env: function that makes the environment of an actor, from settings with its seed and number of vehicles.
        config: settings of the training, a :class:`~magrl.training.config.PlanetConfig`.
        policy: policy with its exploration, whose weights are sent before each batch.
        **options: ``frames_per_batch`` and ``total_frames`` of TorchRL's ``RayCollector``.

    Raises:
        ImportError: without Ray.
        ConnectionError: from the iterator, if there is no cluster at the address.
        UsageError: from the iterator, for a cluster with too few processors, or an actor that ends.
    """

    def __init__(
        self, make_env: Callable[[Any], EnvBase], config: Any, policy: TensorDictModuleBase, **options: Any
    ) -> None:
        self._ray, self._actors = library("ray", "ray"), cast(Any, None)
        self._make_env, self._config, self._policy, self._options = make_env, config, policy, options

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yield batches ``(vehicles, steps)`` without end."""
        try:
            self._start()
            while True:
                yield torch.cat(self._actors.map_fn("next")).to(self._config.device)
                weights = self._ray.put(TensorDict.from_module(self._policy).data.cpu())  # once for each machine
                self._actors.map_fn("update_policy_weights_", [(weights,)] * self._config.collectors)
        except self._ray.exceptions.RayActorError as error:
            reason = str(error).strip().splitlines()[-1].partition(". ")[0]
            raise LostCollectorError(f"a collector ended: {reason}") from error

    def shutdown(self) -> None:
        """End the actors, and the instance of Ray if it is the training's own."""
        if self._actors is not None:
            self._actors.shutdown()
        self._ray.shutdown()

    def _start(self) -> None:
        from torchrl.collectors.distributed import RayCollector

        count, handler = self._config.collectors, signal.getsignal(signal.SIGTERM)
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        self._ray.cloudpickle.register_pickle_by_value(sys.modules[self._make_env.__module__])  # no other node has it
        connected(self._config.address, count)
        if signal.getsignal(signal.SIGTERM) is not handler:  # Ray's own would end this process without a checkpoint
            signal.signal(signal.SIGTERM, handler)
        if (processors := self._ray.cluster_resources().get("CPU", 0)) < count:
            raise UsageError(f"{count} collectors need a processor each, the Ray cluster has {processors:g}")
        first = int(torch.randint(FIRST_RESERVED_SEED - count, ()))
        self._actors = RayCollector(
            [partial(_worker_env, self._make_env, self._config, first + number) for number in range(count)],
            copy.deepcopy(self._policy).cpu(),
            collector_class=Collector,
            sync=True,
            collector_kwargs=OPTIONS | {"postproc": _without_track},
            remote_configs={"num_cpus": 1, "num_gpus": 0},
            weight_sync_schemes={},  # they need a port of this machine, and its name
            **self._options,
        )


def _worker_env(make_env: Callable[[Any], EnvBase], config: Any, seed: int) -> EnvBase:
    """Return the environment of an actor, whose exploration has its seed, too."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    share = {"num_envs": config.num_envs // config.collectors, "seed": seed, "device": "cpu"}
    return make_env(config.model_copy(update=share))


def _without_track(batch: TensorDictBase) -> TensorDictBase:
    return batch.exclude("track", ("next", "track"))
