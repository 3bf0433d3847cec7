"""Counts and running means of a training."""

import math

import pytest
import torch
from tensordict import TensorDict

from magrl.training.curves import RETURN_TERMS, TrainingStatistics


def batch(*ended: tuple[float, bool], running: int = 0, terms: dict[str, float] | None = None) -> TensorDict:
    """Return transitions of vehicles whose episodes end with (return, success), and of some whose episodes go on."""
    count = len(ended) + running
    after = TensorDict(
        episode_reward=torch.tensor([[value] for value, _ in ended] + [[7.0]] * running),
        success=torch.tensor([[success] for _, success in ended] + [[False]] * running),
        done=torch.tensor([[True]] * len(ended) + [[False]] * running),
        batch_size=[count],
    )
    for name, value in (terms or {}).items():
        after[f"episode_reward_{name}"] = torch.full((count, 1), value)
    return TensorDict(next=after, batch_size=[count])


def test_episodes_that_ended_count_alone() -> None:
    statistics = TrainingStatistics(window=2)
    terms = {"destination": 200.0, "proximity": 3.0, "alignment": -1.5}
    statistics.add(batch((300.0, True), (100.0, False), running=1, terms=terms))
    statistics.losses["loss_critic"] = torch.tensor(0.25)
    assert (statistics.frames, statistics.episodes, statistics.iterations) == (3, 2, 1)
    row = statistics.row()
    assert (row["return"], row["success_rate"], row["loss_critic"]) == (200, 50, 0.25)
    assert {name: row[f"return_{name}"] for name in RETURN_TERMS} == terms


def test_a_term_that_the_reward_lacks_is_nan() -> None:
    statistics = TrainingStatistics()
    statistics.add(batch((5.0, False), terms={"proximity": 5.0}))
    row = statistics.row()
    assert row["return_proximity"] == 5
    assert math.isnan(row["return_alignment"])


def test_the_oldest_episodes_are_forgotten() -> None:
    statistics = TrainingStatistics(window=1)
    statistics.add(batch((300.0, False), (100.0, True), running=2))
    statistics.add(batch((50.0, True)))
    assert (statistics.frames, statistics.episodes, statistics.iterations) == (5, 3, 2)
    assert (statistics.row()["return"], statistics.row()["success_rate"]) == (50, 100)


def test_means_are_those_of_two_hundred_episodes() -> None:
    statistics = TrainingStatistics()
    for value in range(201):
        statistics.add(batch((float(value), value > 100), terms={"proximity": 2.0 * value}))
    row = statistics.row()
    assert (row["return"], row["success_rate"], row["return_proximity"]) == (100.5, 50, 201)  # the first is forgotten


def test_means_of_no_episode_are_nan() -> None:
    statistics = TrainingStatistics()
    statistics.add(batch(running=3))
    row = statistics.row()
    assert row["frames"] == 3
    assert all(math.isnan(row[key]) for key in ("return", "success_rate", "return_destination"))


def test_statistics_continue_from_their_state() -> None:
    one, other = TrainingStatistics(), TrainingStatistics()
    one.add(batch((300.0, True), (100.0, False), running=1, terms={"destination": 200.0}))
    one.updates, one.losses = 4, {"loss_actor": torch.tensor(-0.5)}
    other.load_state_dict(one.state_dict())
    for statistics in (one, other):
        statistics.add(batch((20.0, True), terms={"destination": 100.0}))
    assert (other.frames, other.episodes, other.iterations, other.updates) == (4, 3, 2, 4)
    rows = [{key: value for key, value in s.row().items() if not math.isnan(value)} for s in (one, other)]
    assert rows[0] == rows[1]
    assert rows[0]["return_destination"] == pytest.approx(500 / 3)
    with pytest.raises(KeyError, match="frames"):
        other.load_state_dict({})
    with pytest.raises(KeyError, match="episode_reward"):
        other.add(batch((1.0, True)).exclude(("next", "success")))
