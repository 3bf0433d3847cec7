"""Environments that several packages share: another domain with nested keys, the paper's, and other processes."""

from __future__ import annotations

import math
import multiprocessing
import pickle
from collections.abc import Callable
from functools import cache, partial

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, ParallelEnv

from magrl.envs import GeomagneticNavEnv, Scenario, Tasks
from magrl.field import FieldModel
from magrl.geodesy import move, wrap_angle


def nested(name: str) -> NestedKey:
    return ("agents", name)


class PlaneEnv(EnvBase):
    """A walker on a plane that smells two scents: another domain, every key of it nested."""

    def __init__(self, batch_size: tuple[int, ...] = (), dtype: torch.dtype = torch.float32) -> None:
        super().__init__(batch_size=torch.Size(batch_size))
        self.dtype_ = dtype

        def free(*shape: int) -> Unbounded:
            return Unbounded((*self.batch_size, *shape), dtype=dtype)

        def bounded(low: list[float], high: list[float]) -> Bounded:
            ends = (torch.tensor(x, dtype=dtype).expand(*self.batch_size, len(x)) for x in (low, high))
            return Bounded(*ends, (*self.batch_size, len(low)), dtype=dtype)

        angle = partial(bounded, [-math.pi], [math.pi])
        agents = Composite(
            place=free(2),
            obs=bounded([0.0, -2.0], [10.0, 2.0]),
            scent=free(2),
            scent_there=free(2),
            slope=free(2, 2),
            angle=angle(),
            reference=angle(),
            trusted=Binary(1, (*self.batch_size, 1), dtype=torch.bool),
            shape=self.batch_size,
        )
        self.observation_spec = Composite(agents=agents, shape=self.batch_size)
        state = Composite(place=free(2), angle=angle(), shape=self.batch_size)
        self.state_spec = Composite(agents=state, shape=self.batch_size)
        action = Composite(action=bounded([-1.0], [3.0]), shape=self.batch_size)
        self.action_spec = Composite(agents=action, shape=self.batch_size)
        reward = Composite(reward=free(1), shape=self.batch_size)
        self.reward_spec = Composite(agents=reward, shape=self.batch_size)
        self.done_spec = Binary(1, (*self.batch_size, 1), dtype=torch.bool)

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed)

    def _seen(self, place: Tensor, angle: Tensor) -> dict[str, Tensor]:
        slope = torch.tensor([[1.0, 2.0], [-1.0, 0.5]], dtype=self.dtype_).expand(*self.batch_size, 2, 2)
        low, high = (torch.tensor(x, dtype=self.dtype_) for x in ([0.0, -2.0], [10.0, 2.0]))
        return {
            "place": place,
            "obs": low + (high - low) * torch.sigmoid(place),
            "scent": (slope @ place.unsqueeze(-1)).squeeze(-1),
            "scent_there": torch.ones_like(place) * 5,
            "slope": slope,
            "angle": angle,
            "reference": wrap_angle(angle + place[..., :1]),
            "trusted": place[..., 1:] > 0,
        }

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDictBase:  # noqa: ARG002
        place = torch.rand(*self.batch_size, 2, dtype=self.dtype_) - 0.5
        seen = self._seen(place, torch.zeros_like(place[..., :1]))
        return TensorDict({"agents": TensorDict(seen, self.batch_size)}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        angle = wrap_angle(tensordict["agents", "angle"] + tensordict["agents", "action"])
        place = tensordict["agents", "place"] + torch.cat((torch.cos(angle), torch.sin(angle)), -1)
        seen = self._seen(place, angle) | {"reward": place.sum(-1, keepdim=True)}
        done = torch.zeros_like(angle, dtype=torch.bool)
        agents = TensorDict(seen, self.batch_size)
        return TensorDict({"agents": agents, "done": done, "terminated": done.clone()}, self.batch_size)


@cache
def paper_field() -> FieldModel:
    return Scenario().build_field()


def paper_env(num_envs: int = 2, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(field=paper_field()), num_envs=num_envs, **({"seed": 0} | options))


def near(*distances_km: float, rule: str = "declared") -> GeomagneticNavEnv:
    """Vehicles whose targets are some distances northward; a radius of 10 km."""
    start = torch.tensor([[-5.0, 165.0]], dtype=torch.float64).expand(len(distances_km), 2)
    reach = torch.tensor(distances_km, dtype=torch.float64)
    target = torch.stack(move(*start.unbind(-1), torch.zeros_like(reach), reach), -1)
    scenario = Scenario(field=paper_field(), tasks=Tasks(start, target))
    return GeomagneticNavEnv(scenario, num_envs=len(reach), arrival=rule, radius_km=10.0, seed=0)


def parallel(factory: Callable[[], EnvBase]) -> ParallelEnv:
    """Two processes, forked where that is possible because it is ten times as fast as to spawn them."""
    method = "fork" if "fork" in multiprocessing.get_all_start_methods() else "spawn"
    return ParallelEnv(2, pickle.loads(pickle.dumps(factory)), mp_start_method=method)
