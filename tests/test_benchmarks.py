"""The benchmarks run, on next to nothing: what they time is checked where it belongs."""

import math

import pytest
import torch

from benchmarks import env, imports, profile_training, update
from benchmarks.__main__ import cost_figure, seconds_table, table
from benchmarks.timing import Row, alternate
from magrl import td3


def test_alternate_takes_times_in_turn() -> None:
    calls = []
    row = alternate("x", lambda: calls.append(1), lambda: calls.append(2), repeats=3, inner=2, goal="≥ 1")
    assert calls == [1, 1, 2, 2] * 4
    assert row.low <= row.ratio <= row.high
    assert row.first_ms > 0


def test_tables() -> None:
    text = table([Row("a / b", 1.0, 2.5, 2.5, 2.0, 3.0, "≥ 2")])
    assert "| a / b | 1 | 2.5 | 2.50 | 2.00–3.00 | ≥ 2 |" in text
    assert seconds_table([3.0, math.nan, 1.0]).splitlines()[-1] == "| 3.0 | nan | 1.0 | **2.0** |"
    assert "| b | 25 |" in profile_training.table({"a": 0.75, "b": 0.25})
    figure = cost_figure([{"vehicles": n, "raw_us": 1 / n, "guided_us": 2 / n} for n in (64, 128)])
    assert [line.get_label() for line in figure.axes[0].lines] == ["raw step", "guided, in a collector"]


def test_hand_written_step_is_the_recipe_s() -> None:
    """Plain PyTorch and the recipe, from the same weights on the same batch: the same critics after a step."""
    torch.manual_seed(0)
    view = update.view()
    size = td3.observation_size(view)
    learner, plain = update.Learner(update.CONFIG, view, torch.device("cpu")), update.Plain(size)
    weights = iter(learner.loss.critic_parameters())
    with torch.no_grad():
        for mine in plain.critic_weights:
            mine.copy_(next(weights))
        for mine, theirs in zip(plain.actor.parameters(), learner.loss.actor_network_params.parameters(), strict=False):
            mine.copy_(theirs)
    plain.target_actor.load_state_dict(plain.actor.state_dict())
    for target, critic in zip(plain.target_critics, plain.critics, strict=True):
        target.load_state_dict(critic.state_dict())
    batch = update.transitions(size)
    after = batch["next"]
    for _ in range(2):
        torch.manual_seed(1)
        learner.update(batch, update.SATURATION)
        torch.manual_seed(1)
        tensors = (batch["observation"], batch["action"], after["reward"], after["observation"], after["terminated"])
        plain.update(*tensors)
    for mine, theirs in zip(plain.critic_weights, learner.loss.critic_parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)
    first = next(iter(learner.loss.actor_network_params.parameters()))
    torch.testing.assert_close(next(plain.actor.parameters()), first, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("timed", [env.Collecting, lambda n: env.Stepper(env.GeomagneticNavEnv(num_envs=n, seed=0))])
def test_what_is_timed_runs(timed) -> None:
    function = timed(4)
    for _ in range(3):
        function()
    assert env.time_of(function, 0.0) > 0


def test_free_field_flies() -> None:
    flown = env.GeomagneticNavEnv(num_envs=4, seed=0)
    flown.field = env.FreeField(4)
    assert torch.isfinite(flown.rollout(2)["next", "field"]).all()


def test_imports_are_timed_with_and_without_magrl(monkeypatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(imports, "fresh", asked.append)
    assert len(imports.rows(repeats=2)) == 2
    without, with_magrl = asked[0::2], asked[1::2]
    assert [code + "; from magrl import *" for code in without] == with_magrl
    assert set(without) == {
        "import torchrl",
        "import " + ", ".join(f"torchrl.{x}" for x in imports.PARTS),
    }


def test_shares_add_up() -> None:
    found = env.shares(steps=3)
    assert sum(found.values()) == pytest.approx(1)
    assert all(share > 0 for share in found.values())
