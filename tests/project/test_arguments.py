"""Wrong arguments of public functions and classes raise an error that names them.

The mathematics of tensors, in ``geodesy`` and ``guidance``, has no checks: who calls it has made its tensors.

Driven by signatures: every function and class whose required arguments have a value in VALUES is called with a wrong
value for each of its arguments that is a tensor, a number, or some numbers: of another type, or out of all ranges.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from support.public_names import public_members

from magrl.field import IGRF

HOMES = ("field", "transforms", "errors", "envs", "navigators")
VALUES: dict[str, Any] = {
    **dict.fromkeys(("radius_km", "max_leg_km", "speed_km_h"), 25.0),
    **dict.fromkeys(("max_turn_rad", "cost"), 1.5),
    "field_low": (0.0, 0.0, 0.0),
    "field_high": (1.0, 1.0, 1.0),
    "price_range": (0.1, 1.0),
    "name": "marine",
    "uniform": torch.zeros(12),
    "num_trips": 2,
    "gauss": torch.ones(2, 2, dtype=torch.complex128),
    "date": "2026-07-01",
    "weight": 1.0,
    "max_steps": 50,
    "zeta": 0.01,
    "count": 1,
    "seed": 0,
}
OF_KIND = {"tuple[float, float]": (0.0, 10.0), "FieldModel": IGRF("2026-07-01")}
UNCHECKED = {"weight", "offset", "gain", "max_episode_steps"}
"""Factors that may be any number, and a name for ``max_steps``."""
SIGNED = {"seed", "field_low", "field_high"}
"""Numbers that may be below 0."""
NUMBERS: list[object] = ["a", math.nan, math.inf, True]
PAIRS: list[object] = ["a", 5, (), (1.0,), (2.0, 1.0), *((number, 2.0) for number in NUMBERS)]
WRONG: dict[str, list[object]] = {
    "Tensor": ["a", [1.0], torch.zeros(4, 3, 2) > 0],
    "float": NUMBERS,
    "int": [*NUMBERS, 1.5],
    "Sequence[float]": ["a", 5, *((number, 1.0, 1.0) for number in NUMBERS)],
    "tuple[float, float]": PAIRS,
    "tuple[float, float, float]": ["a", 5, (1.0, 1.0), *((number, 1.0, 1.0) for number in NUMBERS)],
}
"""Values by annotation."""
BELOW: dict[str, object] = {"float": -1e9, "int": -(10**9), "Sequence[float]": (-1e9, 1.0, 1.0)}


def kind(parameter: inspect.Parameter) -> str:
    """The annotation of an argument, without a None or a record that it may be instead."""
    return str(parameter.annotation).removesuffix(" | None").removeprefix("SensorStd | ")


def signature(member: Any) -> list[inspect.Parameter]:
    found = list(inspect.signature(member).parameters.values())
    if found[0].kind is found[0].VAR_POSITIONAL:  # the call of a metaclass
        found = list(inspect.signature(member.__init__).parameters.values())[1:]
    return [x for x in found if x.kind not in (x.VAR_POSITIONAL, x.VAR_KEYWORD)]


def cases() -> Iterator[Any]:
    for path, member in public_members().items():
        if path.split(".")[0] not in HOMES or path == "envs.Regions":  # its boxes are no places
            continue
        required = [x for x in signature(member) if x.default is x.empty]
        good = {x.name: OF_KIND.get(kind(x), VALUES.get(x.name)) for x in required}
        sound = not any(good[x.name] is None or "FieldModel |" in kind(x) for x in required)
        for parameter in signature(member) if sound else ():
            if kind(parameter) in WRONG and parameter.name not in UNCHECKED:
                yield pytest.param(member, good, parameter, id=f"{path}-{parameter.name}")


@pytest.mark.parametrize(("member", "good", "parameter"), list(cases()))
def test_wrong_arguments_raise(member: Any, good: dict[str, Any], parameter: inspect.Parameter) -> None:
    below = [BELOW[kind(parameter)]] if kind(parameter) in BELOW and parameter.name not in SIGNED else []
    for value in [*WRONG[kind(parameter)], *below]:
        with pytest.raises((TypeError, ValueError), match=parameter.name) as error:
            member(**good | {parameter.name: value})
        assert "\n" not in str(error.value)


def test_there_are_cases() -> None:
    assert len(list(cases())) > 100
