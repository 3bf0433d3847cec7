"""The benchmarks run, on next to nothing: what they time is checked where it belongs."""

import json

import pytest
import torch

from benchmarks import __main__ as bench
from benchmarks import accelerator, env, onboard, update
from benchmarks.timing import Row, alternate


def test_alternate_takes_times_in_turn() -> None:
    calls = []
    row = alternate("x", lambda: calls.append(1), lambda: calls.append(2), repeats=3, inner=2, goal="≥ 1")
    assert calls == [1, 1, 2, 2] * 4
    assert row.low <= row.speed_up <= row.high
    assert row.magrl_ms > 0


def test_tables_and_figure() -> None:
    text = bench.table([Row("a: b", 1.0, 2.5, 2.5, 2.0, 3.0, "≥ 2")])
    assert "| a: b | 1 | 2.5 | 2.50 | 2.00–3.00 | ≥ 2 |" in text
    assert "| b | 25 |" in bench.shares_table({"a": 0.75, "b": 0.25})
    figure = bench.cost_figure([{"vehicles": n, "raw_us": 1 / n, "guided_us": 2 / n} for n in (64, 128)])
    assert [line.get_label() for line in figure.axes[0].lines] == ["raw step", "guided, in a collector"]


def test_plain_step_is_the_step_of_the_recipe() -> None:
    """From the same weights and batch, plain PyTorch and the recipe's parts have the same networks after two steps."""
    torch.manual_seed(0)
    recipe, plain = update.Recipe(update.OBSERVATION_SIZE), update.Plain(update.OBSERVATION_SIZE)
    pairs = [*zip(plain.critic_weights, recipe.loss.critic_parameters(), strict=True)]
    pairs += zip(plain.actor.parameters(), recipe.loss.actor_parameters(), strict=True)
    with torch.no_grad():
        for mine, theirs in pairs:
            mine.copy_(theirs)
    plain.target_actor.load_state_dict(plain.actor.state_dict())
    for target, critic in zip(plain.target_critics, plain.critics, strict=True):
        target.load_state_dict(critic.state_dict())
    batch = update.transitions(update.OBSERVATION_SIZE, update.CONFIG.batch_size)
    after = batch["next"]
    tensors = (batch["observation"], batch["action"], after["reward"], after["observation"], after["terminated"])
    for _ in range(2):
        torch.manual_seed(1)
        recipe.update(batch)
        torch.manual_seed(1)
        plain.update(*tensors)
    for mine, theirs in pairs:
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)


def test_results_are_written(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(env, "rows", lambda: [Row("env", 1.0, 2.0, 2.0, 1.9, 2.1)])
    out = tmp_path / "new" / "bench.json"
    bench.main(["--only", "env", "--out", str(out)])
    assert [row["what"] for row in json.loads(out.read_text(encoding="utf-8"))["rows"]] == ["env"]
    assert "| env | 1 | 2 | 2.00 | 1.90–2.10 |  |" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="was not measured"):
        bench.main(["--only", "env", "--out", str(out), "--publish"])


def test_timed_functions_run() -> None:
    base, plain = (env.GeomagneticNavEnv(num_envs=4, seed=0) for _ in range(2))
    for timed in (env.Collecting(4), env.Stepper(plain), env.Running(env.with_every_sensor_error(base), begun=2)):
        assert env.time_of(timed, 0.0) > 0
    stock = update.Stock(update.OBSERVATION_SIZE)
    before = [weights.clone() for weights in stock.loss.parameters()]
    for _ in range(2):
        stock.update(update.transitions(update.OBSERVATION_SIZE, 4))
    assert all((one != other).any() for one, other in zip(before, stock.loss.parameters(), strict=True))
    assert onboard.row("secant", repeats=3).magrl_ms > 0


def test_the_cost_by_number_of_vehicles(capsys) -> None:
    accelerator.main(["--device", "cpu", "--vehicles", "2", "3", "--seconds", "0", "--frames", "0"])
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert rows[0] == "| µs per vehicle | 2 | 3 |"
    assert len(rows) == 8
    assert all(float(cost) > 0 for row in rows[2:] for cost in row.split("|")[2:4])
