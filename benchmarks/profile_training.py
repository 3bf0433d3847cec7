"""Profile of a training: `python -m benchmarks.profile_training`, half a minute.

The recipe runs under Python's profiler, which slows code that calls many small functions a little.
"""

from __future__ import annotations

import cProfile
import pstats
import tempfile
from pathlib import Path

from benchmarks.training import recipe

PARTS = {
    "collection: environment, transforms, policy": ("_single.py", "iterator"),
    "sampling from the replay buffer": ("tensordict.py", "sample"),
    "storing in the replay buffer": ("tensordict.py", "extend"),
    "forward: the critics' loss": ("td3.py", "value_loss"),
    "forward: the actor's loss": ("td3.py", "actor_loss"),
    "backward": ("_tensor.py", "backward"),
    "optimizers": ("adam.py", "step"),
    "target networks": ("td3.py", "step"),
    "checks for non-finite values": ("checks.py", "check_finite"),
    "evaluation": ("episodes.py", "evaluation_rollout"),
}


def shares(frames: int = 61_440) -> dict[str, float]:
    """Return the share of each part in the time of the training loop."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        config = recipe.Config().replace(total_frames=frames, wandb_mode="disabled", eval_trips=10, out=out)
        profiler = cProfile.Profile()
        result = profiler.runcall(recipe.train, config)
    return shares_of(profiler, PARTS, result["training_seconds"])


def shares_of(profiler: cProfile.Profile, parts: dict[str, tuple[str, str]], total: float) -> dict[str, float]:
    """Return the share of functions in a time.

    Args:
        profiler: profile.
        parts: file name and function name of each part; none of them may call another.
        total: time [s].
    """
    seconds = dict.fromkeys(parts, 0.0)
    for (file, _, name), (_, _, _, cumulative, _) in pstats.Stats(profiler).stats.items():
        for part, (ending, function) in parts.items():
            if Path(file).name == ending and name == function:
                seconds[part] = max(seconds[part], cumulative)
    found = {part: value / total for part, value in seconds.items()}
    return found | {"the rest": 1 - sum(found.values())}


if __name__ == "__main__":
    print(shares())
