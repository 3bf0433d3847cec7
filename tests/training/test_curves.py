"""Statistics of a training by hand, the selection of its best policy, and curves that are on disk at once."""

import csv
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from magrl.training.curves import (
    RETURN_TERMS,
    BestPolicy,
    RunLog,
    TrainingStatistics,
    training_figure,
)
from magrl.training.wandb_run import WandbRun


def steps(done: list[bool], success: list[bool], **sums: list[float]) -> TensorDict:
    """Return a batch of transitions; TorchRL's RewardSum writes sums from the start of the episode."""
    flags = {"done": torch.tensor(done).unsqueeze(-1), "success": torch.tensor(success).unsqueeze(-1)}
    values = {key: torch.tensor(value).unsqueeze(-1) for key, value in sums.items()}
    return TensorDict(next=TensorDict(**flags, **values), batch_size=[len(done)])


def test_statistics_count_ended_episodes_only_and_continue_from_their_state() -> None:
    statistics = TrainingStatistics(window=3)
    assert math.isnan(statistics.row()["return"])
    sums = {
        "episode_reward": [9.0, 100.0, -50.0],
        "episode_reward_destination": [9.0, 200.0, 0.0],
        "episode_reward_proximity": [9.0, -100.0, -50.0],
    }
    statistics.add(steps([False, True, True], [False, True, False], **sums))
    statistics.first_cohort = statistics.frames + 1
    assert math.isnan(statistics.row()["return"]), "only short episodes have ended"
    statistics.first_cohort = 0
    statistics.losses["loss_critic"] = torch.tensor(0.25)
    row = statistics.row()
    assert (row["frames"], row["episodes"], row["updates"], statistics.iterations) == (3, 2, 0, 1)
    assert (row["success_rate"], row["return"], row["loss_critic"]) == (50.0, 25.0, 0.25)
    assert (row["return_destination"], row["return_proximity"]) == (100.0, -75.0)
    assert math.isnan(row["return_alignment"]), "an agent without guidance has no such term"
    resumed = TrainingStatistics(window=3)
    resumed.load_state_dict(statistics.state_dict())
    for each in (statistics, resumed):
        each.add(steps([True, True], [True, True], episode_reward=[10.0, 20.0]))
        assert each.row()["return"] == pytest.approx((-50 + 10 + 20) / 3), "the last three episodes"
    assert str(resumed.row()) == str(statistics.row())


def test_best_policy_is_the_best() -> None:
    best, layer = BestPolicy(), nn.Linear(1, 1)
    for score, weight in ((1.0, 10.0), (3.0, 30.0), (2.0, 20.0)):
        nn.init.constant_(layer.weight, weight)
        best.offer(score, layer)
    other = BestPolicy()
    other.load_state_dict(best.state_dict())
    other.offer(2.9, layer)
    assert (other.score, other.weights["weight"].item()) == (3, 30)


def test_rows_are_on_disk_when_written(tmp_path: Path) -> None:
    row = {"frames": 512, "return": 1.5, "eval_spl": 88.4, "return_alignment": -0.5}
    log = RunLog(tmp_path, list(row), lambda **_: WandbRun(tmp_path, "disabled", {}))
    log.row(row)
    with (tmp_path / "train.csv").open(encoding="utf-8") as file:
        assert [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)] == [row]
    with pytest.raises(ValueError, match="unknown_column"):
        log.row({"unknown_column": 1.0})
    log.close()
    assert {path.name for path in tmp_path.iterdir()} == {"train.csv"}


def test_training_figure_shows_the_columns_of_a_training() -> None:
    """Return, its terms, score and losses, each from its column; the labels tell lines of a panel apart."""
    columns = ["return", *(f"return_{term}" for term in RETURN_TERMS), "success_rate", "eval_score"]
    columns += ["eval_success_rate", "eval_spl", "loss_critic", "loss_actor"]
    rows = [{"frames": 0.0, "return": math.nan}]  # a row without values is left out
    rows += [{"frames": frames, **{key: 10.0 * i + frames for i, key in enumerate(columns)}} for frames in (1, 2)]
    panels = training_figure(rows).axes
    shown = [[line.get_ydata()[0] for line in axes.lines] for axes in panels]
    assert shown == [[1], [11, 21, 31], [41, 51, 61, 71], [81, 91]]
    assert [text.get_text() for text in panels[1].get_legend().get_texts()] == list(RETURN_TERMS)
