"""Messages of checked models, shortened values and non-finite values."""

import math
from typing import Annotated

import pytest
import torch
from pydantic import BeforeValidator, Field
from tensordict import TensorDict

from magrl.checks import CheckedModel, check_finite, require, short


def even(value: int) -> int:
    if value % 2:
        raise ValueError(f"must be even, got {value}. Input should be 2")
    return value


class Options(CheckedModel):
    tau: float = Field(0.5, gt=0, le=1)
    widths: Annotated[tuple[int, ...], Field(min_length=1)] = (8,)
    pair: Annotated[int, BeforeValidator(even)] = 2
    needed: int


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"tau": 2.0}, "tau must be less than or equal to 1, got 2.0"),
        ({"tau": math.nan}, "tau must be a finite number, got nan"),
        ({"tau": True}, "tau must be a valid number, got True"),
        ({"widths": ()}, "widths must hold at least 1 value, got ()"),
        ({"pair": 3}, "pair: must be even, got 3. Input should be 2"),
        ({"rho": 1}, "unknown key 'rho': choose from tau, widths, pair, needed"),
        (
            {"tau": 2.0, "widths": ()},
            "tau must be less than or equal to 1, got 2.0; widths must hold at least 1 value, got ()",
        ),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_message_names_field_value_and_remedy(bad: dict, message: str) -> None:
    with pytest.raises(ValueError, match=r"must|unknown") as error:
        Options(**{"needed": 1} | bad)
    assert str(error.value) == message


def test_missing_field_is_named() -> None:
    with pytest.raises(ValueError, match=r"^needed is missing$"):
        Options()


def test_checked_models_are_frozen_and_replaced() -> None:
    options = Options(needed=1)
    with pytest.raises(ValueError, match="frozen"):
        options.tau = 0.1
    assert options.replace(tau=0.25) == Options(needed=1, tau=0.25)
    with pytest.raises(ValueError, match="tau must be greater than 0"):
        options.replace(tau=0.0)


def test_short_values_are_kept_and_long_ones_cut() -> None:
    assert short("x" * 78) == "'" + "x" * 78 + "'"
    assert short("x" * 79) == "'" + "x" * 76 + "..."
    assert short(12345, 5) == "12345"
    assert short(123456, 5) == "12..."


def test_at_most_eight_rows_are_named_and_integers_are_ignored() -> None:
    values = torch.full((20, 3), math.nan)
    with pytest.raises(FloatingPointError) as error:
        check_finite([("count", torch.tensor([2**62, 2**62])), ("loss", values)], "update 7")
    assert str(error.value) == "update 7: loss is not finite in rows [0, 1, 2, 3, 4, 5, 6, 7]"
    with pytest.raises(FloatingPointError, match=r"^here: next\.reward is not finite in rows \[1\]$"):
        check_finite(TensorDict(next=TensorDict(reward=torch.tensor([0.0, math.inf])), batch_size=[]), "here")
    with pytest.raises(FloatingPointError, match=r"rows \[0\]$"):
        check_finite([("loss", torch.tensor(math.nan))], "here")


def test_required_values_are_checked_in_a_compiled_graph_too() -> None:
    def add_one(x: torch.Tensor) -> torch.Tensor:
        require(x > 0, x, "x {} must be positive")
        return x + 1

    compiled = torch.compile(add_one, backend="eager", fullgraph=True)
    assert compiled(torch.ones(2)).tolist() == [2, 2]
    with pytest.raises(RuntimeError, match=r"x \{\} must be positive"):
        compiled(torch.tensor([1.0, -1.0]))
    with pytest.raises(ValueError, match=r"^x -1\.0 must be positive$"):
        add_one(torch.tensor([1.0, -1.0]))
