"""Fit the prior of the gradients on random planets, by likelihood: half a minute on one core.

    python recipes/gradient_prior.py                                        # prints how well it fits
    python recipes/gradient_prior.py --out magrl/tracking/learned_prior.pt  # and replaces the one of the library

The fields are those on which recipes/ppo_anywhere.py trains. The Earth is compared with them, and not used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from magrl import paper
from magrl.envs import Scenario, earth_scenario, planet_scenario
from magrl.field import elements_at
from magrl.field.model import elements_gradient_at
from magrl.files import check_writable
from magrl.tracking import LearnedPrior
from magrl.training import command, parse

import torch
from torch import Tensor
from torch.optim import Adam
from torch.optim.lr_scheduler import LinearLR
from tqdm import tqdm

RECIPE = "gradient_prior.py"
REGIONS = {"half_size_deg": 20, "degree": 16, "max_latitude": 75, "distance_law": "log"}


@dataclass(frozen=True)
class Config:
    """Settings of the fit."""

    seed: int = 0
    """Random seed of planets, tasks and weights."""
    num_regions: int = 4096
    """Number of training regions, two on each random planet."""
    num_tasks: int = 200_000
    """Number of training tasks: starts and destinations."""
    distance_range_km: tuple[float, float] = (150.0, 1800.0)
    """Shortest and longest distance of a task [km], log-uniform."""
    test_regions: int = 256
    """Number of regions of other planets, and of the Earth, on which the fit is tested."""
    width: int = 64
    """Width of the two hidden layers."""
    updates: int = 6000
    """Number of gradient steps."""
    batch_size: int = 2048
    """Tasks per gradient step."""
    learning_rate: float = 2e-3
    """Learning rate of Adam at the start; it falls linearly to a hundredth."""
    out: Path | None = None
    """File of the weights."""


def samples(
    world: Callable[..., Scenario], count: int, tasks: int, seed: int, config: Config
) -> tuple[Tensor, Tensor, Tensor]:
    """Return elements at starts and at targets ``(tasks, 3)``, and the gradients at the starts ``(tasks, 3, 2)``."""
    scenario = world(count, seed=seed, distance_range_km=config.distance_range_km, **REGIONS)
    task = scenario.random_tasks(tasks, seed)
    here, there = (elements_at(scenario.field, place, task.region) for place in (task.start, task.target))
    return here, there, elements_gradient_at(scenario.field, task.start, task.region)


def fit(config: Config) -> LearnedPrior:
    """Fit the prior by maximum likelihood; print its mean loss on other planets and on the Earth."""
    torch.manual_seed(config.seed)
    training = samples(planet_scenario, config.num_regions, config.num_tasks, config.seed, config)
    worlds = {"other planets": planet_scenario, "the Earth": earth_scenario}
    tests = {
        name: samples(world, config.test_regions, 10_000, paper.VALIDATION_SEED, config)
        for name, world in worlds.items()
    }
    prior = LearnedPrior(config.width)
    dipole = {name: prior.loss(*test).mean().item() for name, test in tests.items()}
    optimizer = Adam(prior.parameters(), lr=config.learning_rate)
    schedule = LinearLR(optimizer, 1.0, 0.01, config.updates)
    for _ in tqdm(range(config.updates), unit="update"):
        batch = torch.randint(config.num_tasks, (config.batch_size,))
        loss = prior.loss(*(values[batch] for values in training)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    for name, test in tests.items():
        print(f"{name}: loss {prior.loss(*test).mean():.2f}, of a dipole {dipole[name]:.2f}")
    return prior


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and fit."""
    config = parse(Config, RECIPE, __doc__, args)
    if config.out is not None:
        check_writable(config.out)
    prior = fit(config)
    if config.out is not None:
        torch.save(prior.state_dict(), config.out)


if __name__ == "__main__":
    command(RECIPE, main)
