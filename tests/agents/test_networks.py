"""Networks of actors and critics."""

import math

import pytest
import torch
from tensordict import TensorDict

from magrl.agents import make_actor
from magrl.agents.networks import CorrectedMove
from magrl.tracking import Rules


def test_new_actor_is_not_saturated() -> None:
    """Half the longest move and no turn, give or take what the weights add."""
    torch.manual_seed(0)
    actions = make_actor(13, (16, 16))(TensorDict(observation=2 * torch.rand(50, 13) - 1, batch_size=[50]))["action"]
    assert actions.abs().max() < 0.95
    assert actions.std(0).min() > 0.01


def test_a_correction_scales_and_turns_the_plan() -> None:
    """Up to the longest move; where the turn is too large, the vehicle turns where it is."""
    corrected = CorrectedMove(Rules())
    planned = torch.tensor([[20.0, 0.0], [20.0, 0.0], [0.0, 40.0], [-10.0, 0.0]])
    change = torch.tensor([[0.0, 1.0], [2 * math.log(2.0), 0.0], [2.0, -math.pi], [0.0, -0.1]])
    expected = torch.tensor([[-0.2, 1 / math.pi], [0.6, 0.0], [1.0, 0.0], [-1.0, 1.0]])
    torch.testing.assert_close(corrected(planned, torch.zeros(4, 1), change), expected)
    turned = corrected(planned[:1], torch.tensor([[0.3]]), torch.zeros(1, 2))  # at a heading, without a correction
    torch.testing.assert_close(turned, torch.tensor([[-0.2, -0.6 / math.pi]]))


def test_bad_sizes_are_refused() -> None:
    for size, cells in ((0, (8,)), (13, (0,)), (13, (1.5,)), (13, (10**9,))):
        with pytest.raises(ValueError, match="must be a whole number from 1 up to 65536"):
            make_actor(size, cells)
