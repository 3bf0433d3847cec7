"""Fly a track of the benchmark and write a submission, or verify one.

    python -m magrl.benchmark run kalman --track earth-v2 --out kalman --tasks 20    # a trial of 20 tasks
    python -m magrl.benchmark run mine.onnx --track alone-v2 --out mine
    python -m magrl.benchmark verify mine --tasks 64 --seed 5

A policy is a file of magrl.save_policy, or the name of a navigator of the library. `verify` runs no code of the
submitter. Its exit status is 0 for a verified submission, 1 for a contradiction, and 2 where nothing can be checked.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from magrl.benchmark.submission import BUILT_IN, run, verify
from magrl.benchmark.tracks import TRACKS
from magrl.checks import command, printable


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    arguments = argparse.ArgumentParser(
        prog="python -m magrl.benchmark", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = arguments.add_subparsers(dest="command", required=True)
    flown = commands.add_parser("run", help="fly a track and write a submission")
    flown.add_argument("policy", help=f"policy file (.safetensors, .onnx), or one of {', '.join(BUILT_IN)}")
    flown.add_argument("--track", required=True, choices=TRACKS, help="track and its version")
    flown.add_argument("--out", type=Path, required=True, help="folder of the submission, new or empty")
    flown.add_argument("--tasks", type=int, help="number of tasks, for a trial; default all")
    checked = commands.add_parser("verify", help="compare a submission with flights of its policy")
    checked.add_argument("folder", type=Path, help="folder of a submission")
    checked.add_argument("--tasks", type=int, default=32, help="number of repeated and of new tasks; default 32")
    checked.add_argument("--seed", type=int, help="seed of repeated and new tasks; default a secret one")
    return arguments


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line, and fly or verify."""
    command("python -m magrl.benchmark", lambda: _main(parser().parse_args(args)), ValueError)


def _main(options: argparse.Namespace) -> None:
    if options.command == "run":
        episodes = run(options.policy, options.track, options.out, options.tasks)
        means = 100 * episodes.groupby("level", sort=False)[["success", "spl"]].mean()
        print(means.round(1).to_string(), f"The submission is in {options.out}", sep="\n")
        return
    notes, wrong = verify(options.folder, options.tasks, options.seed)
    print(*map(printable, (*notes, *(f"CONTRADICTION: {text}" for text in wrong))), sep="\n")
    print("verdict: not verified" if wrong else "verdict: verified")
    if wrong:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
