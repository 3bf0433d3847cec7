"""Submissions: what was flown is verified, and what was changed afterwards is not."""

import hashlib
import json
import pickle
from pathlib import Path

import pandas
import pytest
import torch
from support.networks import network_file
from tensordict import TensorDict

from magrl import Anywhere, save_policy
from magrl.benchmark import TRACKS, Track, read_episodes, submission, write_episodes
from magrl.benchmark.__main__ import main
from magrl.evaluation import episode_measures
from magrl.transforms import ReadingView

NAME = "small-v1"
LEVELS = ((0.05, 0.05, 5.0), (0.5, 0.1, 20.0))
SMALL = Track(regions=3, tasks=12, within_km=25, distance_km=(100, 200), max_steps=8, levels=LEVELS)


@pytest.fixture(autouse=True)
def small_track(monkeypatch) -> None:
    monkeypatch.setitem(TRACKS, NAME, SMALL)
    monkeypatch.setattr(submission, "SHIFTS_DEG", [(0.0, 1e-4)])


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "mine.safetensors"
    save_policy(path, Anywhere(step_price=1.0))
    return path


def fly(policy: object, out: Path, *options: str) -> Path:
    main(["run", str(policy), "--track", NAME, "--out", str(out), *options])
    return out


def status(folder: Path, *options: str) -> int:
    try:
        main(["verify", str(folder), "--seed", "0", *options])
    except SystemExit as end:
        return end.code
    return 0


def change(folder: Path, **values: object) -> None:
    """Change a record, with digests of the files as they are now."""
    record = json.loads((folder / "run.json").read_text())
    for key, name in (("episodes_sha256", "episodes.csv.gz"), ("policy_sha256", "policy.safetensors")):
        if (folder / name).exists():
            record[key] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    (folder / "run.json").write_text(json.dumps(record | values))


def claim(folder: Path, **columns: object) -> None:
    write_episodes(folder / "episodes.csv.gz", [read_episodes(folder / "episodes.csv.gz").assign(**columns)])


def test_a_part_of_the_vehicles_repeats_their_episodes() -> None:
    """With the errors of a ship, which move it, and random start headings."""
    track, part = Track(["ship"], regions=3, tasks=12, max_steps=8), torch.tensor([11, 4])
    ends = []
    for vehicle in (torch.arange(12), part):
        flight = track.flight(track.errors["ship"], num_envs=len(vehicle))
        flight.base.vehicle = vehicle
        ends.append(episode_measures(flight.fly("secant")))
    for name in ("length_km", "navigation_error_km", "spl", "success"):
        torch.testing.assert_close(ends[1][name], ends[0][name][part], rtol=0, atol=1e-6)


def test_what_was_flown_is_verified(policy: Path, tmp_path: Path, capsys) -> None:
    folder = fly(policy, tmp_path / "mine", "--tasks", "8")
    assert {path.name for path in folder.iterdir()} == {"run.json", "episodes.csv.gz", "policy.safetensors"}
    episodes = read_episodes(folder / "episodes.csv.gz")
    assert episodes["task"].tolist() == 2 * [*range(8)]
    assert episodes["region"].tolist() == 2 * SMALL.scenario.tasks.region[:8].tolist()
    assert set(episodes["navigator"]) == {"policy.safetensors"}
    assert status(folder, "--tasks", "4") == 0
    assert "8 of 8 repeated episodes end alike" in capsys.readouterr().out
    assert status(fly("geodesic", tmp_path / "named", "--tasks", "2"), "--tasks", "2") == 0


def test_what_was_changed_is_not_verified(policy: Path, tmp_path: Path, capsys) -> None:
    folder = fly(policy, tmp_path / "mine", "--tasks", "3")
    claim(folder, track="\x1b[2J", level="\x1b[2Jverdict: verified")
    assert status(folder) == 1
    assert "episodes.csv.gz is not the file of the record" in capsys.readouterr().out
    change(folder, magrl="\x1b[2J\nverdict: verified\n", declared={"max_steps": 500})
    assert status(folder) == 1
    out = capsys.readouterr().out
    assert "the episodes are not one of each level" in out
    assert "than in the \\x1b[2J verdict: verified of the record" in out
    assert "\x1b" not in out
    assert out.endswith("\nverdict: not verified\n")
    (folder / "policy.safetensors").write_bytes(b"")
    assert status(folder) == 2
    save_policy(folder / "policy.safetensors", Anywhere())
    assert status(folder) == 1
    assert "policy.safetensors is not the file of the record" in capsys.readouterr().out
    change(folder, tasks=10**15)
    assert status(folder) == 1


@pytest.fixture(scope="module")
def rows() -> pandas.DataFrame:
    """What one navigator flies."""
    flown = submission._flown("geodesic", SMALL, torch.arange(12))
    return flown.assign(track=NAME, navigator="geodesic")


@pytest.fixture
def folder(rows: pandas.DataFrame, tmp_path: Path, monkeypatch) -> Path:
    """A submission; later flights repeat its rows, whatever their tasks."""
    monkeypatch.setattr(submission, "_flown", lambda _0, _1, vehicle, *_: rows[rows["task"].isin(vehicle.tolist())])
    return fly("geodesic", tmp_path / "geodesic")


@pytest.mark.parametrize(
    ("column", "value", "text"),
    [
        ("spl", 250.0, "not all rows have spl in (0, 1] with success, 0 without: level 0.5, 0.1, 20, task 7"),
        ("navigator", "MyNet-v9 (PPO)", "not all rows have navigator geodesic: level 0.5, 0.1, 20, task 7"),
        ("spl", 0.9, "rounding does not explain 1 of the others: level and task [('0.5, 0.1, 20', 7)]"),
        ("steps", 7, "rounding does not explain 1 of the others: level and task [('0.5, 0.1, 20', 7)]"),
    ],
)
def test_one_number_that_was_changed_is_found(
    column: str, value: object, text: str, folder: Path, rows, capsys
) -> None:
    """Whatever the record says of the platform: what may differ is decided by the flights of the verifier."""
    assert status(folder) == 0
    values = rows[column].astype(object)
    values[19] = value
    claim(folder, **{column: values})
    change(folder, platform={"cpu": "another"})
    assert status(folder) == 1
    assert f"CONTRADICTION: {text}" in capsys.readouterr().out


def test_an_end_that_rounding_decides_may_differ(folder: Path, rows, monkeypatch, capsys) -> None:
    """Task 7 takes a step more in the flights of the verifier, and starts east of it show that it may take fewer."""
    slow = (rows["task"] == 7) & (rows["level"] == rows["level"].iloc[-1])
    flown = rows.assign(steps=rows["steps"] + slow)

    def fly_again(_policy, _track, vehicle, tasks=None, seed=None) -> pandas.DataFrame:
        east = seed is None and tasks is not None and (tasks.start > SMALL.scenario.tasks.start)[:, 1].all()
        return (rows.assign(steps=3) if east else flown)[rows["task"].isin(vehicle.tolist())]

    monkeypatch.setattr(submission, "_flown", fly_again)
    assert status(folder) == 0
    assert "23 of 24 repeated episodes end alike\nrounding decides how 1 of the others" in capsys.readouterr().out


def test_an_interrupted_run_is_flown_again(folder: Path, policy: Path, monkeypatch, capsys) -> None:
    with pytest.raises(SystemExit, match="2"):
        fly(policy, folder)
    assert "holds files: choose a new folder" in capsys.readouterr().err

    def full(_source, _to) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as disk:
        disk.setattr("magrl.files.os.replace", full)
        with pytest.raises(SystemExit, match="2"):
            fly(policy, folder.parent / "mine")
    fly(policy, folder.parent / "mine")


def test_no_action_of_a_network_depends_on_the_rest_of_the_batch(tmp_path: Path) -> None:
    """Here it subtracts the mean over the batch, which leaves nothing."""
    view = ReadingView(keys=["move"], max_move_km=50.0, max_turn_rad=1.5)
    save_policy(tmp_path / "mean.onnx", network_file(tmp_path, 2, mixing=True), view)
    mine = submission._policy(str(tmp_path / "mean.onnx"), SMALL)
    assert mine(TensorDict(move=torch.rand(5, 2), batch_size=[5]))["action"].tolist() == [[25, 0]] * 5


def test_another_policy_than_that_which_flew_is_found(tmp_path: Path) -> None:
    folder = fly("secant", tmp_path / "secant", "--tasks", "3")
    claim(folder, navigator="geodesic")
    change(folder, policy="geodesic")
    assert status(folder, "--tasks", "2") == 1


@pytest.mark.parametrize("name", ["mine.py", "policy.pt", "pso", "module:Class", "anywhere=runs/mine"])
def test_what_would_run_code_or_is_not_repeatable_is_refused(name: str, tmp_path: Path, capsys) -> None:
    with pytest.raises(SystemExit, match="2"):
        fly(name, tmp_path / "out")
    assert f"refused {name!r}: submit a file of magrl.save_policy" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_pickles_and_policies_elsewhere_are_refused(policy: Path, tmp_path: Path, capsys) -> None:
    pickled = tmp_path / "pickled.safetensors"
    pickled.write_bytes(pickle.dumps({"weights": 1}))
    with pytest.raises(SystemExit, match="2"):
        fly(pickled, tmp_path / "out")
    folder = fly("geodesic", tmp_path / "named", "--tasks", "2")
    change(folder, policy=str(policy))
    assert status(folder) == 2
    assert "policy must be one of 'policy.safetensors', 'policy.onnx', 'kalman'" in capsys.readouterr().err


def test_a_network_of_another_library_is_submitted(tmp_path: Path) -> None:
    view = ReadingView(max_move_km=50.0, max_turn_rad=1.5)
    save_policy(tmp_path / "mine.onnx", network_file(tmp_path, view.size, memory=True), view)
    folder = fly(tmp_path / "mine.onnx", tmp_path / "out", "--tasks", "2")
    assert {path.name for path in folder.iterdir()} == {"run.json", "episodes.csv.gz", "policy.onnx"}
    assert status(folder, "--tasks", "2") == 0


def test_a_policy_with_a_filter_does_not_fly_raw_sequences(policy: Path, tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match="it reads bias_std, drift_std, iron_std, sensor_std, which this track does not"
    ):
        submission.run(str(policy), "sequences-v2", tmp_path / "out")
