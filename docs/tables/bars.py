"""Bars of the named tasks: what navigators without training reach on the first episode of 1000 vehicles.

    python docs/tables/bars.py    # half an hour; prints them with their CPU time

The seed is reserved for evaluations: ``envs.reset(seed=SEED)`` of 1000 vehicles starts the same episodes. Oracles are
the true bearing, which knows where vehicle and destination are, the shortest paths around no-go areas, all or those
seen so far, and the plan on the true map of the currents. The rule around the areas in sight reads public keys alone.
*Readings* has the episodes of *Anywhere*: only what a policy observes is different.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from currents import CURRENT_RULES
from magrl.evaluation import evaluation_rollout
from magrl.evaluation.episodes import first_episode_mask
from magrl.evaluation.scores import SEED, scored
from magrl.evaluation.tables import markdown_table
from magrl.files import read_document
from magrl.geodesy import polar, steer
from magrl.named_tasks import NAMED_TASKS, storm_errors
from magrl.navigators import Kalman, Navigator
from magrl.navigators.names import make_navigator
from magrl.navigators.quasi_newton import last_leg
from magrl.training import command
from magrl.transforms.areas import CLEAR_KM, RADIUS_KM, SEEN, SIGHT_KM, NoGoAreas, Shield, distance_km, shielded, turned
from magrl.transforms.track import READ_KEYS, track_of

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform

VEHICLES = 1000
STEP_PRICE, STORM_PRICE = 0.05, 0.1
"""Price of a step [% of SPL] of kalman and anywhere, where the score has none, chosen among .02, .05, .1, .2 and .5; in
a storm, more steps find less."""
BESIDE_KM, POINTS, FAR_KM = 1.0, 12, 1e4
"""Paths lead through so many corners around each no-go area, at this distance from it; and where none is."""
COLUMNS = ("score", "SR", "SPL", "steps", "ms")
BARS = {"secant": "secant", "kalman": "kalman, cheap steps", "anywhere": "anywhere (pretrained), cheap steps"}
BARS |= {"memory": "memory (trained on storm)", "readings-ppo_memory": "memory (trained on readings)"}
BARS |= {"told": "kalman, cheap steps, which knows the size of each error"}
BARS |= {"shielded": "secant behind the shield of the recipe"}
BARS |= {"around": "shortest path around the areas seen so far, by kalman"}
BARS |= {"sighted": "shortest path around the areas seen so far (oracle in direction)"}
BARS |= {"parallel": "parallel (oracle)", "offset": "bearing that offsets half of the last set (a map)"}
BARS |= {"estimated": "plan on a Gaussian process of the currents (a map, their spectrum)"}
BARS |= {"mapped": "plan on the true currents (oracle)"}
BARS |= {"geodesic": "true bearing (oracle)", "detour": "shortest path around the areas (oracle)"}


BEHIND: dict[str, tuple[str, Callable[[], Sequence[Transform]]]]
BEHIND = {"told": ("kalman", partial(storm_errors, stated=True)), "shielded": ("secant", lambda: [Shield()])}
"""Navigators behind transforms."""


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

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:
        """Return the action."""
        heading, numbers = seen["heading"], seen["no_go_areas"]
        centers, radii = self._known(seen, memory)
        leg = first_leg(numbers[..., -2:], centers, radii)
        ahead = turned(leg, -heading)
        turn = torch.atan2(ahead[..., 1], ahead[..., 0])
        length = torch.where(turn.abs() > math.pi / 2, 0.0, leg.norm(dim=-1).clamp(max=50.0))
        return torch.stack((length, turn.clamp(-math.pi / 2, math.pi / 2)), -1)

    def _known(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        """Return centers and radii of the areas that it goes around."""
        return NoGoAreas.discs(seen["no_go_areas"])


def first_leg(place: Tensor, centers: Tensor, radii: Tensor) -> Tensor:
    """Return the first leg ``(..., 2)`` of the shortest path from places to 0 around discs [km]."""
    angle = torch.arange(POINTS) * 2 * math.pi / POINTS
    apart = (radii + BESIDE_KM) / math.cos(math.pi / POINTS)
    corners = centers.unsqueeze(-2) + apart[..., None, None] * torch.stack((torch.cos(angle), torch.sin(angle)), -1)
    nodes = torch.cat((place.unsqueeze(-2), torch.zeros_like(place).unsqueeze(-2), corners.flatten(-3, -2)), -2)
    begin, end = nodes.unsqueeze(-2), nodes.unsqueeze(-3)
    met = distance_km(centers[:, None, None], *torch.broadcast_tensors(begin, end)) < radii[:, None, None] + CLEAR_KM
    length = (begin - end).norm(dim=-1).masked_fill(met.any(-1), math.inf)
    left = length[..., 1]
    for _ in range(2 * len(radii[0]) + 1):
        left = torch.minimum(left, (length + left.unsqueeze(-2)).min(-1).values)
    first = 1 + (length[:, 0, 1:] + left[:, 1:]).argmin(-1)
    return nodes[torch.arange(len(nodes)), first] - place


class Sighted(Detour):
    """Follow the shortest path around the no-go areas seen so far: an oracle in direction alone."""

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        return {"sighted": torch.zeros_like(NoGoAreas.discs(seen["no_go_areas"])[1], dtype=torch.bool)}

    def _known(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        centers, radii = super()._known(seen, memory)
        gap_km = (centers - seen["no_go_areas"][..., None, -2:]).norm(dim=-1) - radii
        sighted = (gap_km < SIGHT_KM) & (gap_km <= gap_km.kthvalue(SEEN, keepdim=True).values)
        memory["sighted"] = memory["sighted"] | sighted
        return torch.where(memory["sighted"].unsqueeze(-1), centers, FAR_KM), radii


class Around(Kalman):
    """Follow the shortest path around the no-go areas seen so far to the estimated destination: a rule on public keys.

    It reckons its way from the start, and keeps length and side of the legs by which :class:`~magrl.Kalman` probes. A
    leg that would still meet an area in sight turns as in a shield. On 400 episodes of seed 31337, it has an SPL of
    98.26, and the least turn of the secant's legs around the areas in sight 96.05.
    """

    in_keys: ClassVar[list[str]] = [*READ_KEYS, "track", "areas"]

    def transforms(self, env: EnvBase, **rules: Any) -> list[Transform]:
        return [*super().transforms(env, **rules), *Navigator.transforms(self, env, **rules)]

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        none = seen["areas"].new_zeros(*seen["areas"].shape[:-1], SEEN, 3, dtype=torch.float64)
        return {"discs": none, "way": none[..., 0, :2]}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:
        """Return the action."""
        heading, track = seen["heading"].squeeze(-1).double(), track_of(seen["track"])
        aim, plan, discs = track.aim.double(), track.plan.double(), self._remembered(seen, memory)
        known = discs[..., 2:] > 0
        centers = torch.where(known, discs[..., :2] - (memory["way"] + aim).unsqueeze(-2), FAR_KM)
        (reach, course), (length, bow) = polar(first_leg(-aim, centers, discs[..., 2])), polar(plan)
        action = steer(
            heading, course + bow - polar(aim)[1], torch.minimum(reach, length), self.max_leg_km, self.max_turn_rad
        )
        return shielded(torch.stack(action, -1), seen["areas"], self.max_turn_rad)

    def _remembered(self, seen: TensorDictBase, memory: TensorDictBase) -> Tensor:
        """Return centers north and east of the start, and radii, of areas seen so far ``(..., SEEN, 3)`` [km]."""
        memory["way"] = torch.where(seen["elapsed_steps"] == 0, 0.0, memory["way"] + last_leg(seen))
        ahead, radii = sighted_km(seen["areas"].double())
        centers = memory["way"].unsqueeze(-2) + turned(ahead, seen["heading"].double().unsqueeze(-1))
        again = ((memory["discs"][..., 2:] - radii.unsqueeze(-2)).abs() < 1e-3).any(-1, keepdim=True)
        both = torch.cat((torch.cat((centers, radii.unsqueeze(-1)), -1), memory["discs"].masked_fill(again, 0.0)), -2)
        memory["discs"] = both.take_along_dim(both[..., 2:].topk(SEEN, dim=-2).indices, -2)
        return memory["discs"]


def sighted_km(areas: Tensor) -> tuple[Tensor, Tensor]:
    """Return centers of areas in sight, forward and to the right ``(..., SEEN, 2)``, and radii ``(..., SEEN)`` [km]; 0
    of others."""
    ahead, size = areas.unflatten(-1, (SEEN, 3)).split((2, 1), -1)
    close = ahead.norm(dim=-1, keepdim=True)
    radius = RADIUS_KM[1] * size
    return ahead * (radius + SIGHT_KM * (1 - close)) / close.clamp_min(1e-9), radius.squeeze(-1)


def flown(task: str, navigator: str, vehicles: int | None = None, **options: Any) -> tuple[EnvBase, TensorDictBase]:
    """Return the environment of a task with options, and the first episode of each vehicle; as of :func:`bar`."""
    name, transforms = BEHIND.get(navigator, (navigator, list))
    options |= {"transforms": transforms()} if navigator in BEHIND else {}
    observation = "legs" if navigator in CURRENT_RULES else "dict"  # rules of currents read the fixes of a map
    count = vehicles or VEHICLES
    env = NAMED_TASKS[task].make(count, observation=observation, scale_actions=False, seed=SEED, **options)
    rules: dict[str, Any] = {
        "detour": Detour,
        "sighted": Sighted,
        "around": partial(Around.for_env, env.base_env, step_price=STEP_PRICE),
    }
    rules |= {name: partial(rule, env.base_env.max_leg_km) for name, rule in CURRENT_RULES.items()}
    price = STORM_PRICE if task == "storm" else STEP_PRICE
    priced = {"step_price": price} if name in ("kalman", "anywhere") else {}
    policy = rules[name]() if name in rules else make_navigator(name, env.base_env, **priced)
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
