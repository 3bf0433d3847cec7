"""Policies that come with the library."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

import magrl
from magrl.agents import pretrained
from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv
from magrl.transforms import TrackView

FOLDER = Path(pretrained.__file__).parent


def test_anywhere_acts_without_a_map() -> None:
    policy = magrl.load_pretrained("anywhere")
    assert isinstance(policy.config.view, TrackView)
    assert not set(policy.in_keys) & {*PRIVILEGED_KEYS, "region", "true_field"}
    moves = GeomagneticNavEnv(num_envs=3, seed=0).rollout(5, policy)["next", "move"]
    assert moves.isfinite().all()
    assert moves[..., 0].max() > 1


def test_anywhere_acts_alike_by_any_default_type_of_floating_point_numbers() -> None:
    def actions() -> Tensor:
        return GeomagneticNavEnv(num_envs=3, seed=0).rollout(5, magrl.load_pretrained("anywhere"))["action"]

    expected = actions()
    torch.set_default_dtype(torch.float64)
    try:
        torch.testing.assert_close(actions(), expected, rtol=0, atol=1e-3)
    finally:
        torch.set_default_dtype(torch.float32)


def test_every_policy_is_small_and_has_a_card() -> None:
    (file,) = FOLDER.glob("*.safetensors")
    assert file.stat().st_size < 1_000_000
    card = file.with_suffix(".md").read_text()
    assert all(f"## {part}\n" in card for part in ("Training", "Data", "Figures", "Limits"))


def test_unknown_name() -> None:
    with pytest.raises(ValueError, match="pretrained_policy must be one of 'anywhere', got 'nowhere'"):
        magrl.load_pretrained("nowhere")
    with pytest.raises(ValueError, match="must be one of 'anywhere'"):
        magrl.load_pretrained("../pretrained/anywhere")
