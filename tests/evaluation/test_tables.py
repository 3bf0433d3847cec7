"""Tables of navigators: averages over runs, intervals, and the paper's rows."""

import math
import re

from magrl.evaluation.tables import cell, comparison_table, mean_of_runs, short_table

RUNS = [97.0, 98.0, 99.0, 100.0]


def cells(line: str) -> list[str]:
    return [text.strip() for text in line.strip("|").split("|")]


def test_mean_of_runs_by_hand() -> None:
    """One run, its value; a few, interquartile mean and range; ten or more, the interval, which is narrower."""
    assert mean_of_runs([99.0], form=".1f") == "99.0"
    assert mean_of_runs([math.nan, 2.0, None], form=".1f") == "2.0"
    assert mean_of_runs([None, math.nan], form=".1f") == "—"
    assert mean_of_runs(RUNS, form=".2f") == "98.50 [97.00–100.00]"
    assert mean_of_runs([0.0, *RUNS], form=".1f") == "98.0 [0.0–100.0]"
    assert mean_of_runs(RUNS, form=".1f", interval=False) == "98.5"
    assert "[" in mean_of_runs([*RUNS * 2, 99.0], form=".1f")
    middle, low, high = map(float, re.findall(r"[\d.]+", mean_of_runs([*RUNS * 2, *RUNS[1:3]], form=".3f")))
    assert 97 < low < middle == 98.5 < high < 100


def test_worst_run_and_interval_over_trips() -> None:
    assert cell([{"spl": 99.0}, {"spl": None}, {"spl": 98.456}], "worst", ".2f") == "98.46"
    assert cell([{"spl": 99.0}, {"spl": None}], "worst", ".2f") == cell([], "worst", ".2f") == "—"
    one = {"spl": 98.0, "spl_low": 97.5, "spl_high": 98.5, "steps": None}
    assert cell([one], "spl", ".1f") == "98.0 (97.5–98.5)"
    assert cell([one, one], "spl", ".1f") == "98.0 [98.0–98.0]"
    assert cell([one], "steps", ".1f") == cell([one], "unknown", ".1f") == "—"
    assert cell([{**one, "spl": None, "spl_low": None, "spl_high": None}], "spl", ".1f") == "—"


def test_rows_of_one_and_of_several_runs() -> None:
    one = {"success_rate": 100.0, "success_rate_low": 99.6, "success_rate_high": 100.0, "spl": 99.0, "steps": 9.0}
    one |= {"spl_low": 98.0, "spl_high": 99.5, "path_efficiency": 97.0, "smoothness_deg": 170.0}
    several = [{**one, "spl": spl} for spl in RUNS]
    head, _, published, guided, secant = comparison_table({"gg_td3": several, "secant": [one]}).splitlines()
    rows = [dict(zip(cells(head), cells(line), strict=True)) for line in (published, guided, secant)]
    assert [(row["trained on"], row["given"]) for row in rows] == [
        ("—", "—"),
        ("the region", "nothing"),
        ("nothing", "nothing"),
    ]
    assert [row["runs"] for row in rows] == ["1", "4", "1"]
    assert [row["SPL %"] for row in rows] == ["88.41", "98.50 [97.00–100.00]", "99.00 (98.00–99.50)"]
    assert [row["worst run, SPL %"] for row in rows] == ["—", "97.00", "—"]
    assert [row["SR %"] for row in rows] == ["97.0", "100.0 [100.0–100.0]", "100.0 (99.6–100.0)"]
    assert [row["smoothness °"] for row in rows] == ["—", "170.0", "170.0"]


def test_papers_row_stands_above_the_algorithm() -> None:
    lines = comparison_table({"ga": [{"spl": 1.0}], "secant": [{"spl": 1.0}]}).splitlines()
    assert [cells(line)[0] for line in lines[2:4]] == ["GA, paper", "GA, look-ahead (an oracle)"]


def test_short_table_has_nine_columns_and_no_row_of_the_paper() -> None:
    """False arrivals, and what ran out of steps, are shown where vehicles declare their arrival."""
    runs = {"success_rate": 90.0, "spl": 80.0, "steps": 9.0, "navigation_error_km": 8.0}
    lines = short_table(
        {"ga": [runs] * 2, "kalman": [runs | {"false_arrival_rate": 1.5, "not_declared_rate": 2.0}]}
    ).splitlines()
    declared = ["false arrivals %", "not declared %"]
    assert cells(lines[0]) == ["navigator", "given", "runs", "SR %", "SPL %", "TNT steps", "NE km", *declared]
    assert cells(lines[2])[2:5] == ["2", "90.0 [90.0–90.0]", "80.00 [80.00–80.00]"]
    assert [cells(line)[-2:] for line in lines[2:]] == [["—", "—"], ["1.5", "2.0"]]
    assert "paper" not in comparison_table({"ga": [runs]}, published=False)
