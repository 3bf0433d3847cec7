"""Each checker: what it accepts, and the message for what it does not."""

import math
import re
from collections.abc import Callable
from functools import partial
from typing import Annotated

import numpy as np
import pytest
import torch
from pydantic import BeforeValidator, Field
from tensordict import TensorDict

from magrl.checks import (
    CheckedModel,
    check_finite,
    check_number,
    check_numbers,
    check_tensor,
    check_type,
    require,
    short,
)

NAN, INF = math.nan, math.inf


def test_what_is_sound_passes() -> None:
    check_number(0, 1, low_end=0, high_end=1.0, numpy=np.float32(0.5))
    check_number(1, whole=True, optional=True, seed=None, count=np.int64(1))
    check_number(0, above=True, small=1e-300)
    check_numbers(2, x=(0, 1.5), y=[np.float64(1), 2])
    check_tensor(3, 2, x=torch.zeros(3, 2), y=torch.zeros(0, 5, 3, 2, dtype=torch.int64))
    check_tensor(x=torch.zeros(()))
    check_type((int, str), x=5, y="a")


UNIT = {"low": 0, "high": 1}
NUMBERS: list[tuple[dict, object, str]] = [
    *(({}, value, "a finite number") for value in (NAN, INF, "a", True, None, 1j)),
    ({"high": 1}, 1.5, "a finite number up to 1"),
    (UNIT, -0.5, "a finite number from 0 up to 1"),
    ({"low": 0, "above": True}, 0.0, "a finite number above 0"),
    (UNIT | {"above": True}, 0.0, "a finite number above 0 up to 1"),
    ({"whole": True}, 2.0, "a whole number"),
    ({"low": 1, "whole": True}, 0, "a whole number from 1 on"),
    ({"low": 1, "optional": True}, 0, "a finite number from 1 on"),
]
TENSORS: list[tuple[object, str]] = [
    ([1.0], "be a tensor, got the list [1.0]"),
    (torch.zeros(3, 2) > 0, "hold real numbers, got torch.bool"),
    (torch.zeros(3, 2) * 1j, "hold real numbers, got torch.complex64"),
    (torch.zeros(3), "have the shape (..., 3, 2), got (3,)"),
    (torch.zeros(5, 2, 3), "have the shape (..., 3, 2), got (5, 2, 3)"),
]
PAIRS = (5, None, (1.0,), (1.0, 2.0, 3.0), "ab", (0.0, NAN), (0.0, True))
MISTAKES: list[tuple[Callable[[], object], str]] = [
    *((partial(check_number, **limits, y=1, x=value), f"be {says}, got {value!r}") for limits, value, says in NUMBERS),
    *((partial(check_numbers, 2, x=value), f"be 2 finite numbers, got {value!r}") for value in PAIRS),
    (partial(check_numbers, 2, 0, x=(1, -1)), "be a finite number from 0 on, got -1"),
    *((partial(check_tensor, 3, 2, x=value), says) for value, says in TENSORS),
    (partial(check_type, (int, str), x=1.5), "be a int or str, got 1.5"),
    (partial(check_type, str, x=5), "be a str, got 5"),
]


@pytest.mark.parametrize(("check", "says"), MISTAKES)
def test_mistakes_are_named(check: Callable[[], object], says: str) -> None:
    with pytest.raises((TypeError, ValueError), match=f"^x must {re.escape(says)}$"):
        check()


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
        ({"tau": NAN}, "tau must be a finite number, got nan"),
        ({"tau": True}, "tau must be a valid number, got True"),
        ({"widths": ()}, "widths must hold at least 1 value, got ()"),
        ({"pair": 3}, "pair: must be even, got 3. Input should be 2"),
        ({"rho": 1}, "unknown key 'rho': choose from tau, widths, pair, needed"),
        ({"tau": 0.0, "needed": "a"}, "tau must be greater than 0, got 0.0; needed must be a valid integer, got 'a'"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_messages_of_a_checked_model(bad: dict, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        Options(**{"needed": 1} | bad)


def test_checked_models_are_complete_frozen_and_replaced() -> None:
    with pytest.raises(ValueError, match=r"^needed is missing$"):
        Options()
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


def test_check_finite_names_at_most_eight_rows_and_ignores_integers() -> None:
    values = torch.full((20, 3), NAN)
    with pytest.raises(FloatingPointError, match=r"^update 7: loss is not finite in rows \[0, 1, 2, 3, 4, 5, 6, 7\]$"):
        check_finite([("count", torch.tensor([2**62, 2**62])), ("loss", values)], "update 7")
    with pytest.raises(FloatingPointError, match=r"^here: next\.reward is not finite in rows \[1\]$"):
        check_finite(TensorDict(next=TensorDict(reward=torch.tensor([0.0, INF])), batch_size=[]), "here")
    with pytest.raises(FloatingPointError, match=r"rows \[0\]$"):
        check_finite([("loss", torch.tensor(NAN))], "here")
    check_finite([("overflow", torch.full((2,), 3e38))], "a finite value whose sum is infinite")


def add_one(x: torch.Tensor) -> torch.Tensor:
    require(x > 0, x, "x {} must be positive")
    return x + 1


def test_require_names_the_first_value_and_works_in_a_compiled_graph() -> None:
    compiled = torch.compile(add_one, backend="eager", fullgraph=True)
    for function, error, message in (
        (add_one, ValueError, r"^x -1\.0 must be positive$"),
        (compiled, RuntimeError, r"x \{\} must be positive"),
    ):
        assert function(torch.ones(2)).tolist() == [2, 2]
        with pytest.raises(error, match=message):
            function(torch.tensor([1.0, -1.0, -2.0]))
