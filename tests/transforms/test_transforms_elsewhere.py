"""The transforms in environments of other domains, as docs/transforms.md shows them."""

import importlib
import math
import sys
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).parent.parent.parent / "docs" / "examples"))


plume, plume_env, pendulum, classic_control = map(
    importlib.import_module, ("plume", "plume_env", "pendulum", "classic_control")
)


# The estuary


def test_the_way_by_two_tracers_leads_to_the_target() -> None:
    """An oracle that holds the theoretical heading arrives: so the transforms speak the language of this env too."""
    env = TransformedEnv(plume_env.PlumeEnv(60), Compose(StepCounter(30), *plume.guidance()))

    def hold(td: TensorDictBase) -> TensorDictBase:
        turn = wrap_angle(td["way"] - td["heading"]).clamp(-math.pi / 2, math.pi / 2)
        return td.set("action", torch.cat((torch.full_like(turn, 0.6), turn), -1))

    flown = env.rollout(30, hold, break_when_any_done=False, break_when_all_done=True)
    assert flown["next", "terminated"].any(1).double().mean() > 0.95
    assert flown["way_valid"].double().mean() > 0.95


def test_the_plume_example(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = {"seeds": 2, "total_frames": 64, "num_envs": 16, "init_random_frames": 32, "batch_size": 16}
    trainings = plume.main(plume.Config(out=tmp_path, eval_every=4, eval_tasks=8, max_steps=5, **small))
    frames = {name: [run.frames for run in runs] for name, runs in trainings.items()}
    assert frames == {"gg_td3": [[64]] * 2, "td3": [[64]] * 2}
    assert "| TD3 | 2 | 2 of 2 never |" in capsys.readouterr().out
    assert (tmp_path / "plume.png").read_bytes().startswith(b"\x89PNG")


# Pendulum and classic control


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
