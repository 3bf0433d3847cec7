"""The filter of a field and its gradient: against a textbook filter and the exact gradient."""

import math

import numpy as np
import pytest
import torch
from support.tracks import F64, SCALES, STD, f64, randn, random_track, started

from magrl.field import IGRF, elements_at, elements_gradient_at
from magrl.geodesy import move
from magrl.tracking import (
    CURVATURE,
    DISTANCE_SCALE_KM,
    ELEMENT_SCALES,
    VARIANCE_FLOOR,
    FieldTrack,
    GradientPrior,
    GradientRelation,
    curl_relation,
    dipole_prior,
    displacement_of,
    estimated_gradient,
    predict,
    read,
    relate,
    start,
    update,
    way_to,
)

NAN = math.nan
FLOOR = 1e-8 * VARIANCE_FLOOR  # in float64


def textbook_start(reading, gradient, std, noise, azimuth, scale):
    """State and covariance of one element as in any textbook, in NumPy; distances in units of 100 km."""
    turn = np.array([[math.cos(azimuth), -math.sin(azimuth)], [math.sin(azimuth), math.cos(azimuth)]])
    covariance = np.zeros((3, 3))
    covariance[0, 0] = max((noise / scale) ** 2, FLOOR)
    covariance[1:, 1:] = turn @ np.diag((std * 100 / scale) ** 2) @ turn.T
    return np.array([reading, *(gradient * 100)]) / scale, covariance


def textbook_predict(x, p, d, c):
    d = d / 100
    length2 = d @ d
    f = np.eye(3)
    f[0, 1:] = d
    q = np.zeros((3, 3))
    q[0, 0] = c**2 * length2**2 / 4
    q[0, 1:] = q[1:, 0] = c**2 * length2 * d / 2
    q[1:, 1:] = c**2 * length2 * np.eye(2)
    return f @ x, f @ p @ f.T + q


def textbook_update(x, p, z, r):
    h = np.array([[1.0, 0.0, 0.0]])
    s = h @ p @ h.T + r
    k = p @ h.T @ np.linalg.inv(s)
    return x + (k @ (z - h @ x)), p - k @ h @ p


def test_filter_is_the_textbook_filter():
    """On four random tracks of 30 moves, with other scales, curvatures and noise than the defaults, to 1e-10."""
    scales, curvature, noise = (0.3, 1.5, 100.0, 7.0), (0.02, 0.05, 12.0, 0.3), (0.1, 0.001, 30.0, 2.0)
    scale = f64(*scales)
    readings = randn(31, 4, 4, seed=1) * scale
    gradient, std = randn(4, 4, 2, seed=2) * scale[:, None] / 100, randn(4, 4, 2, seed=3).abs() * scale[:, None] / 100
    azimuth, moves = randn(4, seed=4), 40 * randn(30, 4, 2, seed=5)
    track = start(readings[0], GradientPrior(gradient, std, azimuth), noise, scales)
    expected = {}
    for n, e in np.ndindex(4, 4):
        given = float(readings[0, n, e]), gradient[n, e].numpy(), std[n, e].numpy(), noise[e], float(azimuth[n])
        expected[n, e] = textbook_start(*given, scales[e])
    for step in range(31):
        if step:
            track = update(predict(track, moves[step - 1], curvature, scales), readings[step], noise, scales)
        for (n, e), (x, p) in expected.items():
            if step:
                x, p = textbook_predict(x, p, moves[step - 1, n].numpy(), curvature[e] / scales[e])
                r = max((noise[e] / scales[e]) ** 2, FLOOR)
                x, p = expected[n, e] = textbook_update(x, p, float(readings[step, n, e]) / scales[e], r)
            np.testing.assert_allclose(track.mean[n, e].numpy(), x, rtol=0, atol=1e-10)
            np.testing.assert_allclose(track.covariance[n, e].numpy(), p, rtol=0, atol=1e-10)


def test_elements_and_vehicles_are_independent():
    """A vehicle alone, and an element alone, gets what it gets in the batch, by default as D, I, B_H."""
    track, moves, readings = random_track(5, 3), 40 * randn(5, 2), randn(5, 3) * SCALES
    whole = update(predict(track, moves), readings, STD)
    one = update(predict(FieldTrack(*(x[2] for x in track)), moves[2]), readings[2], STD)
    torch.testing.assert_close(tuple(one), (whole.mean[2], whole.covariance[2]), rtol=1e-14, atol=1e-14)
    one = predict(FieldTrack(*(x[:, 1:2] for x in track)), moves, CURVATURE[1:2], ELEMENT_SCALES[1:2])
    one = update(one, readings[:, 1:2], STD[1:2], ELEMENT_SCALES[1:2])
    torch.testing.assert_close(one.mean, whole.mean[:, 1:2], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize(("shape", "elements"), [((), 1), ((2, 3), 5), ((0,), 3)])
def test_shapes_and_dtypes(shape, elements, dtype):
    scales, ones = (1.0,) * elements, torch.ones(*shape, elements, 2, dtype=dtype)
    reading = torch.zeros(*shape, elements, dtype=dtype)
    track = start(reading, GradientPrior(ones, ones, ones[..., 0, 0]), scales, scales)
    track = update(predict(track, torch.ones(*shape, 2, dtype=dtype), scales, scales), reading, scales, scales)
    way = way_to(track, reading, 300.0, scales)
    wanted = {(*shape, elements, 3): track.mean, (*shape, elements, 3, 3): track.covariance}
    wanted |= {(*shape, 2): way.displacement, (*shape, 2, 2): way.covariance}
    wanted |= {(*shape, elements, 2): estimated_gradient(track, scales)}
    for size, tensor in wanted.items():
        assert (tensor.shape, tensor.dtype) == (size, dtype)


@pytest.mark.parametrize(("km", "straight"), [(0.0, False), (1.0, True), (50.0, False), (1000.0, False)])
def test_covariance_stays_positive_definite_in_float32(km, straight):
    """Over readings without noise on 16 tracks: the smallest eigenvalue of the correlations, which has no units."""
    reading = torch.tensor([8.0, -16.0, 35000.0]).expand(16, 3)
    track, moves = started(reading, (0.0, 0.0, 0.0)), randn(400, 16, 2).float()
    for step in range(400):
        track = update(predict(track, km * moves[0 if straight else step]), reading, (0.0, 0.0, 0.0))
        assert torch.equal(track.covariance, track.covariance.mT)
        std = track.covariance.double().diagonal(dim1=-2, dim2=-1).sqrt()
        correlation = track.covariance.double() / std.unsqueeze(-1) / std.unsqueeze(-2)
        assert torch.linalg.eigvalsh(correlation).min() > 1e-6


# --- the gradient -----------------------------------------------------------------------------------------------------


def test_gradient_converges_to_the_exact_one_of_igrf():
    """On 20 zigzag legs of 30 km, to 0.04 deg, 0.06 deg, 10 nT per 100 km: a tenth and less of the prior's error."""
    igrf, noise = IGRF("2022-01-01", generation=13), (0.001, 0.001, 0.1)
    place = f64((-2.0, 162.0), (40.0, -100.0), (-35.0, 20.0), (55.0, 10.0), (10.0, 100.0), (-45.0, -70.0))
    errors = f64(*noise) * randn(21, 6, 3)
    track = prior = started(elements_at(igrf, place) + errors[0], noise)
    for step in range(20):
        heading = torch.full((6, 1), math.radians(60.0 - 120 * (step % 2)), dtype=F64)
        km = torch.full_like(heading, 30.0)
        place = torch.stack(move(*place.unbind(-1), heading[:, 0], km[:, 0]), -1)
        leg = displacement_of(km, heading)
        track = read(track, leg, elements_at(igrf, place) + errors[step + 1], noise)
    exact = elements_gradient_at(igrf, place)
    error, before = estimated_gradient(track) - exact, estimated_gradient(prior) - exact
    largest, largest_before = (100 * x.abs().amax((0, 2)) for x in (error, before))
    assert (largest < f64(0.04, 0.06, 10.0)).all()
    assert (largest_before > 10 * largest).all()
    std = track.covariance.diagonal(dim1=-2, dim2=-1)[..., 1:].sqrt() * SCALES[:, None] / DISTANCE_SCALE_KM
    ratio = (error / std).square().mean((0, 2)).sqrt()
    assert ((ratio > 0.4) & (ratio < 2)).all()  # the filter knows how large its error is


def test_a_straight_track_says_nothing_across_it():
    """Without drift, the gradient along the track converges; the one across it keeps its prior and its variance."""
    gradient, std = torch.zeros(3, 2, dtype=F64), f64((0.4, 0.5), (0.3, 0.2), (190.0, 135.0)) / 100
    along, across = f64(math.cos(0.6), math.sin(0.6)), f64(-math.sin(0.6), math.cos(0.6))
    before = track = start(f64(0.0, 0.0, 0.0), GradientPrior(gradient, std, f64(0.6)[0]), STD)
    slope = 0.01 * SCALES
    for step in range(1, 31):
        track = update(predict(track, 20 * along, (0.0, 0.0, 0.0)), 20 * step * slope, STD)
    found = estimated_gradient(track)
    torch.testing.assert_close(found @ along, slope, rtol=0.01, atol=0)
    torch.testing.assert_close(found @ across, torch.zeros(3, dtype=F64), rtol=0, atol=1e-10)
    blocks = before.covariance[:, 1:, 1:], track.covariance[:, 1:, 1:]
    (first, wide), (last, still) = ([block @ axis @ axis for axis in (along, across)] for block in blocks)
    torch.testing.assert_close(still, wide, rtol=1e-10, atol=0)
    assert (last < 1e-3 * first).all()


def test_prior_is_narrow_along_the_azimuth():
    """Standard deviations 1 along and 3 across an azimuth of 30 deg, worked by hand."""
    std, turn = 0.01 * f64((1.0, 3.0)).expand(1, 2), f64(math.radians(30))[0]
    found = start(f64(0.0), GradientPrior(torch.zeros(1, 2, dtype=F64), std, turn), (0.0,), (1.0,)).covariance[0]
    half, cos2, sin2 = math.sqrt(3) / 4, 0.75, 0.25
    block = f64((cos2 + 9 * sin2, (1 - 9) * half), ((1 - 9) * half, sin2 + 9 * cos2))
    torch.testing.assert_close(found[1:, 1:], block)
    torch.testing.assert_close(found[0], f64(FLOOR, 0.0, 0.0), rtol=1e-7, atol=0)
    rounded = start(torch.zeros(1), GradientPrior(torch.zeros(1, 2), std.float(), turn.float()), (0.0,), (1.0,))
    assert rounded.covariance[0, 0, 0] == pytest.approx(VARIANCE_FLOOR)


def test_a_relation_conditions_the_joint_normal_distribution():
    track, weights = random_track(20, 3), 100 * randn(20, 3, 2, seed=5)
    relation = GradientRelation(weights, randn(20, seed=6), randn(20, seed=7).abs() + 0.1)
    found, shared = relate(track, relation, scales=(1.0,) * 3)
    assert torch.equal(found.covariance, track.covariance)
    for n in range(20):
        mean, covariance = track.mean[n].flatten().numpy(), torch.block_diag(*track.covariance[n]).numpy()
        row = np.concatenate([[0.0, *w] for w in relation.weights[n].numpy()]) / 100
        gain = covariance @ row / (row @ covariance @ row + float(relation.std[n]) ** 2)
        expected = mean + gain * (float(relation.value[n]) - row @ mean)
        np.testing.assert_allclose(found.mean[n].flatten().numpy(), expected, rtol=1e-9, atol=1e-12)
        u = shared[n].flatten().numpy()
        np.testing.assert_allclose(np.outer(u, u), np.outer(gain, row @ covariance), rtol=1e-9, atol=1e-12)


# --- what every function keeps ----------------------------------------------------------------------------------------


def every(reading, moved, after, target, noise):
    """All functions in a row."""
    track = update(predict(start(reading, dipole_prior(reading), noise), moved), after, STD)
    known, shared = relate(track, curl_relation(after))
    return (*track, *way_to(known, target, 300.0, shared=shared), estimated_gradient(known))


def arguments(dtype=F64):
    reading = f64(8.0, -16.0, 35000.0).expand(5, 3)
    after, target = reading + 0.1 * SCALES * randn(5, 3), reading + SCALES * randn(5, 3, seed=1)
    return [x.to(dtype) for x in (reading, 40 * randn(5, 2, seed=2), after, target, f64(*STD).expand(5, 3))]


@pytest.mark.parametrize("place", range(5))
def test_nan_in_gives_nan_out_in_that_vehicle_alone(place):
    inputs, clean = arguments(), every(*arguments())
    inputs[place] = inputs[place].clone()
    inputs[place][2] = NAN
    mean, covariance, way, way_covariance, gradient = found = every(*inputs)
    assert way[2].isnan().all()
    if place != 3:  # the target is no part of the state
        assert mean[2].isnan().all()
        assert gradient[2].isnan().all()
    if place not in (2, 3):  # covariances do not depend on what is read
        assert covariance[2].isnan().any()
        assert way_covariance[2].isnan().all()
    others = [0, 1, 3, 4]
    assert all(torch.equal(x[others], y[others]) for x, y in zip(found, clean, strict=True))


TRACK = FieldTrack(torch.zeros(4, 3, 3), torch.eye(3).expand(4, 3, 3, 3))
READING = torch.zeros(4, 3)
PRIOR = GradientPrior(torch.zeros(4, 3, 2), torch.ones(4, 3, 2), torch.zeros(4))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: start(READING, PRIOR._replace(std=torch.zeros(4, 3)), STD), r"prior_std .* got \(4, 3\)"),
        (lambda: start(READING, PRIOR, (0.1, -0.2, 1.0)), "sensor_std must be a finite number from 0 on, got -0.2"),
        (lambda: start(READING, PRIOR, STD, scales=(1.0, 0.0, 1.0)), "scales must be a finite number above 0, got"),
        (lambda: start(READING, PRIOR[0], STD), "prior must be a GradientPrior"),
        (lambda: predict(TRACK, torch.zeros(4, 3)), r"displacement must have the shape \(..., 2\), got \(4, 3\)"),
        (lambda: predict(TRACK, torch.zeros(4, 2), torch.zeros(4, 2)), r"curvature .* got \(4, 2\)"),
        (lambda: predict(tuple(TRACK), torch.zeros(4, 2)), "track must be a FieldTrack"),
        (lambda: update(FieldTrack(TRACK.mean[:2], TRACK.covariance), READING, STD), "mean and covariance must have"),
        (lambda: update(TRACK, torch.zeros(4, 1), STD), r"reading must have the shape \(..., 3\), got \(4, 1\)"),
        (lambda: way_to(TRACK, READING, 0.0), "range_km must be a finite number above 0, got 0.0"),
    ],
)
def test_bad_arguments_are_refused_by_name(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()
