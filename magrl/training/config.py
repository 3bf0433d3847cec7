"""Settings that every training recipe shares, the command line, and the settings of a run that is resumed."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import AfterValidator, Field, model_validator

from magrl.checks import CheckedModel, check_choice, check_device, library
from magrl.commands import UsageError
from magrl.envs import Scenario, load_scenario
from magrl.envs.scenario import RULES, rule_settings
from magrl.files import read_document
from magrl.random_numbers import FIRST_RESERVED_SEED
from magrl.training.wandb_run import WandbMode

Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
PositiveShare = Annotated[float, Field(gt=0, le=1)]
Discount = Annotated[float, Field(ge=0, lt=1)]
Widths = Annotated[tuple[Count, ...], Field(min_length=1)]
Seed = Annotated[int, Field(ge=0, lt=FIRST_RESERVED_SEED)]
Noise = tuple[NonNegative, NonNegative, NonNegative]


def _check_rising(values: tuple[float, float]) -> tuple[float, float]:
    if values[0] >= values[1]:
        raise ValueError(f"must be two rising numbers, got {values}")
    return values


LONGEST_KM = 4400.0
"""Longest distance of a trip on a random planet: the side of a region [km]."""
Rising = Annotated[tuple[Positive, Positive], AfterValidator(_check_rising)]


WANDB_OPTIONS = ("wandb_entity", "wandb_group", "wandb_tags")
CHANGEABLE = ("device", "wandb_mode", *WANDB_OPTIONS, "log_every", "checkpoint_every", "address", "out", "resume")
"""Settings that may be edited in ``config.json`` before a run is resumed: they are not part of the training."""


class RunConfig(CheckedModel):
    """Settings that all recipes share.

    Raises:
        ValueError: naming the setting, its value and what would be right.

    Example:
        >>> RunConfig(seed=-1)
        Traceback (most recent call last):
        ValueError: seed must be greater than or equal to 0, got -1
    """

    seed: Seed = 0
    """Random seed of weights, exploration and training trips."""
    out: Path | None = None
    """Run folder; runs/<recipe>-<preset>-seed<seed> by default."""
    resume: Path | None = None
    """Folder of an interrupted run to resume, with its settings."""
    device: str = "cpu"
    """Device of all tensors: cpu, cuda, cuda:0, ..."""
    wandb_mode: WandbMode = "offline"
    """Mode of wandb: offline needs no network and no login, disabled writes nothing."""
    wandb_entity: str = ""
    """User or team of wandb; by default from the login."""
    wandb_group: str = ""
    """Group of runs in wandb; by default WANDB_RUN_GROUP, or the name of the run without its seed."""
    wandb_tags: tuple[str, ...] = ()
    """Tags of the run in wandb."""
    log_every: Count = 5
    """Collected batches between points of the curves; each evaluation is a point, too."""
    checkpoint_every: NonNegative = 30.0
    """Time between checkpoints [s]."""
    num_envs: Count = 512
    """Number of vehicles."""
    total_frames: Count = 204_800
    """Total number of steps over all vehicles."""
    total_episodes: Count | None = None
    """Maximum number of training episodes."""
    eval_every: Count = 20
    """Collected batches between evaluations on the validation trips."""
    eval_trips_small: Count = 200
    """Number of validation trips, by which the best policy is selected."""
    eval_trips: Count = 1000
    """Number of test trips of the final evaluation."""
    gamma: Discount = 0.9
    """Discount factor."""
    learning_rate: Positive = 2e-3
    """Learning rate of Adam at the start."""
    final_learning_rate: Positive = 4e-5
    """Learning rate of Adam at the end; linear in between."""

    @model_validator(mode="after")
    def _available(self) -> Self:
        check_device(self.device)
        return self

    @property
    def rules(self) -> dict[str, Any]:
        """Rules of an episode among the settings, which replace the scenario's."""
        return self.model_dump(include=set(RULES))

    def linear(self, name: str, remaining: float) -> float:
        """Interpolate a setting linearly from ``name`` to ``final_name``, by the remaining share of the training."""
        start, end = getattr(self, name), getattr(self, f"final_{name}")
        return end + remaining * (start - end)


class RegionConfig(rule_settings("zeta"), RunConfig):  # type: ignore[misc]
    """Settings of recipes that train in the region of a scenario.

    Raises:
        ValueError: as :class:`RunConfig`, also for a scenario that says otherwise.

    Example:
        >>> RegionConfig(noise=(0.05, 0.05, 5.0)).zeta
        0.01
    """

    scenario: Path | None = None
    """Scenario file (.toml or .json) of region, date and altitude (docs/data.md); the paper's by default."""
    noise: Noise = (0.0, 0.0, 0.0)
    """Standard deviations of the sensors' noise on D [deg], I [deg], B_H [nT], in training and evaluations."""
    num_cells: Widths = (128, 128, 128)
    """Width of each hidden layer."""
    saturation_weight: NonNegative = 0.05
    """Initial weight of the penalty on the actor's outputs before the tanh; decreases linearly to 0."""

    @model_validator(mode="after")
    def _of_the_scenario(self) -> Self:
        try:
            scenario = self.load_scenario()
        except OSError as error:
            raise ValueError(str(error)) from None
        for name, value in self.rules.items():
            if (given := scenario.given(name)) not in (None, value):
                option = f"--{name.replace('_', '-')}"
                raise ValueError(f"the scenario sets {name} = {given!r}, the training {value!r}: add {option} {given}")
        if scenario.arrival == "declared":
            trains = "only ppo_anywhere.py --arrival declared trains for that"
            raise ValueError(f'the scenario sets arrival = "declared": {trains}')
        return self

    def load_scenario(self) -> Scenario:
        """Return the scenario of the file, or the paper's."""
        return Scenario() if self.scenario is None else load_scenario(self.scenario)


class PlanetConfig(rule_settings("max_steps"), RunConfig):  # type: ignore[misc]
    """Settings of PPO recipes that train on random planets and learn corrections of legs.

    Example:
        >>> PlanetConfig(distance_range_km=(100.0, 200.0)).regions
        {'distance_range_km': (100.0, 200.0), 'max_leg_km': 50.0, 'max_latitude': 70}
    """

    eval_every: Count = 10
    learning_rate: Positive = 3e-4
    final_learning_rate: Positive = 1e-5

    num_regions: Count = 1024
    """Number of training regions, two on each random planet."""
    collectors: Annotated[int, Field(ge=0)] = 0
    """Environments in Ray actors, each with num_envs / collectors vehicles and regions; 0: one in this process.
    With collectors, a resumed training is exact but for running episodes, which begin anew."""
    address: str | None = None
    """Ray cluster of the collectors: auto (the one of this machine) or HOST:PORT; by default one of their own."""
    distance_range_km: Rising = (300.0, 500.0)
    """Shortest and longest distance of a trip [km]."""
    steps_per_batch: Count = 32
    """Steps of each vehicle in a collected batch."""
    epochs: Count = 8
    """Epochs over each collected batch."""
    batch_size: Count = 1024
    """Transitions per gradient step."""
    gae_lambda: Share = 0.95
    """Factor lambda of the generalized advantage estimate."""
    clip_epsilon: Positive = 0.2
    """Clipping range of the probability ratio."""
    clip_gradient: Positive = 1.0
    """Largest norm of the gradients."""
    critic_cells: Widths = (256, 256)
    """Width of each hidden layer of the critic."""
    exploration: Positive = 0.4
    """Standard deviation of the correction at the start of the training."""
    final_exploration: Positive = 0.15
    """Standard deviation of the correction at its end; linear in between."""
    critic_learning_rate: Positive = 1e-3
    """Learning rate of the critic at the start."""
    final_critic_learning_rate: Positive = 5e-5
    """Learning rate of the critic at the end; linear in between."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.batch_size > (frames := self.num_envs * self.steps_per_batch):
            raise ValueError(f"batch_size {self.batch_size} must not exceed num_envs * steps_per_batch, {frames}")
        if self.collectors and self.num_envs % self.collectors:
            raise ValueError(f"collectors {self.collectors} must divide num_envs, {self.num_envs}")
        if self.distance_range_km[1] > LONGEST_KM:
            message = f"must end at {LONGEST_KM:g} km or below, the side of a region"
            raise ValueError(f"distance_range_km {message}, got {self.distance_range_km}")
        return self

    @property
    def reach_km(self) -> float:
        """Farthest that a leg takes a vehicle [km]."""
        return 50.0

    @property
    def regions(self) -> dict[str, Any]:
        """Options of the regions: large enough for the longest trip, and how the distances are drawn."""
        far = {"half_size_deg": 20, "degree": 16, "max_latitude": 75, "distance_law": "log"}
        size = far if self.distance_range_km[1] > 500 else {"max_latitude": 70}
        return {"distance_range_km": self.distance_range_km, "max_leg_km": self.reach_km, **size}


Config = TypeVar("Config")


def read_presets(script: str, **others: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the settings of each preset of a recipe, from the file ``presets.toml`` beside it.

    Args:
        script: path of the recipe; its presets are the tables ``[NAME.PRESET]`` with its name.
        **others: settings by name that a preset may extend, as another preset (``extends``).

    Raises:
        ValueError: for a file that is not valid, or a preset that extends an unknown one.
    """
    path = Path(script)
    tables = read_document(path.with_name("presets.toml"))[path.stem]
    known = tables | others

    def settings(name: str) -> dict[str, Any]:
        check_choice(list(known), extends=name)
        own = {"preset": name, **known[name]}
        base = own.pop("extends", None)
        return (settings(base) if base else {}) | {k: tuple(x) if isinstance(x, list) else x for k, x in own.items()}

    return {name: settings(name) for name in tables}


def make_presets(kind: type[Config], tables: Mapping[str, Mapping[str, Any]]) -> dict[str, Config]:
    """Return the presets of a recipe by name, validated.

    Args:
        kind: class of the settings.
        tables: settings of each, as of :func:`read_presets`.

    Raises:
        ValueError: for a setting that is unknown or out of its range, naming preset, setting and value.

    Example:
        >>> make_presets(RunConfig, {"fast": {"seed": -1}})
        Traceback (most recent call last):
        ValueError: preset fast: seed must be greater than or equal to 0, got -1
    """
    presets = {}
    for name, settings in tables.items():
        try:
            presets[name] = kind(**settings)
        except ValueError as error:
            raise ValueError(f"preset {name}: {error}") from None
    return presets


def parse_config(
    kind: type[Config], presets: Mapping[str, Config], recipe: str, description: str | None, args: Sequence[str] | None
) -> Config:
    """Return the settings of a command line: the preset, then what overrides it; or the settings of a run to resume.

    Args:
        kind: class of the settings.
        presets: settings by name; the default has the name of ``--task``, or else is the first.
        recipe: file name of the recipe.
        description: text of ``--help``.
        args: command line; by default of this process.

    Raises:
        UsageError: for a run that cannot be resumed, or options beside ``--resume``.

    Example:
        >>> presets = {"fast": RunConfig(seed=1)}
        >>> parse_config(RunConfig, presets, "mine.py", None, ["--device", "cpu"]).seed
        1
    """
    first = argparse.ArgumentParser(prog=recipe, add_help=False, allow_abbrev=False)
    first.add_argument("--resume", type=Path)
    first.add_argument("--preset", choices=list(presets))
    first.add_argument("--task")
    args = sys.argv[1:] if args is None else list(args)
    chosen, others = first.parse_known_args(args)
    if chosen.resume and not {"-h", "--help"} & set(args):
        others += [f"--{name} {value}" for name, value in vars(chosen).items() if value and name != "resume"]
        if others:
            raise UsageError(f"--resume takes its settings from the run: leave out {' '.join(others)}")
        return resumed_config(chosen.resume, kind, recipe)
    default = presets[chosen.preset or (chosen.task if chosen.task in presets else next(iter(presets)))]
    return parse(kind, recipe, description, args, default=default)


def parse(
    kind: Callable[..., Config], recipe: str, description: str | None, args: Sequence[str] | None = None, **options: Any
) -> Config:
    """Return the settings of a command line, in tyro's form or in the form of W&B sweeps.

    Args:
        kind: class of the settings.
        recipe: file name of the recipe.
        description: text of ``--help``.
        args: command line; by default of this process.
        options: options of ``tyro.cli``.

    Example:
        >>> parse(RegionConfig, "mine.py", None, ["--noise=[0.05, 0.05, 5]"]).noise
        (0.05, 0.05, 5.0)
    """
    words = [part for word in (sys.argv[1:] if args is None else args) for part in _tyro_words(word)]
    return library("tyro", "recipes").cli(kind, args=words, prog=recipe, description=description, **options)


def _tyro_words(word: str) -> list[str]:
    """Return ``--key=True``, ``--key=False`` and ``--key=[1, 2]``, as W&B sweeps write them, in tyro's form."""
    option, _, value = word.partition("=")
    if option.startswith("--") and value in ("True", "False"):
        return [option if value == "True" else f"--no-{option[2:]}"]
    if option.startswith("--") and value[:1] == "[" and value[-1:] == "]":
        return [option, *(item.strip(" '\"") for item in value[1:-1].split(","))]
    return [word]


def resumed_config(folder: Path, kind: type[Config], recipe: str) -> Config:
    """Return the settings of an interrupted run, with its folder as ``out`` and ``resume``.

    Args:
        folder: run folder.
        kind: class of the settings.
        recipe: file name of the recipe that resumes it.

    Raises:
        UsageError: naming the file and what is wrong: no run, a complete run, or one of another recipe or version.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "config.json").write_text('{"recipe": "mine.py", "seed": 7}')
        ...     resumed_config(Path(folder), RunConfig, "mine.py").seed
        7
    """
    path, result = folder / "config.json", folder / "eval.json"
    if not path.is_file():
        raise UsageError(f"there is no run to resume in {folder}: it holds no config.json")
    if result.is_file():
        raise UsageError(f"the run in {folder} is complete: its results are in {result}")
    try:
        settings = read_document(path)
        if not isinstance(settings, dict) or "recipe" not in settings:
            raise ValueError("it is not of this version of magrl: start the training again in a new folder")
        if (begun := settings.pop("recipe")) != recipe:
            raise ValueError(f"the run was started by {begun}: resume it with that recipe")
        settings.pop("name", None)
        if settings.get("scenario"):
            settings["scenario"] = folder / Path(settings["scenario"]).name
        settings = {key: tuple(x) if isinstance(x, list) else x for key, x in settings.items()}
        return kind(**settings | {"out": folder, "resume": folder})
    except (ValueError, TypeError) as error:
        raise UsageError(f"cannot resume from {path}: {error}") from error
