"""Bars of the named tasks: what navigators without training reach on the first episode of 1000 vehicles.

    python docs/tables/bars.py    # half an hour; prints them with their CPU time

The seed is reserved for evaluations: ``envs.reset(seed=SEED)`` of 1000 vehicles starts the same episodes. Oracles are
the true bearing, which knows where vehicle and destination are, the shortest paths around no-go areas, all or those
seen so far, and the plan on the true map of the currents. Plans on estimated currents are of the first 200 vehicles.
The rule around the areas in sight reads public keys alone. *Readings* has the episodes of *Anywhere*: only what a
policy observes is different.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from currents import CURRENT_RULES
from magrl.evaluation import evaluation_rollout
from magrl.evaluation.episodes import first_episode_mask
from magrl.evaluation.scores import SEED, scored
from magrl.evaluation.tables import markdown_table
from magrl.files import read_document
from magrl.geodesy import steer
from magrl.named_tasks import NAMED_TASKS, storm_errors
from magrl.navigators import Navigator, Secant
from magrl.navigators.names import make_navigator
from magrl.training import command
from magrl.transforms.areas import SEEN, SIGHT_KM, NoGoAreas, distance_km, inside_km, turned

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

VEHICLES, FEWER = 1000, {"estimated": 200}
COLUMNS = ("score", "SR", "SPL", "steps", "ms")
BARS = {"secant": "secant", "kalman": "kalman", "anywhere": "anywhere (pretrained)"}
BARS |= {"memory": "memory (pretrained)"}
BARS |= {"told": "kalman, which knows the size of each error"}
BARS |= {"around": "secant, least turn around the areas in sight"}
BARS |= {"sighted": "shortest path around the areas seen so far (oracle in direction)"}
BARS |= {"parallel": "parallel (oracle)", "offset": "bearing that offsets half of the last set (a map)"}
BARS |= {"estimated": "plan on a Gaussian process of the currents (a map, their spectrum)"}
BARS |= {"mapped": "plan on the true currents (oracle)"}
BARS |= {"geodesic": "true bearing (oracle)", "detour": "shortest path around the areas (oracle)"}


class Shown(NamedTuple):
    """What tables and figures show of a named task, as tasks.toml explains."""

    reference: str = "kalman"
    bars: Sequence[str] = ("geodesic",)
    picture: Sequence[Any] = ("kalman", 0)


_TABLES = read_document(Path(__file__).with_name("tasks.toml"))
TASKS = {task: Shown(**_TABLES.get(task, {})) for task in NAMED_TASKS}
"""What is shown, by the name of the task."""


class Detour(Navigator):
    """Follow the shortest path around the no-go areas, through points beside their edges: an oracle."""

    in_keys = ["true_displacement", "heading", "no_go_areas", "elapsed_steps"]
    BESIDE_KM, POINTS = 3.0, 12

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:
        """Return the action."""
        heading, numbers = seen["heading"], seen["no_go_areas"]
        centers, radii = self._known(seen, memory)
        leg = self._next(numbers[..., -2:], centers, radii)
        ahead = turned(leg, -heading)
        turn = torch.atan2(ahead[..., 1], ahead[..., 0])
        length = torch.where(turn.abs() > math.pi / 2, 0.0, leg.norm(dim=-1).clamp(max=50.0))
        return torch.stack((length, turn.clamp(-math.pi / 2, math.pi / 2)), -1)

    def _known(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        """Return centers and radii of the areas that it goes around."""
        return NoGoAreas.discs(seen["no_go_areas"])

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


class Sighted(Detour):
    """Follow the shortest path around the no-go areas seen so far: an oracle in direction alone."""

    FAR_KM = 1e4

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        return {"sighted": torch.zeros_like(NoGoAreas.discs(seen["no_go_areas"])[1], dtype=torch.bool)}

    def _known(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        centers, radii = super()._known(seen, memory)
        gap_km = (centers - seen["no_go_areas"][..., None, -2:]).norm(dim=-1) - radii
        sighted = (gap_km < SIGHT_KM) & (gap_km <= gap_km.kthvalue(SEEN, keepdim=True).values)
        memory["sighted"] = memory["sighted"] | sighted
        return torch.where(memory["sighted"].unsqueeze(-1), centers, self.FAR_KM), radii


class Around(TensorDictModuleBase):
    """Turn the leg of a navigator by the least angle that clears the no-go areas in sight: a rule on public keys.

    Args:
        navigator: navigator that knows nothing of areas, with its ``max_leg_km`` and ``max_turn_rad``.
    """

    out_keys = ["action"]
    STEADY, ANGLES = 0.3, 721
    """Cost of a change of course by that of a deviation, and angles tried. On 400 episodes of seed 31337, it has an SPL
    of 96.05; with a strip of 1 km beside the areas 95.69, with a cost of 0 and 0.6 95.87 and 95.77."""

    def __init__(self, navigator: Navigator) -> None:
        super().__init__()
        self.navigator, self.in_keys = navigator, [*navigator.in_keys, "areas"]
        self.limits = navigator.max_leg_km, navigator.max_turn_rad

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        length, turn = self.navigator(tensordict)["action"].unbind(-1)
        offset = torch.linspace(-math.pi, math.pi, self.ANGLES)
        angle = turn.unsqueeze(-1) + offset
        reach = torch.where(length < self.limits[0] - 1e-3, length, math.inf)  # a whole leg has another behind it
        inside = inside_km(tensordict["areas"], reach.unsqueeze(-1), angle)
        cost = offset.abs() + self.STEADY * angle.abs()
        best = (inside + cost / 10).argmin(-1, keepdim=True)  # no turn is worth half a kilometer inside
        chosen = angle.gather(-1, best).squeeze(-1)
        return tensordict.set("action", torch.stack(steer(torch.zeros_like(turn), chosen, length, *self.limits), -1))


def flown(task: str, navigator: str, vehicles: int | None = None, **options: Any) -> tuple[EnvBase, TensorDictBase]:
    """Return the environment of a task with options, and the first episode of each vehicle; as of :func:`bar`."""
    options |= {"transforms": storm_errors(stated=True)} if navigator == "told" else {}
    observation = "legs" if navigator in CURRENT_RULES else "dict"  # rules of currents read the fixes of a map
    count = min(vehicles or VEHICLES, FEWER.get(navigator, math.inf))
    env = NAMED_TASKS[task].make(count, observation=observation, scale_actions=False, seed=SEED, **options)
    rules: dict[str, Any] = {
        "detour": Detour,
        "sighted": Sighted,
        "around": lambda: Around(Secant.for_env(env.base_env)),
    }
    rules |= {name: partial(rule, env.base_env.max_leg_km) for name, rule in CURRENT_RULES.items()}
    name = "kalman" if navigator == "told" else navigator
    policy = rules[name]() if name in rules else make_navigator(name, env.base_env)
    return env, evaluation_rollout(env, policy)


@cache
def bar(task: str, navigator: str) -> dict[str, float]:
    """Return the score of a navigator, as :func:`magrl.score`, and its CPU time a step and vehicle ``ms``.

    Args:
        task: name of the task.
        navigator: one of :data:`BARS`, or the file of a policy.
    """
    began = time.process_time()
    rollout = flown(task, navigator)[1]
    steps = first_episode_mask(rollout["next", "done"]).sum().item()
    return {**scored(rollout), "ms": 1000 * (time.process_time() - began) / steps}


def bars_of(task: str) -> list[str]:
    """Return the bars of a task, the oracle last."""
    return ["secant", "kalman", "anywhere", *TASKS[task].bars]


def main() -> None:
    """Fly all navigators and print the table."""
    rows = [
        [task, BARS[name], *(f"{bar(task, name)[key]:.3g}" for key in COLUMNS)]
        for task in NAMED_TASKS
        for name in bars_of(task)
    ]
    print(markdown_table(["task", "navigator", "score [%]", "SR [%]", "SPL [%]", "steps", "CPU a step [ms]"], rows))


if __name__ == "__main__":
    command("bars.py", lambda: tyro.cli(main, prog="bars.py", description=__doc__))
