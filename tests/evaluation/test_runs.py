"""Settings of trainings, as an evaluation shares them."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from magrl.evaluation.runs import TrainedRun, agreed, read_run, trained_runs, unfinished

NOISE = (0.05, 0.05, 5.0)


@pytest.fixture
def trained(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that makes the folder of a finished run with some settings."""

    def make(name: str, **settings: object) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        if "scenario" in settings:
            (folder / "scenario.toml").write_text("date = 2026-07-01")
        settings = {"recipe": "td3_gradient_guided.py", "guided": True, "zeta": 0.01} | settings
        (folder / "config.json").write_text(json.dumps(settings))
        (folder / "eval.json").write_text("{}")
        return folder

    return make


def test_settings_of_a_run(trained) -> None:
    run = read_run(trained("a", noise=NOISE, start_heading="random", zeta=0.05, scenario="elsewhere/scenario.toml"))
    assert (run.kind, run.errors, run.start_heading, run.zeta) == ("gg_td3", NOISE, "random", 0.05)
    assert run.scenario == run.folder / "scenario.toml"
    assert (read_run(trained("b", guided=False)).kind, read_run(trained("c", guided=None)).kind) == ("td3", None)


def test_runs_among_navigators(trained, tmp_path: Path) -> None:
    """A name that is that of another kind is refused; ``_noise`` tells trainings of one kind apart."""
    guided, other = trained("a"), trained("b", recipe="ppo_anywhere.py", guided=None)
    texts = [f"gg_td3_noise={guided}", f"anywhere={other}", "secant", f"td3={tmp_path}/c"]
    assert [run.folder for run in trained_runs(texts)] == [guided, other]
    for name, folder, kind in (("td3", guided, "gg_td3"), ("td3", other, "anywhere")):
        with pytest.raises(ValueError, match=rf"was trained as {kind}, not {name}: write {kind}={folder}"):
            trained_runs([f"{name}={folder}"])
    assert trained_runs([f"policy:OWN={guided}"])[0].kind == "gg_td3"
    (guided / "eval.json").unlink()
    (tmp_path / "file.pt").touch()
    assert unfinished([*texts, f"policy={tmp_path}/file.pt"]) == [
        f"{folder} is not a finished training: it holds no eval.json" for folder in (guided, tmp_path / "c")
    ]


@pytest.mark.parametrize(
    ("setting", "value", "default", "text"),
    [
        ("zeta", 0.02, 0.01, "zeta, 0.01 (a), 0.02 (b): choose with --zeta"),
        ("start_heading", "random", "north", "start heading, north (a), random (b): choose with --start-heading"),
        ("errors", NOISE, (0.0, 0.0, 0.0), "errors, 0 0 0 (a), 0.05 0.05 5 (b): choose with --errors"),
    ],
)
def test_runs_agree_or_need_a_choice(setting: str, value: object, default: object, text: str) -> None:
    one, other = TrainedRun(Path("a"), "td3"), TrainedRun(Path("b"), "td3", **{setting: value})
    assert agreed([], setting, None, default) == agreed([one], setting, None, None) == (default, [])
    assert agreed([other], setting, None, default) == (value, [])
    with pytest.raises(ValueError, match=re.escape(f"the runs were trained with different {text}")):
        agreed([one, other, one], setting, None, default)
    name, first, second = re.match(r"([\w ]+), (.+) \(a\), (.+) \(b\)", text).groups()
    note = f"b was trained with {name} {second} and is evaluated with {first}"
    assert agreed([one, other], setting, default, None) == (default, [note])


def test_scenarios_agree_by_their_content(trained, tmp_path: Path) -> None:
    runs = [read_run(trained(name, scenario="scenario.toml")) for name in ("a", "b")]
    plain = read_run(trained("c"))
    assert agreed(runs, "scenario", None, None) == (runs[0].scenario, [])
    with pytest.raises(ValueError, match=r"different scenario, scenario.toml \(.*a\), of the paper \(.*c\): choose"):
        agreed([*runs, plain], "scenario", None, None)
    copy = tmp_path / "copy.toml"
    copy.write_text(runs[0].scenario.read_text())
    assert agreed(runs, "scenario", copy, None) == (copy, [])
    copy.write_text("date = 2027-01-01")
    note = f"{runs[0].folder} was trained with scenario scenario.toml and is evaluated with copy.toml"
    assert agreed(runs[:1], "scenario", copy, None) == (copy, [note])


def test_damaged_settings_are_refused(tmp_path: Path) -> None:
    for content in ("[", "[1]", '{"noise": [1, 2]}', '{"guided": []}', '{"scenario": 5}', '{"zeta": "x"}'):
        (tmp_path / "config.json").write_text(content)
        with pytest.raises(ValueError, match="is not the configuration of a run"):
            read_run(tmp_path)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no run at"):
        read_run(tmp_path)
    (tmp_path / "config.json").write_text('{"scenario": "scenario.toml"}')
    with pytest.raises(FileNotFoundError, match=r"was trained in its scenario file scenario\.toml, which is missing"):
        read_run(tmp_path)
