"""Cost of a step on board of one vehicle: `python -m benchmarks.onboard`, seconds on one core."""

from __future__ import annotations

import math

from benchmarks.timing import HEADER, Row, alternate, one_thread
from magrl.envs import GeomagneticNavEnv
from magrl.navigators import policy_env
from magrl.navigators.names import make_navigator
from magrl.onboard import Onboard

import torch
from tensordict import TensorDictBase

NAVIGATORS = ("anywhere", "secant", "kalman")


class Simulated:
    """A navigator in the environment with one vehicle, one episode after the other; it keeps what it flew."""

    def __init__(self, name: str) -> None:
        base = GeomagneticNavEnv(num_envs=1, seed=0)
        self.policy = make_navigator(name, base)
        self.env = policy_env(base, self.policy)
        self.state = self.env.reset()
        self.flown: list[TensorDictBase] = []

    def __call__(self) -> None:
        with torch.no_grad():
            step, following = self.env.step_and_maybe_reset(self.policy(self.state))
        self.flown.append(step)
        self.state = following


class Aboard:
    """The same navigator on board, on the readings of a simulated flight."""

    def __init__(self, name: str, flown: list[TensorDictBase]) -> None:
        self.vehicle, self.number = Onboard(name, max_steps=50, confidence=1.0), 0
        self.readings = [
            (*step["field"][0].tolist(), math.degrees(step["heading"].item()), step["leg"][0, 0].item())
            for step in flown
        ]
        self.target = flown[0]["target_field"][0].tolist()

    def __call__(self) -> None:
        if self.number % len(self.readings) == 0:
            self.vehicle.start(self.target, target_std=(0.0, 0.0, 0.0))
        self.vehicle.step(*self.readings[self.number % len(self.readings)])
        self.number += 1


def rows(repeats: int = 60) -> list[Row]:
    """Return the times of a step on one thread: on board, and of the environment with the same navigator.

    Args:
        repeats: pairs of times for each row.
    """
    with one_thread():
        return [row(name, repeats) for name in NAVIGATORS]


def row(name: str, repeats: int) -> Row:
    """Return the times of a navigator."""
    simulated = Simulated(name)
    while not simulated.flown or not simulated.flown[-1]["next", "done"].item():
        simulated()
    aboard = Aboard(name, list(simulated.flown))
    return alternate(f"step on board, {name}: environment and policy", aboard, simulated, repeats=repeats)


if __name__ == "__main__":
    print(HEADER + "\n".join(map(str, rows())))
