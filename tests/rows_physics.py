"""Bad calls of magrl.checks, files, geodesy, guidance, field and transforms."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch
from refusals import (
    INF,
    NAN,
    Nan,
    Refused,
    Rows,
    bad_numbers,
    bad_tensors,
    bad_vectors,
    folder,
    int64,
    refused,
    t,
    text_file,
    zeros,
)
from tensordict import TensorDict
from torch import Tensor

from magrl import checks, field, files, geodesy, guidance, transforms

READING: dict[str, Any] = {"declination": 3.5, "inclination": 73.0, "horizontal_intensity": 15000.0}
FOUNDATIONS: Rows = {
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
        Nan(lambda: geodesy.local_frame(t(NAN), t(0.0))[..., 0, :]),
        Nan(lambda: geodesy.local_frame(t(0.0), t(INF))[..., 1, :2]),
    ],
    "geodesy.to_ecef": [
        *bad_tensors(geodesy.to_ecef, "latitude", "longitude"),
        refused(lambda: geodesy.to_ecef(zeros(1), zeros(1), t(1j)), TypeError, "altitude_km", "complex64"),
        Nan(lambda: geodesy.to_ecef(t(NAN, INF, 0.0), t(0.0, 0.0, 0.0), t(0.0, 0.0, NAN))),
    ],
    "geodesy.from_ecef_surface": [
        *bad_vectors(geodesy.from_ecef_surface, "ecef"),
        Nan(lambda: geodesy.from_ecef_surface(t(NAN, 0.0, 0.0))),
    ],
    "geodesy.move": [
        *bad_tensors(geodesy.move, "latitude", "longitude", "heading", "distance_km"),
        *(
            Nan(lambda k=k, v=v: geodesy.move(*[t(0.0)] * k, t(v), *[t(0.0)] * (3 - k)))
            for k in (0, 2, 3)
            for v in (NAN, INF)
        ),
    ],
    "geodesy.geodesic": [
        *bad_tensors(geodesy.geodesic, "latitude1", "longitude1", "latitude2", "longitude2"),
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
    "geodesy.check_positions": [
        refused(lambda: geodesy.check_positions(t(0.0, 90.5), zeros(2)), ValueError, "latitude 90.5"),
        refused(lambda: geodesy.check_positions(t(NAN), zeros(1)), ValueError, "latitude nan"),
        refused(lambda: geodesy.check_positions(zeros(1), t(INF)), ValueError, "longitude inf"),
    ],
    "geodesy.check_box": [
        refused(lambda: geodesy.check_box(5, (0, 1)), ValueError, "5"),
        refused(lambda: geodesy.check_box((1, 1), (0, 1)), ValueError, "(1, 1)"),
        refused(lambda: geodesy.check_box((0, NAN), (0, 1)), ValueError, "(0, nan)"),
        refused(lambda: geodesy.check_box((0, 1), (170, -170)), ValueError, "(170, -170)", "(170, 190)"),
        refused(lambda: geodesy.check_box((0, 1), (0, INF)), ValueError, "(0, inf)"),
    ],
    "checks.check_finite": [
        refused(lambda: checks.check_finite([("a", t(0.0, INF))], "here"), FloatingPointError, "here: a", "[1]"),
        refused(lambda: checks.check_finite({("a", "b"): t(NAN)}.items(), ""), FloatingPointError, "a.b", "[0]"),
    ],
    "checks.require": [
        refused(lambda: checks.require(t(1.0, NAN) > 0, t(1.0, NAN), "{} is not positive"), ValueError, "nan is not")
    ],
    "files.save_tensors": [
        refused(lambda: files.save_tensors({}, Path("nowhere/at/all.pt")), FileNotFoundError, "nowhere/at/all.pt")
    ],
    "files.load_tensors": [
        refused(lambda: files.load_tensors("nowhere.pt"), files.DamagedFileError, "nowhere.pt"),
        refused(lambda: files.load_tensors(text_file("a.pt", "no tensors")), files.DamagedFileError, "a.pt"),
    ],
    "files.write_json": [
        refused(lambda: files.write_json("here", {}), TypeError, "path", "'here'"),
        refused(lambda: files.write_json(folder() / "a.json", {"a": {1}}), TypeError, "set"),
    ],
    "files.check_writable": [
        refused(lambda: files.check_writable(text_file("a", "") / "b.json"), OSError, "cannot write", "b.json")
    ],
}


def of_elements(function: Callable[[Tensor, Tensor, Tensor], object], *names: str) -> list[Refused | Nan]:
    """Fields, targets and a third whose last dimensions differ, a single element included."""
    good = [torch.ones(2, 3)] * 3
    shapes = ((2, 1), (2, 2), ())
    wrong = [[*good[:k], torch.ones(shape), *good[k + 1 :]] for k in range(3) for shape in shapes]
    return [refused(lambda w=w: function(*w), ValueError, *names, "(2, 3)") for w in wrong]


GUIDANCE: Rows = {
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
        Nan(lambda: guidance.proximity_reward(t(0.0, NAN), t(NAN, 0.0), 1.0)),
        Nan(lambda: guidance.proximity_reward(t(0.0, NAN), t(NAN, 0.0), 1.0, limit=5.0)),
        *bad_numbers(
            lambda **limit: guidance.proximity_reward(t(1.0), t(1.0), 1.0, **limit), limit=(0.0, -1.0, NAN, "a")
        ),
    ],
    "guidance.late_decay": [
        *bad_tensors(lambda a, b: guidance.late_decay(a, b, 50), "proximity", "step"),
        refused(lambda: guidance.late_decay(zeros(1), int64(1), 0), ValueError, "max_steps", "0"),
        refused(lambda: guidance.late_decay(zeros(1), int64(1), NAN), ValueError, "max_steps", "nan"),
        Nan(lambda: guidance.late_decay(t(NAN, NAN), torch.tensor([1, 50]), 50)),
    ],
    "guidance.alignment_reward": [
        *bad_tensors(lambda a, b: guidance.alignment_reward(a, b, 3.0), "angle", "reference"),
        Nan(lambda: guidance.alignment_reward(t(0.0, NAN, INF), t(NAN, 0.0, 0.0), 3.0)),
    ],
    "guidance.best_pair": [
        *bad_vectors(guidance.best_pair, "gradient", 2)[:2],
        refused(lambda: guidance.best_pair(zeros(1, 2)), ValueError, "two elements", "(1, 2)"),
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

GAUSS = torch.zeros(2, 2, dtype=torch.complex128)


@cache
def igrf() -> field.IGRF:
    return field.IGRF("2022-01-01", 13)


@cache
def box() -> field.RegionalField:
    return field.RegionalField(igrf(), (-10.0, 0.0), (160.0, 170.0), degree=6, tolerance_nt=1.0)


@cache
def bank() -> field.FieldBank:
    return field.FieldBank(zeros(2, 3, 4, 4), *(torch.tensor([[-10.0, 0.0], [0.0, 10.0]]),) * 2)


@cache
def crust() -> field.RandomCrust:
    return field.RandomCrust((0.0, 10.0), (0.0, 10.0), 0, waves=4)


def bad_places(model: Callable[..., object]) -> list[Refused | Nan]:
    return [
        refused(lambda: model(t(-95.0), t(0.0)), ValueError, "latitude -95.0"),
        refused(lambda: model(t(NAN), t(0.0)), ValueError, "latitude nan"),
        refused(lambda: model(t(0.0), t(INF)), ValueError, "longitude inf"),
        refused(lambda: model(t(0.0), t(0.0), NAN), ValueError, "altitude_km"),
    ]


FIELDS: Rows = {
    "field.parse_date": [
        refused(lambda: field.parse_date("May"), ValueError, "'May'"),
        *(
            refused(lambda v=v: field.parse_date(v), ValueError, repr(v))
            for v in (NAN, INF, 0.5, 10_000, None, True, [])
        ),
    ],
    "field.igrf_coefficients": [
        refused(lambda: field.igrf_coefficients(1899.5), ValueError, "1899-07-02", "1900"),
        refused(lambda: field.igrf_coefficients(2031), ValueError, "2031", "2030"),
        refused(lambda: field.igrf_coefficients(2022, 12), ValueError, "12", "[13, 14]"),
        refused(lambda: field.igrf_coefficients(2022, "13"), ValueError, "'13'"),
    ],
    "field.SphericalHarmonicField": [
        refused(lambda: field.SphericalHarmonicField(zeros(2, 3)), ValueError, "(2, 3)"),
        refused(lambda: field.SphericalHarmonicField(GAUSS + NAN), ValueError, "gauss", "non-finite"),
        refused(lambda: field.SphericalHarmonicField(GAUSS, chunk=0), ValueError, "chunk", "0"),
        refused(lambda: field.SphericalHarmonicField(GAUSS, altitude_km=NAN), ValueError, "altitude_km", "nan"),
        refused(lambda: field.SphericalHarmonicField(GAUSS, altitude_km=-200.0), ValueError, "altitude_km", "-200.0"),
        refused(lambda: field.SphericalHarmonicField(5), TypeError, "gauss", "5"),
        refused(lambda: field.SphericalHarmonicField(GAUSS, chunk=1.5), ValueError, "chunk", "1.5"),
        refused(lambda: field.SphericalHarmonicField(GAUSS, altitude_km="a"), ValueError, "altitude_km", "'a'"),
        refused(lambda: field.SphericalHarmonicField(GAUSS)(t(0.0), t(0.0), -200.0), ValueError, "altitude_km -200.0"),
        refused(lambda: field.SphericalHarmonicField(GAUSS)(t(1j), t(0.0)), TypeError, "complex64"),
        *bad_places(field.SphericalHarmonicField(GAUSS)),
    ],
    "field.SphericalHarmonicField.value_and_gradient": bad_places(
        lambda *place: field.SphericalHarmonicField(GAUSS).value_and_gradient(*place)
    ),
    "field.IGRF": [
        refused(lambda: field.IGRF("2031-01-01"), ValueError, "2031-01-01", "2030"),
        refused(lambda: field.IGRF(2022.0, 12), ValueError, "12", "[13, 14]"),
        refused(lambda: field.IGRF(2022.0, altitude_km=INF), ValueError, "altitude_km", "inf"),
        refused(lambda: field.IGRF(2022.0, "13"), ValueError, "'13'", "[13, 14]"),
        refused(lambda: field.IGRF([2022.0, "May"]), ValueError, "'May'"),
        refused(lambda: field.IGRF(2022.0, altitude_km=5000), ValueError, "altitude_km 5000", "1000 km", "meters?"),
        *bad_places(lambda *place: igrf()(*place)),
    ],
    "field.elements_at": [
        refused(lambda: field.elements_at(igrf(), zeros(4, 3)), ValueError, "(4, 3)"),
        refused(lambda: field.elements_at(igrf(), t(-95.0, 0.0)), ValueError, "latitude -95.0"),
        refused(lambda: field.elements_at(lambda latitude, _: latitude, zeros(4, 2)), ValueError, "b_ned", "(4,)"),
        Nan(lambda: field.elements_at(box(), t(5.0, 165.0))),
    ],
    "field.elements_range": [
        refused(lambda: field.elements_range(igrf(), t(0.0, NAN)), ValueError, "longitude nan"),
        refused(lambda: field.elements_range(igrf(), zeros(0, 2)), ValueError, "(0, 2)"),
        Nan(lambda: field.elements_range(box(), torch.tensor([[5.0, 165.0], [-5.0, 165.0]]))),
    ],
    "field.elements_gradient_at": [
        refused(lambda: field.elements_gradient_at(igrf(), t(-95.0, 0.0)), ValueError, "latitude -95.0"),
        Nan(lambda: field.elements_gradient_at(box(), t(5.0, 165.0))[1]),
    ],
    "field.RegionalField": [
        refused(lambda: field.RegionalField(igrf(), (0, -1), (0, 1)), ValueError, "(0, -1)"),
        refused(lambda: field.RegionalField(igrf(), (0, 1), (0, 1), degree=0), ValueError, "degree", "0"),
        refused(lambda: field.RegionalField(igrf(), (0, 1), (0, 1), degree=1.5), ValueError, "degree", "1.5"),
        refused(lambda: box()(t(1j), t(0.0)), TypeError, "complex64"),
        refused(
            lambda: field.RegionalField(igrf(), (0, 1), (0, 1), tolerance_nt=NAN), ValueError, "tolerance_nt", "nan"
        ),
        refused(lambda: field.RegionalField(igrf(), (0, 60), (0, 90), degree=2), ValueError, "degree 2", "(0, 60)"),
        Nan(lambda: box()(t(5.0, NAN, -5.0), t(165.0, 165.0, INF))),
    ],
    "field.RegionalField.value_and_gradient": [
        Nan(lambda: box().value_and_gradient(t(5.0, NAN, -5.0), t(165.0, 165.0, NAN))),
    ],
    "field.random_planets": [
        *bad_numbers(
            lambda count=1, seed=0, **options: field.random_planets(count, seed, **options),
            count=(0, -1, 1.5, "a"),
            seed=(-1, 0.5, NAN, None, 2**63),
            degree=(0, 2.0, NAN),
            tilt_deg=(-1.0, 181.0, NAN, "a"),
            strength=(1.0, (1.3, 0.7), (-1.0, 1.0), (1.0, NAN)),
            spread=(1.0, (2.0, 0.5), (1.0,), (0.5, INF)),
        ),
    ],
    "field.wmmhr_coefficients": [
        refused(lambda: field.wmmhr_coefficients("2024-12-31"), ValueError, "2024-12-31", "2025-01-01", "2030-01-01"),
        refused(lambda: field.wmmhr_coefficients(2030.5), ValueError, "2030-07-02", "2030-01-01"),
        refused(lambda: field.wmmhr_coefficients("May"), ValueError, "'May'"),
    ],
    "field.WMMHR": [
        refused(lambda: field.WMMHR("2024-12-31"), ValueError, "2024-12-31", "2025-01-01"),
        refused(lambda: field.WMMHR(2026.0, altitude_km=-2.0), ValueError, "altitude_km", "-2.0"),
        refused(lambda: field.WMMHR(2026.0, chunk=0), ValueError, "chunk", "0"),
    ],
    "field.crustal_spectrum": [
        refused(lambda: field.crustal_spectrum(134), TypeError, "degree", "134"),
        refused(lambda: field.crustal_spectrum(t(134.0, 0.0)), ValueError, "degree 0.0"),
        refused(lambda: field.crustal_spectrum(t(NAN)), ValueError, "degree nan"),
    ],
    "field.RandomCrust": [
        *bad_numbers(
            lambda seed=0, **options: field.RandomCrust((0, 10), (0, 10), seed, **options),
            seed=(-1, 0.5, NAN, None, 2**63),
            degrees=(134, (400, 134), (0, 100), (134, NAN)),
            strength=(-1.0, NAN, "a"),
            waves=(0, 1.5, NAN),
            altitude_km=(-1.0, INF, "a"),
        ),
        refused(lambda: field.RandomCrust((0, -1), (0, 1), 0), ValueError, "(0, -1)"),
        refused(lambda: field.RandomCrust((0, 40), (0, 10), 0), ValueError, "(0, 40)", "20.6 degrees", "smaller"),
        refused(lambda: crust()(t(1j), t(0.0)), TypeError, "complex64"),
        Nan(lambda: crust()(t(11.0, NAN, 5.0), t(5.0, 5.0, INF))),
    ],
    "field.RandomCrust.value_and_gradient": [
        Nan(lambda: crust().value_and_gradient(t(11.0, NAN, 5.0), t(5.0, 5.0, -1.0))),
    ],
    "field.CrustedField": [
        refused(lambda: field.CrustedField(igrf(), 5), TypeError, "crust", "5"),
        refused(lambda: field.CrustedField(zeros(3), crust()), TypeError, "field"),
        Nan(lambda: field.CrustedField(igrf(), crust())(t(11.0), t(5.0))),
    ],
    "field.CrustedField.value_and_gradient": [
        Nan(lambda: field.CrustedField(igrf(), crust()).value_and_gradient(t(11.0), t(5.0))),
    ],
    "field.check_earth_reading": [
        *bad_numbers(lambda **given: field.check_earth_reading(**(READING | given)), inclination=(NAN, 91.0, "a")),
        refused(lambda: field.check_earth_reading(3.5, 73.0, 15.0), ValueError, "15 ", "microtesla"),
        refused(lambda: field.check_earth_reading(0.06, 1.27, 15000.0), ValueError, "1.27", "radians"),
    ],
    "field.check_earth_jump": [
        refused(lambda: field.check_earth_jump((1.0, 2.0), (1.0, 2.0, 3.0), 1.0), ValueError, "before", "(1.0, 2.0)"),
        refused(lambda: field.check_earth_jump((0, 60, 2e4), (0, 60, 3e4), 50.0), ValueError, "B_H", "30000", "50 km"),
        refused(lambda: field.check_earth_jump((0, 60, 2e4), (0, 60, 2e4), -1.0), ValueError, "distance_km", "-1.0"),
    ],
    "field.weather_record": [
        refused(lambda n=name: field.weather_record(n), ValueError, repr(name), "quiet, disturbed")
        for name in ("storm", 5, None)
    ],
    "field.WeatherRecord": [
        *bad_tensors(field.WeatherRecord, "variation"),
        refused(lambda: field.WeatherRecord(zeros(5, 2)), ValueError, "variation", "(5, 2)"),
        refused(lambda: field.WeatherRecord(zeros(0, 3)), ValueError, "T >= 1", "(0, 3)"),
        *bad_numbers(lambda **options: field.WeatherRecord(zeros(5, 3), **options), first=(-1, 5, 0.5), last=(5, "a")),
        refused(lambda: field.WeatherRecord(zeros(5, 3), name=5), TypeError, "name", "5"),  # type: ignore[arg-type]
    ],
    "field.WeatherRecord.starts": [
        *bad_numbers(field.WeatherRecord(zeros(5, 3)).starts, span_h=(-1, NAN, "a")),
        refused(lambda: field.WeatherRecord(zeros(61, 3)).starts(1.1), ValueError, "1.1 h", "at most 1 h"),
    ],
    "field.FieldBank": [
        *bad_tensors(lambda a, b: bank()(a, b, int64(1)), "latitude", "longitude"),
        refused(lambda: field.FieldBank(5, zeros(1, 2), zeros(1, 2)), TypeError, "expansion", "5"),
        refused(lambda: field.FieldBank(zeros(1, 3, 4, 5), zeros(1, 2), zeros(1, 2)), ValueError, "(1, 3, 4, 5)"),
        refused(lambda: field.FieldBank(zeros(2, 3, 4, 4), t(0, 1)[None], t(0, 1)[None]), ValueError, "2 boxes", "1"),
        refused(lambda: field.FieldBank(zeros(1, 3, 4, 4), t(1, 0)[None], t(0, 1)[None]), ValueError, "(1.0, 0.0)"),
        refused(lambda: field.FieldBank(zeros(1, 3, 4, 4), t(0, 1)[None], t(0, 361)[None]), ValueError, "361.0"),
        refused(lambda: bank()(t(0.0), t(0.0), t(0.0)), TypeError, "index", "torch.float32"),
        refused(lambda: bank()(t(0.0), t(0.0), int64(1) + 2), ValueError, "index 2", "[0, 2)"),
        Nan(lambda: bank()(t(5.0, NAN, -5.0), t(-5.0, -5.0, INF), int64(3))),
    ],
    "field.FieldBank.value_and_gradient": [
        refused(lambda: bank().value_and_gradient(t(0.0), t(0.0), int64(1) - 1), ValueError, "index -1", "[0, 2)"),
        Nan(lambda: bank().value_and_gradient(t(5.0, NAN, -5.0), t(-5.0, -5.0, NAN), int64(3))),
    ],
}

PAIR = ["here", "there"]
TRANSFORMS: Rows = {
    "transforms.AngleVector": [
        refused(lambda: transforms.AngleVector(5, "b"), TypeError, "5"),
        refused(lambda: transforms.AngleVector(["a", "b"], "c"), ValueError, "['a', 'b']", "['c']"),
        refused(lambda: transforms.AngleVector("a", "b")(TensorDict(c=zeros(1))), KeyError, "['a']", "['c']"),
        Nan(lambda: transforms.AngleVector("a", "b")(TensorDict(a=t(NAN)))["b"]),
    ],
    "transforms.TargetDifference": [
        refused(lambda: transforms.TargetDifference("ab"), TypeError, "'ab'"),
        refused(lambda: transforms.TargetDifference(["a"]), ValueError, "['a']"),
        refused(
            lambda: transforms.TargetDifference(PAIR)(TensorDict(here=zeros(2), there=zeros(3))),
            RuntimeError,
            "(3)",
            "(2)",
        ),
        Nan(lambda: transforms.TargetDifference(PAIR)(TensorDict(here=t(NAN), there=t(0.0)))["field_difference"]),
    ],
    "transforms.FieldGradient": [
        refused(lambda: transforms.FieldGradient("IGRF"), ValueError, "value_and_gradient", "str"),
        refused(
            lambda: transforms.FieldGradient(torch.sum)(TensorDict(position=zeros(2))),
            ValueError,
            "values (E,), got ()",
        ),
        refused(
            lambda: transforms.FieldGradient(torch.sin)(TensorDict(position=zeros(3))), ValueError, "position", "(3,)"
        ),
        refused(lambda: transforms.FieldGradient(igrf(), ["a", "b"]), ValueError, "['a', 'b']"),
        refused(lambda: transforms.FieldGradient(igrf())(TensorDict(position=t(-95.0, 0.0))), ValueError, "-95.0"),
    ],
    "transforms.GradientHeading": [
        *bad_numbers(transforms.GradientHeading, min_crossing_deg=(-1.0, 90.0, NAN, "a")),
        *bad_numbers(transforms.GradientHeading, pair=(5, "DI", "Auto", ("D", 0), ("D", -1), ("D", 0.5))),
        refused(lambda: transforms.GradientHeading(pair=("D", "Z")), ValueError, "'Z'"),
        refused(lambda: transforms.GradientHeading("abc"), TypeError, "'abc'"),
    ],
    "transforms.TrackGradient": [
        *bad_numbers(transforms.TrackGradient, range_km=(0.0, NAN, "a", None), frame=("north", 5), prior=(5, None)),
        *bad_numbers(transforms.TrackGradient, noise_std=(5, (0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0, NAN))),
        *bad_numbers(
            transforms.TrackGradient, scales=(5, (), (1.0, 1.0, 0.0)), curvature=(5, (1.0,), (1.0, 1.0, -1.0))
        ),
        *bad_numbers(transforms.TrackGradient, angles=(5, (3,), (-1,), (0.5,))),
        refused(lambda: transforms.TrackGradient("field"), TypeError, "'field'"),
        refused(lambda: transforms.TrackGradient(["field"]), ValueError, "4 to 6 in_keys", "['field']"),
        refused(lambda: transforms.TrackGradient(list("abcde"), noise_std=(0.0,) * 3), ValueError, "'e'", "not both"),
        refused(lambda: transforms.TrackGradient()(TensorDict(field=zeros(3))), KeyError, "target_field"),
        Nan(
            lambda: transforms.TrackGradient()(
                TensorDict(field=t(NAN, 0.0, 1.0), target_field=zeros(3), move=zeros(2), heading=zeros(1))
            )["way"]
        ),
    ],
    "transforms.SensorErrors": [
        *bad_numbers(
            transforms.SensorErrors,
            bias=((0.1, 0.1), (0.1, 0.1, -1.0), (0.1, 0.1, NAN), 5),
            scale=((0.1, 0.1, -1.0),),
            drift=((0.1, 0.1, -1.0),),
            resolution=((0.1,), (0.1, 0.1, INF)),
            outage_rate=(-0.1, 1, NAN, "a"),
        ),
        refused(lambda: transforms.SensorErrors(drift=(0.0, 0.0, 1.0)), ValueError, "drift_length", "None"),
        refused(lambda: transforms.SensorErrors(vector=5), TypeError, "vector", "5"),
        refused(lambda: transforms.SensorErrors((1.0,), scale=(0.1,)), ValueError, "scale", "1 elements"),
        refused(lambda: transforms.SensorErrors()(TensorDict(field=zeros(3))), NotImplementedError, "TransformedEnv"),
    ],
    "transforms.VectorErrors": [
        *bad_numbers(
            transforms.VectorErrors,
            hard_iron_nt=((1.0,), (1.0, 1.0, -1.0), (1.0, 1.0, NAN), 5),
            attitude_deg=((1.0,), (1.0, -1.0), (1.0, INF)),
        ),
        refused(lambda: transforms.VectorErrors(soft_iron=((1.0,),)), ValueError, "soft_iron", "((1.0,),)"),
        refused(lambda: transforms.VectorErrors(soft_iron=((0.1, 0.1),) * 3), ValueError, "soft_iron", "(0.1, 0.1)"),
    ],
    "transforms.VectorErrors.constants": bad_vectors(transforms.VectorErrors().constants, "normal", 14),
    "transforms.VectorErrors.disturb": bad_vectors(
        lambda x: transforms.VectorErrors().disturb(x, zeros(1), zeros(12)), "elements", 3
    ),
    "transforms.VectorErrors.variance": bad_vectors(transforms.VectorErrors().variance, "elements", 3),
    "transforms.NorthReferenceError": [
        *bad_numbers(
            transforms.NorthReferenceError,
            constant_deg=(-1.0, NAN, "a"),
            drift_deg=(-1.0, INF),
            random_deg=(-1.0, "a"),
            seed=(0.5,),
        ),
        refused(lambda: transforms.NorthReferenceError(0.0, 1.0), ValueError, "drift_length_km", "None"),
        refused(
            lambda: transforms.NorthReferenceError(in_keys=PAIR), ValueError, "3 or 4 in_keys", "['here', 'there']"
        ),
    ],
    "transforms.north_reference": [
        refused(lambda: transforms.north_reference("sextant", speed_km_h=1.0), ValueError, "'sextant'", "marine"),
        *bad_numbers(lambda **x: transforms.north_reference("marine", **x), speed_km_h=(0.0, -1.0, NAN, "a")),
    ],
    "transforms.MotionError": [
        *bad_numbers(
            transforms.MotionError,
            log_scale=(-0.1, NAN, 0.25),
            log_noise=(-0.1, "a", 0.25),
            compass_deg=(-1.0, INF),
            heading_noise_deg=(-1.0, NAN),
            current_km_h=(-1.0, NAN),
            eddies_km_h=(-1.0, "a"),
            eddy_km=(0.0, -1.0),
            seed=(0.5,),
        ),
        refused(lambda: transforms.MotionError(current_km_h=1.0), ValueError, "speed_km_h", "None"),
        refused(lambda: transforms.MotionError(eddies_km_h=1.0, speed_km_h=0.0), ValueError, "speed_km_h", "0.0"),
        refused(lambda: transforms.MotionError(in_keys=PAIR), ValueError, "3 in_keys", "['here', 'there']"),
    ],
    "transforms.MotionError.farthest_km": bad_numbers(
        lambda **x: transforms.MotionError().farthest_km(**x), max_move_km=(0.0, -1.0, NAN, "a")
    ),
    "transforms.MagneticWeather": [
        *bad_numbers(
            lambda speed_km_h=5.0, **options: transforms.MagneticWeather(speed_km_h=speed_km_h, **options),
            speed_km_h=(0, -5.0, NAN, "a"),
            reading_s=(-1, INF),
            span_h=(-1, "a"),
            seed=(0.5,),
        ),
        refused(lambda: transforms.MagneticWeather("storm", speed_km_h=5), ValueError, "'storm'", "quiet, disturbed"),
        refused(lambda: transforms.MagneticWeather(5, speed_km_h=5), TypeError, "record", "5"),
        refused(lambda: transforms.MagneticWeather(speed_km_h=5, in_keys=["a"]), ValueError, "2 in_keys", "['a']"),
        refused(
            lambda: transforms.MagneticWeather(speed_km_h=5)(TensorDict(field=zeros(3), move=zeros(2))),
            KeyError,
            "'weather_clock'",
        ),
        Nan(
            lambda: transforms.MagneticWeather(speed_km_h=5)(
                TensorDict(field=t(NAN, NAN, NAN), move=zeros(2), weather_clock=zeros(2).double())
            )["field"]
        ),
    ],
    "transforms.DeclareArrival": [
        *bad_numbers(transforms.DeclareArrival, within_km=(0, -1.0, NAN, "a")),
        refused(lambda: transforms.DeclareArrival(5.0, way_keys="way"), TypeError, "'way'"),
        refused(lambda: transforms.DeclareArrival(5.0, way_keys=["way"]), ValueError, "['way']"),
        refused(lambda: transforms.DeclareArrival(5.0).inv(TensorDict(action=zeros(2))), KeyError, "'way'"),
    ],
    "transforms.SensorNoise": [
        *bad_numbers(transforms.SensorNoise, std=(5, (), "ab", (0.1, -0.1), (0.1, NAN), (0.1, INF))),
        refused(lambda: transforms.SensorNoise((0.1,), seed=0.5), ValueError, "seed", "0.5"),
        refused(lambda: transforms.SensorNoise((0.1,), in_keys=PAIR), ValueError, "['here', 'there']"),
        refused(lambda: transforms.SensorNoise((0.1,))(TensorDict(field=zeros(1))), KeyError, "'sensor_stream'"),
        Nan(
            lambda: transforms.SensorNoise((1.0,))(TensorDict(field=t(NAN), sensor_std=t(1.0), sensor_stream=int64(1)))[
                "field"
            ]
        ),
    ],
    "transforms.RandomSensorNoise": [
        *bad_numbers(transforms.RandomSensorNoise, draws=(0, 1.5, "a")),
        refused(lambda: transforms.RandomSensorNoise(5), TypeError, "levels", "5"),
        refused(lambda: transforms.RandomSensorNoise(draws=3), ValueError, "uniform", "(3,)"),
    ],
    "transforms.Conditions": [
        refused(lambda: transforms.Conditions(5), TypeError, "name", "5"),
        refused(lambda: transforms.Conditions("own", north="sextant"), ValueError, "'sextant'", "marine"),
        refused(lambda: transforms.Conditions("own", sensors={"bias": (1.0,)}), ValueError, "bias", "(1.0,)"),
        refused(lambda: transforms.Conditions("own", weather={"record": "hail"}), ValueError, "'hail'", "quiet"),
        refused(lambda: transforms.Conditions("own", 0.0, motion={"current_km_h": 1.0}), ValueError, "speed_km_h"),
    ],
    "transforms.Conditions.transforms": bad_numbers(
        lambda **x: transforms.Conditions("own").transforms(**x), seed=(0.5, "a")
    ),
    "transforms.Conditions.drift_km": bad_numbers(
        lambda **x: transforms.Conditions("own").drift_km(**x), max_move_km=(0.0, -1.0, NAN, "a")
    ),
    "transforms.SensorErrors.variances": bad_vectors(transforms.SensorErrors().variances, "field", 3),
    "transforms.NorthReferenceError.variances": bad_tensors(transforms.NorthReferenceError().variances, "field"),
    "transforms.MagneticWeather.variances": bad_vectors(
        transforms.MagneticWeather(speed_km_h=5.0).variances, "field", 3
    ),
    "transforms.conditions_named": [
        refused(lambda: transforms.conditions_named("sledge"), ValueError, "'sledge'", "laboratory, aircraft, ship"),
        refused(lambda: transforms.conditions_named(5), ValueError, "5", "low-cost"),
    ],
    "transforms.with_conditions": [
        refused(lambda: transforms.with_conditions(5, "ship"), TypeError, "env", "5"),
        refused(lambda: transforms.with_conditions(5, "sledge"), ValueError, "'sledge'", "ship"),
        refused(lambda: transforms.with_conditions(5, 5), TypeError, "conditions", "5"),
    ],
    "transforms.sensor_levels": [
        *bad_vectors(transforms.sensor_levels, "uniform", 7),
        *bad_numbers(lambda exponent: transforms.sensor_levels(zeros(7), exponent), exponent=(0.0, -1.0, NAN, "a")),
    ],
    "transforms.with_sensor_noise": [
        refused(lambda: transforms.with_sensor_noise(5, (0.1, -1.0)), ValueError, "std", "(0.1, -1.0)"),
        refused(lambda: transforms.with_sensor_noise(5, (0.1,)), TypeError, "env", "5"),
    ],
    "transforms.SearchAim": [
        *bad_numbers(
            lambda **options: transforms.SearchAim(**({"zeta": 0.01} | options)),
            zeta=(0.0, -1.0, NAN, "a"),
            frame=("vessel", None),
        ),
        refused(lambda: transforms.SearchAim(PAIR, zeta=0.01), ValueError, "8 in_keys", str(PAIR)),
        refused(lambda: transforms.SearchAim(zeta=0.01)(TensorDict(field=zeros(3))), KeyError, "'target_field'"),
    ],
    "transforms.TrackObservation": [
        *bad_numbers(
            lambda **options: transforms.TrackObservation(**({"zeta": 0.01, "max_steps": 50} | options)),
            zeta=(0.0, -1.0, NAN, "a"),
            max_steps=(0, 2.5, "a", None),
        ),
        refused(lambda: transforms.TrackObservation("field", zeta=0.01, max_steps=50), TypeError, "'field'"),
        refused(lambda: transforms.TrackObservation(PAIR, zeta=0.01, max_steps=50), ValueError, "8 in_keys", str(PAIR)),
        refused(
            lambda: transforms.TrackObservation(zeta=0.01, max_steps=50)(TensorDict(field=zeros(3))),
            KeyError,
            "target_field",
            "sensor_std",
        ),
    ],
    "transforms.TrueWay": [
        refused(lambda: transforms.TrueWay("position"), TypeError, "'position'"),
        refused(lambda: transforms.TrueWay(PAIR), ValueError, "3 in_keys", str(PAIR)),
        refused(lambda: transforms.TrueWay()(TensorDict(position=zeros(2))), KeyError, "target_position", "heading"),
        Nan(
            lambda: transforms.TrueWay()(
                TensorDict(position=t(NAN, 0.0), target_position=zeros(2), heading=zeros(1)),
            )["true_way"]
        ),
    ],
    "transforms.DistanceCost": [
        *bad_numbers(transforms.DistanceCost, cost=(-0.1, NAN, INF, "a")),
        refused(lambda: transforms.DistanceCost(0.1, in_keys=PAIR), ValueError, "1 in_keys", str(PAIR)),
        refused(lambda: transforms.DistanceCost(0.1)(TensorDict(move=zeros(2))), KeyError, "next"),
    ],
    "transforms.DetourReward": [
        *bad_numbers(
            transforms.DetourReward,
            arrival=(-1.0, NAN, "a"),
            detour=(-1.0, INF),
            step=(-0.1, None),
            lost_penalty=(-5.0, NAN),
        ),
        refused(lambda: transforms.DetourReward("true_way"), TypeError, "'true_way'"),
        refused(lambda: transforms.DetourReward(PAIR), ValueError, "6 in_keys", str(PAIR)),
        refused(lambda: transforms.DetourReward()(TensorDict(true_way=zeros(2))), KeyError, "next"),
    ],
    "transforms.AlignmentReward": [
        *bad_numbers(transforms.AlignmentReward, weight=(NAN, INF, "a", None), offset=(NAN, "a")),
        refused(lambda: transforms.AlignmentReward("angle"), TypeError, "'angle'"),
        refused(lambda: transforms.AlignmentReward(["a"]), ValueError, "['a']"),
        refused(lambda: transforms.AlignmentReward(PAIR)(TensorDict(here=zeros(1))), KeyError, "next"),
    ],
    "transforms.AlignmentReward.term": [
        refused(
            lambda: transforms.AlignmentReward(PAIR).term(TensorDict(), TensorDict(here=zeros(1))), KeyError, "there"
        ),
        Nan(lambda: transforms.AlignmentReward(PAIR).term(TensorDict(there=t(NAN)), TensorDict(here=zeros(1)))),
    ],
    "transforms.MinMaxNorm": [
        *bad_numbers(transforms.MinMaxNorm, interval=(5, (1.0,), (1.0, 1.0), (0.0, NAN), ("a", "b")), bounds=(5, "ab")),
        refused(lambda: transforms.MinMaxNorm(5), TypeError, "5"),
        refused(lambda: transforms.MinMaxNorm(["x"], bounds={"x": 5}), ValueError, "'x'", "5"),
        refused(lambda: transforms.MinMaxNorm(["x"], bounds={"x": (1.0, 1.0)}), ValueError, "'x'", "1.0"),
        refused(lambda: transforms.MinMaxNorm(["x"], bounds={"x": (0.0, NAN)}), ValueError, "'x'", "nan"),
        refused(lambda: transforms.MinMaxNorm(["x"], bounds={"y": (0.0, 1.0)}), ValueError, "'y'", "['x']"),
    ],
    "transforms.MinMaxNorm.normalize": [
        refused(lambda: transforms.MinMaxNorm(["x"]).normalize("x", zeros(1)), RuntimeError, "'x'"),
        refused(lambda: transforms.MinMaxNorm(["x"]).normalize("y", zeros(1)), KeyError, "'y'", "['x']"),
        Nan(lambda: transforms.MinMaxNorm(["x"], bounds={"x": (0.0, 1.0)}).normalize("x", t(NAN))),
    ],
    "transforms.MinMaxNorm.denormalize": [
        refused(lambda: transforms.MinMaxNorm(["x"]).denormalize("y", zeros(1)), KeyError, "'y'", "['x']"),
        refused(
            lambda: transforms.MinMaxNorm(["x"], bounds={"x": (zeros(2), torch.ones(2))}).denormalize("x", zeros(3)),
            RuntimeError,
            "(2)",
            "(3)",
        ),
        Nan(lambda: transforms.MinMaxNorm(["x"], bounds={"x": (0.0, 1.0)}).denormalize("x", t(NAN))),
    ],
}


def sound_view(**options: Any) -> transforms.ObservationView:
    """A sound view but for some options."""
    sound: dict[str, Any] = {"observe_heading": True, "observe_difference": True, "max_move_km": 50.0}
    sound |= {"field_low": (0.0, -50.0, 3e4), "field_high": (10.0, 0.0, 4e4), "max_turn_rad": 1.5}
    return transforms.ObservationView(**(sound | options))


def track_view(**options: Any) -> transforms.TrackView:
    """A sound view but for some options."""
    sound: dict[str, Any] = {"zeta": 0.01, "max_steps": 50, "max_move_km": 50.0, "max_turn_rad": 1.5}
    return transforms.TrackView(**(sound | options))


NARROW = sound_view(field_high=(10.0, -40.0, 4e4))

VIEWS: Rows = {
    "transforms.ObservationView.action_transform": [
        refused(lambda: sound_view().action_transform(declared=1), TypeError, "declared", "1")
    ],
    "transforms.ObservationView": bad_numbers(
        sound_view,
        observe_heading=(None,),
        observe_difference=("no",),
        field_low=(5, (1.0, 2.0), (NAN, 0.0, 0.0), (99.0, -50.0, 3e4)),
        field_high=("abc", (0.0, 0.0, INF)),
        max_move_km=(0.0, -50.0, NAN, "a"),
        max_turn_rad=(0.0, 4.0, "a"),
    ),
    "transforms.ObservationView.check_covers": [
        refused(lambda: NARROW.check_covers(igrf(), t(-5.0, 165.0)), ValueError, "I is", "-50.0 to -40.0°")
    ],
    "transforms.TrackView": [
        *bad_numbers(
            track_view,
            zeta=(0.0, NAN, "a"),
            max_steps=(0, 2.5, None),
            max_move_km=(0.0, -50.0, "a"),
            max_turn_rad=(0.0, 4.0, "a"),
            range_km=(0.0, INF, "a"),
        ),
        refused(lambda: track_view(search="yes"), TypeError, "search", "'yes'"),
    ],
}

ROWS = FOUNDATIONS | GUIDANCE | FIELDS | TRANSFORMS | VIEWS
