"""Scenarios of evaluations: frozen tasks, and the scenario keys that a command line can change."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from magrl.checks import check_number
from magrl.envs import Scenario, Tasks, load_scenario, named_tasks
from magrl.envs.scenario import RULES, rule_settings
from magrl.envs.tasks import RANDOM_SETS
from magrl.random_numbers import FIRST_RESERVED_SEED

TaskSet = Literal["test-1000", "paper-100", "figure-4-1"]
FIRST_TASKS_SEED = 2 * FIRST_RESERVED_SEED
"""Seed of random tasks with --tasks-seed 0: beyond the seeds of trainings and of frozen sets."""

ScenarioOptions: Any = rule_settings(**dict.fromkeys((*RULES, "altitude_km")))
"""Fields of a scenario that a command line can change, each None for its value in the scenario's file or in the
trainings, or its default."""


def choose_tasks(path: Path | None, tasks: str | int | None, tasks_seed: int | None = None, **changes: Any) -> Scenario:
    """Return a scenario with frozen tasks.

    Args:
        path: scenario file; the paper's scenario by default.
        tasks: task set, or number of random tasks; by default the scenario's own tasks, or ``test-1000`` where it has
            none.
        tasks_seed: seed of random tasks; 0 by default.
        **changes: keys of the scenario that replace its own.

    Raises:
        ValueError: for a file that is not a scenario, the paper's example task in another scenario, or a seed for tasks
            that are not random.
        FileNotFoundError: for a missing file.

    Example:
        >>> choose_tasks(None, 30, 7).tasks.start.shape
        torch.Size([30, 2])
    """
    scenario = Scenario(**changes) if path is None else load_scenario(path, **changes)
    if isinstance(tasks, int):
        tasks_seed = 0 if tasks_seed is None else tasks_seed
        check_number(0, 2**62, whole=True, tasks_seed=tasks_seed)
        return scenario.with_tasks(scenario.random_tasks(tasks, FIRST_TASKS_SEED + tasks_seed))
    if tasks_seed is not None:
        raise ValueError(f"--tasks-seed {tasks_seed} needs a number of random tasks, such as --tasks 300")
    if path is None:
        return scenario.with_tasks(named_tasks(tasks or "test-1000"))
    if tasks == "figure-4-1":
        raise ValueError("--tasks figure-4-1 lies in the paper's region: omit it, or --scenario")
    if scenario.tasks is not None and tasks is None:
        return scenario
    return scenario.with_tasks(scenario.random_tasks(*RANDOM_SETS[tasks or "test-1000"]))


def first_tasks(scenario: Scenario, num_tasks: int) -> Scenario:
    """Return a scenario with its first tasks only.

    Raises:
        ValueError: for fewer than one task, or more than it has.

    Example:
        >>> first_tasks(choose_tasks(None, "paper-100"), 3).tasks.start.shape
        torch.Size([3, 2])
    """
    assert scenario.tasks is not None
    check_number(1, len(scenario.tasks.start), whole=True, num_tasks=num_tasks)
    tasks = Tasks(*(values[:num_tasks] for values in scenario.tasks))
    return scenario.replace(tasks=tasks, names=scenario.names[:num_tasks])
