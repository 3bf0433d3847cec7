"""The benchmarks run, on next to nothing: what they time is checked where it belongs."""

import json
import math

import pytest
import torch

from benchmarks import __main__ as bench
from benchmarks import env, imports, onboard, profile_training, update
from benchmarks.__main__ import cost_figure, seconds_table, table
from benchmarks.timing import Row, alternate


def test_alternate_takes_times_in_turn() -> None:
    calls = []
    row = alternate("x", lambda: calls.append(1), lambda: calls.append(2), repeats=3, inner=2, goal="≥ 1")
    assert calls == [1, 1, 2, 2] * 4
    assert row.low <= row.speed_up <= row.high
    assert row.magrl_ms > 0


def test_tables() -> None:
    text = table([Row("a: b", 1.0, 2.5, 2.5, 2.0, 3.0, "≥ 2")])
    assert "| a: b | 1 | 2.5 | 2.50 | 2.00–3.00 | ≥ 2 |" in text
    assert seconds_table([3.0, math.nan, 1.0]).splitlines()[-1] == "| 3.0 | nan | 1.0 | **2.0** |"
    assert "| b | 25 |" in profile_training.table({"a": 0.75, "b": 0.25})
    figure = cost_figure([{"vehicles": n, "raw_us": 1 / n, "guided_us": 2 / n} for n in (64, 128)])
    assert [line.get_label() for line in figure.axes[0].lines] == ["raw step", "guided, in a collector"]


def test_plain_step_is_the_step_of_the_recipe() -> None:
    """From the same weights and batch, plain PyTorch and the recipe's parts have the same networks after two steps."""
    torch.manual_seed(0)
    recipe, plain = update.Recipe(update.OBSERVATION_SIZE), update.Plain(update.OBSERVATION_SIZE)
    with torch.no_grad():
        for mine, theirs in zip(plain.critic_weights, recipe.loss.critic_parameters(), strict=True):
            mine.copy_(theirs)
        for mine, theirs in zip(plain.actor.parameters(), recipe.loss.actor_parameters(), strict=True):
            mine.copy_(theirs)
    plain.target_actor.load_state_dict(plain.actor.state_dict())
    for target, critic in zip(plain.target_critics, plain.critics, strict=True):
        target.load_state_dict(critic.state_dict())
    batch = update.transitions(update.OBSERVATION_SIZE, update.CONFIG.batch_size)
    after = batch["next"]
    for _ in range(2):
        torch.manual_seed(1)
        recipe.update(batch)
        torch.manual_seed(1)
        tensors = (batch["observation"], batch["action"], after["reward"], after["observation"], after["terminated"])
        plain.update(*tensors)
    for mine, theirs in zip(plain.critic_weights, recipe.loss.critic_parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)
    first = recipe.loss.actor_parameters()[0]
    torch.testing.assert_close(next(plain.actor.parameters()), first, rtol=1e-4, atol=1e-5)


def test_rows_are_printed_as_they_are_measured_and_late_parts_are_skipped(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(bench, "measure", lambda part: [Row(part, 1.0, 2.0, 2.0, 1.9, 2.1)])
    out = tmp_path / "bench.json"
    bench.main(["--only", "env", "--only", "update", "--out", str(out)])
    assert [row["what"] for row in json.loads(out.read_text())["rows"]] == ["env", "update"]
    assert "| env | 1 | 2 | 2.00 | 1.90–2.10 |  |" in capsys.readouterr().out
    bench.main(["--only", "env", "--limit-s", "-1", "--out", str(out)])
    assert "skipped" in capsys.readouterr().out
    assert json.loads(out.read_text())["rows"] == []


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
    with_magrl, without = asked[0::2], asked[1::2]
    assert [code + "; from magrl import *" for code in without] == with_magrl
    assert set(without) == {
        "import torchrl",
        "import " + ", ".join(f"torchrl.{x}" for x in imports.PARTS),
    }


def test_steps_on_board_are_timed() -> None:
    found = onboard.row("secant", repeats=5)
    assert found.what.startswith("step on board, secant")
    assert found.magrl_ms > 0


def test_shares_add_up() -> None:
    found = env.shares(steps=45)  # all episodes end within 50 steps
    assert sum(found.values()) == pytest.approx(1)
    assert all(share > 0 for share in found.values())
