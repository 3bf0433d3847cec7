"""Where is this water from? A vehicle in an estuary finds the place of a sample by two dissolved tracers.

Two outfalls, one on either bank, each release a tracer that the current carries north and spreads. The vehicle
measures both concentrations where it is, and knows those of the sample, and its heading: not where it is, nor where the
outfalls are.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

LOW_KM, HIGH_KM = torch.tensor([0.0, -5.0]), torch.tensor([10.0, 5.0])  # north, east: the estuary between its banks
OUTFALLS_KM = torch.tensor([[-2.0, -6.0], [-2.0, 6.0]])
SPREAD_KM = 1.0  # twice the diffusivity over the current: how far a tracer creeps against it
ARRIVAL_KM = 0.5


def concentration(position: Tensor) -> Tensor:
    """Logarithms of the two concentrations, as a sensor with as many decades gives them.

    A steady source in a current that carries it north falls, at a distance r of which x lie northward, as
    ``exp(-(r - x) / SPREAD_KM) / sqrt(r)``: the far field of advection with diffusion in the plane.

    Args:
        position: ``(..., 2)`` north, east [km].

    Returns:
        ``(..., 2)``, 0 where the concentration is that of 1 km north of the outfall.
    """
    apart = position.unsqueeze(-2) - OUTFALLS_KM
    distance = apart.square().sum(-1).sqrt()
    return -(distance - apart[..., 0]) / SPREAD_KM - distance.log() / 2


class PlumeEnv(EnvBase):
    """Journeys between random places of the estuary, by moves of up to 1 km after a turn of up to 90 degrees.

    The reward of a move is what it takes off the difference of the tracers, and 10 for arriving within 0.5 km.
    """

    batch_locked = True

    def __init__(self, num_envs: int = 64, seed: int = 0) -> None:
        super().__init__(batch_size=[num_envs])

        def bounded(low: Tensor | float, high: Tensor) -> Bounded:
            shape = (num_envs, *high.shape)
            return Bounded(torch.as_tensor(low).expand(shape), high.expand(shape), shape)

        self.observation_spec = Composite(
            tracers=bounded(-12.0, torch.zeros(2)),
            target_tracers=bounded(-12.0, torch.zeros(2)),
            heading=bounded(-math.pi, torch.tensor([math.pi])),
            position=bounded(LOW_KM, HIGH_KM),
            target_position=bounded(LOW_KM, HIGH_KM),
            shape=(num_envs,),
        )
        self.state_spec = self.observation_spec.clone()
        self.action_spec = bounded(torch.tensor([0.0, -math.pi / 2]), torch.tensor([1.0, math.pi / 2]))  # km, rad
        self.reward_spec = Unbounded((num_envs, 1))
        self.done_spec = Binary(1, (num_envs, 1), dtype=torch.bool)
        self.set_seed(seed)

    def _set_seed(self, seed: int) -> None:
        self.random = torch.Generator().manual_seed(seed)

    def _reset(self, _: TensorDictBase | None = None) -> TensorDictBase:
        draws = torch.rand(5, *self.batch_size, generator=self.random)
        start, target = (LOW_KM + (HIGH_KM - LOW_KM) * ends.T for ends in (draws[:2], draws[2:4]))
        return self._seen(start, target, (2 * draws[4:].T - 1) * math.pi)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        distance, turn = tensordict["action"].split(1, -1)
        heading = torch.remainder(tensordict["heading"] + turn + math.pi, 2 * math.pi) - math.pi
        moved = tensordict["position"] + distance * torch.cat((heading.cos(), heading.sin()), -1)
        after = self._seen(moved.clamp(LOW_KM, HIGH_KM), tensordict["target_position"], heading)
        left_before, left = (
            (td["target_tracers"] - td["tracers"]).norm(dim=-1, keepdim=True) for td in (tensordict, after)
        )
        arrived = (after["position"] - after["target_position"]).norm(dim=-1, keepdim=True) < ARRIVAL_KM
        return after.update({"reward": left_before - left + 10.0 * arrived, "done": arrived, "terminated": arrived})

    def _seen(self, position: Tensor, target: Tensor, heading: Tensor) -> TensorDict:
        seen = {"tracers": concentration(position), "target_tracers": concentration(target), "heading": heading}
        return TensorDict(seen | {"position": position, "target_position": target}, self.batch_size)
