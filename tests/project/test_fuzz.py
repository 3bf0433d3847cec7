"""Damaged files: mutants of each kind of file give a clear error, or the content of the file."""

import json
import random
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
import td3_gradient_guided as recipe
import torch
from support.networks import network_file

from magrl.envs import GeomagneticNavEnv, Scenario, load_scenario
from magrl.errors import load_conditions
from magrl.navigators import FieldPolicy, PolicyConfig, load_policy, save_policy
from magrl.training.checkpoints import Checkpoints, read_checkpoint
from magrl.training.config import resumed_config
from magrl.transforms import ReadingView

AZORES = Path(__file__).parents[2] / "docs" / "examples" / "azores.toml"
MUTANTS = 80


def mutant(whole: bytes, dice: random.Random) -> bytes:
    """Return the content of a file with some bytes replaced, inserted, removed or repeated, or cut off."""
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


def fuzz(path: Path, read: Callable[[], object], same: Callable[[object], bool], seed: int) -> None:
    """Read mutants of a file: each is the same content, or raises a ValueError that names the file."""
    whole, dice = path.read_bytes(), random.Random(seed)
    assert same(read())
    for number in range(MUTANTS):
        path.write_bytes(mutant(whole, dice))
        try:
            found = read()
        except ValueError as error:
            sound, message = str(path) in str(error), str(error)
        else:
            sound, message = same(found), "read as something else"
        assert sound, f"mutant {number}: {message}"


def test_policies(tmp_path: Path) -> None:
    path, policy = tmp_path / "policy.pt", FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (4,)))
    save_policy(path, policy)
    weights = policy.actor.state_dict()

    def same(found: FieldPolicy) -> bool:
        other = found.actor.state_dict()
        return found.config == policy.config and all(torch.equal(weights[k], other[k]) for k in weights)

    fuzz(path, lambda: load_policy(path), same, 0)


def test_networks(tmp_path: Path) -> None:
    """A mutant may be another network, but then it is a valid one."""
    view = ReadingView(max_leg_km=50.0, max_turn_rad=1.5)
    path = tmp_path / "policy.onnx"
    save_policy(path, network_file(tmp_path, view.size), view)
    fuzz(path, lambda: load_policy(path), lambda found: isinstance(found, FieldPolicy), 5)


def test_checkpoints(tmp_path: Path) -> None:
    layer = torch.nn.Linear(3, 2)
    path = Checkpoints(tmp_path, {"layer": layer}).save(7)

    def same(found: dict) -> bool:
        return found["frames"] == 7 and torch.equal(found["parts"]["layer"]["weight"], layer.weight)

    fuzz(path, lambda: read_checkpoint(path), same, 1)


def test_settings_of_runs(tmp_path: Path) -> None:
    """A mutant may hold other settings, but then they are valid."""
    path = tmp_path / "config.json"
    settings = {key: value for key, value in vars(recipe.Config()).items() if key not in ("out", "resume")}
    path.write_text(json.dumps({"recipe": recipe.RECIPE, **settings, "out": "run", "resume": None}), encoding="utf-8")
    read = lambda: resumed_config(tmp_path, recipe.Config, recipe.RECIPE)  # noqa: E731
    fuzz(path, read, lambda found: isinstance(found, recipe.Config) and found.out == tmp_path, 2)


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_scenarios(tmp_path: Path, suffix: str) -> None:
    """A mutant may be another scenario, but then it is a valid one."""
    path, text = tmp_path / f"scenario{suffix}", AZORES.read_text(encoding="utf-8")
    content = text if suffix == ".toml" else json.dumps(tomllib.loads(text), default=str)
    path.write_text(content, encoding="utf-8")
    fuzz(path, lambda: load_scenario(path), lambda found: isinstance(found, Scenario), 3)


NUMBERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "conditions.toml": (load_conditions, "speed_km_h = {}"),
    "conditions.json": (load_conditions, '{{"sensors": {{"noise": [0, 0, {}]}}}}'),
    "bias.toml": (load_conditions, "sensors.bias = [{}, 0, 0]"),
    "weather.toml": (load_conditions, "weather.span_h = {}"),
    "vector.toml": (load_conditions, "sensors.vector.hard_iron_nt = [0, 0, {}]"),
    "scenario.toml": (
        load_scenario,
        "date = 2026-07-01\nzeta = {}\nregion = {{latitude = [1, 2], longitude = [1, 2]}}",
    ),
    "region.toml": (load_scenario, "date = 2026-07-01\nregion = {{latitude = [1, 2], longitude = [1, {}]}}"),
}
"""Readers of numbers, and a file of each with one number left open."""


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_that_no_float_holds_are_refused(name: str, tmp_path: Path) -> None:
    (read, text), path = NUMBERS[name], tmp_path / name
    for number in (f"1{'0' * 400}", f"-1{'0' * 400}"):
        path.write_text(text.format(number), encoding="utf-8")
        with pytest.raises(ValueError, match=f"^(cannot read )?{path}"):
            read(path)
