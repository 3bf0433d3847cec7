"""The recipe of the prior of the gradients."""

from pathlib import Path

import gradient_prior
import torch

from magrl.tracking import LearnedPrior


def test_a_short_fit_is_better_than_a_dipole_and_repeatable(tmp_path: Path, capsys) -> None:
    files = [tmp_path / name for name in ("first.pt", "second.pt")]
    options = {"num-regions": 64, "num-tasks": 4096, "updates": 150, "batch-size": 512, "test-regions": 16}
    small = [text for name, value in options.items() for text in (f"--{name}", str(value))]
    for file in files:
        gradient_prior.main([*small, "--out", str(file)])
    found, dipole = map(float, capsys.readouterr().out.splitlines()[0].replace(",", "").split()[3::4])
    assert found < dipole - 0.3
    first, second = (torch.load(file, weights_only=True) for file in files)
    LearnedPrior().load_state_dict(first)
    assert all(torch.equal(first[key], second[key]) for key in first)
