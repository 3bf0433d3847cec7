"""Source localization in an estuary: a vehicle finds the place of a water sample by two dissolved tracers.

Two outfalls, one on each bank, release one tracer each, which the current carries north and spreads. The vehicle
measures both concentrations at its position and knows its heading and the concentrations of the sample. It does not
know its position or those of the outfalls.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

LOW_KM, HIGH_KM = torch.tensor([0.0, -5.0]), torch.tensor([10.0, 5.0])  # corners of the estuary: north, east
OUTFALLS_KM = torch.tensor([[-2.0, -6.0], [-2.0, 6.0]])
SPREAD_KM = 1.0  # twice the diffusivity divided by the speed of the current
ARRIVAL_KM = 0.5


def concentration(position: Tensor) -> Tensor:
    """Return the logarithms of the two concentrations.

    In a uniform current to the north, the concentration of a steady source falls with the distance r and its northward
    part x as ``exp(-(r - x) / SPREAD_KM) / sqrt(r)``: the far field of plane advection and diffusion.

    Args:
        position: ``(..., 2)`` north, east [km].

    Returns:
        ``(..., 2)``, relative to the concentration 1 km north of the outfall.
    """
    apart = position.unsqueeze(-2) - OUTFALLS_KM
    distance = apart.square().sum(-1).sqrt()
    return -(distance - apart[..., 0]) / SPREAD_KM - distance.log() / 2


class PlumeEnv(EnvBase):
    """Episodes between random places of the estuary, by moves of up to 1 km after turns of up to 90 degrees.

    The reward of a step is the decrease of the distance between the two tracer vectors, plus 10 for arriving within
    0.5 km.

    Args:
        num_envs: number of vehicles.
        seed: random seed of the tasks and start headings.
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
        self.observation_spec["move"] = self.action_spec.clone()
        self.reward_spec = Unbounded((num_envs, 1))
        self.done_spec = Binary(1, (num_envs, 1), dtype=torch.bool)
        self.set_seed(seed)

    def _set_seed(self, seed: int) -> None:
        self.random = torch.Generator().manual_seed(seed)

    def _reset(self, _: TensorDictBase | None = None) -> TensorDictBase:
        draws = torch.rand(5, *self.batch_size, generator=self.random)
        start, target = (LOW_KM + (HIGH_KM - LOW_KM) * ends.T for ends in (draws[:2], draws[2:4]))
        return self._seen(start, target, (2 * draws[4:].T - 1) * math.pi, torch.zeros_like(start))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        distance, turn = tensordict["action"].split(1, -1)
        heading = torch.remainder(tensordict["heading"] + turn + math.pi, 2 * math.pi) - math.pi
        moved = tensordict["position"] + distance * torch.cat((heading.cos(), heading.sin()), -1)
        after = self._seen(moved.clamp(LOW_KM, HIGH_KM), tensordict["target_position"], heading, tensordict["action"])
        left_before, left = (
            (td["target_tracers"] - td["tracers"]).norm(dim=-1, keepdim=True) for td in (tensordict, after)
        )
        arrived = (after["position"] - after["target_position"]).norm(dim=-1, keepdim=True) < ARRIVAL_KM
        return after.update({"reward": left_before - left + 10.0 * arrived, "done": arrived, "terminated": arrived})

    def _seen(self, position: Tensor, target: Tensor, heading: Tensor, move: Tensor) -> TensorDict:
        seen = {"tracers": concentration(position), "target_tracers": concentration(target), "heading": heading}
        return TensorDict(seen | {"move": move, "position": position, "target_position": target}, self.batch_size)
