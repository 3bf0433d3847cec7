"""The transforms in environments of other domains, as docs/transforms.md shows them."""

import importlib
import math
import sys
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).parent.parent.parent / "docs" / "examples"))
pendulum, classic_control = map(importlib.import_module, ("pendulum", "classic_control"))


def test_the_pendulum_example() -> None:
    assert pendulum.main(pendulum.Config(steps=50)) == 0.0
    torque = torch.full((5, 1), 0.5)
    flights = (pendulum.fly(pendulum.make_env(0), scale * torque, 0)["next", "reward"] for scale in (1.0, 1.1))
    assert not torch.equal(*flights)


def test_the_classic_control_example(capsys: pytest.CaptureFixture[str]) -> None:
    rows = classic_control.main(classic_control.Config(steps=20))
    assert len(rows) == 2 + 6 + 4
    assert rows[9].startswith("| CartPole-v1 | 1 | -inf to inf | -3 to 3 |")
    assert "CartPole-v1: MinMaxNorm needs finite bounds" in capsys.readouterr().out


def test_numbers_without_bounds_go_on_beyond_the_interval() -> None:
    env = classic_control.make_env("CartPole-v1", open_bound=0.01)
    assert env.rollout(10)["scaled"].abs().max() > 1
    assert env.observation_spec["scaled"].space.high.tolist() == [1.0, math.inf, 1.0, math.inf]
