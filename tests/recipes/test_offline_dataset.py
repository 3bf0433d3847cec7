"""The recipe that writes offline datasets: Minari and TorchRL read them, and their environment repeats them."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from support.recipes import load
from tensordict import TensorDict
from torchrl.data.datasets import MinariExperienceReplay

import magrl.envs
from magrl.envs import PUBLIC_KEYS
from magrl.training import UsageError

minari = pytest.importorskip("minari")
recipe = load("docs/examples/offline_dataset")
SMALL = ["--regions", "2", "--episodes", "3", "--distance-range-km", "60", "90", "--max-steps", "4", "--seed", "1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Folder of small datasets."""
    with pytest.MonkeyPatch.context() as patch:
        path = tmp_path_factory.mktemp("minari") / "datasets"
        patch.setenv("MINARI_DATASETS_PATH", "")  # restored at the end
        recipe.main([*SMALL, "--out", str(path)])
        yield path


@pytest.mark.usefixtures("folder")
def test_torchrl_loads_them_from_disk(tmp_path: Path, monkeypatch) -> None:
    """Whole episodes, with observations before and after each step; `kalman` earns more than random actions."""
    # TorchRL 0.14.1 makes its files with memmap_like, which does not copy: what it loads is 0.
    monkeypatch.setattr(TensorDict, "memmap_like", TensorDict.memmap)
    total = {}
    for policy in ("random", "kalman"):
        options = {"root": tmp_path, "download": False, "load_from_local_minari": True}
        steps = MinariExperienceReplay(f"magrl/earth-{policy}-0_05-v0", batch_size=8, **options)[:]
        count = minari.load_dataset(f"magrl/earth-{policy}-0_05-v0").total_steps
        before, after = steps["observation"], steps["next", "observation"]
        for key, size in zip(PUBLIC_KEYS, (3, 3, 2, 1), strict=True):
            assert before[key].shape == after[key].shape == (count, size)
        assert steps["action"].shape == (count, 2)
        same = steps["episode"][1:] == steps["episode"][:-1]
        assert torch.equal(steps["next", "done"].flatten(), torch.cat((~same, torch.ones(1, dtype=torch.bool))))
        assert torch.equal(after["field"][:-1][same], before["field"][1:][same])
        total[policy] = steps["next", "reward"].sum().item() / 3
    metadata = minari.load_dataset("magrl/earth-secant-0_05-v0").storage.metadata
    assert total["kalman"] > total["random"]
    assert metadata["ref_max_score"] == pytest.approx(total["kalman"])
    assert metadata["ref_min_score"] == pytest.approx(total["random"])


@pytest.mark.usefixtures("folder")
def test_the_environment_in_the_metadata_repeats_them() -> None:
    data = minari.load_dataset("magrl/earth-secant-0_05-v0")
    metadata, episodes = data.storage.metadata, list(data.iterate_episodes())
    assert metadata["command"] == "python docs/examples/offline_dataset.py --field earth " + (
        "--episodes 3 --regions 2 --distance-range-km 60.0 90.0 --max-steps 4 --seed 1"
    )
    envs = eval(metadata["environment"], {"gymnasium": gymnasium, "magrl": magrl})
    assert envs.single_observation_space == data.observation_space
    state, _ = envs.reset(seed=next(iter(data.storage.get_episode_metadata([0])))["seed"])
    for step in range(4):
        running = [row for row, episode in enumerate(episodes) if step < len(episode)]
        actions = np.zeros((3, 2), dtype=np.float32)
        for row in running:
            actions[row] = episodes[row].actions[step]
            reading = {key: episodes[row].observations[key][step] for key in PUBLIC_KEYS}
            assert reading in data.observation_space
            assert actions[row] in data.action_space
            assert all(np.array_equal(reading[key], state[key][row]) for key in PUBLIC_KEYS)
        state, rewards, *_ = envs.step(actions)
        assert [rewards[row] for row in running] == [episodes[row].rewards[step] for row in running]


def test_datasets_are_not_replaced_and_seeds_of_evaluations_are_refused(folder: Path, capsys) -> None:
    with pytest.raises(UsageError, match="earth-random-0-v0 exists: choose another --out"):
        recipe.main([*SMALL, "--out", str(folder)])
    with pytest.raises(SystemExit):
        recipe.main([*SMALL, "--seed", "2000000000", "--out", str(folder)])
    assert "seed must be less than 2000000000" in capsys.readouterr().err
