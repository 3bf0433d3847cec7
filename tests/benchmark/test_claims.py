"""What no row may hold, and what is noticed of rows that were changed; without flights."""

import gzip
import math
from pathlib import Path

import numpy as np
import pandas
import pytest

import magrl
from magrl.benchmark import Track, read_episodes
from magrl.benchmark.comparison import BETTER, TOO_GOOD, compared, different, impossible
from magrl.benchmark.episodes import COLUMNS, MAX_ROW
from magrl.geodesy import geodesic

TRACK = Track(regions=3, tasks=12, within_km=25, max_steps=20, levels=((0.05, 0.05, 5.0), (0.5, 0.1, 20.0)))


def table(**columns: object) -> pandas.DataFrame:
    """Half of the tasks end in a success, a quarter in a false arrival."""
    tasks, rows = TRACK.scenario.tasks, []
    shortest_km = geodesic(*tasks.start.unbind(-1), *tasks.target.unbind(-1))[0]
    for level in TRACK.errors:
        for task in range(12):
            one = {"track": "", "navigator": "mine", "run": 0, "level": level, "task": task, "seed": 0}
            one |= {"region": int(tasks.region[task]), "success": task % 2 == 0, "spl": 0.8 * (task % 2 == 0)}
            one |= {"steps": 15, "false_arrival": task % 4 == 1, "final_distance_km": 20.0 if task % 2 == 0 else 260.0}
            rows.append(one)
    assert shortest_km.min() > 250
    return pandas.DataFrame(rows)[list(COLUMNS)].assign(**columns)


def changed(column: str, value: object, row: int) -> pandas.DataFrame:
    rows = table()
    rows[column] = rows[column].astype(object)
    rows.loc[row, column] = value
    return rows.astype(COLUMNS)


def test_rows_of_a_flight_are_possible() -> None:
    assert impossible(table(), TRACK, "mine") == []


@pytest.mark.parametrize(
    ("column", "value", "row", "lacks"),
    [
        ("navigator", "MyNet-v9 (PPO)", 3, "navigator mine"),
        ("run", 1, 3, "run 0"),
        ("region", 99, 3, "the region of the task"),
        ("seed", 5, 3, "seed 0"),
        ("steps", 0, 3, "steps from 1 to 20"),
        ("steps", 21, 3, "steps from 1 to 20"),
        ("steps", 4, 2, "an spl that the steps allow"),
        ("spl", 250.0, 2, "spl in (0, 1] with success, 0 without"),
        ("spl", -0.1, 2, "spl in (0, 1] with success, 0 without"),
        ("spl", math.nan, 2, "spl in (0, 1] with success, 0 without"),
        ("spl", 0.5, 3, "spl in (0, 1] with success, 0 without"),
        ("success", True, 3, "spl in (0, 1] with success, 0 without"),
        ("success", False, 2, "spl in (0, 1] with success, 0 without"),
        ("false_arrival", True, 2, "false_arrival without success"),
        ("final_distance_km", 26.0, 2, "success near enough"),
        ("final_distance_km", -1.0, 2, "a final_distance_km that the steps allow"),
        ("final_distance_km", 2000.0, 3, "a final_distance_km that the steps allow"),
        ("final_distance_km", math.inf, 3, "a final_distance_km that the steps allow"),
        ("final_distance_km", math.nan, 3, "a final_distance_km that the steps allow"),
    ],
)
def test_a_row_that_contradicts_itself_or_its_track_is_found(column: str, value: object, row: int, lacks: str) -> None:
    found = impossible(changed(column, value, row), TRACK, "mine")
    assert f"not all rows have {lacks}: level 0.05, 0.05, 5, task {row}" in found


def test_no_vehicle_declares_where_a_signal_ends_the_episode() -> None:
    signal = Track(regions=3, tasks=12, max_steps=20, levels=TRACK.levels)
    assert impossible(table(false_arrival=False), signal, "mine") == []
    assert len(impossible(table(), signal, "mine")) == 1


@pytest.mark.parametrize(("column", "value"), [("spl", 0.802), ("steps", 14), ("final_distance_km", 19.8)])
def test_an_episode_that_ends_differently_is_found(column: str, value: float) -> None:
    part = table()[lambda rows: rows["task"] != 5]
    assert different(part, table()).empty
    assert different(changed(column, value, 14), part).tolist() == [("0.5, 0.1, 20", 2)]


def test_claims_are_compared_by_the_variance_of_what_is_flown() -> None:
    """By hand: the mean of 12 flags and 16 more, half set, has the standard error 0.0945, a difference 0.134."""
    flown, better = table(), table(success=True, spl=1.0, false_arrival=False, steps=5, final_distance_km=0.0)
    first, second = compared("new", better, flown, TRACK)
    start = "claimed for flown: success 1 for 0.5 ± 0.13, false_arrival 0 for 0.25 ± 0.13, spl"
    assert first.startswith(f"new, 0.05, 0.05, 5, {start}")
    assert second.startswith(f"new, 0.5, 0.1, 20, {start}")
    assert first.endswith(f"steps 5 for 15 ± 2.1{TOO_GOOD}, final_distance_km 0 for 140 ± 57")
    assert TOO_GOOD not in "".join(compared("new", flown, better, TRACK))
    assert compared("repeated", better, flown, TRACK, different(flown, flown))[0].count(f"± 0{TOO_GOOD}") == 5
    texts = compared("repeated", better, flown, TRACK, different(changed("spl", 0.9, 0), flown))
    assert f"success 1 for 0.5 ± 0.039{TOO_GOOD}" in texts[0]
    assert f"success 1 for 0.5 ± 0{TOO_GOOD}" in texts[1]


def test_what_is_rare_may_be_claimed_where_it_was_not_flown() -> None:
    rare = table().assign(success=lambda rows: rows["task"] == 0, spl=lambda rows: 0.8 * (rows["task"] == 0))
    rare["steps"] -= rare["task"] == 0
    assert TOO_GOOD not in "".join(compared("new", rare, rare[rare["task"] > 3], TRACK))


def forged(rows: pandas.DataFrame, column: str, unit: float) -> pandas.DataFrame:
    """Return rows of which as few as possible have the best value, so that the mean gains more than a point."""
    best = {"spl": 1.0 * rows["success"], "steps": 1 + 0 * rows["steps"], "final_distance_km": 0 * rows["spl"]}[column]
    gain = (BETTER[column] * (best - rows[column]) / unit).sort_values(ascending=False)
    chosen = gain.index[: int((gain.cumsum() <= 0.01 * len(rows)).sum()) + 1]
    return rows.assign(**{column: rows[column].where(~rows.index.isin(chosen), best)})


@pytest.mark.parametrize(
    ("column", "unit", "tasks", "power"),
    [
        ("spl", 1, 1000, 0.985),
        ("steps", 50, 1000, 0.962),
        ("final_distance_km", 500, 1000, 0.949),
        ("spl", 1, 2000, 0.979),
        ("steps", 50, 2000, 0.945),
        ("final_distance_km", 500, 2000, 0.904),
    ],
)
def test_power_to_find_a_column_that_is_forged_by_a_point(column: str, unit: float, tasks: int, power: float) -> None:
    """Of draws of 256 tasks, how many hold an episode that was changed: of secant on earth-v2, at the highest noise."""
    rows = read_episodes(Path(magrl.__file__).parent.parent / "docs/results/earth.csv.gz")
    rows = rows[(rows["navigator"] == "secant (quasi-Newton)") & (rows["level"] == "0.5, 0.1, 20")][:tasks]
    apart = different(forged(rows, column, unit), rows).get_level_values("task")
    draws = np.random.default_rng(0).random((2000, tasks)).argsort(1)[:, :256]
    assert np.isin(draws, apart).any(1).mean() == pytest.approx(power, abs=0.015)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (",".join(COLUMNS) + "\n" + 10**6 * ",", f"a row has more than {MAX_ROW} bytes"),
        (10**6 * ",", "its header is"),
        (",".join(COLUMNS) + "\n" + 4 * ("," * 11 + "\n"), "it holds more than 3 rows"),
    ],
)
def test_no_more_is_read_than_a_track_has(text: str, message: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delattr(pandas, "read_csv")
    (tmp_path / "episodes.csv.gz").write_bytes(gzip.compress(text.encode()))
    with pytest.raises(ValueError, match=message.replace("(", ".")):
        read_episodes(tmp_path / "episodes.csv.gz", 3)
