"""Files from strangers: thousands of mutants of each kind give a clean error, or what the file held before."""

import json
import random
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from magrl import td3
from magrl.checkpoints import Checkpoints, read_checkpoint, save_tensors
from magrl.env import GeomagneticNavEnv
from magrl.settings import read_settings
from magrl.worlds import World, load_world

sys.path.insert(0, str(Path(__file__).parent.parent / "recipes"))
import td3_gradient_guided as recipe

MUTANTS = 3000


def mutant(whole: bytes, dice: random.Random) -> bytes:
    """A file with some bytes replaced, inserted, removed, repeated, or cut off."""
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
    """Reads mutants of a file; counts those that were read whole."""
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
                said = str(error)
                assert str(path) in said, f"mutant {number} of seed {seed}: {said}"
                continue
            survived += 1
            assert same(found), f"mutant {number} of seed {seed} was read as something else"
    return survived


def test_policies(tmp_path: Path) -> None:
    path = tmp_path / "policy.pt"
    policy = td3.FieldPolicy(td3.policy_config(GeomagneticNavEnv(seed=0), (4,), layer_norm=True))
    td3.save_policy(path, policy)
    weights = policy.actor.state_dict()

    def same(found: object) -> bool:
        assert isinstance(found, td3.FieldPolicy)
        other = found.actor.state_dict()
        return found.config == policy.config and all(torch.equal(weights[k], other[k]) for k in weights)

    assert fuzz(path, lambda: td3.load_policy(path), same, ValueError, 0) < MUTANTS / 2


def test_checkpoints(tmp_path: Path) -> None:
    layer = torch.nn.Linear(3, 2)
    path = Checkpoints(tmp_path, {"layer": layer}).save(7)

    def same(found: object) -> bool:
        assert isinstance(found, dict)
        return found["frames"] == 7 and torch.equal(found["parts"]["layer"]["weight"], layer.weight)

    assert fuzz(path, lambda: read_checkpoint(path), same, ValueError, 1) < MUTANTS / 2


def test_settings_of_runs(tmp_path: Path) -> None:
    """Settings are texts: a mutant may be other settings, but then they are sound, and of the same kinds."""
    path = tmp_path / "config.json"
    settings = {key: value for key, value in vars(recipe.Config()).items() if key not in ("out", "resume")}
    path.write_text(json.dumps({**settings, "out": "run", "resume": None, "guided": True}))

    def sound(found: object) -> bool:
        assert isinstance(found, recipe.Config)
        assert found.out == tmp_path
        return all(
            isinstance(getattr(found, key), (int, float) if isinstance(value, float) else type(value))
            for key, value in settings.items()
            if value is not None
        )

    fuzz(path, lambda: read_settings(tmp_path, recipe.Config, guided=True), sound, ValueError, 2)


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_worlds(tmp_path: Path, suffix: str) -> None:
    """A mutant may be another world, but then it is a sound one."""
    path = tmp_path / f"world{suffix}"
    region, task = {"latitude": [40, 50], "longitude": [-30, -20]}, {"start": [41.0, -29.0], "target": [44.5, -24.0]}
    content = {"region": region, "field": {"date": "2026-07-01", "generation": 14, "altitude_km": 0.5}}
    content |= {"journeys": {"distance_range_km": [300, 500]}, "tasks": [{"name": "a name", **task}, task]}
    tables = [f"[{name}]\n{lines(content[name])}" for name in ("region", "field", "journeys")]
    tables += [f"[[tasks]]\n{lines(task)}" for task in content["tasks"]]
    path.write_text("\n".join(tables) if suffix == ".toml" else json.dumps(content))

    def sound(found: object) -> bool:
        assert isinstance(found, World)
        if found.tasks is not None:
            assert found.region.contains(torch.stack(found.tasks)).all()
            assert len(found.names) == len(found.tasks.start)
        return found.altitude_km >= 0 and found.generation in (13, 14)

    fuzz(path, lambda: load_world(path), sound, ValueError, 3)


def lines(table: dict) -> str:
    """A table as TOML, whose numbers, texts and lists are written as in JSON."""
    return "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())


@pytest.mark.parametrize("cells", [(60000, 60000), (10**9,), (0,), (-1,), ("a",), ()])
def test_policy_that_asks_for_more_than_it_holds(tmp_path: Path, cells: tuple) -> None:
    path = tmp_path / "policy.pt"
    td3.save_policy(path, td3.FieldPolicy(td3.policy_config(GeomagneticNavEnv(seed=0), (4,), layer_norm=False)))
    content = torch.load(path, weights_only=True)
    content["config"]["num_cells"] = cells
    save_tensors(content, path)
    with pytest.raises(ValueError, match="another shape"):
        td3.load_policy(path)
