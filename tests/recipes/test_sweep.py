"""Sweeps: seeds of recipes and of any command, their scores and curves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from pandas import DataFrame, read_csv
from support.recipes import ROOT, load

from magrl import score
from magrl.envs.measures import interquartile_mean, stratified_bootstrap
from magrl.files import locked
from magrl.training import UsageError

sweep = load("recipes/sweep")
PRETRAINED = ROOT / "magrl" / "navigators" / "pretrained"
SCRIPT = f"""
import json, os, shutil, sys
from pathlib import Path
given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
resumed = "--resume" in given
out = Path(given.get("--out") or given["--resume"])
left = sorted(path.name for path in out.iterdir()) if out.exists() else []
names = "OMP_NUM_THREADS", "WANDB_RUN_GROUP"
calls = Path("calls.jsonl").open("a", encoding="utf-8")
print(json.dumps([given, left, *map(os.environ.get, names)]), file=calls)
out.mkdir(exist_ok=True)
seed = given.get("--seed", "5")
if seed == "5" and not resumed:  # a run of magrl.training.Run, which is interrupted
    (out / "config.json").write_text('{{"recipe": "mine.py"}}')
    sys.exit(130)
if seed == "6" and not Path("again").exists():  # another one, which fails late
    (out / "config.json").write_text('{{"mine": 1}}')
    Path("again").touch()
    print("Traceback\\nValueError: no luck", file=sys.stderr)
    sys.exit(1)
if seed != "7":
    agent = "eddies-TD3" if seed == "0" else "memory"
    shutil.copy(f"{PRETRAINED}/{{agent}}.safetensors", out / "policy.safetensors")
(out / "train.csv").write_text(f"frames,return,eval_score\\n100,1,{{seed}}0\\n150,2,\\n200,3,50\\n")
"""


@pytest.fixture(autouse=True)
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Score few episodes, in a folder with a script that trains nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep, "EPISODES", 8)
    Path("mine.py").write_text(SCRIPT, encoding="utf-8")


def run(*seeds: int, command: str = "mine=python mine.py", out: str = "mine") -> None:
    """Sweep the script over seeds."""
    sweep.main(["--command", command, "--seeds", *map(str, seeds), "--out", out, "--", "--task", "box"])


def calls() -> list[list]:
    """Return options, files in the run folder, and environment of each call of the script."""
    return [json.loads(line) for line in Path("calls.jsonl").read_text("utf-8").splitlines()]


def test_each_seed_is_trained_once_and_scored_as_by_the_library(capsys) -> None:
    run(0, 1)
    printed = capsys.readouterr().out
    options = {"--task": "box", "--seed": "1", "--out": str(Path("mine/box-mine-seed1").resolve())}
    assert calls()[1] == [options, [], "1", "mine"]
    scores = read_csv("mine/scores.csv.gz")
    assert list(scores) == ["task", "agent", "seed", "episode", "score", "success", "SPL", "steps"]
    assert scores[["task", "agent"]].drop_duplicates().to_numpy().tolist() == [["box", "mine"]]
    assert scores["episode"].tolist() == [*range(8), *range(8)]
    for seed, agent in enumerate(("eddies-TD3", "memory")):
        mean, wanted = scores[scores["seed"] == seed].mean(numeric_only=True), score(agent, "box", episodes=8)
        shown = {
            "score": mean["score"],
            "SR": 100 * mean["success"],
            "SPL": 100 * mean["SPL"],
            "steps": mean["steps"],
        }
        assert shown == pytest.approx({key: wanted[key] for key in shown}, rel=1e-4)
        row = " | ".join(f"{wanted[key]:.1f}" for key in shown)
        assert f"| mine | {seed} | {row} |\n" in printed
    assert Path("mine/table.md").read_text("utf-8").strip() in printed
    assert Path("mine/curves.png").stat().st_size > 1000
    whole = Path("mine/scores.csv.gz").read_bytes()
    run(0, 1)
    assert len(calls()) == 2
    assert Path("mine/scores.csv.gz").read_bytes() == whole
    assert capsys.readouterr().out == printed


def test_an_interrupted_run_goes_on_and_another_begins_again(capsys) -> None:
    with pytest.raises(UsageError, match=r"box-mine-seed5: 'python mine\.py' ended with status 130"):
        run(5)
    with pytest.raises(UsageError, match=r"seed6: 'python mine.py' ended with status 1: ValueError: no luck \(all in "):
        run(6)
    run(5, 6)
    folder = str(Path("mine/box-mine-seed5").resolve())
    assert [(sorted(given), left) for given, left, *_ in calls()[2:]] == [
        (["--resume"], ["config.json"]),
        (["--out", "--seed", "--task"], []),
    ]
    assert calls()[2][0] == {"--resume": folder}
    assert "| mine | IQM |" in capsys.readouterr().out


def test_a_complete_run_of_a_recipe_is_scored_without_its_command() -> None:
    with pytest.raises(UsageError, match="status 130"):
        run(5)
    folder = Path("mine/box-mine-seed5")
    (folder / "eval.json").touch()
    (folder / "policy.safetensors").write_bytes((PRETRAINED / "eddies-TD3.safetensors").read_bytes())
    run(5)
    assert len(calls()) == 1
    assert not Path("mine/curves.png").exists()


def test_errors_say_which_run_and_what_to_do() -> None:
    with pytest.raises(UsageError, match=r"seed7: 'python mine.py' left no policy\.safetensors or policy\.onnx in .*"):
        run(7)
    with pytest.raises(UsageError, match=r"seed0: 'pithon mine\.py' ended with status 127: .*pithon.*No such file"):
        run(0, command="mine=pithon mine.py")
    run(0)
    with pytest.raises(UsageError, match=r"is of 'python mine\.py', not of 'python mine\.py --x': choose another"):
        run(0, command="mine=python mine.py --x")
    with locked(Path("mine")), pytest.raises(UsageError, match="another process is writing"):
        run(0)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["td3_gradient_guided.py"], "name the task after --"),
        (["td3_gradient_guided.py", "--", "--task"], "name the task after --"),
        (["td3_gradient_guided.py", "--", "--task", "mars"], "task must be one of .*, got 'mars'"),
        (["td4.py", "--", "--task", "box"], r"there is no recipe .*td4\.py: give another program by --command"),
        (["--", "--task", "box"], "name a recipe, a --command or both"),
        (["td3_gradient_guided.py", "--seeds", "--", "--task", "box"], "at least one of the --seeds"),
        (["--command", "python mine.py", "--", "--task", "box"], "takes NAME='COMMAND'.* got python mine.py"),
        (["--command", "a=x", "--command", "a=y", "--", "--task", "box"], "a name of its own, got a=x and a=y"),
        (["--command", "a/b=x", "--", "--task", "box"], "takes NAME='COMMAND'"),
    ],
)
def test_a_sweep_is_refused_before_anything_is_trained(args: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sweep.main(args)
    assert not Path("runs").exists()


def test_recipes_and_commands_share_seeds_and_options() -> None:
    config = sweep.Config("ppo_memory.py", ("mine=python 'my file.py'",), seeds=(3, 4, 3))
    jobs = sweep.planned(config, ["--noise", "0", "--task", "storm", "--x=a b"])
    assert [job[1:3] for job in jobs] == [("ppo_memory", 3), ("mine", 3), ("ppo_memory", 4), ("mine", 4)]
    assert jobs[0].line == f"python {ROOT / 'recipes' / 'ppo_memory.py'} --noise 0 '--x=a b'"
    assert jobs[3].line == "python 'my file.py' --noise 0 '--x=a b'"
    assert jobs[3].folder == Path("runs/sweep-storm/storm-mine-seed4").resolve()


def test_the_table_has_the_middle_of_the_seeds() -> None:
    spl = torch.tensor([0.0, 0.97, 0.98, 0.99, 1.0]).double()
    rows = {"agent": "A", "seed": range(5), "score": 2.0, "success": 1, "SPL": spl, "steps": 9}
    *_, last, iqm = sweep.table(DataFrame(rows)).splitlines()
    low, high = stratified_bootstrap([100 * spl])
    assert last == "| A | 4 | 2.0 | 100.0 | 100.0 | 9.0 |"
    assert f"| A | IQM | 2.0 (2.0–2.0) | 100.0 (100.0–100.0) | 98.0 ({low:.1f}–{high:.1f}) | 9.0" in iqm
    assert interquartile_mean(spl).item() == pytest.approx(0.98)


def test_curves_are_the_evaluations(tmp_path: Path) -> None:
    job = sweep.Job.of(tmp_path, "box", "A", 3, "x")
    assert sweep.curves([job]).empty
    job.folder.mkdir()
    (job.folder / "train.csv").write_text("frames,return,eval_score\n10,1,\n20,2,50\n30,3,60\n", encoding="utf-8")
    points = sweep.curves([job, sweep.Job.of(tmp_path, "box", "A", 4, "x")])
    assert points[["agent", "seed", "frames", "eval_score"]].to_numpy().tolist() == [["A", 3, 20, 50], ["A", 3, 30, 60]]
    (line,) = sweep.figure(points).axes[0].lines
    assert line.get_xydata().tolist() == [[20, 50], [30, 60]]


@pytest.mark.slow
def test_results_are_the_same_for_any_number_of_jobs(monkeypatch) -> None:
    monkeypatch.setattr(sweep, "EPISODES", 1000)  # as in other processes
    tiny = ["--total-frames", "4096", "--num-envs", "256", "--eval-trips", "50", "--eval-trips-small", "20"]
    options = ["--", "--task", "box", "--wandb-mode", "disabled", *tiny]
    for jobs in ("1", "2"):
        args = ["td3_gradient_guided.py", "--seeds", "0", "1", "--jobs", jobs, "--out", f"jobs{jobs}", *options]
        sweep.main(args)
    for name in ("scores.csv.gz", "table.md", "box-td3_gradient_guided-seed1/policy.safetensors"):
        assert Path("jobs1", name).read_bytes() == Path("jobs2", name).read_bytes()
    config = json.loads(Path("jobs2/box-td3_gradient_guided-seed1/config.json").read_text("utf-8"))
    assert (config["seed"], config["task"], config["wandb_group"]) == (1, "box", "")
