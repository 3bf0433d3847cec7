"""Wrong arguments of public functions and classes raise an error that names them.

Driven by signatures: every function and class whose required arguments have a value in VALUES is called with a wrong
value for each of its arguments that is a tensor or a number.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from support.public_names import public_members

HOMES = ("geodesy", "guidance", "field", "transforms")
PLACES = torch.zeros(4)
VALUES: dict[str, Any] = {
    **dict.fromkeys(("latitude", "longitude", "latitude1", "longitude1", "latitude2", "longitude2"), PLACES),
    **dict.fromkeys(("heading", "distance", "distance_km", "angle", "reference", "proximity", "step"), PLACES),
    **dict.fromkeys(("objective_before", "objective_after"), PLACES),
    **dict.fromkeys(("field", "target_field", "weights", "floors"), torch.ones(4, 2)),
    **dict.fromkeys(("displacement", "error"), torch.zeros(4, 2)),
    "gradient": torch.eye(2),
    "gauss": torch.ones(2, 2, dtype=torch.complex128),
    "date": "2026-07-01",
    "weight": 1.0,
    "max_steps": 50,
    "zeta": 0.01,
    "count": 1,
    "seed": 0,
}
UNCHECKED = {"weight", "offset", "gain"}
"""Factors that may be any number."""
WRONG: dict[str, list[object]] = {
    "Tensor": ["a", [1.0], torch.zeros(4, 3, 2) > 0],
    "float": ["a", math.nan, math.inf, True],
    "int": ["a", 1.5, True],
}


def cases() -> Iterator[Any]:
    for path, member in public_members().items():
        if path.split(".")[0] not in HOMES:
            continue
        parameters = inspect.signature(member).parameters.values()
        required = {
            x.name for x in parameters if x.default is x.empty and x.kind not in (x.VAR_POSITIONAL, x.VAR_KEYWORD)
        }
        checked = [x for x in parameters if x.annotation in WRONG and x.name not in UNCHECKED]
        for parameter in checked if required <= VALUES.keys() else ():
            good = {name: VALUES[name] for name in required - {parameter.name}}
            yield pytest.param(member, good, parameter, id=f"{path}-{parameter.name}")


@pytest.mark.parametrize(("member", "good", "parameter"), list(cases()))
def test_wrong_arguments_raise(member: Any, good: dict[str, Any], parameter: inspect.Parameter) -> None:
    for value in WRONG[parameter.annotation]:
        with pytest.raises((TypeError, ValueError), match=parameter.name):
            member(**good, **{parameter.name: value})


def test_there_are_cases() -> None:
    assert len(list(cases())) > 60
