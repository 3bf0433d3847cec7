"""Submissions: what was flown is verified, and what was changed afterwards is not."""

import hashlib
import json
import pickle
from pathlib import Path

import pandas
import pytest
import torch

from magrl.agents import kalman, save_policy
from magrl.benchmark import TRACKS, Track, read_episodes, submission, write_episodes
from magrl.benchmark.__main__ import main
from magrl.evaluation import episode_measures

NAME = "small-v1"
SMALL = Track(regions=3, tasks=12, within_km=25, max_steps=20, levels=((0.05, 0.05, 5.0), (0.5, 0.1, 20.0)))


@pytest.fixture(autouse=True)
def small_track(monkeypatch) -> None:
    monkeypatch.setitem(TRACKS, NAME, SMALL)


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "mine.safetensors"
    save_policy(path, kalman(step_price=1.0))
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
    assert set(episodes["navigator"]) == {"mine.safetensors"}
    assert status(folder, "--tasks", "4") == 0
    assert "flown on the same platform: 8 of 8 episodes end alike" in capsys.readouterr().out
    assert status(fly("geodesic", tmp_path / "named"), "--tasks", "2") == 0
    change(folder, platform={"cpu": "another"})
    assert status(folder, "--tasks", "4") == 0
    assert "another platform, {'cpu': 'another'}" in capsys.readouterr().out


def test_what_was_changed_is_not_verified(policy: Path, tmp_path: Path, capsys) -> None:
    folder = fly(policy, tmp_path / "mine")
    claim(folder, spl=1.0, success=True, steps=0)
    assert status(folder) == 1
    assert "episodes.csv.gz is not the file of the record" in capsys.readouterr().out
    change(folder)
    assert status(folder) == 1
    out = capsys.readouterr().out
    assert "24 of 24 repeated episodes end differently" in out
    assert "CONTRADICTION: new tasks, 0.5, 0.1, 20: SPL 100.0 % claimed" in out
    assert out.endswith("verdict: not verified\n")
    claim(folder, task=0)
    change(folder)
    assert status(folder) == 1
    assert "the episodes are not one of each level" in capsys.readouterr().out
    (folder / "policy.safetensors").write_bytes(b"")
    assert status(folder) == 2
    save_policy(folder / "policy.safetensors", kalman())
    assert status(folder) == 1
    assert "policy.safetensors is not the file of the record" in capsys.readouterr().out
    change(folder, declared={"max_steps": 500}, tasks=10**15)
    assert status(folder) == 1
    assert "small-v1 is another track in magrl" in capsys.readouterr().out


def test_another_policy_than_that_which_flew_is_found(tmp_path: Path) -> None:
    folder = fly("secant", tmp_path / "secant")
    change(folder, policy="geodesic")
    assert status(folder, "--tasks", "6") == 1


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
    assert "policy must be one of 'policy.safetensors', 'anywhere'" in capsys.readouterr().err


def test_a_policy_with_a_filter_does_not_fly_raw_sequences(policy: Path, tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match="it reads bias_std, drift_std, iron_std, sensor_std, which this track does not"
    ):
        submission.run(str(policy), "sequences-v1", tmp_path / "out")


def test_a_claim_is_compared_by_its_standard_error() -> None:
    """By hand: of 0 and 100 % in turn, the mean of 16 has the standard error 12.5, and that of a pair 17.7."""
    flown = pandas.Series(8 * [0.0, 100.0])
    assert submission._compared(flown + 70, flown, paired=False) == (
        "SPL 120.0 % claimed, 50.0 % flown, standard error 17.7",
        False,
    )
    assert submission._compared(flown + 72, flown, paired=False)[1]
    assert submission._compared(flown + 1, flown, paired=True)[1]
    assert not submission._compared(flown + 0.4, flown, paired=True)[1]
    assert submission._compared(flown * float("nan"), flown, paired=True)[1]
