"""Where the time of a training goes: `python -m benchmarks.profile_training`, half a minute.

The recipe runs under Python's profiler, which adds a little to whatever calls many small functions.
"""

from __future__ import annotations

import cProfile
import pstats
import tempfile
from dataclasses import replace
from pathlib import Path

from benchmarks.training import recipe

PARTS = {
    "collection: environment, transforms, policy": ("_single.py", "iterator"),
    "sampling from the replay buffer": ("tensordict.py", "sample"),
    "storing in the replay buffer": ("tensordict.py", "extend"),
    "forward: the critics' loss": ("td3.py", "value_loss"),
    "forward: the actor's loss": ("td3.py", "actor_loss"),
    "backward": ("_tensor.py", "backward"),
    "optimisers": ("adam.py", "step"),
    "targets": ("td3.py", "step"),
    "checks for numbers that are none": ("checkpoints.py", "check_finite"),
    "evaluation": ("td3.py", "evaluation_rollout"),
}


def shares(frames: int = 61_440) -> dict[str, float]:
    """Share of the training loop's time in each part."""
    with tempfile.TemporaryDirectory() as folder:
        config = replace(recipe.Config(), total_frames=frames, wandb_mode="disabled", eval_tasks=10)
        config = replace(config, out=Path(folder) / "run")
        profiler = cProfile.Profile()
        result = profiler.runcall(recipe.train, config)
    return shares_of(profiler, PARTS, result["training_seconds"])


def shares_of(profiler: cProfile.Profile, parts: dict[str, tuple[str, str]], total: float) -> dict[str, float]:
    """Share of some seconds that was spent in functions, each named by its file and its name; none calls another."""
    seconds = dict.fromkeys(parts, 0.0)
    for (file, _, name), (_, _, _, cumulative, _) in pstats.Stats(profiler).stats.items():
        for part, (ending, function) in parts.items():
            if Path(file).name == ending and name == function:
                seconds[part] = max(seconds[part], cumulative)
    found = {part: value / total for part, value in seconds.items()}
    return found | {"the rest": 1 - sum(found.values())}


def table(found: dict[str, float]) -> str:
    """Shares in per cent."""
    lines = ["| part | % |", "|---|---|", *(f"| {part} | {100 * share:.0f} |" for part, share in found.items())]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(table(shares()))
