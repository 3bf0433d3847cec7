"""Damaged files: thousands of mutants of each kind give a clear error, or the content of the file."""

import json
import random
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import td3_gradient_guided as recipe
import torch

from magrl.agents import FieldPolicy, PolicyConfig, load_policy, save_policy
from magrl.envs import GeomagneticNavEnv, Scenario, load_scenario
from magrl.files import save_tensors
from magrl.training.checkpoints import Checkpoints, read_checkpoint
from magrl.training.config import resumed_config

MUTANTS = 3000


def mutant(whole: bytes, dice: random.Random) -> bytes:
    """Return the content of a file with some bytes replaced, inserted, removed, repeated, or cut off."""
    content = bytearray(whole)
    for _ in range(dice.choice((1, 1, 2, 8))):
        at = dice.randrange(len(content) + 1)
        match dice.randrange(5):
            case 0:
                content[at : at + 1] = bytes([dice.randrange(256)])
            case 1:
                content[at:at] = dice.randbytes(dice.randrange(1, 9))
            case 2:
                del content[at : at + dice.randrange(1, 9)]
            case 3:
                content[at:at] = content[max(0, at - dice.randrange(1, 65)) : at]
            case _:
                content = content[:at] if dice.random() < 0.2 else content
    return bytes(content)


def fuzz(
    path: Path, read: Callable[[], object], same: Callable[[object], bool], clean: type[Exception], seed: int
) -> int:
    """Read mutants of a file; return how many were read without an error."""
    whole, dice, survived = path.read_bytes(), random.Random(seed), 0
    assert same(read())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for number in range(MUTANTS):
            content = mutant(whole, dice)
            path.write_bytes(content)
            try:
                found = read()
            except clean as error:
                message = str(error)
                assert str(path) in message, f"mutant {number} of seed {seed}: {message}"
                continue
            survived += 1
            assert same(found), f"mutant {number} of seed {seed} was read as something else"
    return survived


def small_policy() -> FieldPolicy:
    return FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (4,)))


def test_policies(tmp_path: Path) -> None:
    path, policy = tmp_path / "policy.pt", small_policy()
    save_policy(path, policy)
    weights = policy.actor.state_dict()

    def same(found: object) -> bool:
        assert isinstance(found, FieldPolicy)
        other = found.actor.state_dict()
        return found.config == policy.config and all(torch.equal(weights[k], other[k]) for k in weights)

    assert fuzz(path, lambda: load_policy(path), same, ValueError, 0) < MUTANTS / 2


def test_checkpoints(tmp_path: Path) -> None:
    layer = torch.nn.Linear(3, 2)
    path = Checkpoints(tmp_path, {"layer": layer}).save(7)

    def same(found: object) -> bool:
        assert isinstance(found, dict)
        return found["frames"] == 7 and torch.equal(found["parts"]["layer"]["weight"], layer.weight)

    assert fuzz(path, lambda: read_checkpoint(path), same, ValueError, 1) < MUTANTS / 2


def test_settings_of_runs(tmp_path: Path) -> None:
    """A mutant may hold other settings, but then they are valid, and of the same types."""
    path = tmp_path / "config.json"
    settings = {key: value for key, value in vars(recipe.Config()).items() if key not in ("out", "resume")}
    path.write_text(json.dumps({"recipe": recipe.RECIPE, **settings, "out": "run", "resume": None}))

    def sound(found: object) -> bool:
        assert isinstance(found, recipe.Config)
        assert found.out == tmp_path
        return all(
            isinstance(getattr(found, key), (int, float) if isinstance(value, float) else type(value))
            for key, value in settings.items()
            if value is not None
        )

    fuzz(path, lambda: resumed_config(tmp_path, recipe.Config, recipe.RECIPE), sound, ValueError, 2)


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_scenarios(tmp_path: Path, suffix: str) -> None:
    """A mutant may be another scenario, but then it is a valid one."""
    path = tmp_path / f"scenario{suffix}"
    region, task = {"latitude": [40, 50], "longitude": [-30, -20]}, {"start": [41.0, -29.0], "target": [44.5, -24.0]}
    content = {"date": "2026-07-01", "generation": 14, "altitude_km": 0.5, "distance_range_km": [300, 500]}
    tables = {"region": region, "tasks": [{"name": "a name", **task}, task]}
    parts = [lines(content), f"[region]\n{lines(region)}", *(f"[[tasks]]\n{lines(task)}" for task in tables["tasks"])]
    path.write_text("\n".join(parts) if suffix == ".toml" else json.dumps(content | tables))

    def sound(found: object) -> bool:
        assert isinstance(found, Scenario)
        if found.tasks is not None:
            assert found.edge.contains(torch.stack(found.tasks)).all()
            assert len(found.names) == len(found.tasks.start)
        return found.altitude_km >= 0 and found.generation in (13, 14)

    fuzz(path, lambda: load_scenario(path), sound, ValueError, 3)


def lines(table: dict) -> str:
    """Return a table as TOML, whose numbers, texts and lists are written as in JSON."""
    return "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())


@pytest.mark.parametrize("cells", [(60000, 60000), (10**9,), (0,), (-1,), ("a",), ()])
def test_policy_that_asks_for_more_than_it_holds(tmp_path: Path, cells: tuple) -> None:
    path = tmp_path / "policy.pt"
    save_policy(path, small_policy())
    content = torch.load(path, weights_only=True)
    content["config"]["num_cells"] = cells
    save_tensors(content, path)
    with pytest.raises(ValueError, match="does not hold a valid policy") as error:
        load_policy(path)
    assert str(path) in str(error.value)
