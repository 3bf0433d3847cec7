"""Bars of the named tasks: what navigators without training reach on the first episode of 200 vehicles.

    python recipes/tables/bars.py    # a minute; prints them with their returns

The seed is reserved for evaluations: ``envs.reset(seed=SEED)`` of 200 vehicles starts the same episodes. Oracles are
the true bearing, which knows where vehicle and destination are, and the shortest path around all no-go areas. The
episodes of *Readings* are those of *Anywhere*: only what a policy observes is different.
"""

from __future__ import annotations

import math
from functools import cache

from magrl.envs.navigation import NAMED_ENVS
from magrl.evaluation import evaluation_rollout, score
from magrl.evaluation.episodes import first_episode_mask
from magrl.evaluation.navigators import make_navigator
from magrl.evaluation.scores import SEED
from magrl.evaluation.tables import markdown_table
from magrl.training import command
from magrl.transforms.areas import NoGoAreas, distance_km, turned

import torch
import tyro
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

VEHICLES = 200
COLUMNS = ("SR", "SPL", "steps", "return")
BARS = {"secant": "secant", "kalman": "kalman", "anywhere": "anywhere (pretrained)"}
BARS |= {"geodesic": "true bearing (oracle)", "detour": "shortest path around the areas (oracle)"}


class Detour(TensorDictModuleBase):
    """Follow the shortest path around the no-go areas, through points beside their edges: an oracle."""

    in_keys, out_keys = ["true_way", "heading", "no_go_areas"], ["action"]
    BESIDE_KM, POINTS = 3.0, 12

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        heading, numbers = tensordict["heading"], tensordict["no_go_areas"]
        centers, radii = NoGoAreas.discs(numbers)
        leg = self._next(numbers[..., -2:], centers, radii)
        ahead = turned(leg, -heading)
        turn = torch.atan2(ahead[..., 1], ahead[..., 0])
        length = torch.where(turn.abs() > math.pi / 2, 0.0, leg.norm(dim=-1).clamp(max=50.0))
        return tensordict.set("action", torch.stack((length, turn.clamp(-math.pi / 2, math.pi / 2)), -1))

    def _next(self, place: Tensor, centers: Tensor, radii: Tensor) -> Tensor:
        """Return the first leg of the shortest path, ``(..., 2)`` [km]."""
        angle = torch.arange(self.POINTS) * 2 * math.pi / self.POINTS
        apart = (radii + self.BESIDE_KM) / math.cos(math.pi / self.POINTS)
        corners = centers.unsqueeze(-2) + apart[..., None, None] * torch.stack((torch.cos(angle), torch.sin(angle)), -1)
        nodes = torch.cat((place.unsqueeze(-2), torch.zeros_like(place).unsqueeze(-2), corners.flatten(-3, -2)), -2)
        begin, end = nodes.unsqueeze(-2), nodes.unsqueeze(-3)
        met = distance_km(centers[:, None, None], *torch.broadcast_tensors(begin, end)) < radii[:, None, None] + 1
        length = (begin - end).norm(dim=-1).masked_fill(met.any(-1), math.inf)
        left = length[..., 1]
        for _ in range(2 * len(radii[0]) + 1):
            left = torch.minimum(left, (length + left.unsqueeze(-2)).min(-1).values)
        first = 1 + (length[:, 0, 1:] + left[:, 1:]).argmin(-1)
        return nodes[torch.arange(len(nodes)), first] - place


def flown(task: str, navigator: str) -> tuple[EnvBase, TensorDictBase]:
    """Return the environment of a task, and the first episode of each vehicle; arguments as of :func:`bar`."""
    env = NAMED_ENVS[task](VEHICLES, observation="dict", scale_actions=False, seed=SEED)
    return env, evaluation_rollout(env, Detour() if navigator == "detour" else make_navigator(navigator, env.base_env))


@cache
def bar(task: str, navigator: str) -> dict[str, float]:
    """Return the score of a navigator (:func:`magrl.score`).

    Args:
        task: name of the task.
        navigator: one of :data:`BARS`, or the file of a policy.
    """
    agent = Detour() if navigator == "detour" else navigator
    return score(agent, "anywhere" if task == "readings" else task, episodes=VEHICLES)


def bars_of(task: str) -> list[str]:
    """Return the bars of a task, the oracle last."""
    return ["secant", "kalman", "anywhere", "detour" if task == "nogo" else "geodesic"]


def draw_areas(axes: Axes, vehicle: int = 1) -> None:
    """Draw the no-go areas of an episode, straight to the destination and around them, in the plane there."""
    for name in ("geodesic", "detour"):
        steps = flown("nogo", name)[1][vehicle]
        numbers = steps["no_go_areas"][first_episode_mask(steps["next", "done"][None])[0]]
        axes.plot(*numbers[:, -2:].flip(-1).T, ".-", label=BARS[name].partition(" (")[0])
    centers, radii = NoGoAreas.discs(numbers[0])
    for (north, east), radius in zip(centers.tolist(), radii.tolist(), strict=True):
        axes.add_patch(Circle((east, north), radius, color="gray", alpha=0.3))
    axes.plot(0, 0, "k^", label="destination")
    axes.set(title="an episode of nogo", xlabel="east [km]", ylabel="north [km]", aspect="equal", adjustable="datalim")
    axes.legend(fontsize="x-small", loc="best")


def main() -> None:
    """Fly all navigators and print the table."""
    rows = [
        [task, BARS[name], *(f"{bar(task, name)[key]:.1f}" for key in COLUMNS)]
        for task in NAMED_ENVS
        if task != "readings"
        for name in bars_of(task)
    ]
    print(markdown_table(["task", "navigator", "SR [%]", "SPL [%]", "steps", "return"], rows))


if __name__ == "__main__":
    command("bars.py", lambda: tyro.cli(main, prog="bars.py", description=__doc__))
