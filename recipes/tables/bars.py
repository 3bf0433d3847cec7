"""Bars of the named tasks: what navigators without training reach on the first episode of 200 vehicles.

    python recipes/tables/bars.py    # a minute; prints the table of docs/environment.md

The seed is reserved for evaluations, so that ``envs.reset(seed=SEED)`` of 200 vehicles flies the same tasks and errors.
The true way knows where the vehicle and the destination are, the true gradient knows the map: both are oracles.
The episodes of *Readings* are those of *Anywhere*: only what a policy observes is different.
"""

from __future__ import annotations

from magrl import paper
from magrl.envs.named import NAMED_ENVS
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.evaluation.intervals import wilson_interval
from magrl.evaluation.metrics import first_episode_mask
from magrl.evaluation.navigators import make_navigator
from magrl.evaluation.tables import markdown_table

SEED, VEHICLES = paper.FIRST_RESERVED_SEED + 69, 200
BARS = {"secant": "secant", "kalman": "kalman", "anywhere": "anywhere"}
BARS |= {"parallel": "true gradient (an oracle)", "geodesic": "true way (an oracle)"}


def bar(task: str, navigator: str) -> list[str]:
    """Return success rate with its 95 % interval and SPL [%], steps, and the mean return of the default reward."""
    env = NAMED_ENVS[task](VEHICLES, observation="dict", scale_actions=False, seed=SEED)
    rollout = evaluation_rollout(env, make_navigator(navigator, env.base_env))
    measures, after = episode_measures(rollout, env), rollout["next"]
    earned = (after["reward"].squeeze(-1) * first_episode_mask(after["done"])).sum(1).mean().item()
    success, spl, steps = (measures[name].double().mean().item() for name in ("success", "spl", "steps"))
    low, high = wilson_interval(success, VEHICLES)
    rate = f"{100 * success:.1f} ({100 * low:.0f}-{100 * high:.0f})"
    return [task, BARS[navigator], rate, f"{100 * spl:.1f}", f"{steps:.1f}", f"{earned:.1f}"]


if __name__ == "__main__":
    rows = [bar(task, navigator) for task in NAMED_ENVS if task != "readings" for navigator in BARS]
    print(markdown_table(["task", "navigator", "SR [%]", "SPL [%]", "steps", "return"], rows))
