"""Every public function, class and method refuses what it cannot use, with the value in the message.

``ROWS`` holds the bad calls of each name. A name without a row, or without a reason in ``EXEMPT``, fails the suite: who
adds a function says here what it refuses. Where NaN in means NaN out by design, the row holds the function to that.
"""

from __future__ import annotations

import importlib
import inspect
import math
import pkgutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

import gymnasium
import pytest
import torch
from matplotlib.figure import Figure
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

import magrl
from magrl import (
    checkpoints,
    checks,
    elements,
    env,
    export,
    fields,
    geodesy,
    guidance,
    gymnasium_env,
    harmonics,
    loggers,
    metaheuristics,
    metrics,
    navigators,
    plots,
    recurrent,
    regional,
    replay,
    runs,
    settings,
    tasks,
    td3,
    worlds,
)
from magrl.metaheuristics import base
from magrl.tasks import PAPER_REGION, Region
from magrl.transforms import AlignmentReward, AngleVector, FieldGradient, GradientHeading, MinMaxNorm, TargetDifference
from magrl.transforms import base as keys

NAN, INF = math.nan, math.inf
FLOAT64: dict[str, Any] = {"dtype": torch.float64}


class Refused(NamedTuple):
    """A call, the error that it must raise, and what the message must say."""

    call: Callable[[], object]
    error: type[Exception]
    says: tuple[str, ...]


class Nan(NamedTuple):
    """A call whose answer must be NaN throughout, because an input was."""

    call: Callable[[], object]


def refused(call: Callable[[], object], error: type[Exception], *says: str) -> Refused:
    return Refused(call, error, says)


def t(*values: complex) -> Tensor:
    """A vector, complex where a value is."""
    return torch.tensor(values)


def zeros(*shape: int, **options: Any) -> Tensor:
    return torch.zeros(shape, **options)


def meta(*shape: int) -> Tensor:
    return torch.zeros(shape, device="meta")


def int64(*shape: int) -> Tensor:
    return torch.zeros(shape, dtype=torch.int64)


@cache
def nav() -> env.GeomagneticNavEnv:
    return env.GeomagneticNavEnv(num_envs=2, seed=0)


@cache
def flight() -> TensorDictBase:
    return nav().rollout(2)


def config(**options: Any) -> td3.PolicyConfig:
    """A sound configuration but for some options."""
    sound = {"num_cells": (8,), "layer_norm": True, "observe_heading": True, "observe_difference": True}
    sound |= {"field_low": (0.0, -50.0, 3e4), "field_high": (10.0, 0.0, 4e4), "max_move_km": 50.0, "max_turn_rad": 1.5}
    return td3.PolicyConfig(**(sound | options))


def folder() -> Path:
    return Path(tempfile.mkdtemp())


def begun(config_json: str) -> Path:
    """The folder of a run with these settings."""
    run = folder()
    (run / "config.json").write_text(config_json)
    return run


@dataclass
class Options:
    """Settings as a recipe's."""

    count: int = 1
    share: float = 0.5
    flag: bool = False
    mode: Literal["quiet", "verbose"] = "quiet"


def axes() -> Any:
    return Figure().subplots()


def run_log(**options: Any) -> runs.RunLog:
    return runs.RunLog(folder(), ["frames"], {}, **options)


def written(content: object) -> Path:
    """A file of torch with some content."""
    path = folder() / "content.pt"
    checkpoints.save_tensors(content, path)
    return path


def bad_numbers(build: Callable[..., object], **options: tuple[Any, ...]) -> list[Refused]:
    """An option of each name with each of some values: a ValueError that holds both."""
    return [
        refused(lambda n=name, v=value: build(**{n: v}), ValueError, name, repr(value))
        for name, values in options.items()
        for value in values
    ]


def bad_tensors(function: Callable[..., object], *names: str) -> list[Refused]:
    """Numbers, texts, bools and complex numbers in the place of each of some tensors."""
    rows = []
    for place in range(len(names)):
        for value, says in ((1.5, "float 1.5"), ("a", "str 'a'"), (t(1j), "complex64"), (zeros(1).bool(), "bool")):
            given = [zeros(1)] * place + [value] + [zeros(1)] * (len(names) - place - 1)
            rows.append(refused(lambda g=given: function(*g), TypeError, names[place], says))
    return rows


def bad_vectors(function: Callable[[Any], object], name: str, size: int = 3) -> list[Refused]:
    """What is no ``(..., size)`` tensor of real numbers."""
    rows = [
        refused(lambda s=s: function(zeros(*s)), ValueError, name, str(s)) for s in ((), (2, size - 1), (2, size + 1))
    ]
    return [row for row in bad_tensors(function, name) if row.says[1] != "bool"] + rows


def unequal(function: Callable[..., object], count: int) -> list[Refused]:
    """Tensors that do not broadcast, and tensors on two devices."""
    others = [zeros(2)] * (count - 1)
    return [
        refused(lambda: function(*others, zeros(3)), RuntimeError, "(2)", "(3)"),
        refused(lambda: function(*others, meta(2)), RuntimeError, "meta"),
    ]


GEODESY = {
    "geodesy.wrap_angle": [*bad_tensors(geodesy.wrap_angle, "angle"), Nan(lambda: geodesy.wrap_angle(t(NAN, INF)))],
    "geodesy.wrap_longitude": [
        *bad_tensors(geodesy.wrap_longitude, "longitude"),
        Nan(lambda: geodesy.wrap_longitude(t(NAN, -INF))),
    ],
    "geodesy.curvature_radii": [
        *bad_tensors(geodesy.curvature_radii, "latitude"),
        Nan(lambda: geodesy.curvature_radii(t(NAN, INF))),
    ],
    "geodesy.local_frame": [
        *bad_tensors(geodesy.local_frame, "latitude", "longitude"),
        *unequal(geodesy.local_frame, 2),
        Nan(lambda: geodesy.local_frame(t(NAN), t(0.0))[..., 0, :]),
        Nan(lambda: geodesy.local_frame(t(0.0), t(INF))[..., 1, :2]),
    ],
    "geodesy.to_ecef": [
        *bad_tensors(geodesy.to_ecef, "latitude", "longitude"),
        *unequal(geodesy.to_ecef, 3),
        refused(lambda: geodesy.to_ecef(zeros(1), zeros(1), t(1j)), TypeError, "altitude_km", "complex64"),
        refused(lambda: geodesy.to_ecef(zeros(1), zeros(1), "a"), TypeError, "str"),
        Nan(lambda: geodesy.to_ecef(t(NAN, INF, 0.0), t(0.0, 0.0, 0.0), t(0.0, 0.0, NAN))),
    ],
    "geodesy.from_ecef_surface": [
        *bad_vectors(geodesy.from_ecef_surface, "ecef"),
        Nan(lambda: geodesy.from_ecef_surface(t(NAN, 0.0, 0.0))),
    ],
    "geodesy.move": [
        *bad_tensors(geodesy.move, "latitude", "longitude", "heading", "distance_km"),
        *unequal(geodesy.move, 4),
        *(
            Nan(lambda k=k, v=v: geodesy.move(*[t(0.0)] * k, t(v), *[t(0.0)] * (3 - k)))
            for k in (0, 2, 3)
            for v in (NAN, INF)
        ),
    ],
    "geodesy.geodesic": [
        *bad_tensors(geodesy.geodesic, "latitude1", "longitude1", "latitude2", "longitude2"),
        refused(lambda: geodesy.geodesic(*[zeros(2)] * 3, zeros(3)), RuntimeError, "(2)", "(3)"),
        refused(lambda: geodesy.geodesic(t(0.0), t(0.0), t(-90.5), t(0.0)), ValueError, "latitude -90.5"),
        refused(lambda: geodesy.geodesic(t(0.0, 91.0), t(0.0), t(0.0), t(0.0)), ValueError, "latitude 91.0"),
        refused(lambda: geodesy.geodesic(t(INF), t(0.0), t(0.0), t(0.0)), ValueError, "latitude inf"),
        *(
            Nan(lambda k=k, v=v: geodesy.geodesic(*[t(0.0)] * k, t(v), *[t(0.0)] * (3 - k)))
            for k, v in ((0, NAN), (1, NAN), (2, NAN), (3, NAN), (1, INF), (3, INF))
        ),
    ],
    "checks.check_tensor": [
        refused(lambda: checks.check_tensor(x=[1.0]), TypeError, "x", "list [1.0]"),
        refused(lambda: checks.check_tensor(3, 2, x=zeros(3)), ValueError, "x", "(..., 3, 2)", "(3,)"),
    ],
    "checks.check_number": [
        *(
            refused(lambda v=v: checks.check_number(x=v), ValueError, "x", repr(v))
            for v in (NAN, INF, "a", None, True, 1j)
        ),
        *(
            refused(
                lambda low=low, options=options: checks.check_number(*low, **options), ValueError, f"x must be {said}"
            )
            for low, options, said in (
                ((), {"x": NAN}, "a finite number, got nan"),
                ((), {"high": 1, "x": 1.5}, "a finite number up to 1, got 1.5"),
                ((0, 1), {"x": 1.5}, "a finite number from 0 up to 1, got 1.5"),
                ((0,), {"above": True, "x": 0.0}, "a finite number above 0, got 0.0"),
                ((0, 1), {"above": True, "x": 0.0}, "a finite number above 0 up to 1, got 0.0"),
                ((), {"whole": True, "x": 2.0}, "a whole number, got 2.0"),
                ((1,), {"whole": True, "x": 0}, "a whole number from 1 on, got 0"),
            )
        ),
    ],
    "checks.check_numbers": [
        *(
            refused(lambda v=v: checks.check_numbers(2, x=v), ValueError, "x", "2 finite", repr(v))
            for v in (5, None, (1.0,), (1.0, 2.0, 3.0), "ab", (0.0, NAN), (0.0, True))
        )
    ],
    "checks.check_type": [refused(lambda: checks.check_type((int, str), x=1.5), TypeError, "x", "int or str", "1.5")],
}

ELEMENTS = {
    "elements.Elements": [refused(lambda: elements.Elements(t(0.0)), TypeError, "missing 6")],
    "elements.element_index": [
        refused(lambda: elements.element_index("Z"), ValueError, "'Z'", "D, I, B_H"),
        refused(lambda: elements.element_index(5), ValueError, "5"),
    ],
    "elements.seven_elements": [
        *bad_vectors(elements.seven_elements, "b_ned"),
        refused(lambda: elements.seven_elements(int64(2, 3)), NotImplementedError, "Long"),
        Nan(lambda: [getattr(elements.seven_elements(t(NAN, 1.0, 1.0)), key) for key in ("D", "I", "B_H", "B_F")]),
    ],
    "elements.measured_elements": [
        *bad_vectors(elements.measured_elements, "b_ned"),
        Nan(lambda: elements.measured_elements(t(1.0, NAN, 1.0))),
    ],
    "elements.field_vector": [
        *bad_vectors(elements.field_vector, "elements"),
        Nan(lambda: elements.field_vector(t(0.0, 0.0, NAN))),
        Nan(lambda: elements.field_vector(t(INF, 0.0, 1.0))[:2]),
    ],
    "elements.elements_jacobian": [
        *bad_vectors(elements.elements_jacobian, "b_ned"),
        # The derivatives of D and B_H downward are zero whatever the field is.
        Nan(lambda: elements.elements_jacobian(t(NAN, 1.0, 1.0))[:, :2]),
        Nan(lambda: elements.elements_jacobian(t(1.0, NAN, 1.0))[:, :2]),
        Nan(lambda: elements.elements_jacobian(t(1.0, 1.0, NAN))[1]),
    ],
    "elements.elements_gradient": [
        *bad_vectors(lambda b: elements.elements_gradient(b, zeros(2, 3, 2)), "b_ned"),
        refused(lambda: elements.elements_gradient(zeros(3), zeros(3, 3)), ValueError, "b_gradient", "(3, 3)"),
        refused(lambda: elements.elements_gradient(zeros(3), zeros(1, 2)), ValueError, "b_gradient", "(1, 2)"),
        refused(lambda: elements.elements_gradient(zeros(2, 3), zeros(4, 3, 2)), RuntimeError, "(2)", "(4)"),
        Nan(lambda: elements.elements_gradient(torch.ones(3), zeros(3, 2) + NAN)),
    ],
}


def of_elements(function: Callable[[Tensor, Tensor, Tensor], object], *names: str) -> list[Refused]:
    """Fields, targets and a third whose last dimensions differ, a single element included."""
    good = [torch.ones(2, 3)] * 3
    shapes = ((2, 1), (2, 2), ())
    wrong = [[*good[:k], torch.ones(shape), *good[k + 1 :]] for k in range(3) for shape in shapes]
    return [refused(lambda w=w: function(*w), ValueError, *names, "(2, 3)") for w in wrong]


GUIDANCE = {
    "guidance.objective_weights": [
        *bad_tensors(guidance.objective_weights, "field", "target_field", "floors"),
        *of_elements(guidance.objective_weights, "field", "target_field", "floors"),
        Nan(lambda: guidance.objective_weights(t(NAN), t(1.0), t(1.0))),
        Nan(lambda: guidance.objective_weights(t(1.0), t(1.0), t(NAN))),
    ],
    "guidance.objective": [
        *bad_tensors(guidance.objective, "field", "target_field", "weights"),
        *of_elements(guidance.objective, "field", "target_field", "weights"),
        Nan(lambda: guidance.objective(t(1.0, NAN), t(1.0, 1.0), t(1.0, 1.0))),
    ],
    "guidance.destination_reward": [
        refused(lambda: guidance.destination_reward(t(1.0), 200.0), TypeError, "arrived", "torch.float32"),
        refused(lambda: guidance.destination_reward(True, 200.0), TypeError, "arrived", "True"),
        Nan(lambda: guidance.destination_reward(zeros(1).bool(), NAN)),
    ],
    "guidance.proximity_reward": [
        *bad_tensors(lambda a, b: guidance.proximity_reward(a, b, 1.0), "objective_before", "objective_after"),
        *unequal(lambda a, b: guidance.proximity_reward(a, b, 1.0), 2),
        Nan(lambda: guidance.proximity_reward(t(0.0, NAN), t(NAN, 0.0), 1.0)),
    ],
    "guidance.late_decay": [
        *bad_tensors(lambda a, b: guidance.late_decay(a, b, 50), "proximity", "step"),
        refused(lambda: guidance.late_decay(zeros(1), int64(1), 0), ValueError, "max_steps", "0"),
        refused(lambda: guidance.late_decay(zeros(1), int64(1), NAN), ValueError, "max_steps", "nan"),
        Nan(lambda: guidance.late_decay(t(NAN, NAN), torch.tensor([1, 50]), 50)),
    ],
    "guidance.alignment_reward": [
        *bad_tensors(lambda a, b: guidance.alignment_reward(a, b, 3.0), "angle", "reference"),
        *unequal(lambda a, b: guidance.alignment_reward(a, b, 3.0), 2),
        Nan(lambda: guidance.alignment_reward(t(0.0, NAN, INF), t(NAN, 0.0, 0.0), 3.0)),
    ],
    "guidance.parallel_approach": [
        *bad_vectors(lambda x: guidance.parallel_approach(x, zeros(2), zeros(2, 2)), "field", 2),
        *bad_vectors(lambda x: guidance.parallel_approach(zeros(2), x, zeros(2, 2)), "target_field", 2),
        *bad_vectors(lambda x: guidance.parallel_approach(zeros(2), zeros(2), x), "gradient", 2)[:2],
        refused(lambda: guidance.parallel_approach(zeros(2), zeros(2), zeros(3, 2)), ValueError, "gradient", "(3, 2)"),
        *(
            refused(
                lambda a=a: guidance.parallel_approach(zeros(2), zeros(2), zeros(2, 2), a),
                ValueError,
                "min_crossing",
                str(a),
            )
            for a in (-0.1, math.pi / 2, NAN)
        ),
    ],
}

GAUSS = zeros(2, 2, dtype=torch.complex128)


def bad_tables(function: Callable[[Any], object], name: str) -> list[Refused]:
    """What is no square table of complex numbers."""
    return [
        refused(lambda: function(zeros(2, 2)), TypeError, name, "float32"),
        refused(lambda: function("a"), TypeError, name, "'a'"),
        refused(lambda: function(GAUSS[0]), ValueError, name, "(2,)"),
        refused(lambda: function(GAUSS[:1]), ValueError, name, "(1, 2)"),
    ]


PLACE = (t(-5.0), t(165.0))


@cache
def igrf() -> fields.IGRF:
    return fields.IGRF("2022-01-01", 13)


@cache
def box() -> regional.RegionalField:
    return regional.RegionalField(igrf(), (-10.0, 0.0), (160.0, 170.0), degree=6, tolerance_nt=1.0)


def bad_places(field: Callable[..., object]) -> list[Refused]:
    return [
        refused(lambda: field(zeros(2), zeros(3)), RuntimeError, "(2)", "(3)"),
        refused(lambda: field(t(-95.0), t(0.0)), ValueError, "latitude -95.0"),
        refused(lambda: field(t(NAN), t(0.0)), ValueError, "latitude nan"),
        refused(lambda: field(t(0.0), t(INF)), ValueError, "longitude inf"),
        refused(lambda: field(t(0.0), t(0.0), NAN), ValueError, "altitude_km"),
    ]


FIELDS: dict[str, list[Refused | Nan]] = {
    "harmonics.differentiate": [
        *bad_tables(harmonics.differentiate, "table"),
        Nan(lambda: harmonics.differentiate(torch.full((1, 1), NAN, dtype=torch.complex128))[2, 1, 0].real),
    ],
    "harmonics.basis": [
        *bad_vectors(lambda x: harmonics.basis(x, 1), "ecef_km"),
        refused(lambda: harmonics.basis(torch.ones(3), 1), ValueError, "ecef_km", "(P, 3)", "(3,)"),
        refused(lambda: harmonics.basis(torch.eye(3)[:2] * t(0.0, 1.0, 1.0), 1), ValueError, "centre", "(0, 0, 0)"),
        *bad_numbers(lambda **d: harmonics.basis(torch.ones(1, 3), **d), degree=(-1, 1.5, "a")),
        Nan(lambda: harmonics.basis(t(NAN, 1.0, 1.0).unsqueeze(0), 1)[2:]),
    ],
    "harmonics.field_table": [
        *bad_tables(harmonics.field_table, "gauss"),
        refused(lambda: harmonics.field_table(GAUSS.expand(5, 2, 2)), ValueError, "gauss", "(5, 2, 2)"),
    ],
    "harmonics.gradient_table": [
        *bad_tables(harmonics.gradient_table, "gauss"),
        refused(lambda: harmonics.gradient_table(GAUSS.expand(5, 2, 2)), ValueError, "gauss", "(5, 2, 2)"),
    ],
    "harmonics.chebyshev_nodes": [
        refused(lambda: harmonics.chebyshev_nodes("a"), ValueError, "count", "'a'"),
        refused(lambda: harmonics.chebyshev_nodes(0), ValueError, "count", "0"),
        refused(lambda: harmonics.chebyshev_nodes(1.5), ValueError, "count", "1.5"),
    ],
    "harmonics.separate": [
        refused(lambda: harmonics.separate(zeros(3, 13, **FLOAT64), 2), RuntimeError, "(7)", "(6)"),
        refused(lambda: harmonics.separate(zeros(3, 12), 2), RuntimeError, "Float", "Double"),
    ],
    "harmonics.on_surface": [
        refused(
            lambda: harmonics.on_surface(zeros(3, 5, 3, **FLOAT64), *zeros(2, 6, **FLOAT64)), RuntimeError, "3", "4x6"
        ),
    ],
    "harmonics.chebyshev": [
        refused(lambda: harmonics.chebyshev("a", 4), TypeError, "str"),
        Nan(lambda: harmonics.chebyshev(t(NAN), 4)[1:]),
    ],
    "harmonics.products": [
        refused(lambda: harmonics.products(torch.ones(2), torch.ones(3), 2), RuntimeError, "(2)", "(3)"),
        Nan(lambda: harmonics.products(t(NAN), t(1.0), 2)),
    ],
    "harmonics.waves": [
        refused(lambda: harmonics.waves(torch.ones(2), torch.ones(3), torch.ones(2), 2), RuntimeError, "[2]", "[3]"),
        Nan(lambda: harmonics.waves(t(NAN), t(NAN), t(1.0), 2)[[0, 1, 3, 4]]),
    ],
    "harmonics.contract": [
        refused(lambda: harmonics.contract(zeros(3, 5, 4), zeros(3, 1), zeros(5, 1)), RuntimeError, "15x4", "3x1"),
        Nan(lambda: harmonics.contract(torch.ones(3, 5, 4), zeros(4, 1) + NAN, torch.ones(5, 1))),
    ],
    "fields.parse_date": [
        refused(lambda: fields.parse_date("May"), ValueError, "'May'"),
        *(
            refused(lambda v=v: fields.parse_date(v), ValueError, repr(v))
            for v in (NAN, INF, 0.5, 10_000, None, True, [])
        ),
    ],
    "fields.igrf_coefficients": [
        refused(lambda: fields.igrf_coefficients(1899.5), ValueError, "1899.5", "1900"),
        refused(lambda: fields.igrf_coefficients(2031), ValueError, "2031", "2030"),
        refused(lambda: fields.igrf_coefficients(2022, 12), ValueError, "12", "[13, 14]"),
        refused(lambda: fields.igrf_coefficients(2022, "13"), ValueError, "'13'"),
    ],
    "fields.SphericalHarmonicField": [
        refused(lambda: fields.SphericalHarmonicField(zeros(2, 3)), ValueError, "(2, 3)"),
        refused(lambda: fields.SphericalHarmonicField(GAUSS + NAN), ValueError, "gauss", "not finite"),
        refused(lambda: fields.SphericalHarmonicField(GAUSS, chunk=0), ValueError, "chunk", "0"),
        refused(lambda: fields.SphericalHarmonicField(GAUSS, altitude_km=NAN), ValueError, "altitude_km", "nan"),
        refused(lambda: fields.SphericalHarmonicField(GAUSS, altitude_km=-200.0), ValueError, "altitude_km", "-200.0"),
        refused(lambda: fields.SphericalHarmonicField(5), TypeError, "gauss", "5"),
        refused(lambda: fields.SphericalHarmonicField(GAUSS, chunk=1.5), ValueError, "chunk", "1.5"),
        refused(lambda: fields.SphericalHarmonicField(GAUSS, altitude_km="a"), ValueError, "altitude_km", "'a'"),
        refused(lambda: fields.SphericalHarmonicField(GAUSS)(t(0.0), t(0.0), -200.0), ValueError, "altitude_km -200.0"),
        refused(lambda: fields.SphericalHarmonicField(GAUSS)(t(1j), t(0.0)), TypeError, "complex64"),
        *bad_places(fields.SphericalHarmonicField(GAUSS)),
    ],
    "fields.SphericalHarmonicField.value_and_gradient": bad_places(
        lambda *place: fields.SphericalHarmonicField(GAUSS).value_and_gradient(*place)
    ),
    "fields.IGRF": [
        refused(lambda: fields.IGRF("2031-01-01"), ValueError, "2031-01-01", "2030"),
        refused(lambda: fields.IGRF(2022.0, 12), ValueError, "12", "[13, 14]"),
        refused(lambda: fields.IGRF(2022.0, altitude_km=INF), ValueError, "altitude_km", "inf"),
        refused(lambda: fields.IGRF(2022.0, "13"), ValueError, "'13'", "[13, 14]"),
        *bad_places(lambda *place: igrf()(*place)),
    ],
    "fields.in_chunks": [refused(lambda: fields.in_chunks(torch.sin, [zeros(5)], 1, 0), ValueError, "chunk", "0")],
    "fields.elements_at": [
        refused(lambda: fields.elements_at(igrf(), zeros(4, 3)), ValueError, "(4, 3)"),
        refused(lambda: fields.elements_at(igrf(), t(-95.0, 0.0)), ValueError, "latitude -95.0"),
        refused(lambda: fields.elements_at(lambda latitude, _: latitude, zeros(4, 2)), ValueError, "b_ned", "(4,)"),
        Nan(lambda: fields.elements_at(box(), t(5.0, 165.0))),
    ],
    "fields.elements_range": [
        refused(lambda: fields.elements_range(igrf(), t(0.0, NAN)), ValueError, "longitude nan"),
        refused(lambda: fields.elements_range(igrf(), zeros(0, 2)), ValueError, "(0, 2)"),
        Nan(lambda: fields.elements_range(box(), torch.tensor([[5.0, 165.0], [-5.0, 165.0]]))),
    ],
    "fields.elements_gradient_at": [
        refused(lambda: fields.elements_gradient_at(igrf(), t(-95.0, 0.0)), ValueError, "latitude -95.0"),
        Nan(lambda: fields.elements_gradient_at(box(), t(5.0, 165.0))[1]),
    ],
    "fields.check_positions": [
        refused(lambda: fields.check_positions(t(0.0, 90.5), zeros(2)), ValueError, "latitude 90.5"),
        refused(lambda: fields.check_positions(t(NAN), zeros(1)), ValueError, "latitude nan"),
        refused(lambda: fields.check_positions(zeros(1), t(INF)), ValueError, "longitude inf"),
    ],
    "fields.check_box": [
        refused(lambda: fields.check_box(5, (0, 1)), ValueError, "5"),
        refused(lambda: fields.check_box((1, 1), (0, 1)), ValueError, "(1, 1)"),
        refused(lambda: fields.check_box((0, NAN), (0, 1)), ValueError, "(0, nan)"),
        refused(lambda: fields.check_box((0, 1), (170, -170)), ValueError, "(170, -170)", "(170, 190)"),
        refused(lambda: fields.check_box((0, 1), (0, INF)), ValueError, "(0, inf)"),
    ],
    "regional.RegionalField": [
        refused(lambda: regional.RegionalField(igrf(), (0, -1), (0, 1)), ValueError, "(0, -1)"),
        refused(lambda: regional.RegionalField(igrf(), (0, 1), (0, 1), degree=0), ValueError, "degree", "0"),
        refused(lambda: regional.RegionalField(igrf(), (0, 1), (0, 1), degree=1.5), ValueError, "degree", "1.5"),
        refused(lambda: box()(t(1j), t(0.0)), TypeError, "complex64"),
        refused(
            lambda: regional.RegionalField(igrf(), (0, 1), (0, 1), tolerance_nt=NAN), ValueError, "tolerance_nt", "nan"
        ),
        refused(lambda: regional.RegionalField(igrf(), (0, 60), (0, 90), degree=2), ValueError, "degree 2", "(0, 60)"),
        Nan(lambda: box()(t(5.0, NAN, -5.0), t(165.0, 165.0, INF))),
        refused(lambda: box()(meta(2), zeros(2)), RuntimeError, "meta"),
    ],
    "regional.RegionalField.value_and_gradient": [
        Nan(lambda: box().value_and_gradient(t(5.0, NAN, -5.0), t(165.0, 165.0, NAN))),
        refused(lambda: box().value_and_gradient(zeros(2), zeros(3)), RuntimeError, "(2)", "(3)"),
    ],
}

ROW = int64(2)
TASKS: dict[str, list[Refused | Nan]] = {
    "tasks.Region": [
        *(
            refused(lambda v=v: Region(v, (0, 1)), ValueError, "latitudes", repr(v))
            for v in (5, ("a", "b"), (0, 1, 2), (0, NAN), (1, 0), (0, 91))
        ),
        refused(lambda: Region((0, 1), (170, -170)), ValueError, "longitudes", "(170, -170)"),
    ],
    "tasks.Region.contains": [
        *bad_vectors(PAPER_REGION.contains, "position", 2),
    ],
    "tasks.Region.expanded": bad_numbers(PAPER_REGION.expanded, margin_deg=(-1.0, NAN, INF, "a", None)),
    "tasks.Region.unwrapped": [
        *bad_vectors(PAPER_REGION.unwrapped, "position", 2),
        Nan(lambda: PAPER_REGION.unwrapped(t(NAN, NAN))),
    ],
    "tasks.Region.holding": [
        *bad_vectors(PAPER_REGION.holding, "position", 2),
        refused(lambda: PAPER_REGION.holding(zeros(0, 2)), ValueError, "position", "size=(0, 2)"),
        refused(lambda: PAPER_REGION.holding(t(NAN, 165.0)), ValueError, "position", "nan"),
        refused(lambda: PAPER_REGION.holding(t(-91.0, 165.0)), ValueError, "-91"),
    ],
    "tasks.Region.grid": bad_numbers(PAPER_REGION.grid, points=(0, -1, 2.5, "a", True)),
    "tasks.Tasks": [refused(lambda: tasks.Tasks(zeros(2, 2)), TypeError, "target")],
    "tasks.counter_uniform": [
        refused(lambda: tasks.counter_uniform(1.5, int64(2, 1), 1), ValueError, "seed", "1.5"),
        refused(lambda: tasks.counter_uniform("a", int64(2, 1), 1), ValueError, "seed", "'a'"),
        refused(lambda: tasks.counter_uniform(0, zeros(2), 1), ValueError, "counters", "tensor([0., 0.])"),
        refused(lambda: tasks.counter_uniform(0, int64(), 1), ValueError, "counters", "tensor(0)"),
        refused(lambda: tasks.counter_uniform(0, [0], 1), ValueError, "counters", "[0]"),
        refused(lambda: tasks.counter_uniform(0, int64(2), 0), ValueError, "draws", "0"),
    ],
    "tasks.check_distance_range": [
        refused(lambda: tasks.check_distance_range(None, (1, 2)), TypeError, "region", "None"),
        *(
            refused(lambda v=v: tasks.check_distance_range(PAPER_REGION, v), ValueError, "distance_range_km", repr(v))
            for v in (5, (1,), (2, 1), (-1, 1), (0, NAN), (0, INF), ("a", "b"), "ab", (5000, 6000))
        ),
    ],
    "tasks.sample_tasks": [
        refused(lambda: tasks.sample_tasks(PAPER_REGION, (500, 300), 0, ROW, ROW), ValueError, "(500, 300)"),
        refused(lambda: tasks.sample_tasks(PAPER_REGION, (300, 500), 1.5, ROW, ROW), ValueError, "seed", "1.5"),
        refused(
            lambda: tasks.sample_tasks(PAPER_REGION, (300, 500), 0, zeros(2), ROW), ValueError, "vehicle", "0., 0."
        ),
        refused(
            lambda: tasks.sample_tasks(PAPER_REGION, (300, 500), 0, ROW, int64(3)), ValueError, "episode", "0, 0, 0"
        ),
        refused(lambda: tasks.sample_tasks(PAPER_REGION, (300, 500), 0, int64(), int64()), ValueError, "tensor(0)"),
        refused(lambda: tasks.sample_tasks(PAPER_REGION, (300, 500), 0, 3, 4), TypeError, "vehicle", "int 3"),
    ],
    "tasks.task_set": [
        *bad_numbers(lambda num_tasks: tasks.task_set(num_tasks, 0), num_tasks=(0, 1.5, "a", True)),
        *bad_numbers(lambda seed: tasks.task_set(1, seed), seed=(1.5, "a", None)),
    ],
    "tasks.named_tasks": [
        refused(lambda: tasks.named_tasks("paper"), ValueError, "'paper'", "paper-100"),
        refused(lambda: tasks.named_tasks(5), ValueError, "5"),
    ],
    "tasks.check_tasks": [
        refused(lambda: tasks.check_tasks(5, PAPER_REGION), ValueError, "5"),
        refused(lambda: tasks.check_tasks("ab", PAPER_REGION), ValueError, "'ab'"),
        refused(lambda: tasks.check_tasks((zeros(0, 2), zeros(0, 2)), PAPER_REGION), ValueError, "(0, 2)"),
        refused(lambda: tasks.check_tasks((zeros(2, 2), zeros(2, 3)), PAPER_REGION), ValueError, "(2, 3)"),
        refused(lambda: tasks.check_tasks((zeros(1, 2), zeros(1, 2)), PAPER_REGION), ValueError, "start of task 0"),
        refused(lambda: tasks.check_tasks((zeros(1, 2) + NAN,) * 2, PAPER_REGION), ValueError, "latitude nan"),
        refused(lambda: tasks.check_tasks((zeros(1, 2),) * 2, None), TypeError, "within", "None"),
    ],
}


def stepped(action: Tensor) -> object:
    return nav().step(nav().reset().set("action", action))


ENV: dict[str, list[Refused | Nan]] = {
    "env.flown_box": [
        refused(lambda: env.flown_box(None, 5, 50), TypeError, "region", "None"),
        *bad_numbers(lambda margin_deg: env.flown_box(PAPER_REGION, margin_deg, 50), margin_deg=(-1.0, NAN, "a")),
        *bad_numbers(lambda max_move_km: env.flown_box(PAPER_REGION, 5, max_move_km), max_move_km=(-1.0, INF, "a")),
    ],
    "env.paper_field": [
        refused(lambda: env.paper_field(5), TypeError, "region", "5"),
        refused(lambda: env.paper_field(margin_deg="a"), ValueError, "margin_deg", "'a'"),
        refused(lambda: env.paper_field(date="May"), ValueError, "'May'"),
        refused(lambda: env.paper_field(generation=12), ValueError, "12"),
        refused(lambda: env.paper_field(altitude_km=NAN), ValueError, "altitude_km", "nan"),
        refused(lambda: env.paper_field(margin_deg=90.0), ValueError, "(-90.0, 90.0)"),
    ],
    "env.GeomagneticNavEnv": [
        *bad_numbers(
            env.GeomagneticNavEnv,
            max_steps=("a",),
            max_move_km=("a", None),
            max_turn_rad=(INF, "a"),
            zeta=("a", None, t(0.01)),
            start_heading=([],),
            objective_floors=(5, None, "abc", ("a", 1, 2)),
            destination_weight=("a",),
            proximity_weight=("a",),
            margin_deg=("a",),
            distance_range_km=(5, (1,), ("a", "b"), "ab"),
            seed=(1.5, -1, "a", NAN, True, 2**64),
            tasks=(5, "ab"),
        ),
        refused(lambda: env.GeomagneticNavEnv(region=((0, 1), (0, 1))), TypeError, "region", "((0, 1), (0, 1))"),
        refused(lambda: env.GeomagneticNavEnv(field="IGRF"), TypeError, "field", "'IGRF'"),
        refused(lambda: env.GeomagneticNavEnv(field=lambda latitude, _: latitude), ValueError, "(81, 81)"),
        refused(lambda: env.GeomagneticNavEnv(device="nowhere"), RuntimeError, "nowhere"),
        refused(lambda: nav().set_seed(None), ValueError, "seed", "None"),
        refused(lambda: stepped(torch.tensor([[1.0, 0.0], [NAN, 0.0]])), ValueError, "vehicles [1]", "nan"),
        refused(lambda: stepped(torch.tensor([[1.0, 0.0], [51.0, 0.0]])), ValueError, "vehicles [1]", "51.0"),
        refused(lambda: stepped(zeros(2, 3)), RuntimeError, "(3)", "(2)"),
    ],
    "env.GeomagneticNavEnv.track": [
        refused(lambda: env.GeomagneticNavEnv(seed=0).track(0), RuntimeError, "reset()"),
        refused(lambda: nav().track(2), IndexError, "vehicle 2"),
        *bad_numbers(lambda vehicle: nav().track(vehicle), vehicle=("a", 0.5, None)),
    ],
    "env.GeomagneticNavEnv.render": [
        refused(lambda: nav().render([5]), IndexError, "vehicle 5"),
        refused(lambda: nav().render([]), ValueError, "path", "0"),
        refused(lambda: nav().render([0], size_px=0), ValueError, "size_px", "0"),
    ],
}

PAIR = ["here", "there"]
TRANSFORMS: dict[str, list[Refused | Nan]] = {
    "transforms.base.sorted_keys": [refused(lambda: keys.sorted_keys(5), TypeError, "container", "5")],
    "transforms.base.key_list": [
        refused(lambda: keys.key_list(5), TypeError, "5"),
        refused(lambda: keys.key_list(["a", 5]), TypeError, "['a', 5]"),
        refused(lambda: keys.key_list(None), TypeError, "None"),
    ],
    "transforms.base.several_keys": [
        refused(lambda: keys.several_keys("here"), TypeError, "'here'"),
        refused(lambda: keys.several_keys(5), TypeError, "5"),
    ],
    "transforms.base.expect_keys": [
        refused(lambda: keys.expect_keys(AngleVector("a", "b"), 2, 1), ValueError, "AngleVector", "2", "['a']"),
        refused(lambda: keys.expect_keys(None, 1, 1), TypeError, "transform", "None"),
    ],
    "transforms.observation.AngleVector": [
        refused(lambda: AngleVector(5, "b"), TypeError, "5"),
        refused(lambda: AngleVector(["a", "b"], "c"), ValueError, "['a', 'b']", "['c']"),
        refused(lambda: AngleVector("a", "b")(TensorDict(c=zeros(1))), KeyError, "['a']", "['c']"),
        Nan(lambda: AngleVector("a", "b")(TensorDict(a=t(NAN)))["b"]),
    ],
    "transforms.observation.TargetDifference": [
        refused(lambda: TargetDifference("ab"), TypeError, "'ab'"),
        refused(lambda: TargetDifference(["a"]), ValueError, "['a']"),
        refused(lambda: TargetDifference(PAIR)(TensorDict(here=zeros(2), there=zeros(3))), RuntimeError, "(3)", "(2)"),
        Nan(lambda: TargetDifference(PAIR)(TensorDict(here=t(NAN), there=t(0.0)))["field_difference"]),
    ],
    "transforms.observation.FieldGradient": [
        refused(lambda: FieldGradient("IGRF"), ValueError, "value_and_gradient", "str"),
        refused(lambda: FieldGradient(torch.sum)(TensorDict(position=zeros(2))), ValueError, "values (E,), got ()"),
        refused(lambda: FieldGradient(torch.sin)(TensorDict(position=zeros(3))), ValueError, "position", "(3,)"),
        refused(lambda: FieldGradient(igrf(), ["a", "b"]), ValueError, "['a', 'b']"),
        refused(lambda: FieldGradient(igrf())(TensorDict(position=t(-95.0, 0.0))), ValueError, "-95.0"),
    ],
    "transforms.observation.GradientHeading": [
        *bad_numbers(GradientHeading, min_crossing_deg=(-1.0, 90.0, NAN, "a")),
        *bad_numbers(GradientHeading, pair=(5, "DI", ("D", 0), ("D", -1), ("D", 0.5))),
        refused(lambda: GradientHeading(pair=("D", "Z")), ValueError, "'Z'"),
        refused(lambda: GradientHeading("abc"), TypeError, "'abc'"),
    ],
    "transforms.reward.AlignmentReward": [
        *bad_numbers(AlignmentReward, weight=(NAN, INF, "a", None), offset=(NAN, "a")),
        refused(lambda: AlignmentReward("angle"), TypeError, "'angle'"),
        refused(lambda: AlignmentReward(["a"]), ValueError, "['a']"),
        refused(lambda: AlignmentReward(PAIR)(TensorDict(here=zeros(1))), KeyError, "next"),
    ],
    "transforms.reward.AlignmentReward.term": [
        refused(lambda: AlignmentReward(PAIR).term(TensorDict(), TensorDict(here=zeros(1))), KeyError, "there"),
        Nan(lambda: AlignmentReward(PAIR).term(TensorDict(there=t(NAN)), TensorDict(here=zeros(1)))),
    ],
    "transforms.scaling.MinMaxNorm": [
        *bad_numbers(MinMaxNorm, interval=(5, (1.0,), (1.0, 1.0), (0.0, NAN), ("a", "b")), bounds=(5, "ab")),
        refused(lambda: MinMaxNorm(5), TypeError, "5"),
        refused(lambda: MinMaxNorm(["x"], bounds={"x": 5}), ValueError, "'x'", "5"),
        refused(lambda: MinMaxNorm(["x"], bounds={"x": (1.0, 1.0)}), ValueError, "'x'", "1.0"),
        refused(lambda: MinMaxNorm(["x"], bounds={"x": (0.0, NAN)}), ValueError, "'x'", "nan"),
        refused(lambda: MinMaxNorm(["x"], bounds={"y": (0.0, 1.0)}), ValueError, "'y'", "['x']"),
    ],
    "transforms.scaling.MinMaxNorm.normalize": [
        refused(lambda: MinMaxNorm(["x"]).normalize("x", zeros(1)), RuntimeError, "'x'"),
        refused(lambda: MinMaxNorm(["x"]).normalize("y", zeros(1)), KeyError, "'y'", "['x']"),
        Nan(lambda: MinMaxNorm(["x"], bounds={"x": (0.0, 1.0)}).normalize("x", t(NAN))),
    ],
    "transforms.scaling.MinMaxNorm.denormalize": [
        refused(lambda: MinMaxNorm(["x"]).denormalize("y", zeros(1)), KeyError, "'y'", "['x']"),
        refused(
            lambda: MinMaxNorm(["x"], bounds={"x": (zeros(2), torch.ones(2))}).denormalize("x", zeros(3)),
            RuntimeError,
            "(2)",
            "(3)",
        ),
        Nan(lambda: MinMaxNorm(["x"], bounds={"x": (0.0, 1.0)}).denormalize("x", t(NAN))),
    ],
}

BOUNDS = {"max_move_km": (0.0, NAN, "a", None), "max_turn_rad": (0.0, 4.0, NAN, "a")}
POLICIES: dict[str, list[Refused | Nan]] = {
    "navigators.steer": [
        *bad_tensors(lambda *x: navigators.steer(*x, 50.0, 1.5), "heading", "wanted", "distance_km"),
        *unequal(lambda *x: navigators.steer(*x, 50.0, 1.5), 3),
        *(
            refused(lambda v=v: navigators.steer(*[zeros(1)] * 3, v, 1.5), ValueError, "max_move_km", repr(v))
            for v in (-5.0, NAN, "a")
        ),
        Nan(lambda: navigators.steer(t(NAN, 0.0), t(0.0, NAN), zeros(2), 50.0, 1.5)[1]),
        Nan(lambda: navigators.steer(t(0.0), t(0.0), t(NAN), 50.0, 1.5)[0]),
    ],
    "navigators.displacement_to": [
        *bad_tensors(lambda x: navigators.displacement_to(x, zeros(1, 2)), "error"),
        refused(lambda: navigators.displacement_to(zeros(2), zeros(3, 2)), ValueError, "jacobian", "(3, 2)"),
        refused(lambda: navigators.displacement_to(zeros(2), zeros(2, 3)), ValueError, "jacobian", "(2, 3)"),
        Nan(lambda: navigators.displacement_to(t(NAN, 0.0), torch.eye(2))),
        Nan(lambda: navigators.displacement_to(t(0.0, 0.0), torch.eye(2) * NAN)),
    ],
    "navigators.broyden_update": [
        *bad_vectors(lambda x: navigators.broyden_update(zeros(1, 2), x, zeros(1)), "displacement", 2),
        refused(lambda: navigators.broyden_update(zeros(1, 2), zeros(2), zeros(2)), ValueError, "jacobian", "(1, 2)"),
        Nan(lambda: navigators.broyden_update(zeros(1, 2), t(NAN, 0.0), zeros(1))),
        Nan(lambda: navigators.broyden_update(zeros(1, 2), torch.ones(2), t(NAN))),
    ],
    "navigators.element_indices": [
        refused(lambda: navigators.element_indices("DI", 2), ValueError, "'DI'"),
        refused(lambda: navigators.element_indices(5, 2), ValueError, "5"),
        refused(lambda: navigators.element_indices(["D"], 2), ValueError, "('D',)"),
        refused(lambda: navigators.element_indices(["D", "Z"], 2), ValueError, "'Z'"),
    ],
    "navigators.project": [
        *bad_vectors(lambda x: navigators.project(x, zeros(2)), "vector", 2),
        Nan(lambda: navigators.project(t(NAN, 0.0), torch.ones(2))),
        Nan(lambda: navigators.project(torch.ones(2), t(NAN, 0.0))),
    ],
    "navigators.Navigator": bad_numbers(
        lambda **options: navigators.Navigator(**({"max_move_km": 50.0, "max_turn_rad": 1.5} | options)), **BOUNDS
    ),
    "navigators.ParallelApproach": [
        *bad_numbers(lambda **options: navigators.ParallelApproach(igrf(), **options), **BOUNDS),
        *bad_numbers(navigators.ParallelApproach, field=("IGRF", None)),
        refused(lambda: navigators.ParallelApproach(igrf(), pair="DI"), ValueError, "'DI'"),
        refused(lambda: navigators.ParallelApproach(igrf(), pair=("D",)), ValueError, "('D',)"),
        refused(lambda: navigators.ParallelApproach(igrf())(TensorDict(field=zeros(2, 3))), KeyError, "target_field"),
    ],
    "navigators.Secant": [
        *bad_numbers(navigators.Secant, **BOUNDS, probe_km=(0.0, 60.0, NAN, "a")),
        refused(lambda: navigators.Secant(elements=("D", "D")), ValueError, "('D', 'D')"),
    ],
    "metaheuristics.build": [
        refused(lambda: metaheuristics.build("ants", nav(), "flown", 0), ValueError, "'ants'", "ga"),
        refused(lambda: metaheuristics.build("ga", nav(), "dreamt", 0), ValueError, "'dreamt'"),
        refused(lambda: metaheuristics.build("ga", None, "flown", 0), TypeError, "env", "None"),
        refused(lambda: metaheuristics.build("ga", nav(), "flown", 1.5), ValueError, "seed", "1.5"),
        refused(lambda: metaheuristics.build("ga", nav(), "flown", 0, wings=2), TypeError, "wings"),
    ],
    "metaheuristics.base.reachable": [
        *bad_vectors(lambda x: base.reachable(x, zeros(), 1.5), "candidate", 2),
        refused(lambda: base.reachable(zeros(2), zeros(), -1.0), ValueError, "max_turn_rad", "-1.0"),
        Nan(lambda: base.reachable(t(NAN, 0.0), zeros(), 1.5)),
    ],
    "metaheuristics.base.displacement": [
        *bad_tensors(base.displacement, "distance", "heading"),
        *unequal(base.displacement, 2),
        Nan(lambda: base.displacement(t(NAN, 1.0), t(0.0, NAN))),
    ],
    "metaheuristics.base.take": [
        refused(lambda: base.take(zeros(2, 3), zeros(2, 1)), IndexError, "long"),
        refused(lambda: base.take(zeros(2, 3), int64(3, 1)), ValueError, "(2, K)", "(3, 1)"),
        refused(lambda: base.take(zeros(2, 3), int64(2, 1) + 5), IndexError, "5"),
        refused(lambda: base.take(zeros(2, 3), 5), TypeError, "index", "int 5"),
    ],
    "metaheuristics.base.in_disc": [
        *bad_vectors(base.in_disc, "candidate", 2),
        Nan(lambda: base.in_disc(t(NAN, 1.0))),
    ],
    "metaheuristics.base.checked": [
        *(
            refused(lambda v=v: base.checked("share", v, 0, 1), ValueError, "share", repr(v))
            for v in (2, -1, NAN, "a", True)
        ),
        refused(lambda: base.checked("size", 2.5, 0, 10, whole=True), ValueError, "size", "2.5"),
    ],
    "metaheuristics.base.Metaheuristic": [
        *bad_numbers(
            lambda **options: base.Metaheuristic(**({"mode": "flown"} | options)),
            **BOUNDS,
            mode=("dreamt", None),
            population_size=(1, 2.5, "a"),
            generations=(0, 1.5, "a"),
            spread=(0.0, 2.0, NAN, "a"),
            objective_floors=(5, (1, 2), (1, 2, 0.0), (1, 2, NAN)),
            seed=(1.5, "a", None),
        ),
        refused(lambda: base.Metaheuristic(mode="look-ahead"), ValueError, "None", "look-ahead"),
        refused(lambda: base.Metaheuristic(mode="look-ahead", field="IGRF"), TypeError, "field", "'IGRF'"),
    ],
    "metaheuristics.fish_swarm.ArtificialFishSwarm": bad_numbers(
        lambda **options: metaheuristics.ArtificialFishSwarm(mode="flown", **options),
        visual=(0.0, NAN, "a"),
        step=(0.0, 11.0, "a"),
        crowding=(-0.1, 1.1, "a"),
        tries=(0, 1.5, "a"),
    ),
    "metaheuristics.genetic.GeneticAlgorithm": bad_numbers(
        lambda **options: metaheuristics.GeneticAlgorithm(mode="flown", **options),
        tournament_size=(0, 1.5, "a"),
        crossover_rate=(-0.1, 1.1, NAN, "a"),
        blend=(-1.0, "a"),
        mutation_rate=(1.5, "a"),
        mutation_scale=(-1.0, INF, "a"),
        elites=(-1, 8, 0.5, "a"),
    ),
    "metaheuristics.particle_swarm.ParticleSwarm": bad_numbers(
        lambda **options: metaheuristics.ParticleSwarm(mode="flown", **options),
        inertia=(-0.1, 3.0, "a"),
        cognitive=(-1.0, NAN, "a"),
        social=(11.0, "a"),
        max_velocity=(0.0, INF, "a"),
    ),
}


def without(name: str) -> dict[str, Tensor]:
    return {key: value for key, value in metrics.episode_measures(flight()).items() if key != name}


METRICS: dict[str, list[Refused | Nan]] = {
    "metrics.flown": [
        refused(lambda: metrics.flown(5), TypeError, "done", "5"),
        refused(lambda: metrics.flown(zeros(2, 3)), ValueError, "float32", "(2, 3)"),
        refused(lambda: metrics.flown(zeros(2).bool()), ValueError, "(2,)"),
        refused(lambda: metrics.flown(zeros(2, 3, 4).bool()), ValueError, "(2, 3, 4)"),
    ],
    "metrics.episode_measures": [
        refused(lambda: metrics.episode_measures(5), TypeError, "rollout", "5"),
        refused(lambda: metrics.episode_measures(flight()[0]), ValueError, "(2,)"),
        refused(lambda: metrics.episode_measures(flight()[:0]), ValueError, "(0, 2)"),
        refused(lambda: metrics.episode_measures(flight().exclude("next")), KeyError, "next"),
    ],
    "metrics.summarise": [
        refused(lambda: metrics.summarise({"success": zeros(0).bool()}), ValueError, "M >= 1", "tensor([]"),
        refused(lambda: metrics.summarise({"success": zeros(2)}), ValueError, "tensor([0., 0.])"),
        refused(lambda: metrics.summarise({}), KeyError, "success"),
        refused(lambda: metrics.summarise(without("spl")), KeyError, "spl"),
    ],
    "metrics.bootstrap_interval": [
        *bad_tensors(metrics.bootstrap_interval, "values"),
        refused(lambda: metrics.bootstrap_interval(zeros(0)), ValueError, "(0,)"),
        refused(lambda: metrics.bootstrap_interval(zeros(2, 3)), ValueError, "(2, 3)"),
        *bad_numbers(lambda **o: metrics.bootstrap_interval(zeros(2), **o), resamples=(0, 1.5), seed=(1.5, "a")),
        Nan(lambda: metrics.bootstrap_interval(t(NAN, NAN))),
    ],
    "metrics.wilson_interval": bad_numbers(
        lambda **options: metrics.wilson_interval(**({"rate": 0.5, "count": 10} | options)),
        rate=(-0.1, 1.1, NAN, "a"),
        count=(0, 1.5, "a"),
        z=(0.0, -1.0, NAN),
    ),
    "metrics.TrainingTally": bad_numbers(
        lambda **options: metrics.TrainingTally(**({"destination_weight": 200.0, "reward_scale": 1.0} | options)),
        destination_weight=(-1.0, NAN, "a"),
        reward_scale=(0.0, NAN, "a"),
        window=(0, 1.5, "a"),
    ),
    "metrics.TrainingTally.load_state_dict": [
        refused(lambda: metrics.TrainingTally(200.0, 1.0).load_state_dict({}), KeyError, "frames")
    ],
    "metrics.TrainingTally.add": [
        refused(lambda: metrics.TrainingTally(200.0, 1.0).add(flight(), None), KeyError, "episode_reward"),
    ],
}

UNKNOWN = {"nobody": {}}
PLOTS: dict[str, list[Refused | Nan]] = {
    "plots.rgb_array": [
        *bad_numbers(lambda size_px: plots.rgb_array(lambda _: None, size_px), size_px=(0, -1, 1.5, "a")),
        refused(lambda: plots.rgb_array(5, 10), TypeError, "int"),
    ],
    "plots.contour_lines": [
        refused(lambda: plots.contour_lines(5, igrf(), PAPER_REGION), TypeError, "axes", "5"),
        refused(lambda: plots.contour_lines(axes(), igrf(), 5), TypeError, "region", "5"),
        refused(lambda: plots.contour_lines(axes(), "IGRF", PAPER_REGION), TypeError, "str"),
    ],
    "plots.draw_contours": [
        refused(lambda: plots.draw_contours(5, igrf(), PAPER_REGION), TypeError, "axes", "5"),
        refused(lambda: plots.draw_contours(axes(), igrf(), 5), TypeError, "region", "5"),
        refused(lambda: plots.draw_contours(axes(), "IGRF", PAPER_REGION), TypeError, "str"),
    ],
    "plots.draw_journeys": [
        refused(lambda: plots.draw_journeys(axes(), igrf(), 5, [zeros(2, 2)], zeros(1, 2)), TypeError, "region", "5"),
        refused(lambda: plots.draw_journeys(axes(), igrf(), PAPER_REGION, [], zeros(0, 2)), ValueError, "(0, 2)"),
        refused(
            lambda: plots.draw_journeys(axes(), igrf(), PAPER_REGION, [zeros(2, 2)], zeros(3, 2)),
            ValueError,
            "1",
            "(3, 2)",
        ),
    ],
    "plots.training_figure": [
        refused(lambda: plots.training_figure([]), ValueError, "frames", "[]"),
        refused(lambda: plots.training_figure([{"return": 1.0}]), ValueError, "frames", "{'return': 1.0}"),
    ],
    "plots.trajectories_figure": [
        refused(lambda: plots.trajectories_figure(5, igrf(), PAPER_REGION), TypeError, "rollout", "5"),
        refused(lambda: plots.trajectories_figure(flight(), igrf(), PAPER_REGION, 0), ValueError, "journeys", "0"),
    ],
    "plots.learning_curves": [
        refused(lambda: plots.learning_curves(UNKNOWN, "SPL"), ValueError, "['nobody']", "secant"),
        refused(lambda: plots.learning_curves({"ga": []}, "SPL", 1), ValueError, "points", "1"),
    ],
    "plots.compared_trajectories": [
        refused(lambda: plots.compared_trajectories(UNKNOWN, igrf(), tasks.task_set(1, 0)), ValueError, "['nobody']"),
        refused(lambda: plots.compared_trajectories({"ga": ([0.0], [0.0])}, igrf(), 5), TypeError, "task", "5"),
    ],
    "plots.convergence": [
        refused(lambda: plots.convergence(UNKNOWN, igrf(), tasks.task_set(1, 0)), ValueError, "['nobody']"),
        refused(lambda: plots.convergence({"ga": {}}, igrf(), 5), TypeError, "task", "5"),
        refused(lambda: plots.convergence({"ga": {}}, igrf(), tasks.task_set(1, 0)), KeyError, "D"),
    ],
    "plots.box_plots": [
        refused(lambda: plots.box_plots(UNKNOWN), ValueError, "['nobody']"),
        refused(lambda: plots.box_plots({}), ValueError, "{}"),
        refused(lambda: plots.box_plots({"ga": {}}), KeyError, "heading_mae_deg"),
    ],
}

NO_CONFIG = {
    name: [refused(lambda f=f: f(5), TypeError, "config", "5")]
    for name, f in {
        "td3.observation_transforms": td3.observation_transforms,
        "td3.action_transform": td3.action_transform,
        "td3.observation_size": td3.observation_size,
        "td3.make_actor": td3.make_actor,
        "td3.make_critic": td3.make_critic,
        "td3.FieldPolicy": td3.FieldPolicy,
    }.items()
}


def replay_data(rollouts: Any = None, **options: Any) -> object:
    sound = {"field": igrf(), "region": PAPER_REGION, "zeta": 0.01}
    return replay.replay_data({"random": flight()} if rollouts is None else rollouts, **(sound | options))


def write_gif(rollout: Any = None, region: Any = PAPER_REGION, **options: Any) -> object:
    return replay.write_gif(folder() / "a.gif", flight() if rollout is None else rollout, igrf(), region, **options)


REPLAY: dict[str, list[Refused | Nan]] = {
    "replay.replay_data": [
        *bad_numbers(replay_data, zeta=(0.0, -1.0, NAN, "a")),
        refused(lambda: replay_data(5), TypeError, "rollouts", "5"),
        refused(lambda: replay_data({}), ValueError, "rollouts", "{}"),
        refused(lambda: replay_data({"mine": 5}), TypeError, "'mine'", "5"),
        refused(lambda: replay_data({"mine": flight()[0]}), ValueError, "(2,)"),
        refused(lambda: replay_data({"mine": flight().exclude("next")}), KeyError, "next"),
        refused(lambda: replay_data(region=5), TypeError, "region", "5"),
        refused(lambda: replay_data(field="IGRF"), TypeError, "str"),
        refused(lambda: replay_data(title=5), TypeError, "title", "5"),
    ],
    "replay.journey_tracks": [
        refused(lambda: replay.journey_tracks(5, PAPER_REGION), TypeError, "rollout", "5"),
        refused(lambda: replay.journey_tracks(flight(), 5), TypeError, "region", "5"),
        refused(lambda: replay.journey_tracks(flight()[0], PAPER_REGION), ValueError, "(2,)"),
    ],
    "replay.write_replay": [
        refused(lambda: replay.write_replay(5, {}), TypeError, "path", "5"),
        refused(lambda: replay.write_replay(folder() / "a.html", 5), TypeError, "data", "5"),
        refused(lambda: replay.write_replay(folder() / "a.html", {"title": ""}), KeyError, "contours", "navigators"),
        refused(lambda: replay.write_replay("nowhere/a.html", replay_data()), FileNotFoundError, "nowhere/a.html"),
    ],
    "replay.write_gif": [
        *bad_numbers(write_gif, frames_per_step=(0, 1.5, "a"), size_px=(0, -1, "a")),
        refused(lambda: write_gif(5), TypeError, "rollout", "5"),
        refused(lambda: write_gif(flight()[0]), ValueError, "(2,)"),
        refused(lambda: write_gif(region=5), TypeError, "region", "5"),
        refused(lambda: replay.write_gif(5, flight(), igrf(), PAPER_REGION), TypeError, "path", "5"),
    ],
}


def loss(**options: float) -> object:
    sound = {"gamma": 0.99, "policy_noise": 0.2, "noise_clip": 0.5}
    return td3.make_loss(td3.make_actor(config()), td3.make_critic(config()), **(sound | options))


TD3: dict[str, list[Refused | Nan]] = NO_CONFIG | {
    "td3.PolicyConfig": [
        *bad_numbers(
            config,
            num_cells=((), (1.5,), (0,)),
            layer_norm=("a", 1),
            observe_heading=(None,),
            observe_difference=("no",),
            field_low=(5, (1.0, 2.0), (NAN, 0.0, 0.0), (99.0, -50.0, 3e4)),
            field_high=("abc", (0.0, 0.0, INF)),
            max_move_km=(0.0, -50.0, NAN, "a"),
            max_turn_rad=(0.0, 4.0, "a"),
        ),
    ],
    "td3.policy_config": [
        refused(lambda: td3.policy_config(5, (8,), layer_norm=True), TypeError, "env", "5"),
        refused(lambda: td3.policy_config(nav(), (0,), layer_norm=True), ValueError, "num_cells", "(0,)"),
    ],
    "td3.guidance_transforms": [
        refused(lambda: td3.guidance_transforms(5, 3.0, 0.0), TypeError, "env", "5"),
        refused(lambda: td3.guidance_transforms(nav(), NAN, 0.0), ValueError, "weight", "nan"),
    ],
    "td3.make_loss": [
        *bad_numbers(loss, gamma=(-0.1, 1.1, NAN, "a"), policy_noise=(-1.0, NAN), noise_clip=(-1.0, INF, "a")),
        refused(lambda: td3.make_loss(5, 5, gamma=0.9, policy_noise=0.0, noise_clip=0.0), TypeError, "actor", "5"),
    ],
    "td3.LeanTD3Loss": [
        refused(lambda: loss().actor_loss(TensorDict()), KeyError, "observation"),
        refused(lambda: loss().actor_loss(TensorDict(observation=zeros(2, 5))), RuntimeError, "2x5", "13x8"),
    ],
    "td3.LeanSoftUpdate": [
        refused(lambda: td3.LeanSoftUpdate(5, tau=0.1), ValueError, "loss_module"),
        refused(lambda: td3.LeanSoftUpdate(loss(), tau=2.0), ValueError, "eps = -1.0"),
    ],
    "td3.saturation_penalty": [
        *bad_tensors(td3.saturation_penalty, "logits"),
        Nan(lambda: td3.saturation_penalty(t(0.0, NAN))),
    ],
    "td3.save_policy": [refused(lambda: td3.save_policy(folder() / "policy.pt", 5), TypeError, "policy", "5")],
    "td3.load_policy": [
        refused(lambda: td3.load_policy("nowhere.pt"), FileNotFoundError, "nowhere.pt"),
        refused(lambda: td3.load_policy(5), TypeError, "int"),
        refused(lambda: td3.load_policy(written([1])), ValueError, "content.pt"),
    ],
    "td3.evaluation_rollout": [
        refused(lambda: td3.evaluation_rollout(5, None), TypeError, "env", "5"),
        refused(lambda: td3.evaluation_rollout(nav(), 5), TypeError, "policy", "5"),
    ],
}


@cache
def memory() -> Any:
    return recurrent.make_actor(config(), 4)


@cache
def recurrent_loss() -> Any:
    return recurrent.make_loss(memory(), recurrent.make_critic(config()), gamma=0.9, policy_noise=0.2, noise_clip=0.5)


RECURRENT: dict[str, list[Refused | Nan]] = {
    "recurrent.LastMove": [
        refused(lambda: recurrent.LastMove(1.5)(5), TypeError, "int"),
        Nan(lambda: recurrent.LastMove(1.5)(zeros(8) + NAN)),
    ],
    "recurrent.observation_transforms": [refused(lambda: recurrent.observation_transforms(5), TypeError, "dataclass")],
    "recurrent.training_transforms": [
        refused(lambda: recurrent.training_transforms(5, memory()), TypeError, "dataclass")
    ],
    "recurrent.make_actor": [
        refused(lambda: recurrent.make_actor(config(), 0), ValueError, "memory_size", "0"),
        refused(lambda: recurrent.make_actor(5, 4), TypeError, "dataclass"),
    ],
    "recurrent.make_critic": [refused(lambda: recurrent.make_critic(5), TypeError, "dataclass")],
    "recurrent.make_loss": [
        refused(lambda: recurrent.make_loss(5, 5, gamma=0.9, policy_noise=0.2, noise_clip=0.5), AttributeError, "int")
    ],
    "recurrent.parameter_groups": [refused(lambda: recurrent.parameter_groups(5), AttributeError, "int")],
    "recurrent.value_loss": [
        refused(lambda: recurrent.value_loss(recurrent_loss(), TensorDict()), KeyError, "is_init")
    ],
    "recurrent.actor_losses": [
        refused(lambda: recurrent.actor_losses(recurrent_loss(), TensorDict()), KeyError, "observation")
    ],
    "recurrent.RecurrentPolicy": [
        refused(lambda: recurrent.RecurrentPolicy(config(), 0), ValueError, "memory_size", "0"),
        refused(lambda: recurrent.RecurrentPolicy(5, 4), TypeError, "dataclass"),
    ],
    "recurrent.save_policy": [refused(lambda: recurrent.save_policy(folder() / "p.pt", 5), AttributeError, "int")],
    "recurrent.load_policy": [
        refused(lambda: recurrent.load_policy("nowhere.pt"), FileNotFoundError, "nowhere.pt"),
        refused(lambda: recurrent.load_policy(written([1])), ValueError, "content.pt"),
    ],
}


def place(*positions: object) -> list[export.Flight]:
    """A journey through some places."""
    return [export.Flight("a", positions, {})]


EXPORT: dict[str, list[Refused | Nan]] = {
    "export.Flight": [refused(lambda: export.Flight("a", []), TypeError, "properties")],
    "export.flights": [
        refused(lambda: export.flights(5, []), TypeError, "rollout", "5"),
        refused(lambda: export.flights(flight(), ["one"]), ValueError, "2 journeys", "1 names"),
    ],
    **{
        f"export.{name}": [
            refused(lambda f=function: f(place((0, 0))), ValueError, "two places", "(0, 0)"),
            refused(lambda f=function: f(place((0, 0), (91, 0))), ValueError, "position", "(91, 0)"),
            refused(lambda f=function: f(place((0, 0), (NAN, 0))), ValueError, "position", "nan"),
            refused(lambda f=function: f(place((0, 0), "ab")), ValueError, "position", "'ab'"),
        ]
        for name, function in (("to_geojson", export.to_geojson), ("to_gpx", export.to_gpx), ("to_kml", export.to_kml))
    },
    "export.cut": [refused(lambda: export.cut([(0, 0), (0, 181)]), ValueError, "position", "(0, 181)")],
    "export.check_suffix": [
        refused(lambda: export.check_suffix("a.shp"), ValueError, "'a.shp'", ".geojson, .gpx, .kml"),
        refused(lambda: export.check_suffix(5), TypeError, "path", "5"),
    ],
    "export.write_flights": [refused(lambda: export.write_flights("a.shp", []), ValueError, "'a.shp'")],
}

WORLDS: dict[str, list[Refused | Nan]] = {
    "worlds.World": [
        refused(lambda: worlds.World(5), TypeError, "region", "5"),
        refused(lambda: worlds.World(distance_range_km=(5, 4)), ValueError, "distance_range_km", "(5, 4)"),
        refused(lambda: worlds.World(date="May"), ValueError, "'May'"),
        refused(lambda: worlds.World(generation=12), ValueError, "12"),
        *bad_numbers(worlds.World, altitude_km=(-1.0, NAN, 601.0, "a")),
        refused(lambda: worlds.World(tasks=tasks.Tasks(zeros(1, 2), zeros(1, 2) + 50)), ValueError, "[0.0, 0.0]"),
        refused(lambda: worlds.World(names=("a",)), ValueError, "('a',)"),
    ],
    "worlds.World.random_tasks": [refused(lambda: worlds.World().random_tasks(0, 1), ValueError, "num_tasks", "0")],
    "worlds.floors_of": [refused(lambda: worlds.floors_of(nav().field, 5), TypeError, "region", "5")],
    "worlds.load_world": [
        refused(lambda: worlds.load_world(5), TypeError, "path", "5"),
        refused(lambda: worlds.load_world("nowhere.toml"), FileNotFoundError, "nowhere.toml"),
        refused(lambda: worlds.load_world(written(1)), ValueError, "content.pt", "'.pt'"),
    ],
    "td3.check_fits": [
        refused(lambda: td3.check_fits(5, nav()), TypeError, "config", "5"),
        refused(lambda: td3.check_fits(config(), 5), TypeError, "env", "5"),
        refused(
            lambda: td3.check_fits(config(field_high=(10.0, -40.0, 4e4)), nav()), ValueError, "I is", "-50.0 to -40.0°"
        ),
    ],
}

RUNS: dict[str, list[Refused | Nan]] = {
    "runs.create_run_folder": [
        refused(lambda: runs.create_run_folder(5), TypeError, "int"),
        refused(lambda: runs.create_run_folder(written(1).parent), FileExistsError, "in use"),
    ],
    "runs.locked": [refused(lambda: runs.locked("here").__enter__(), TypeError, "folder", "'here'")],
    "runs.write_json": [
        refused(lambda: runs.write_json("here", {}), TypeError, "path", "'here'"),
        refused(lambda: runs.write_json(folder() / "a.json", {"a": {1}}), TypeError, "set"),
    ],
    "runs.RunLog": [
        refused(lambda: runs.RunLog("here", [], {}), TypeError, "folder", "'here'"),
        refused(lambda: run_log(wandb_mode="sometimes"), ValueError, "'sometimes'", "offline"),
        refused(lambda: run_log(logger="paper"), ValueError, "'paper'", "csv"),
    ],
    "runs.RunLog.row": [refused(lambda: run_log().row({"framse": 1.0}), ValueError, "framse")],
    "runs.RunLog.figure": [refused(lambda: run_log().figure("a", 5), AttributeError, "int")],
    "runs.RunLog.result": [refused(lambda: run_log().result({"a": {1}}), TypeError, "set")],
    "runs.RunLog.load_state_dict": [refused(lambda: run_log().load_state_dict({}), KeyError, "seconds")],
    "loggers.check_logger": [
        refused(lambda: loggers.check_logger("paper"), ValueError, "'paper'", "tensorboard"),
        refused(lambda: loggers.check_logger("wandb", "sometimes"), ValueError, "'sometimes'", "offline"),
    ],
    "loggers.panels": [refused(lambda: loggers.panels({"frames": 1, "return": "a"}), ValueError, "'a'")],
    "loggers.open_log": [
        refused(lambda: loggers.open_log("paper", folder(), {}), ValueError, "'paper'"),
        refused(lambda: loggers.open_log("csv", "here", {}), TypeError, "folder", "'here'"),
    ],
    "loggers.ScalarLog": [
        refused(lambda: loggers.ScalarLog("here", "csv"), TypeError, "folder", "'here'"),
        refused(lambda: loggers.ScalarLog(folder(), "paper"), ValueError, "'paper'"),
    ],
    "loggers.WandbRun": [
        refused(lambda: loggers.WandbRun("here", "disabled", {}), TypeError, "folder", "'here'"),
        refused(lambda: loggers.WandbRun(folder(), "sometimes", {}), ValueError, "'sometimes'"),
    ],
    "checkpoints.Checkpoints": [
        refused(lambda: checkpoints.Checkpoints(folder(), {}, 0), ValueError, "keep", "0"),
        refused(lambda: checkpoints.Checkpoints(folder(), {}, 1.5), ValueError, "keep", "1.5"),
        refused(lambda: checkpoints.Checkpoints(5, {}), TypeError, "int"),
        refused(lambda: checkpoints.Checkpoints(folder(), {"a": 5}), TypeError, "part a", "state_dict", "5"),
    ],
    "checkpoints.Checkpoints.save": [
        refused(lambda: checkpoints.Checkpoints(folder(), {}).save("a"), ValueError, "frames", "'a'"),
        refused(lambda: checkpoints.Checkpoints(folder(), {}).save(-1), ValueError, "frames", "-1"),
        refused(lambda: checkpoints.Checkpoints(written(1), {}).save(1), FileExistsError, "content.pt"),
    ],
    "checkpoints.read_checkpoint": [
        refused(
            lambda: checkpoints.read_checkpoint(written([1])), ValueError, "content.pt", "format, frames and parts"
        ),
        refused(lambda: checkpoints.read_checkpoint("nowhere.pt"), ValueError, "nowhere.pt"),
    ],
    "checkpoints.save_tensors": [
        refused(lambda: checkpoints.save_tensors({}, Path("nowhere/at/all.pt")), FileNotFoundError, "nowhere/at/all.pt")
    ],
    "checkpoints.load_tensors": [refused(lambda: checkpoints.load_tensors("nowhere.pt"), ValueError, "nowhere.pt")],
    "checkpoints.RunningEpisodes.load_state_dict": [
        refused(lambda: checkpoints.RunningEpisodes(None, nav()).load_state_dict({}), KeyError, "running")
    ],
    "checkpoints.BestPolicy.offer": [
        *(
            refused(lambda v=v: checkpoints.BestPolicy().offer(v, nn.Linear(1, 1)), ValueError, "score", repr(v))
            for v in (NAN, INF, "a")
        ),
    ],
    "checkpoints.BestPolicy.load_state_dict": [
        refused(lambda: checkpoints.BestPolicy().load_state_dict({}), KeyError, "score")
    ],
    "checkpoints.check_finite": [
        refused(lambda: checkpoints.check_finite([("a", t(0.0, INF))], "here"), FloatingPointError, "here: a", "[1]"),
        refused(lambda: checkpoints.check_finite({("a", "b"): t(NAN)}.items(), ""), FloatingPointError, "a.b", "[0]"),
        refused(lambda: checkpoints.check_finite(5, "here"), TypeError, "int"),
    ],
    "gymnasium_env.navigation_env": [
        refused(lambda: gymnasium_env.navigation_env(0), ValueError, "num_envs", "0"),
        refused(lambda: gymnasium_env.navigation_env(observation="flag"), ValueError, "observation", "'flag'"),
        refused(lambda: gymnasium_env.navigation_env(reward=5), ValueError, "reward", "5"),
        refused(lambda: gymnasium_env.navigation_env(scale_actions="a"), TypeError, "scale_actions", "'a'"),
        refused(lambda: gymnasium_env.navigation_env(wings=2), TypeError, "'wings'"),
        refused(lambda: gymnasium_env.navigation_env(alignment_weight=NAN), ValueError, "weight", "nan"),
    ],
    "gymnasium_env.GeomagneticNavGymEnv": [
        refused(lambda: gymnasium_env.GeomagneticNavGymEnv(render_mode="human"), ValueError, "'human'"),
        refused(lambda: gymnasium_env.GeomagneticNavGymEnv(zeta="a"), ValueError, "zeta", "'a'"),
        refused(
            lambda: gymnasium_env.GeomagneticNavGymEnv().step(zeros(2).numpy()), gymnasium.error.ResetNeeded, "reset()"
        ),
    ],
    "gymnasium_env.GeomagneticNavVectorEnv": [
        refused(lambda: gymnasium_env.GeomagneticNavVectorEnv(0), ValueError, "num_envs", "0"),
        refused(lambda: gymnasium_env.GeomagneticNavVectorEnv(seed=1.5), ValueError, "seed", "1.5"),
    ],
}

SETTINGS: dict[str, list[Refused | Nan]] = {
    "settings.check_settings": [
        refused(lambda: settings.check_settings(Options(count=1.5), {}), ValueError, "count", "int", "1.5"),
        refused(lambda: settings.check_settings(Options(count=True), {}), ValueError, "count", "int", "True"),
        refused(lambda: settings.check_settings(Options(flag=1), {}), ValueError, "flag", "bool", "1"),
        refused(lambda: settings.check_settings(Options(share="a"), {}), ValueError, "share", "float", "'a'"),
        refused(lambda: settings.check_settings(Options(mode="loud"), {}), ValueError, "mode", "'quiet'", "'loud'"),
        refused(lambda: settings.check_settings(Options(share=NAN), {"share": (0, 1)}), ValueError, "share", "nan"),
        refused(lambda: settings.check_settings(Options(share=2), {"share": (0, 1)}), ValueError, "share", "1", "2"),
        refused(lambda: settings.check_settings(5, {}), TypeError, "dataclass"),
    ],
    "settings.resume_folder": [
        refused(lambda: settings.resume_folder(["--resume", "run", "--seed", "1"]), ValueError, "--seed 1"),
    ],
    "settings.read_settings": [
        refused(lambda: settings.read_settings("here", Options), TypeError, "folder", "'here'"),
        refused(lambda: settings.read_settings(Path("nowhere"), Options), ValueError, "nowhere", "config.json"),
        refused(lambda: settings.read_settings(begun("[1]"), Options), ValueError, "config.json", "resume"),
        refused(lambda: settings.read_settings(begun('{"a": false}'), Options, a=True), ValueError, "{'a': True}"),
        refused(lambda: settings.read_settings(begun('{"wings": 2}'), Options), ValueError, "wings"),
    ],
}

ROWS = (
    GEODESY
    | ELEMENTS
    | GUIDANCE
    | FIELDS
    | TASKS
    | ENV
    | TRANSFORMS
    | POLICIES
    | METRICS
    | PLOTS
    | REPLAY
    | TD3
    | RECURRENT
    | EXPORT
    | WORLDS
    | RUNS
    | SETTINGS
)

EXEMPT = {
    "fields.FieldModel": "a protocol: it says what a field is and runs nothing",
    "fields.FieldModel.value_and_gradient": "of the protocol",
    "fields.Float64Module": "takes no arguments",
    "checkpoints.Stateful": "a protocol: it says what a part is and runs nothing",
    "checkpoints.Stateful.load_state_dict": "of the protocol",
    "checkpoints.DamagedCheckpointError": "an error",
    "checkpoints.RunningEpisodes": "holds what the recipe hands it, and is asked for it in load_state_dict",
    "checkpoints.BestPolicy": "takes no arguments",
    "navigators.Navigator.first_memory": "of a subclass; called by forward with what forward has selected",
    "navigators.Navigator.decide": "of a subclass; called by forward with what forward has selected",
    "metaheuristics.base.Metaheuristic.begin": "of a subclass; called with the population that first_state drew",
    "metaheuristics.base.Metaheuristic.evolve": "of a subclass; called with the population and its fitness",
    "metaheuristics.base.Metaheuristic.uniform": "draws in the shape that the algorithm asks for",
    "metaheuristics.base.Metaheuristic.normal": "draws in the shape that the algorithm asks for",
    "metaheuristics.base.Metaheuristic.first_state": "draws for as many vehicles as forward has selected",
    "transforms.base.ObservationTransform": "a base without a constructor: the rows are those of its children",
    "runs.StopRequest": "takes no arguments",
    "loggers.CurveLog": "a base; the rows are those of its children",
    "loggers.CurveLog.row": "what goes wrong in a logger is said once and never stops the caller",
    "loggers.CurveLog.picture": "what goes wrong in a logger is said once and never stops the caller",
    "loggers.CurveLog.table": "what goes wrong in a logger is said once and never stops the caller",
    "loggers.CurveLog.summary": "what goes wrong in a logger is said once and never stops the caller",
    "loggers.CurveLog.artifact": "what goes wrong in a logger is said once and never stops the caller",
    "gymnasium_env.register": "takes no arguments",
}


def modules() -> Iterator[ModuleType]:
    for found in pkgutil.walk_packages(magrl.__path__, "magrl."):
        yield importlib.import_module(found.name)


def new_methods(cls: type) -> Iterator[str]:
    """Public methods with arguments that no class above has: those that override one are part of the class's rows."""
    for name, member in vars(cls).items():
        inherited = any(name in vars(parent) for parent in cls.__mro__[1:])
        ours = inspect.isfunction(member) and not name.startswith("_") and not inherited
        if ours and len(inspect.signature(member).parameters) > 1:
            yield name


def public_names() -> Iterator[str]:
    for module in modules():
        home = module.__name__.removeprefix("magrl.")
        for name, member in vars(module).items():
            ours = (inspect.isfunction(member) or inspect.isclass(member)) and member.__module__ == module.__name__
            if ours and not name.startswith("_"):
                yield f"{home}.{name}"
                if inspect.isclass(member):
                    yield from (f"{home}.{name}.{method}" for method in new_methods(member))


def test_every_public_name_has_a_row_or_a_reason() -> None:
    names = set(public_names())
    assert not ROWS.keys() & EXEMPT.keys()
    assert names - ROWS.keys() - EXEMPT.keys() == set(), "say in ROWS what these refuse"
    assert ROWS.keys() - names == set(), "these are gone"
    assert EXEMPT.keys() - names == set(), "these are gone"
    assert all(ROWS.values())
    assert all(len(reason) > 5 for reason in EXEMPT.values())


def leaves(answer: object) -> Iterator[Tensor]:
    if isinstance(answer, (tuple, list)):
        for part in answer:
            yield from leaves(part)
    else:
        yield torch.as_tensor(answer)


CASES = [(name, index) for name, rows in ROWS.items() for index in range(len(rows))]


@pytest.mark.parametrize(("name", "index"), CASES, ids=[f"{name}-{index}" for name, index in CASES])
def test_bad_input_is_refused_by_value(name: str, index: int) -> None:
    row = ROWS[name][index]
    if isinstance(row, Nan):
        assert all(leaf.isnan().all() and leaf.numel() for leaf in leaves(row.call()))
        return
    with pytest.raises(row.error) as raised:
        row.call()
    missing = [text for text in row.says if text not in str(raised.value)]
    assert not missing, f"{raised.value!r} does not say {missing}"


def test_parallel_approach_masks_nan() -> None:
    """The one function of a step whose answer to NaN is not NaN: a heading of 0, and a mask that says so."""
    good = [zeros(2), torch.ones(2), torch.eye(2)]
    assert guidance.parallel_approach(*good)[1].all()
    for place in range(3):
        bad = [x * NAN if k == place else x for k, x in enumerate(good)]
        heading, valid = guidance.parallel_approach(*bad)
        assert heading.eq(0).all()
        assert not valid.any()


def test_nan_is_in_no_region() -> None:
    assert not PAPER_REGION.contains(torch.tensor([[NAN, 165.0], [-5.0, NAN], [NAN, NAN]])).any()


def test_a_latitude_beyond_the_pole_goes_on_over_it() -> None:
    over, down = ((100.0, 0.0), (80.0, 180.0))
    ends = [geodesy.to_ecef(*(torch.tensor(x, **FLOAT64) for x in place)) for place in (over, down)]
    torch.testing.assert_close(*ends)
