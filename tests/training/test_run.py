"""Runs around a training: folder, settings, noise, resume after any end, and several collecting processes."""

import importlib.util
import json
import random
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import td3_gradient_guided as recipe
import torch

from magrl.training import Run, RunConfig, UsageError, command, parse_config
from magrl.training.checkpoints import Checkpoints, create_run_folder, locked
from magrl.training.collectors import worker_seed
from magrl.training.run import StopRequest, passes_paper

ROOT = Path(__file__).parent.parent.parent
AZORES = ROOT / "docs" / "examples" / "azores.toml"
NOISE = (0.05, 0.05, 5.0)
SMALL = shlex.split(
    "--num-envs 16 --total-frames 320 --num-cells 16 16 --batch-size 32 --buffer-size 1000 --init-random-frames 32 "
    "--updates-per-batch 1 --eval-every 10 --eval-tasks-small 4 --eval-tasks 6 --wandb-mode disabled"
)


def parse(*args: str) -> recipe.Config:
    return parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, recipe.__doc__, args)


def in_run(config: RunConfig) -> Run:
    return Run(config, recipe="mine.py", name="mine")


# The folder


def test_config_and_scenario_are_written_with_the_folder(tmp_path: Path) -> None:
    config = RunConfig(out=tmp_path / "run", seed=4, wandb_mode="disabled", scenario=AZORES)
    with in_run(config) as run:
        assert {path.name for path in run.folder.iterdir()} == {".lock", "config.json", "scenario.toml"}
        written = json.loads((run.folder / "config.json").read_text())
        assert (written["recipe"], written["seed"]) == ("mine.py", 4)
        assert (written["out"], written["resume"], written["scenario"]) == ("run", None, "scenario.toml")
        assert (run.folder / "scenario.toml").read_text() == AZORES.read_text()
        with pytest.raises(UsageError, match="another process"), locked(run.folder):
            pass
    with locked(run.folder):
        pass


def test_only_a_start_that_fails_removes_the_folder(tmp_path: Path, monkeypatch) -> None:
    """So the same command can be given again; what was collected, another's folder and a resumed run stay."""

    def broken(*_: object, **__: object) -> None:
        raise MemoryError("no room for the collector")

    monkeypatch.setattr(recipe, "make_collector", broken)
    with pytest.raises(MemoryError, match="no room"):
        recipe.train(parse(*SMALL, "--out", str(tmp_path / "run")))
    assert not (tmp_path / "run").exists()
    run = in_run(RunConfig(out=tmp_path / "run"))
    run.statistics.frames = 1
    with pytest.raises(RuntimeError), run:
        raise RuntimeError
    with pytest.raises(RuntimeError), in_run(RunConfig(out=tmp_path / "run", resume=tmp_path / "run")):
        raise RuntimeError
    with pytest.raises(UsageError), in_run(RunConfig(out=tmp_path / "run")):
        pass
    assert (tmp_path / "run" / "config.json").is_file()


def test_second_process_is_kept_out(tmp_path: Path, capsys) -> None:
    folder = create_run_folder(tmp_path / "run")
    (folder / "config.json").write_text(json.dumps({"recipe": recipe.RECIPE}))
    with locked(folder), pytest.raises(SystemExit) as stop:
        command(recipe.RECIPE, lambda: recipe.main(["--resume", str(folder)]))
    message = f"td3_gradient_guided.py: another process is writing the run folder {folder}\n"
    assert (stop.value.code, capsys.readouterr().err) == (2, message)
    assert {path.name for path in folder.iterdir()} == {"config.json", ".lock"}


def test_run_is_named_after_its_scenario_and_noise() -> None:
    for options, name in (({}, "mine"), ({"scenario": AZORES, "noise": (0.05, 0, 1)}, "mine-azores-noise-0.05-0-1")):
        run = in_run(RunConfig(seed=2, **options))
        assert (run.name, run.folder) == (name, Path("runs") / f"{name}-seed2")


def test_validation_and_test_have_the_noise_of_the_run(tmp_path: Path) -> None:
    for noise, share in ((NOISE, 1.0), ((0.0, 0.0, 0.0), 0.0)):
        with in_run(RunConfig(out=tmp_path / f"run{share}", noise=noise, eval_tasks=6, eval_tasks_small=4)) as run:
            states = [env.reset() for env in run.evaluation_envs(zeta=0.01)]
        errors = [state["field"] - state.get("true_field", state["field"]) for state in states]
        assert [(error != 0).double().mean().item() for error in errors] == [share, share]
        assert not share or not torch.equal(errors[0], errors[1][:4])


@pytest.mark.parametrize(("rate", "spl", "passes"), [(97.0, 88.4, True), (96.9, 99.0, False), (99.0, 88.3, False)])
def test_results_of_the_paper(rate: float, spl: float, passes: bool) -> None:
    assert passes_paper({"eval_success_rate": rate, "eval_spl": spl}) is passes


# Resume


def test_stop_request_waits_and_a_second_one_does_not() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with StopRequest() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.usefixtures("without_figures")
def test_run_that_ended_before_its_first_checkpoint_starts_again(tmp_path: Path, same_outcome, monkeypatch) -> None:
    """``config.json`` is there as soon as the folder is, and the seed leads to the same training."""
    folder, whole = tmp_path / "killed", tmp_path / "whole"
    recipe.train(parse(*SMALL, "--out", str(whole)))

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", killed)
        with pytest.raises(KeyboardInterrupt):
            recipe.train(parse(*SMALL, "--out", str(folder), "--checkpoint-every", "0"))
    assert not (folder / "checkpoints").exists()
    recipe.train(parse("--resume", str(folder)))
    assert same_outcome(folder, whole)


@pytest.mark.filterwarnings("ignore:.*trying the previous checkpoint")
@pytest.mark.usefixtures("without_figures")
def test_checkpoint_that_cannot_be_used_is_named(tmp_path: Path, signalled) -> None:
    """The curves so far stay in their file."""
    with signalled(5, signal.SIGTERM), pytest.raises(SystemExit):
        recipe.train(parse(*SMALL, "--eval-every", "2", "--out", str(tmp_path)))
    curves = (tmp_path / "train.csv").read_text()
    config = tmp_path / "config.json"
    settings = config.read_text()
    config.write_text(settings.replace("16,\n    16", "24,\n    24"))
    with pytest.raises(UsageError, match=r"cannot resume: .*checkpoint-\d+\.pt: loss does not fit this training"):
        recipe.train(parse("--resume", str(tmp_path)))
    config.write_text(settings)
    for file in tmp_path.glob("checkpoints/*.pt"):
        file.write_bytes(b"")
    with pytest.raises(UsageError, match="cannot resume: there is no valid checkpoint in"):
        recipe.train(parse("--resume", str(tmp_path)))
    assert len(curves.splitlines()) == 3
    assert (tmp_path / "train.csv").read_text() == curves


def run_process(*args: str, kill_after: float | None = None) -> int:
    """Run the recipe to its end, or until some seconds after its first checkpoint; return the exit code."""
    folder = Path(args[-1])
    process = subprocess.Popen([sys.executable, str(ROOT / "recipes" / recipe.RECIPE), *args])
    if kill_after is not None:
        while process.poll() is None and not list(folder.glob("checkpoints/checkpoint-*.pt")):
            time.sleep(0.01)
        time.sleep(kill_after)
        process.kill()
    return process.wait()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 9))
def test_many_kills(tmp_path: Path, same_outcome: Callable, seed: int, monkeypatch) -> None:
    """Kill a training several times, let it end, and compare it with one that was left alone."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # as in this process: other numbers round differently
    folder, whole, survived, moments = tmp_path / "killed", tmp_path / "whole", 0, random.Random(seed)
    options = (*SMALL, "--total-frames", "3200", "--checkpoint-every", "0.05", "--out")
    assert run_process(*options, str(whole)) == 0
    code = run_process(*options, str(folder), kill_after=moments.uniform(0, 1))
    while code == -signal.SIGKILL:
        survived += 1
        code = run_process("--resume", str(folder), kill_after=moments.uniform(0, 5) if survived < 5 else None)
        assert code in (0, -signal.SIGKILL)
    assert same_outcome(folder, whole)
    assert survived >= 1


# Several collecting processes


@pytest.fixture
def _without_ray():
    yield
    if "ray" in sys.modules:
        sys.modules["ray"].shutdown()


@pytest.mark.slow
@pytest.mark.usefixtures("without_figures", "_without_ray")
@pytest.mark.parametrize("backend", ["process", "ray"])
def test_interrupted_training_of_several_processes_resumes(
    backend: str, tmp_path: Path, signalled, monkeypatch
) -> None:
    """Other processes start new episodes; frames and updates add up, and weights that change here act there."""
    if backend == "ray" and importlib.util.find_spec("ray") is None:
        pytest.skip("ray is an extra")
    run, made = tmp_path / "run", {}
    config = parse(*SMALL).replace(num_envs=8, num_cells=(8,), batch_size=16, init_random_frames=16, total_frames=80)
    with signalled(4, signal.SIGTERM), pytest.raises(SystemExit):
        recipe.train(config.replace(out=run, collectors=2, collector_backend=backend))

    def recorded(name: str, kind: type) -> None:
        class Recorded(kind):
            def __init__(self, *args, **options) -> None:
                super().__init__(*args, **options)
                made[name] = self

        monkeypatch.setattr(recipe, kind.__name__, Recorded)

    def turn_right(*_: object, **__: object) -> None:
        with torch.no_grad():
            made["loss"].networks.actor[0].module[-1].bias.fill_(50.0)

    recorded("loss", recipe.TD3Loss)
    recorded("buffer", recipe.TensorDictReplayBuffer)
    monkeypatch.setattr(recipe, "optimize", turn_right)
    recipe.train(parse("--resume", str(run)))
    result = json.loads((run / "eval.json").read_text())
    assert (result["frames"], result["updates"]) == (80, 9)
    stored = made["buffer"][:]
    assert all(len(batch["observation"].unique(dim=0)) == 8 for batch in stored.split(8))
    assert (stored["action"][: 4 * 8] < 0).any()
    assert (stored["action"][-8:] > 0.3).all()  # 1, less the noise of exploration


def test_workers_fly_random_tasks_of_their_own() -> None:
    """None of the tasks of the scenario file, of the validation or the test."""
    config = recipe.Config(scenario=AZORES, num_envs=8, collectors=2)
    assert config.load_scenario().tasks is not None
    base = recipe.GeomagneticNavEnv(config.load_scenario().with_tasks(None))
    env = recipe.worker_env(config, base.observation_view(), 0)
    assert len(env.reset()["position"].unique(dim=0)) == 4
    seeds = [worker_seed(seed, index) for seed in (0, 1, 1_999_999_999) for index in range(3)]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2_000_000_000 for seed in seeds)
