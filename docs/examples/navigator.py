"""A navigator of your own: two legs at a right angle, then quasi-Newton steps with Broyden's update.

    python docs/examples/navigator.py    # seconds

The two legs give a first Jacobian J of D and I, and the vehicle heads for where both have their target values. After a
leg d, over which D and I change by c, Broyden's update makes J explain it: J + (c - J d) d^T / |d|^2.
"""

from __future__ import annotations

from magrl import GeomagneticNavEnv, Scenario, episode_measures, evaluation_rollout, summarize
from magrl.geodesy import steer
from magrl.guidance import displacement_to
from magrl.navigators import Navigator

import torch
from tensordict import TensorDictBase
from torch import Tensor


class SimpleSecant(Navigator):
    """Make two legs at a right angle, then quasi-Newton steps to the destination."""

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        """Return what an episode starts with: the reading, and an unknown Jacobian of D and I."""
        here = seen["field"][:, :2].double()  # D and I [deg]
        return {"here": here, "jacobian": here.new_zeros(len(here), 2, 2)}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return distance [km] and turn [rad]."""
        here, target = (seen[key][:, :2].double() for key in ("field", "target_field"))
        heading = seen["heading"].squeeze(-1).double()
        direction = torch.stack((heading.cos(), heading.sin()), -1)  # north, east
        leg = seen["leg"][:, :1].double() * direction  # of the last leg [km]
        innovation = here - memory["here"] - (memory["jacobian"] @ leg.unsqueeze(-1)).squeeze(-1)
        square = leg.square().sum(-1).clamp_min(1e-9)[:, None, None]
        jacobian = memory["jacobian"] + innovation.unsqueeze(-1) * leg.unsqueeze(-2) / square
        memory.update({"here": here, "jacobian": jacobian})

        left = displacement_to(target - here, jacobian)
        bearing = torch.atan2(left[:, 1], left[:, 0])
        distance, turn = steer(heading, bearing, left.norm(dim=-1), self.max_leg_km, self.max_turn_rad)
        step = seen["elapsed_steps"].squeeze(-1)
        probe_turn = torch.where(step == 0, 0.0, self.max_turn_rad)
        return torch.where(step < 2, 10.0, distance), torch.where(step < 2, probe_turn, turn)


scenario = Scenario()
env = GeomagneticNavEnv(scenario.with_trips(scenario.random_trips(100, seed=7)), num_envs=100)
summary = summarize(episode_measures(evaluation_rollout(env, SimpleSecant())))
print(f"SR {summary['success_rate']:.1f} %, SPL {summary['spl']:.1f} %")
