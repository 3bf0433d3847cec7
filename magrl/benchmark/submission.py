"""Submissions to the benchmark: a folder with episodes, their record and the policy, which others verify by flying it.

A policy is a file of :func:`magrl.save_policy`, or the name of a navigator of the library: verifying runs no code of
the submitter.
"""

from __future__ import annotations

import hashlib
import platform
import secrets
import shutil
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import pandas
import torch
from pydantic import Field
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

import magrl
from magrl.agents import FieldPolicy, load_policy
from magrl.agents.onnx_policy import OnnxNetwork
from magrl.benchmark.comparison import TOO_GOOD, compared, different, impossible
from magrl.benchmark.episodes import episode_table, read_episodes, write_episodes
from magrl.benchmark.tracks import TRACKS, Track
from magrl.checks import CheckedModel, check_choice, check_number, short
from magrl.envs import Tasks
from magrl.evaluation import episode_measures
from magrl.evaluation.navigators import SUFFIXES
from magrl.files import read_document, write_json
from magrl.navigators import NAVIGATORS, Anywhere
from magrl.sensor_std import STD_KEYS

BUILT_IN = tuple(name for name, kind in NAVIGATORS.items() if "mode" not in kind.options)
"""Navigators that need no file. Random numbers of metaheuristics depend on the batch, so that no part is repeated."""
RECORD, EPISODES = "run.json", "episodes.csv.gz"
POLICIES = tuple(f"policy{suffix}" for suffix in SUFFIXES)
"""Names of the file of a policy."""
PACKAGES = ("torch", "torchrl", "tensordict", "numpy", "safetensors")
SHIFTS_DEG = tuple(
    (size * north, size * east) for size in (1e-4, 3e-4) for north, east in ((1, 0), (-1, 0), (0, 1), (0, -1))
)
"""How far starts are moved [deg], 11 m and 33 m, where an episode ends differently: does rounding decide its end?"""
MOST_UNEXPLAINED = 0.02
"""Largest share of the episodes that end differently for which these starts need not show it. With AVX2 in place of
the default instructions of the processor, 14 of 192 episodes of ``anywhere`` end differently on alone-v2 and 78 of 256
on vehicles-v1; a start 14 m to the northeast shows it for 84 of the 92, these starts for the others."""


class Submission(CheckedModel):
    """What ``run.json`` states.

    Example:
        >>> Submission(magrl="0.2.0", track="mars-v1", declared={}, policy="secant", tasks=3, episodes_sha256="")
        Traceback (most recent call last):
        ValueError: policy_sha256 is missing; platform is missing
    """

    format: Literal[1] = 1
    magrl: str
    """Version of the library."""
    track: str
    declared: dict[str, Any]
    """Declaration of the track, with the digest of its tasks and its seeds."""
    policy: str
    """Name of a navigator of the library, or that of the file in the folder."""
    policy_sha256: str | None
    tasks: int = Field(ge=1)
    """Number of tasks that were flown, from the first on."""
    episodes_sha256: str
    platform: dict[str, str]
    """Versions of Python and of libraries, instructions of the processor, and number of threads: they decide the last
    bits of a number, and so how some episodes end."""


def run(policy: str, track: str, out: Path, tasks: int | None = None) -> pandas.DataFrame:
    """Fly a track and write the folder of a submission.

    Args:
        policy: policy file, ``.safetensors`` or ``.onnx``, or one of :data:`BUILT_IN`.
        track: one of :data:`~magrl.benchmark.TRACKS`.
        out: folder, new or empty.
        tasks: number of tasks for a trial; by default all.

    Returns:
        The episodes.

    Raises:
        ValueError: for a policy that is refused, an unknown track, or a number of tasks that it does not have.
        FileNotFoundError: for a missing policy.
        FileExistsError: for a folder that holds other files than those of an interrupted run.

    Example:
        >>> import tempfile
        >>> len(run("geodesic", "earth-v2", Path(tempfile.mkdtemp()), tasks=2))
        6
    """
    check_choice(TRACKS, track=track)
    chosen = TRACKS[track]
    count = chosen.tasks if tasks is None else tasks
    check_number(1, chosen.tasks, whole=True, tasks=count)
    navigator = _policy(policy, chosen)
    out.mkdir(parents=True, exist_ok=True)
    if {path.name for path in out.iterdir()} - {
        EPISODES,
        *POLICIES,
    }:  # which an interrupted run leaves
        raise FileExistsError(f"{out} holds files: choose a new folder")
    name = navigator if isinstance(navigator, str) else f"policy{Path(policy).suffix}"
    if name in POLICIES:
        shutil.copyfile(policy, out / name)
    episodes = _flown(navigator, chosen, torch.arange(count)).assign(track=track, navigator=name)
    write_episodes(out / EPISODES, [episodes])
    record = Submission(
        magrl=magrl.__version__,
        track=track,
        declared=chosen.record(),
        policy=name,
        policy_sha256=_sha256(out / name) if name in POLICIES else None,
        tasks=count,
        episodes_sha256=_sha256(out / EPISODES),
        platform=_platform(),
    )
    write_json(out / RECORD, record.model_dump())
    return episodes


def verify(folder: Path, tasks: int = 32, seed: int | None = None) -> tuple[list[str], list[str]]:
    """Compare a submission with flights of its policy.

    Each row must agree with the track and with itself. Some of the tasks, drawn at random, are flown again and must end
    alike, unless they end differently from starts moved by :data:`SHIFTS_DEG` as well: then rounding decides. Claimed
    means must not be better than those of repeated tasks, nor than those of new tasks, which the submitter has not
    seen. All limits come from the track and from the flights of the verifier.

    Args:
        folder: folder of :func:`run`.
        tasks: number of tasks that are repeated, and of new tasks.
        seed: seed of both draws; by default a secret one.

    Returns:
        What was found, and the contradictions, in sentences; without any, the submission is verified.

    Raises:
        ValueError: for a folder that is no submission, of an unknown track, or with a policy that is refused.
        FileNotFoundError: for a missing file.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> _ = run("geodesic", "earth-v2", folder, tasks=4)
        >>> verify(folder, tasks=2, seed=0)[1]
        []
    """
    check_number(2, whole=True, tasks=tasks)
    seed = secrets.randbelow(2**31) if seed is None else seed
    record = Submission(**read_document(folder / RECORD))
    check_choice(TRACKS, track=record.track)
    check_choice((*POLICIES, *BUILT_IN), policy=record.policy)
    track = TRACKS[record.track]
    claimed = read_episodes(folder / EPISODES, len(track.errors) * min(record.tasks, track.tasks))
    navigator = _policy(str(folder / record.policy) if record.policy in POLICIES else record.policy, track)
    notes = [f"{record.track}, {record.policy}: {record.tasks} of {track.tasks} tasks, seed of this check {seed}"]
    if wrong := list(_contradictions(folder, record, track, claimed)):
        return notes, wrong
    draw = torch.randperm(record.tasks, generator=torch.Generator().manual_seed(seed))[:tasks].sort().values
    again = _flown(navigator, track, draw)
    new = _flown(navigator, track, torch.arange(tasks), track.scenario.random_tasks(tasks, seed), seed)
    apart = different(claimed, again)
    forged = _not_rounded(navigator, track, again, apart)
    notes.append(f"{len(again) - len(apart)} of {len(again)} repeated episodes end alike")
    notes.append(f"rounding decides how {len(apart) - len(forged)} of the others end")
    if len(forged) > MOST_UNEXPLAINED * len(apart):
        wrong.append(f"rounding does not explain {len(forged)} of the others: level and task {short(forged.tolist())}")
    means = compared("repeated tasks", claimed[claimed["task"].isin(draw.tolist())], again, track, apart)
    means += compared("all tasks", claimed, again, track) + compared("new tasks", claimed, new, track)
    for text in means:
        (wrong if TOO_GOOD in text else notes).append(text)
    return notes, wrong


def _not_rounded(
    navigator: TensorDictModuleBase | str, track: Track, again: pandas.DataFrame, apart: pandas.MultiIndex
) -> pandas.MultiIndex:
    """Return which of some episodes end in the same way from all starts nearby: rounding does not decide how."""
    assert track.scenario.tasks is not None
    start, *ends = track.scenario.tasks
    for shift in SHIFTS_DEG:
        if len(apart):
            vehicle = torch.tensor(sorted(set(apart.get_level_values("task"))))
            moved = _flown(navigator, track, vehicle, Tasks(start + torch.tensor(shift), *ends))
            apart = apart.difference(different(moved, again))
    return apart


class _OneByOne(OnnxNetwork):
    """A network that acts for one vehicle at a time: no action depends on the rest of a batch, nor does memory."""

    def run(self, observation: Tensor, memory: Mapping[str, Tensor]) -> list[Tensor]:
        """Return the action and the next memory for observations ``(N, K)``."""
        run, sizes = super().run, self.shapes.items()
        parts = {key: memory[key].expand(len(observation), *shape).split(1) for key, shape in sizes}
        rows = enumerate(observation.split(1))
        found = [run(seen, {key: part[row] for key, part in parts.items()}) for row, seen in rows]
        return [torch.cat(values) for values in zip(*found, strict=True)]


def _policy(text: str, track: Track) -> TensorDictModuleBase | str:
    """Return the policy of a file, or the name of a navigator of the library; raise for any other."""
    if Path(text).suffix not in SUFFIXES:
        if text not in BUILT_IN:
            names = ", ".join(BUILT_IN)
            raise ValueError(
                f"refused {text!r}: submit a file of magrl.save_policy (.safetensors, .onnx), or one of {names}"
            )
        return text
    policy = load_policy(text)
    if isinstance(policy, FieldPolicy) and isinstance(policy.actor, OnnxNetwork):
        policy.actor = _OneByOne(policy.actor.content, policy.actor.size)
    reads = {*policy.in_keys, *(STD_KEYS if isinstance(policy, Anywhere) else ())}
    if hidden := sorted(reads - set(track.keys)):
        raise ValueError(f"refused {text!r}: it reads {', '.join(hidden)}, which this track does not give")
    return policy


def _flown(
    policy: TensorDictModuleBase | str,
    track: Track,
    vehicle: Tensor,
    tasks: Tasks | None = None,
    seed: int | None = None,
) -> pandas.DataFrame:
    """Return an episode of each level and vehicle, whose number is that of its task; of other tasks, if they are given.

    With a seed, the errors are others, too.
    """
    tables = []
    for level, errors in track.errors.items():
        changes = {} if seed is None else {"seed": seed}
        flight = track.flight(errors, tasks, num_envs=len(vehicle), **changes)
        flight.base.vehicle = vehicle
        assert flight.base.tasks is not None
        measures, region = episode_measures(flight.fly(policy)), flight.base.tasks.region[vehicle]
        table = episode_table(measures, region, level=level, seed=flight.seed)
        tables.append(table.assign(task=vehicle.tolist()))
    return pandas.concat(tables, ignore_index=True)


def _contradictions(folder: Path, record: Submission, track: Track, claimed: pandas.DataFrame) -> Iterator[str]:
    """Yield what is wrong with a submission before anything is flown."""
    if record.declared != track.record():
        yield f"{record.track} is another track in magrl {magrl.__version__} than in the {record.magrl} of the record"
    if record.policy in POLICIES and _sha256(folder / record.policy) != record.policy_sha256:
        yield f"{record.policy} is not the file of the record"
    if _sha256(folder / EPISODES) != record.episodes_sha256:
        yield f"{EPISODES} is not the file of the record"
    rows = [(record.track, level, task) for level in track.errors for task in range(min(record.tasks, track.tasks))]
    if record.tasks > track.tasks or list(map(tuple, claimed[["track", "level", "task"]].values)) != rows:
        yield f"the episodes are not one of each level and each of {record.tasks} tasks, in their order"
    else:
        yield from impossible(claimed, track, record.policy)


def _platform() -> dict[str, str]:
    """Return what decides the last bits of a number."""
    versions = {"python": platform.python_version()} | {package: version(package) for package in PACKAGES}
    return versions | {"cpu": torch.backends.cpu.get_cpu_capability(), "threads": str(torch.get_num_threads())}


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
