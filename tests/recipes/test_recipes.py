"""The recipes without memory as their users run them: small, but complete."""

import csv
import json
import math
import re
import signal
from pathlib import Path

import ppo
import pytest
import sac
import td3_anywhere
import td3_gradient_guided as recipe
import td3_recurrent
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from magrl import paper
from magrl.agents import PolicyConfig, load_policy
from magrl.envs import GeomagneticNavEnv
from magrl.training import Run, command, parse_config
from magrl.transforms import SensorNoise, with_sensor_noise

RECIPES = Path(__file__).parent.parent.parent / "recipes"
SMALL = {
    "num_envs": 16,
    "total_frames": 320,
    "num_cells": (16, 16),
    "batch_size": 32,
    "buffer_size": 1000,
    "init_random_frames": 32,
    "updates_per_batch": 2,
    "eval_every": 10,
    "eval_tasks_small": 4,
    "eval_tasks": 6,
    "wandb_mode": "disabled",
}


def settings(out: Path, preset: str = "fast", **options) -> recipe.Config:
    return recipe.PRESETS[preset].replace(out=out, **SMALL | options)


def parse(*args: str) -> recipe.Config:
    return parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, recipe.__doc__, args)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, dict[str, float]]:
    """Return the folder and the result of a guided training that was left alone."""
    out = tmp_path_factory.mktemp("recipes") / "run"
    return out, recipe.train(settings(out))


def test_run_folder(trained, outcome) -> None:
    out, result = trained
    names = {".lock", "config.json", "train.csv", "policy.pt", "eval.json", "training.png", "trajectories.png"}
    assert {path.name for path in out.iterdir()} == names
    written = json.loads((out / "eval.json").read_text())
    needed = {"success_rate", "spl", "trajectory_length_m", "steps", "navigation_error_km", "num_tasks", "seed"}
    assert needed <= written.keys()
    assert (written["num_tasks"], written["seed"], written["frames"]) == (6, 0, 320)
    assert written["spl"] == result["spl"]
    config = json.loads((out / "config.json").read_text())
    assert (config["recipe"], config["guided"], config["preset"]) == ("td3_gradient_guided.py", True, "fast")
    rows, _ = outcome(out)
    assert [int(row["frames"]) for row in rows] == [160, 320]
    assert [int(row["updates"]) for row in rows] == [18, 38]
    assert all(math.isfinite(float(row[key])) for row in rows for key in ("loss_critic", "loss_actor"))
    for picture in ("training.png", "trajectories.png"):
        assert (out / picture).read_bytes().startswith(b"\x89PNG")
    env = GeomagneticNavEnv(num_envs=3, seed=0)
    assert env.rollout(2, load_policy(out / "policy.pt"))["action"].isfinite().all()


def returns(folder: Path) -> list[dict[str, float]]:
    with (folder / "train.csv").open() as file:
        rows = [{key: float(value) for key, value in row.items() if "return" in key} for row in csv.DictReader(file)]
    return [row for row in rows if math.isfinite(row["return"])]


TERMS = ("return_destination", "return_proximity", "return_alignment")


@pytest.mark.usefixtures("without_figures")
def test_return_is_the_sum_of_its_terms(tmp_path: Path) -> None:
    """The unscaled return, whatever the factor on rewards for the critics."""
    recipe.train(settings(tmp_path / "run", total_frames=960, eval_every=60))
    (row,) = returns(tmp_path / "run")
    assert row["return"] == pytest.approx(sum(row[key] for key in TERMS), rel=1e-4)
    assert all(row[key] != 0 for key in TERMS[1:])


@pytest.mark.usefixtures("without_figures")
def test_options_of_the_loss_and_the_reward_reach_the_training(tmp_path: Path, outcome) -> None:
    """60 steps, so that episodes reach their limit of 50."""
    options = {"none": {}, "limit": {"objective_limit": 0.5}, "end": {"time_limit_ends": True}}
    options["precision"] = {"precision": "bfloat16"}
    found = []
    for name, changed in options.items():
        recipe.train(settings(tmp_path / name, total_frames=960, eval_every=60, **changed))
        found.append(torch.cat([weight.flatten() for weight in outcome(tmp_path / name)[1].values()]))
    assert all(not torch.equal(found[0], other) for other in found[1:])


@pytest.mark.usefixtures("without_figures")
def test_training_without_guidance(tmp_path: Path) -> None:
    """The same recipe without the theoretical heading and its reward."""
    out = tmp_path / "run"
    recipe.train(settings(out, "td3-fast", total_frames=960, eval_every=60))
    (row,) = returns(out)
    assert math.isnan(row["return_alignment"])
    assert row["return"] == pytest.approx(row["return_destination"] + row["return_proximity"], rel=1e-4)
    config = json.loads((out / "config.json").read_text())
    assert (config["guided"], config["preset"]) == (False, "td3-fast")


def test_environment_without_guidance_knows_no_theoretical_heading() -> None:
    for preset, guided in (("fast", True), ("paper", True), ("td3-fast", False), ("td3-paper", False)):
        config = parse("--preset", preset)
        assert config.guided is guided
        base = GeomagneticNavEnv(num_envs=2, seed=0)
        state = recipe.make_env(base, base.observation_view(), config).reset()
        assert ("gradient_heading" in state.keys()) is guided  # noqa: SIM118


@pytest.mark.usefixtures("without_figures")
def test_other_seed_gives_other_weights(trained, tmp_path: Path, outcome) -> None:
    """That the same seed gives the same weights is part of the tests of resume."""
    recipe.train(settings(tmp_path / "other", seed=2))
    (rows, weights), (others, other_weights) = outcome(trained[0]), outcome(tmp_path / "other")
    assert rows != others
    assert not all(torch.equal(weights[key], other_weights[key]) for key in weights)


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize(
    ("frames", "number"),
    [(240, signal.SIGINT), (96, signal.SIGTERM)],
    ids=["after an evaluation", "before any"],
)
def test_interrupted_training_resumes_exactly(
    trained, tmp_path: Path, signalled, same_outcome, capsys, frames: int, number: int
) -> None:
    """Ctrl-C and SIGTERM: the iteration ends, policy and checkpoint are saved, and --resume is exact."""
    run = tmp_path / "run"
    with signalled(frames // 16, number), pytest.raises(SystemExit) as stop:
        recipe.train(settings(run))
    assert stop.value.code == 128 + number
    said = capsys.readouterr().err
    assert f"Stopped after {frames} frames" in said
    assert f"To resume: --resume {run}" in said
    assert load_policy(run / "policy.pt").config.num_cells == (16, 16)
    assert (run / "training.png").exists() == (frames >= 160)
    assert not (run / "eval.json").exists()
    recipe.train(parse("--resume", str(run)))
    assert same_outcome(run, trained[0])
    assert not (run / "checkpoints").exists()


@pytest.mark.usefixtures("without_figures")
def test_training_without_a_gradient_step_warns(trained, tmp_path: Path, capsys) -> None:
    """The first episodes end before the replay buffer holds a batch; progress is shown in episodes."""
    result = recipe.train(settings(tmp_path / "run", total_episodes=1, batch_size=320, zeta=2.9))
    said = capsys.readouterr().err
    assert "episode/s" in said
    assert "frame/s" not in said
    assert result["updates"] == 0 < trained[1]["updates"]
    (line,) = [line for line in said.splitlines() if "no gradient step" in line]
    assert line.startswith(f"Warning: no gradient step was made in {result['frames']} frames")
    assert "increase total_frames (and total_episodes), or reduce batch_size" in line


@pytest.mark.usefixtures("without_figures")
def test_summary_without_a_success_has_no_nan(tmp_path: Path, capsys) -> None:
    result = recipe.train(settings(tmp_path / "run", zeta=1e-12))
    said = capsys.readouterr()
    assert math.isnan(result["steps"])
    assert "6 test tasks: success rate 0.0 %, SPL 0.0 %, no episode arrived\n" in said.out
    assert not re.search(r"\bnan\b", said.out + said.err)
    assert "gradient step" not in said.err


# Sensor noise

NOISE = (0.05, 0.05, 5.0)


@pytest.mark.usefixtures("without_figures")
def test_training_with_noise_resumes_exactly(tmp_path: Path, signalled, same_outcome) -> None:
    """With many short episodes, each of which has its own noise: their number is part of the checkpoint."""
    noisy = {"noise": NOISE, "zeta": 2.9, "start_heading": "random"}
    recipe.train(settings(tmp_path / "whole", **noisy))
    with signalled(12, signal.SIGINT), pytest.raises(SystemExit):
        recipe.train(settings(tmp_path / "run", **noisy))
    recipe.train(parse("--resume", str(tmp_path / "run")))
    assert same_outcome(tmp_path / "run", tmp_path / "whole")
    recipe.train(settings(tmp_path / "perfect", **noisy | {"noise": (0.0, 0.0, 0.0)}))
    assert not same_outcome(tmp_path / "perfect", tmp_path / "whole")
    assert json.loads((tmp_path / "run" / "config.json").read_text())["noise"] == list(NOISE)
    env, policy = GeomagneticNavEnv(num_envs=3, seed=0), load_policy(tmp_path / "run" / "policy.pt")
    for flown in (env, with_sensor_noise(env, NOISE)):
        assert flown.rollout(2, policy)["action"].isfinite().all()


def first_state(module, noise: tuple[float, ...], seed: int = 5) -> TensorDict:
    """Return the first observation of a recipe's training environment."""
    config, base = module.Config(noise=noise), GeomagneticNavEnv(num_envs=4, seed=seed)
    if module is not td3_recurrent:
        return module.make_env(base, base.observation_view(), config).reset()
    view = base.observation_view(observe_heading=False)
    actor = PolicyConfig(view, (8,), memory_size=4).make_actor()
    return td3_recurrent.make_env(base, view, actor, config).reset()


@pytest.mark.parametrize("module", [recipe, td3_recurrent, sac, ppo], ids=lambda module: module.__name__)
def test_noise_is_observed_and_the_guidance_is_by_the_truth(module) -> None:
    perfect, noisy = first_state(module, (0.0, 0.0, 0.0)), first_state(module, NOISE)
    assert "true_field" not in perfect.keys()  # noqa: SIM118
    for key, other in (("true_field", "field"), ("gradient_heading", "gradient_heading"), ("objective", "objective")):
        assert torch.equal(noisy[key], perfect[other])
    assert (noisy["field"] != perfect["field"]).all()
    expected = SensorNoise(NOISE, seed=5)(noisy.clone().set("field", perfect["field"]))["field"]
    assert torch.equal(noisy["field"], expected)
    assert (noisy["observation"] != perfect["observation"])[:, :3].all()  # D, I, B_H come first


def test_validation_and_test_have_the_noise_of_the_run(tmp_path: Path) -> None:
    for noise, share in ((NOISE, 1.0), ((0.0, 0.0, 0.0), 0.0)):
        config = settings(tmp_path / f"run{share}", noise=noise)
        with Run(config, recipe=recipe.RECIPE, name="mine") as run:
            states = [env.reset() for env in run.evaluation_envs(zeta=config.zeta)]
        first = [state["field"] - state.get("true_field", state["field"]) for state in states]
        assert [(error != 0).double().mean().item() for error in first] == [share, share]
        assert not share or not torch.equal(first[0], first[1][:4])


def test_run_is_named_after_its_noise() -> None:
    for options, name in (
        ({}, "mine"),
        ({"noise": (0.05, 0.1, 5.0)}, "mine-noise-0.05-0.1-5"),
        (
            {"scenario": RECIPES.parent / "docs" / "examples" / "azores.toml", "noise": (0, 0, 1)},
            "mine-azores-noise-0-0-1",
        ),
    ):
        run = Run(recipe.Config(seed=2, **options), recipe=recipe.RECIPE, name="mine")
        assert (run.name, run.folder) == (name, Path("runs") / f"{name}-seed2")


# Other algorithms


def small(module, out: Path):
    """Return the settings of five batches of 32 transitions."""
    own = {"steps_per_batch": 2, "epochs": 2} if module is ppo else {"num_envs": 32}
    shared = {key: value for key, value in SMALL.items() if key in module.Config.model_fields}
    return module.Config(out=out, **shared | {"total_frames": 160} | own)


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("module", [sac, ppo], ids=lambda module: module.__name__)
def test_other_algorithms_resume_exactly(module, tmp_path: Path, signalled, same_outcome, outcome) -> None:
    """With networks, optimizers and running episodes; the losses have their columns, and the policy is loaded."""
    result = module.train(small(module, tmp_path / "whole"))
    with signalled(3, signal.SIGINT), pytest.raises(SystemExit):
        module.train(small(module, tmp_path / "run"))
    module.main(["--resume", str(tmp_path / "run")])
    assert same_outcome(tmp_path / "run", tmp_path / "whole")
    rows, weights = outcome(tmp_path / "whole")
    assert result["updates"] == int(rows[-1]["updates"]) > 0
    assert all(math.isfinite(float(rows[-1][key])) for key in module.LOSSES)
    torch.manual_seed(0)
    env = GeomagneticNavEnv(num_envs=3, seed=0)
    start = dict(PolicyConfig(env.observation_view(), SMALL["num_cells"]).make_actor().named_parameters())
    assert not any(torch.equal(weights[key], start[key]) for key in start)
    policy = load_policy(tmp_path / "run" / "policy.pt")
    assert env.rollout(2, policy)["action"].isfinite().all()


@pytest.mark.parametrize("module", [sac, ppo], ids=lambda module: module.__name__)
def test_saved_actor_is_the_stochastic_one_without_noise(module) -> None:
    config, base = module.Config(), GeomagneticNavEnv(num_envs=4, seed=0)
    view = base.observation_view()
    env = module.make_env(base, view, config)
    actor = PolicyConfig(view, (16,)).make_actor()
    options = (actor, env, view, config) if module is sac else (actor, env, config)
    stochastic, seen = module.make_stochastic_actor(*options), env.reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(stochastic(seen.copy())["action"], actor(seen.copy())["action"])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        assert not torch.equal(stochastic(seen.copy())["action"], actor(seen.copy())["action"])


# Settings and command line


@pytest.mark.parametrize(
    "bad",
    [
        {"num_envs": 0},
        {"total_frames": -1},
        {"gamma": 1.0},
        {"gamma": math.nan},
        {"seed": -1},
        {"seed": 2_000_000_011},
        {"buffer_size": 16},
        {"init_random_frames": -1},
        {"learning_rate": 0.0},
        {"tau": 2.0},
        {"tau": 0.0},
        {"zeta": 0.0},
        {"zeta": 3.0},
        {"batch_size": 321},
        {"alignment_weight": math.inf},
        {"exploration_noise": -0.1},
        {"final_exploration_noise": 0.3},
        {"num_cells": ()},
        {"num_cells": (16, 0)},
        {"start_heading": "south"},
        {"guided": 1},
        {"logger": "paper"},
        {"noise": (0.05, -0.05, 5.0)},
        {"noise": (0.05, math.nan, 5.0)},
        {"noise": (0.05, 0.05)},
        {"noise": 0.05},
    ],
    ids=str,
)
def test_bad_settings_are_refused_by_name(tmp_path: Path, bad: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        settings(tmp_path / "run", **bad)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("module", "args", "message"),
    [
        (recipe, "--device foo", "device 'foo' cannot be used here"),
        (recipe, "--device cuda:99", "device 'cuda:99' cannot be used here"),
        (recipe, "--num-cells", "num_cells must hold at least 1 value, got ()"),
        (recipe, "--gamma 2", "gamma must be less than 1, got 2.0"),
        (recipe, "--gamma fast", "fast"),
        (recipe, "--total-farmes 10", "--total-farmes"),
        (recipe, "--preset slow", "invalid choice: 'slow' (choose from"),
        (recipe, "--scenario nowhere.toml", "there is no scenario file at nowhere.toml"),
        (recipe, "--resume nowhere", "there is no run to resume in nowhere: it holds no config.json"),
        (recipe, "--zeta 5", "zeta must be below 3, got 5.0: the objective F is at most 3 at the start"),
        (recipe, "--total-frames 512", "batch_size 1024 must not exceed total_frames: no gradient step is possible"),
        (td3_recurrent, "--zeta 3", "zeta must be below 3, got 3.0"),
        (recipe, "--noise 0.05 -0.05 5", "noise.1 must be greater than or equal to 0, got -0.05"),
        (td3_recurrent, "--noise 0.05 0.05", "Missing value for argument '--noise'. Expected 3 values"),
        (recipe, "--num-envs 8 --collectors 3", "num_envs 8 cannot be divided evenly among 3 collectors"),
        (td3_recurrent, "--num-envs 1", "num_envs must be at least 2, got 1"),
        (td3_recurrent, "--exploration-noise 0.05", "must not exceed exploration_noise 0.05"),
        (
            td3_anywhere,
            "--distance-range-km 500 300",
            "distance_range_km: must be two rising numbers, got (500.0, 300.0)",
        ),
        (sac, "--total-frames 512", "batch_size 1024 must not exceed total_frames: no gradient step is possible"),
        (sac, "--buffer-size 1000", "buffer_size 1000 does not hold one batch of 1024"),
        (ppo, "--num-envs 8", "batch_size 1024 must not exceed num_envs * steps_per_batch, 128"),
        (td3_recurrent, "--shortest-task-km 600", "shortest_task_km must be below 500, got 600.0"),
    ],
)
def test_bad_usage_exits_with_status_2(module, args: str, message: str, tmp_path: Path, monkeypatch, capsys) -> None:
    """With a message, without a traceback and without a folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    with pytest.raises(SystemExit) as stop:
        command(module.RECIPE, lambda: module.main(args.split()))
    said = capsys.readouterr()
    text = re.sub(r"[\s│]+", " ", said.out + said.err)
    assert stop.value.code == 2
    assert message in text
    assert "Traceback" not in text
    assert list(tmp_path.iterdir()) == []


def test_region_at_a_pole_is_bad_usage(tmp_path: Path, monkeypatch, capsys) -> None:
    """With file, key and remedy in one message, and before a run folder is made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "500")
    Path("polar.toml").write_text("date = 2026-07-01\nregion = {latitude = [75, 85], longitude = [0, 20]}\n")
    with pytest.raises(SystemExit) as stop:
        command(recipe.RECIPE, lambda: recipe.main(["--scenario", "polar.toml"]))
    said = capsys.readouterr()
    text = re.sub(r"[\s│]+", " ", said.out + said.err)
    assert stop.value.code == 2
    assert "polar.toml: region.latitude (75.0, 85.0): with margin_deg 5, vehicles reach a pole" in text
    assert "reduce margin_deg to 4, or move the region 1° toward the equator" in text
    assert [path.name for path in tmp_path.iterdir()] == ["polar.toml"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="the message of a build or machine without CUDA")
def test_missing_cuda_is_bad_usage(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        command(recipe.RECIPE, lambda: recipe.main(["--device", "cuda"]))
    assert stop.value.code == 2
    assert "device 'cuda' cannot be used here" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_folder_in_use_is_refused_in_one_line(tmp_path: Path, capsys) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(SystemExit) as stop:
        command(recipe.RECIPE, lambda: recipe.main(["--out", str(tmp_path)]))
    said = f"td3_gradient_guided.py: the run folder {tmp_path} is not empty: choose another --out\n"
    assert (stop.value.code, capsys.readouterr().err) == (2, said)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_errors_of_a_training_keep_their_traceback() -> None:
    """A ValueError inside a training is a bug, not bad usage."""

    def broken() -> None:
        raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        command("mine.py", broken)


def test_paper_preset_is_table_1() -> None:
    config = parse("--preset", "paper", "--seed", "4")
    table = {
        "learning_rate": 1e-3,
        "final_learning_rate": 1e-3,
        "policy_delay": 2,
        "gamma": 0.995,
        "tau": 0.005,
        "buffer_size": 50_000,
        "batch_size": 256,
        "num_cells": (512, 512, 512),
        "exploration_noise": 0.2,
        "final_exploration_noise": 0.2,
        "policy_noise": 0.1,
        "total_episodes": 20_000,
        "total_frames": 1_000_000,
        "num_envs": 1,
        "updates_per_batch": 1,
        "seed": 4,
        "alignment_offset": math.pi / 4,
        "distance_cost": 0.0,
        "observe_difference": False,
        "layer_norm": False,
    }
    assert {key: getattr(config, key) for key in table} == table
    unguided = parse("--preset", "td3-paper", "--seed", "4")
    assert unguided == config.replace(preset="td3-paper", guided=False)


def test_evaluation_seeds_are_out_of_reach() -> None:
    for seed in (paper.TEST_SEED, paper.VALIDATION_SEED):
        with pytest.raises(ValueError, match="seed"):
            recipe.Config(seed=seed)


@pytest.mark.parametrize("module", [recipe, td3_recurrent, sac, ppo], ids=lambda module: module.__name__)
def test_help_lists_the_flags(module, capsys, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        module.main(["--help"])
    assert stop.value.code == 0
    said = capsys.readouterr().out
    for flag in ("--seed", "--out", "--device", "--num-envs", "--total-frames", "--wandb-mode", "--resume"):
        assert flag in said
    assert ("--preset" in said) == (module is recipe)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 6])
def test_the_agent_learns_to_navigate(tmp_path: Path, seed: int) -> None:
    """Half of the preset's frames, on seeds that were not used for tuning: the paper's results, on 1000 test tasks."""
    result = recipe.train(recipe.Config(seed=seed, total_frames=102_400, out=tmp_path / "run", wandb_mode="disabled"))
    assert result["success_rate"] >= 97
    assert result["spl"] >= 88.4
