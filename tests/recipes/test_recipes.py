"""The training recipes as their users run them: small, but complete."""

import ast
import json
import math
import multiprocessing
import random
import re
import signal
import time
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import ppo_anywhere
import ppo_memory
import pytest
import td3_gradient_guided as recipe
import torch
from support.paths import with_paths
from support.recipes import ROOT, small
from tensordict import TensorDict

from magrl import GeomagneticNavEnv, Scenario, evaluate, evaluation_rollout, load_policy, paper, planet_scenario
from magrl.errors import SensorErrors
from magrl.named_tasks import eddies_env, no_go_env
from magrl.navigators import policy_env
from magrl.random_numbers import TEST_SEED
from magrl.training import command, parse_config
from magrl.training.curves import RETURN_TERMS
from magrl.transforms import Shield

RECIPES = (recipe, ppo_anywhere, ppo_memory)
NOISE = (0.05, 0.05, 5.0)


def names(module) -> str:
    return module.__name__


def few_steps(monkeypatch, max_steps: int, task: str = "nogo") -> None:
    """Give a task another deadline."""
    row = recipe.NAMED_TASKS[task]
    monkeypatch.setitem(recipe.NAMED_TASKS, task, row._replace(make=partial(row.make, max_steps=max_steps)))


def test_the_return_is_the_sum_of_its_terms() -> None:
    after = recipe.make_env(Scenario(), recipe.Config(num_envs=2)).rollout(4)["next"]
    terms = sum(after[f"episode_reward_{term}"] for term in RETURN_TERMS)
    torch.testing.assert_close(terms, after["episode_reward"], rtol=1e-5, atol=1e-4)


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize(
    "module", [*RECIPES[:1], *(pytest.param(m, marks=pytest.mark.slow) for m in RECIPES[1:])], ids=names
)
def test_interrupted_training_resumes_exactly(module, tmp_path: Path, signalled, same_outcome, outcome, capsys) -> None:
    """With networks, optimizers, running episodes and the noise of their sensors; the run folder is complete."""
    whole, run = tmp_path / "whole", tmp_path / "run"
    noise = {} if module is ppo_memory else {"noise": NOISE}  # the task has errors of its own
    short = "date = 2022-01-01\nregion = {latitude = [-30, 0], longitude = [150, 180]}\nmax_steps = 8"
    (tmp_path / "short.toml").write_text(short, encoding="utf-8")
    frames = {"steps_per_batch": 2, "total_frames": 192, "eval_every": 2, **noise}
    frames |= {"scenario": tmp_path / "short.toml"} if module is recipe else {}
    result = module.train(small(module, whole, **frames))
    with signalled(2, signal.SIGINT), pytest.raises(SystemExit) as stop:
        module.train(small(module, run, **frames))
    assert stop.value.code == 130
    assert f"To resume: --resume {run}" in capsys.readouterr().err
    assert not (run / "eval.json").exists()
    module.main(["--resume", str(run)])
    assert same_outcome(run, whole)
    assert not (run / "checkpoints").exists()

    files = {"config.json", "train.csv", "policy.safetensors", "eval.json", "training.png"}
    assert files <= {path.name for path in whole.iterdir()} <= files | {".lock", "scenario.toml", "trajectories.png"}
    assert with_paths(whole) == []
    written, config = (json.loads((whole / f"{name}.json").read_text(encoding="utf-8")) for name in ("eval", "config"))
    assert (written["num_trips"], written["trips_seed"], written["frames"]) == (6, TEST_SEED, 192)
    assert (written["spl"], written["score"]) == (result["spl"], result["score"])
    assert config["recipe"] == module.RECIPE
    assert tuple(config.get("noise", NOISE)) == NOISE
    rows, weights = outcome(whole)
    assert result["updates"] == int(rows[-1]["updates"]) > 0
    losses = getattr(module, "LOSSES", ("loss_critic", "loss_actor"))
    assert all(math.isfinite(float(rows[-1][key])) for key in (*losses, "eval_score"))
    policy = load_policy(run / "policy.safetensors")
    env = policy_env(GeomagneticNavEnv(num_envs=3, seed=0), policy)
    assert env.rollout(2, policy)["action"].isfinite().all()
    assert all(weight.isfinite().all() for weight in weights.values())


def test_a_task_takes_its_preset_unless_another_is_given() -> None:
    found = [
        parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, None, ["--task", "nogo", *args])
        for args in ([], ["--preset", "fast"])
    ]
    assert found == [recipe.PRESETS["nogo"], recipe.PRESETS["fast"].replace(task="nogo")]


def test_the_task_may_reward_a_guided_agent_too() -> None:
    """In the paper's unit, and without the preset's cost of the distance."""
    config = parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, None, ["--reward", "spl", "--num-envs", "4"])
    step = recipe.make_env(Scenario(), config).rollout(3)
    earned = 200 * (step["next", "earned_spl"] - step["earned_spl"]) + step["next", "reward_alignment"]
    torch.testing.assert_close(step["next", "reward"], config.reward_scale * earned)
    assert config.distance_cost > 0


@pytest.mark.usefixtures("without_figures")
def test_training_around_no_go_areas(tmp_path: Path, outcome, capsys, monkeypatch) -> None:
    """Actor and critic see areas in training, and the policy flies where there are some."""
    few_steps(monkeypatch, 4)
    make_critic = Mock(wraps=recipe.make_critic)
    monkeypatch.setattr(recipe, "make_critic", make_critic)
    options = {"task": "nogo", "reward": "spl", "shield": True, "total_frames": 64, "eval_every": 4}
    config = small(recipe, tmp_path / "run", **options)
    recipe.train(config)
    assert any(isinstance(step, Shield) for step in recipe.make_env(Scenario(), config).transform)
    assert "td3_gradient_guided-fast-nogo" in capsys.readouterr().err
    assert make_critic.call_args.kwargs["geometry"].observe_areas
    rows, _ = outcome(tmp_path / "run")
    assert all(math.isnan(float(rows[-1][f"return_{term}"])) for term in RETURN_TERMS[:2])  # not parts of the reward

    policy = load_policy(tmp_path / "run" / "policy.safetensors")
    assert policy.config.shield
    with pytest.raises(ValueError, match="shield True needs a view with no-go areas"):
        recipe.train(small(recipe, tmp_path / "box", shield=True))
    env = no_go_env(8, observation="dict", scale_actions=False, seed=1, max_steps=8)
    seen = next(state for state in evaluation_rollout(env, policy).unbind(1) if state["areas"].any())
    blind = seen.select(*policy.in_keys).set("areas", torch.zeros_like(seen["areas"]))
    assert not torch.equal(policy(blind)["action"], seen["action"])
    flat, dicts = no_go_env(8, seed=1), no_go_env(8, observation="dict", seed=1)
    assert policy.view == flat.view
    assert torch.equal(policy.observe(dicts.reset())["observation"], flat.reset()["observation"])
    with pytest.raises(ValueError, match="observes no-go areas, the environment has none: fly it in no_go_env"):
        evaluate(policy, "paper-100")


@pytest.mark.usefixtures("without_figures")
def test_training_in_eddies(tmp_path: Path, monkeypatch) -> None:
    """Its policy gets its last legs from the map of any environment of one region, and acts as in training."""
    few_steps(monkeypatch, 8, "eddies")
    options = {"reward": "spl", "total_frames": 64, "eval_every": 4, "eval_trips": 2, "eval_trips_small": 2}
    recipe.train(small(recipe, tmp_path / "run", task="eddies", **options))
    policy = load_policy(tmp_path / "run" / "policy.safetensors")
    make = partial(eddies_env, 8, max_steps=8, seed=1)
    assert policy.view == make().view
    plain, own = make(observation="dict", scale_actions=False), make()
    flown = policy_env(plain, policy).rollout(5, policy, break_when_any_done=False)
    trained = own.rollout(5, policy.actor, break_when_any_done=False)
    seen = torch.cat([flown["next", key] for key in policy.view.in_keys], -1)
    assert torch.equal(seen, trained["next", "observation"])
    assert (seen[..., 45:] != 0).all()
    assert len(evaluate(policy, "paper-example", max_steps=2)) == 1
    with pytest.raises(ValueError, match="a map is of one region, got 3"):
        evaluate(policy, planet_scenario(3, seed=0).with_trips(planet_scenario(3, seed=0).random_trips(2, seed=0)))


@pytest.mark.slow
@pytest.mark.usefixtures("without_figures")
def test_options_reach_the_training(tmp_path: Path, outcome) -> None:
    """60 steps, so that episodes reach their limit of 50; the return is the unscaled sum of its terms."""
    found = []
    for changed in ({}, {"objective_limit": 0.5}, {"guided": False}, {"time_limit_ends": True}):
        run = tmp_path / f"{len(found)}"
        recipe.train(small(recipe, run, num_envs=4, total_frames=240, eval_every=60, **changed))
        (*_, row), weights = outcome(run)
        found.append(torch.cat([weight.flatten() for weight in weights.values()]))
        terms = [float(row[f"return_{term}"]) for term in ("destination", "proximity", "alignment")]
        assert math.isnan(terms[2]) == ("guided" in changed)
        assert float(row["return"]) == pytest.approx(sum(terms[: 2 if "guided" in changed else 3]), rel=1e-4)
    assert all(not torch.equal(found[0], other) for other in found[1:])


@pytest.mark.usefixtures("without_figures")
def test_training_without_a_gradient_step_or_a_success(tmp_path: Path, capsys, monkeypatch) -> None:
    """The first episodes end before the replay buffer holds a batch; progress is shown in episodes."""
    few_steps(monkeypatch, 10)
    options = {"total_episodes": 1, "total_frames": 88, "batch_size": 85, "num_envs": 4, "zeta": 1e-12}
    result = recipe.train(small(recipe, tmp_path, task="nogo", reward="spl", **options))
    text = capsys.readouterr()
    assert "episode/s" in text.err
    assert f"Warning: no gradient step was made in {result['frames']} frames" in text.err
    assert math.isnan(result["steps"])
    assert "6 test trips: success rate 0.0 %, SPL 0.0 %, no episode arrived\n" in text.out
    assert not re.search(r"\bnan\b", text.out + text.err)


def first_state(noise: tuple[float, ...]) -> TensorDict:
    """Return the first observation of a recipe's training environment."""
    return recipe.make_env(Scenario(), recipe.Config(noise=noise, num_envs=4, seed=5)).reset()


def test_noise_is_observed_and_the_guidance_is_by_the_truth() -> None:
    perfect, noisy = first_state((0.0, 0.0, 0.0)), first_state(NOISE)
    assert "true_field" not in perfect.keys()  # noqa: SIM118
    for key, other in (("true_field", "field"), ("gradient_heading", "gradient_heading"), ("objective", "objective")):
        assert torch.equal(noisy[key], perfect[other])
    expected = SensorErrors(NOISE, seed=5)(noisy.clone().set("field", perfect["field"]))["field"]
    assert torch.equal(noisy["field"], expected)
    assert (noisy["observation"] != perfect["observation"])[:, :3].all()  # D, I, B_H come first


@pytest.mark.parametrize(
    ("module", "args", "message"),
    [
        (recipe, "--num-cells", "num_cells must hold at least 1 value, got ()"),
        (recipe, "--total-farmes 10", "--total-farmes"),
        (recipe, "--preset slow", "invalid choice: 'slow' (choose from"),
        (recipe, "--resume nowhere", "there is no run to resume in nowhere: it holds no config.json"),
        (recipe, "--total-frames 512", "batch_size 1024 must not exceed total_frames: no gradient step is possible"),
        (recipe, "--buffer-size 16", "buffer_size 16 does not hold one batch of 1024"),
        (recipe, "--final-exploration-noise 0.3", "final_exploration_noise 0.3 must not exceed exploration_noise 0.2"),
        (recipe, "--noise 0.05 0.05", "Missing value for argument '--noise'. Expected 3 values"),
        (ppo_anywhere, "--distance-range-km 500 300", "must be two rising numbers, got (500.0, 300.0)"),
        (ppo_anywhere, "--distance-range-km 150 6000", "must end at 4400 km or below, the side of a region"),
        (ppo_anywhere, "--max-turn-deg 200", "max_turn_deg must be less than or equal to 180, got 200.0"),
        (ppo_anywhere, "--scenario docs/examples/azores.toml", "Unrecognized options: --scenario"),
        (ppo_memory, "--noise 0.1 0 0", "Unrecognized options: --noise"),
        (ppo_anywhere, "--collectors 3", "collectors 3 must divide num_envs, 4096"),
        (ppo_anywhere, "--num-envs 8", "must not exceed num_envs * steps_per_batch, 256"),
    ],
)
def test_bad_usage_exits_with_status_2(module, args: str, message: str, tmp_path: Path, monkeypatch, capsys) -> None:
    """With a message, without a traceback and without a folder."""
    (tmp_path / "docs").symlink_to(Path(__file__).parent.parent.parent / "docs")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    with pytest.raises(SystemExit) as stop:
        command(module.RECIPE, lambda: module.main(args.split()))
    output = capsys.readouterr()
    text = re.sub(r"[\s│]+", " ", output.out + output.err)
    assert stop.value.code == 2
    assert message in text
    assert "Traceback" not in text
    assert [path.name for path in tmp_path.iterdir()] == ["docs"]


@pytest.mark.parametrize("module", RECIPES, ids=names)
def test_help_describes_every_flag(module, capsys, monkeypatch) -> None:
    """Shared settings keep their descriptions where a recipe has a default of its own."""
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        module.main(["--help"])
    assert stop.value.code == 0
    text = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    for name in module.Config.model_fields:
        assert re.search(rf"--{name.replace('_', '-')}[ ,]", text), name
    for name in ("gamma", "total-frames"):
        assert re.search(rf"--{name} \S+ [A-Z][^()]+\. \(default: ", text), name


SHARED = [ROOT / "magrl" / "training" / f"{name}.py" for name in ("run", "config")]


def names_read(tree: ast.Module) -> set[str]:
    """Attributes of settings, and texts, such as of ``linear``, but for docstrings, keys, and what validators read."""
    nodes, others = list(ast.walk(tree)), set[ast.AST]()
    for node in nodes:
        others |= {node.value} if isinstance(node, ast.Expr) else set()
        others |= set(node.keys) if isinstance(node, ast.Dict) else set()
        if isinstance(node, ast.FunctionDef) and "model_validator" in "".join(map(ast.unparse, node.decorator_list)):
            others |= set(ast.walk(node))
    own = ("config", "self", "self.config")
    texts = {x.value for x in nodes if isinstance(x, ast.Constant) and isinstance(x.value, str) and x not in others}
    attributes = [x for x in nodes if isinstance(x, ast.Attribute) and x not in others]
    return texts | {f"final_{x}" for x in texts} | {x.attr for x in attributes if ast.unparse(x.value) in own}


@pytest.mark.parametrize("module", RECIPES, ids=names)
def test_every_setting_is_read(module) -> None:
    """By the recipe or its run; what a validator alone reads is offered in vain."""
    sources = [Path(module.__file__), *SHARED]
    read = [names_read(ast.parse(path.read_text(encoding="utf-8"))) for path in sources]
    assert module.Config.model_fields.keys() - set.union(*read) == set()


def test_paper_preset_is_table_1() -> None:
    config = parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, None, ["--preset", "paper", "--seed", "4"])
    own = {"final_learning_rate": 1e-3, "final_exploration_noise": 0.2, "total_frames": 1_000_000, "num_envs": 1}
    own |= {"updates_per_batch": 1, "distance_cost": 0.0, "observe_difference": False, "layer_norm": False, "seed": 4}
    table = {**paper.TABLE_1, **own}
    assert {key: getattr(config, key) for key in table} == table
    assert (config.gamma, config.tau, config.batch_size, config.num_cells) == (0.995, 0.005, 256, (512, 512, 512))
    unguided = recipe.PRESETS["td3-paper"].replace(seed=4)
    assert unguided == config.replace(preset="td3-paper", guided=False)


@pytest.mark.slow
@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("seed", range(1, 9))
def test_many_kills(tmp_path: Path, same_outcome, seed: int, monkeypatch) -> None:
    """Kill a training several times, let it end, and compare it with one that was left alone."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # as in this process: other numbers round differently
    context = multiprocessing.get_context("spawn")
    folder, whole, survived, moments = tmp_path / "killed", tmp_path / "whole", 0, random.Random(seed)
    config = small(recipe, folder, total_frames=3200, checkpoint_every=0.05)
    recipe.train(config.replace(out=whole))
    process = context.Process(target=recipe.train, args=(config,))
    while survived < 6 and process.exitcode is None:
        process.start()
        while process.is_alive() and not list(folder.glob("checkpoints/checkpoint-*.safetensors")):
            time.sleep(0.01)
        process.join(moments.uniform(0, 5) if survived < 5 else None)
        process.kill()
        process.join()
        if process.exitcode:
            survived, process = survived + 1, context.Process(target=recipe.main, args=(["--resume", str(folder)],))
    assert same_outcome(folder, whole)
    assert survived >= 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 6])
def test_the_agent_learns_to_navigate(tmp_path: Path, seed: int) -> None:
    """Half of the preset's frames, without its cost of distance, on seeds that were not used for tuning."""
    options = {"total_frames": 102_400, "distance_cost": 0.0, "wandb_mode": "disabled"}
    config = recipe.PRESETS["fast"].replace(seed=seed, out=tmp_path / "run", **options)
    result = recipe.train(config)
    assert result["success_rate"] >= 97
    assert result["spl"] >= 88.4
