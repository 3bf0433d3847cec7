"""The recipe of the recurrent agent: its run folder, resuming, settings, and that it learns."""

import json
from pathlib import Path

import pytest
import td3_recurrent as recipe
import torch
from support.recipes import small

from magrl.agents import RecurrentTD3Loss
from magrl.training import Run


def test_non_finite_weight_stops_the_training(tmp_path: Path, monkeypatch) -> None:
    """After the last update of a batch, so that no loss is computed with it."""

    class Poisoned(recipe.SoftUpdate):
        def __init__(self, loss: RecurrentTD3Loss, *, tau: float) -> None:
            super().__init__(loss, tau=tau)
            self.weight, self.steps = loss.memory_parameters()[0], 0

        def step(self) -> None:
            super().step()
            self.steps += 1
            if self.steps == 4:  # two updates of the targets a batch
                with torch.no_grad():
                    self.weight[0] = float("nan")

    monkeypatch.setattr(recipe, "SoftUpdate", Poisoned)
    with pytest.raises(FloatingPointError, match=r"after update 8: .*lstm.* is not finite in rows \[0"):
        recipe.train(small(recipe, tmp_path))


@pytest.mark.parametrize(
    ("name", "value"),
    [("memory_size", 0), ("steps_per_batch", 1), ("buffer_size", 63), ("noise_share", 0.0), ("random_share", 1.5)],
)
def test_bad_settings_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        recipe.Config(**{name: value})


def test_a_scenario_has_distances_and_steps_of_its_own(tmp_path: Path) -> None:
    """The shortest training task is below its longest one; its step limit is that of the evaluations alone."""
    content = {"region": {"latitude": [40, 50], "longitude": [-30, -20]}, "date": "2026-07-01", "max_steps": 80}
    near, far = tmp_path / "near.json", tmp_path / "far.json"
    near.write_text(json.dumps(content | {"distance_range_km": [50, 90]}))
    far.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="shortest_task_km must be below 90, got 100"):
        recipe.Config(out=tmp_path / "run", scenario=near)
    config = recipe.Config(out=tmp_path / "run", scenario=far)
    with Run(config, recipe="mine.py", name="mine") as run:
        assert recipe.make_base(run, config).max_steps == config.train_steps != 80
        assert [env.max_steps for env in run.evaluation_envs()] == [80, 80]


@pytest.mark.slow
def test_the_eight_numbers_suffice_with_a_memory(tmp_path: Path) -> None:
    """On a seed that was not used for tuning."""
    result = recipe.train(recipe.Config(seed=5, out=tmp_path / "run", wandb_mode="disabled"))
    assert result["success_rate"] >= 90
    assert result["num_tasks"] == 1000
