"""The filter of a field and its gradient: against a textbook filter, the exact gradient, and simulations."""

import math

import numpy as np
import pytest
import torch

from magrl.field import IGRF, SphericalHarmonicField, elements_at, elements_gradient_at, random_planets
from magrl.field.elements import measured_elements
from magrl.geodesy import REFERENCE_RADIUS_KM, curvature_radii, local_frame, move, to_ecef
from magrl.tracking import (
    CURVATURE,
    CURVATURE_NT,
    DIPOLE_STD_NT,
    DISTANCE_SCALE_KM,
    ELEMENT_SCALES,
    VARIANCE_FLOOR,
    FieldTrack,
    GradientPrior,
    GradientRelation,
    curl_relation,
    dipole_prior,
    estimated_gradient,
    field_curvature,
    predict,
    relate,
    start,
    update,
    way_to,
)

F64 = torch.float64
SCALES = torch.tensor(ELEMENT_SCALES, dtype=F64)
NOISE = (0.05, 0.05, 5.0)
NAN = float("nan")


def f64(*values):
    return torch.tensor(values, dtype=F64)


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def random_track(*shape, seed=0, spread=1.0):
    """A state with random means and positive definite covariances."""
    root = randn(*shape, 3, 3, seed=seed + 1)
    return FieldTrack(randn(*shape, 3, seed=seed), spread * (root @ root.mT + 0.1 * torch.eye(3, dtype=F64)))


def smallest_eigenvalue(covariance):
    """The smallest eigenvalue of correlation matrices, which does not depend on the units."""
    variance = covariance.double().diagonal(dim1=-2, dim2=-1)
    if not (variance > 0).all():
        return -math.inf
    std = variance.sqrt()
    return float(torch.linalg.eigvalsh(covariance.double() / std.unsqueeze(-1) / std.unsqueeze(-2)).min())


def started(reading, noise=NOISE):
    prior = dipole_prior(reading)
    return start(reading, prior, noise)


# --- against a textbook filter ----------------------------------------------------------------------------------------


def textbook_start(reading, gradient, std, noise, azimuth, scale):
    """State and covariance of one element as in any textbook, in NumPy; distances in units of 100 km."""
    turn = np.array([[math.cos(azimuth), -math.sin(azimuth)], [math.sin(azimuth), math.cos(azimuth)]])
    covariance = np.zeros((3, 3))
    covariance[0, 0] = max((noise / scale) ** 2, VARIANCE_FLOOR)
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
    scale = torch.tensor(scales, dtype=F64)
    readings = randn(31, 4, 4, seed=1) * scale
    gradient, std = randn(4, 4, 2, seed=2) * scale[:, None] / 100, randn(4, 4, 2, seed=3).abs() * scale[:, None] / 100
    azimuth, moves = randn(4, seed=4), 40 * randn(30, 4, 2, seed=5)
    track = start(readings[0], GradientPrior(gradient, std, azimuth), noise, scales)
    expected = {
        (n, e): textbook_start(
            float(readings[0, n, e]),
            gradient[n, e].numpy(),
            std[n, e].numpy(),
            noise[e],
            float(azimuth[n]),
            scales[e],
        )
        for n in range(4)
        for e in range(4)
    }
    for step in range(31):
        if step:
            track = update(predict(track, moves[step - 1], curvature, scales), readings[step], noise, scales)
        for (n, e), (x, p) in expected.items():
            if step:
                x, p = textbook_predict(x, p, moves[step - 1, n].numpy(), curvature[e] / scales[e])
                r = max((noise[e] / scales[e]) ** 2, VARIANCE_FLOOR)
                x, p = expected[n, e] = textbook_update(x, p, float(readings[step, n, e]) / scales[e], r)
            np.testing.assert_allclose(track.mean[n, e].numpy(), x, rtol=0, atol=1e-10)
            np.testing.assert_allclose(track.covariance[n, e].numpy(), p, rtol=0, atol=1e-10)


def test_defaults_are_those_of_d_i_bh():
    reading, moved = f64(8.0, -16.0, 35000.0), f64(30.0, -20.0)
    track = started(reading)
    torch.testing.assert_close(track.mean[:, 0] * SCALES, reading)
    torch.testing.assert_close(track.covariance[:, 0, 0].sqrt() * SCALES, f64(*NOISE))
    after = predict(track, moved)
    again = predict(track, moved, f64(*CURVATURE), SCALES)
    torch.testing.assert_close(after.covariance, again.covariance, rtol=0, atol=0)
    assert not torch.allclose(after.covariance, predict(track, moved, (0.0, 0.0, 0.0)).covariance, rtol=1e-6)


def test_elements_and_vehicles_are_independent():
    """A vehicle alone, and an element alone, gets to the bit what it gets in the batch."""
    track, moves, readings = random_track(5, 3), 40 * randn(5, 2), randn(5, 3) * SCALES
    whole = update(predict(track, moves), readings, NOISE)
    for n in range(5):
        one = update(predict(FieldTrack(*(x[n] for x in track)), moves[n]), readings[n], NOISE)
        torch.testing.assert_close(one.mean, whole.mean[n], rtol=1e-14, atol=1e-14)
        torch.testing.assert_close(one.covariance, whole.covariance[n], rtol=1e-14, atol=1e-14)
    column = [x[:, 1:2] for x in track]
    one = predict(FieldTrack(*column), moves, CURVATURE[1:2], ELEMENT_SCALES[1:2])
    one = update(one, readings[:, 1:2], NOISE[1:2], ELEMENT_SCALES[1:2])
    torch.testing.assert_close(one.mean, whole.mean[:, 1:2], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
@pytest.mark.parametrize("elements", [1, 3, 5])
def test_shapes_and_dtypes(shape, dtype, elements):
    scales, ones = (1.0,) * elements, torch.ones(*shape, elements, 2, dtype=dtype)
    reading = torch.zeros(*shape, elements, dtype=dtype)
    track = start(reading, GradientPrior(ones, ones, ones[..., 0, 0]), scales, scales)
    track = update(predict(track, torch.ones(*shape, 2, dtype=dtype), scales, scales), reading, scales, scales)
    way = way_to(track, reading, 300.0, scales)
    wanted = {(*shape, elements, 3): track.mean, (*shape, elements, 3, 3): track.covariance}
    wanted |= {(*shape, 2): way.displacement, (*shape, 2, 2): way.covariance}
    wanted |= {(*shape, elements, 2): estimated_gradient(track, scales)}
    for size, tensor in wanted.items():
        assert tensor.shape == size
        assert tensor.dtype == dtype


def test_leading_dimensions_broadcast():
    """One state, one gradient and one move serve many readings."""
    track = started(f64(8.0, -16.0, 35000.0))
    after = update(predict(track, torch.ones(4, 1, 2, dtype=F64)), torch.zeros(5, 3, dtype=F64), NOISE)
    assert after.mean.shape == (4, 5, 3, 3)
    assert after.covariance.shape == (4, 5, 3, 3, 3)
    assert way_to(after, f64(8.0, -16.0, 35000.0), 300.0).displacement.shape == (4, 5, 2)


# --- float32 ----------------------------------------------------------------------------------------------------------


def short_of_joseph(track, reading, noise_std):
    """Update by the plain form P - K H P."""
    value, covariance = track.mean[..., 0], track.covariance
    unit = reading.new_tensor(ELEMENT_SCALES)
    noise = (reading.new_tensor(noise_std) / unit).square().clamp_min(VARIANCE_FLOOR)
    gain = covariance[..., 0] / (covariance[..., 0, 0] + noise).unsqueeze(-1)
    mean = track.mean + gain * (reading / unit - value).unsqueeze(-1)
    return FieldTrack(mean, covariance - gain.unsqueeze(-1) * covariance[..., :1, :])


def least_eigenvalue(correct, km, straight=False, steps=2000):
    """The smallest eigenvalue of the correlations after any of many readings without noise, on 16 tracks in float32."""
    generator = torch.Generator().manual_seed(0)
    reading = torch.tensor([8.0, -16.0, 35000.0]).expand(16, 3)
    track, least = started(reading, (0.0, 0.0, 0.0)), math.inf
    moves = torch.randn(steps, 16, 2, generator=generator)
    for step in range(steps):
        track = predict(track, km * (moves[0] if straight else moves[step]))
        track = correct(track, reading, (0.0, 0.0, 0.0))
        assert torch.equal(track.covariance, track.covariance.mT) or correct is not update
        least = min(least, smallest_eigenvalue(track.covariance))
    return least


@pytest.mark.parametrize(
    ("km", "straight"), [(0.0, False), (1.0, False), (50.0, False), (1000.0, False), (1.0, True), (50.0, True)]
)
def test_covariance_stays_positive_definite_in_float32(km, straight):
    assert least_eigenvalue(update, km, straight) > 1e-6


def test_the_plain_form_does_not_stay_positive_definite_in_float32():
    """What the test above would catch, within 20 readings."""
    assert not least_eigenvalue(short_of_joseph, 1000.0, steps=20) > 0


# --- the gradient of IGRF ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def igrf():
    return IGRF("2022-01-01", generation=13)


def travel(igrf, headings_deg, km, noise, seed=0):
    """Follow headings from six places, with noise on the readings; return the state, the prior and the positions."""
    places = f64((-2.0, 162.0), (40.0, -100.0), (-35.0, 20.0), (55.0, 10.0), (10.0, 100.0), (-45.0, -70.0))
    latitude, longitude = places.unbind(-1)
    noises = f64(*noise) * randn(len(headings_deg) + 1, 6, 3, seed=seed)
    track = prior = started(elements_at(igrf, places) + noises[0], noise)
    for step, degrees in enumerate(headings_deg, start=1):
        heading = torch.full_like(latitude, math.radians(degrees))
        latitude, longitude = move(latitude, longitude, heading, torch.full_like(latitude, km))
        step_km = km * torch.stack((torch.cos(heading), torch.sin(heading)), -1)
        reading = elements_at(igrf, torch.stack((latitude, longitude), -1)) + noises[step]
        track = update(predict(track, step_km), reading, noise)
    return track, prior, torch.stack((latitude, longitude), -1)


def test_gradient_converges_to_the_exact_one_of_igrf(igrf):
    """On 20 zigzag legs of 30 km, to 0.04 deg, 0.06 deg, 10 nT per 100 km: a tenth and less of the prior's error."""
    track, prior, position = travel(igrf, [60.0, -60.0] * 10, 30.0, (0.001, 0.001, 0.1))
    exact = elements_gradient_at(igrf, position)
    error, before = estimated_gradient(track) - exact, estimated_gradient(prior) - exact
    largest, largest_before = (100 * x.abs().amax((0, 2)) for x in (error, before))
    assert (largest < f64(0.04, 0.06, 10.0)).all()
    assert (largest_before > 10 * largest).all()
    std = track.covariance.diagonal(dim1=-2, dim2=-1)[..., 1:].sqrt() * SCALES[:, None] / DISTANCE_SCALE_KM
    ratio = (error / std).square().mean((0, 2)).sqrt()
    assert ((ratio > 0.5) & (ratio < 2)).all()  # the filter knows how large its error is


def test_a_straight_track_says_nothing_across_it():
    """Without drift, the gradient along the track converges; the one across it keeps its prior and its variance."""
    gradient, std = torch.zeros(3, 2, dtype=F64), f64((0.4, 0.5), (0.3, 0.2), (190.0, 135.0)) / 100
    heading = 0.6
    along, across = f64(math.cos(heading), math.sin(heading)), f64(-math.sin(heading), math.cos(heading))
    track, slope = (
        start(f64(0.0, 0.0, 0.0), GradientPrior(gradient, std, torch.tensor(heading, dtype=F64)), NOISE),
        0.01 * SCALES,
    )
    before = track.covariance
    for step in range(1, 31):
        track = update(predict(track, 20 * along, (0.0, 0.0, 0.0)), 20 * step * slope, NOISE)
    found = estimated_gradient(track)
    torch.testing.assert_close(found @ along, slope, rtol=0.01, atol=0)
    torch.testing.assert_close(found @ across, torch.zeros(3, dtype=F64), rtol=0, atol=1e-10)
    variances = [
        [torch.einsum("i,eij,j->e", axis, covariance[:, 1:, 1:], axis) for axis in (along, across)]
        for covariance in (before, track.covariance)
    ]
    torch.testing.assert_close(variances[1][1], variances[0][1], rtol=1e-10, atol=0)
    assert (variances[1][0] < 1e-3 * variances[0][0]).all()


# --- the way ----------------------------------------------------------------------------------------------------------


def test_way_in_a_linear_field_is_exact():
    """With small variances the way is where the linear field has the target's values, to 1 m in 400 km."""
    track, way = random_track(50, 3, spread=1e-12), 200 * randn(50, 2, seed=9)
    target = (track.mean[..., 0] + (track.mean[..., 1:] * way[:, None] / DISTANCE_SCALE_KM).sum(-1)) * SCALES
    found = way_to(track, target, 1e5)
    torch.testing.assert_close(found.displacement, way, rtol=0, atol=1e-3)
    low = way_to(FieldTrack(*(x.float() for x in track)), target.float(), 1e5)
    torch.testing.assert_close(low.displacement.double(), way, rtol=0, atol=1.0)


def test_way_satisfies_its_normal_equations():
    """The last solve, with the variances at the way before it, against a least-squares solution in NumPy."""
    track, target = random_track(20, 4), randn(20, 4, seed=7)
    scales, reach = (1.0,) * 4, 2.5
    found = way_to(track, target, 100 * reach, scales)
    for n in range(20):
        mean, covariance = track.mean[n].numpy(), track.covariance[n].numpy()
        variance = covariance[:, 0, 0] + reach**2 * (covariance[:, 1, 1] + covariance[:, 2, 2])
        for _ in range(3):
            normal = mean[:, 1:].T @ np.diag(1 / variance) @ mean[:, 1:] + np.eye(2) / reach**2
            way = np.linalg.solve(normal, mean[:, 1:].T @ ((target[n].numpy() - mean[:, 0]) / variance))
            lever = np.array([1.0, *way])
            variance = np.array([lever @ p @ lever for p in covariance])
        np.testing.assert_allclose(found.displacement[n].numpy(), 100 * way, rtol=1e-9)
        np.testing.assert_allclose(found.covariance[n].numpy(), 1e4 * np.linalg.inv(normal), rtol=1e-9)


def test_a_constant_error_widens_the_way_and_nothing_else():
    """It is as if the value were less certain, but not its relation to the gradients."""
    track, target = random_track(20, 3), SCALES * randn(20, 3, seed=7)
    bias = f64(0.5, 0.1, 20.0)
    covariance = track.covariance.clone()
    covariance[..., 0, 0] += (bias / SCALES).square()
    expected = way_to(FieldTrack(track.mean, covariance), target, 300.0)
    found = way_to(track, target, 300.0, bias_std=bias)
    torch.testing.assert_close((found.displacement, found.covariance), tuple(expected))


def test_way_is_accurate_in_float32_where_gradients_are_nearly_parallel():
    """At 1e-3 rad between them, a c - b^2 would have no correct digit left."""
    gradients = f64((1.0, 0.0), (2.0, 2e-3), (3.0, 0.0))
    mean = torch.cat((torch.zeros(3, 1, dtype=F64), gradients), -1)
    track = FieldTrack(mean, 1e-8 * torch.eye(3, dtype=F64).expand(3, 3, 3))
    target = gradients @ f64(1.0, -2.0) * SCALES
    exact, low = way_to(track, target, 1e4), way_to(FieldTrack(*(x.float() for x in track)), target.float(), 1e4)
    torch.testing.assert_close(exact.displacement, f64(100.0, -200.0), rtol=1e-3, atol=0)
    torch.testing.assert_close(low.displacement.double(), exact.displacement, rtol=1e-3, atol=0)
    torch.testing.assert_close(low.covariance.double(), exact.covariance, rtol=1e-3, atol=0)


def test_covariance_of_the_way_is_that_of_a_simulation():
    """Over 40 000 fields drawn from the filter's distribution, within 10 % on both principal axes."""
    count, std = 40_000, randn(3, 3, seed=4)
    mean = torch.cat((torch.zeros(3, 1, dtype=F64), f64((0.3, 1.2), (1.0, 0.2), (-0.8, 0.5))), -1)
    covariance = 1e-3 * (std @ std.T + torch.eye(3, dtype=F64)) * torch.ones(3, 1, 1, dtype=F64)
    truth = mean + torch.einsum("ij,nej->nei", torch.linalg.cholesky(covariance[0]), randn(count, 3, 3, seed=1))
    way = f64(150.0, -80.0)
    target = (truth[..., 0] + (truth[..., 1:] * way / DISTANCE_SCALE_KM).sum(-1)) * SCALES
    found = way_to(FieldTrack(mean, covariance), target, 3000.0)
    error = found.displacement - way
    ratio = torch.linalg.eigvals(torch.linalg.solve(found.covariance.mean(0), error.T.cov())).real
    assert (ratio - 1).abs().max() < 0.1
    assert (error.mean(0).abs() < 0.1 * error.std(0)).all()


def test_way_stays_in_range_without_information():
    """With no gradient at all the way is zero, and as uncertain as its prior."""
    way = way_to(FieldTrack(torch.zeros(3, 3), torch.eye(3).expand(3, 3, 3)), torch.ones(3), 250.0)
    torch.testing.assert_close(way.displacement, torch.zeros(2), rtol=0, atol=0)
    torch.testing.assert_close(way.covariance, 250.0**2 * torch.eye(2))


# --- relations between the gradients ----------------------------------------------------------------------------------


def related(count, elements, seed=0):
    """States, and a relation of their gradients in units of 1 / km."""
    track = random_track(count, elements, seed=seed)
    weights, value = 100 * randn(count, elements, 2, seed=seed + 5), randn(count, seed=seed + 6)
    return track, GradientRelation(weights, value, randn(count, seed=seed + 7).abs() + 0.1)


def joint(track, n):
    """Mean ``(3 E,)`` and covariance ``(3 E, 3 E)`` of all elements of one vehicle, in NumPy."""
    return track.mean[n].flatten().numpy(), torch.block_diag(*track.covariance[n]).numpy()


def test_a_relation_conditions_the_joint_normal_distribution():
    track, relation = related(20, 3)
    found, shared = relate(track, relation, scales=(1.0,) * 3)
    assert torch.equal(found.covariance, track.covariance)
    for n in range(20):
        mean, covariance = joint(track, n)
        row = np.concatenate([[0.0, *w] for w in relation.weights[n].numpy()]) / 100
        gain = covariance @ row / (row @ covariance @ row + float(relation.std[n]) ** 2)
        expected = mean + gain * (float(relation.value[n]) - row @ mean)
        np.testing.assert_allclose(found.mean[n].flatten().numpy(), expected, rtol=1e-9, atol=1e-12)
        u = shared[n].flatten().numpy()
        np.testing.assert_allclose(np.outer(u, u), np.outer(gain, row @ covariance), rtol=1e-9, atol=1e-12)


def test_way_given_a_relation_satisfies_its_normal_equations():
    """As above, with the full covariance of the remaining differences from the second solve on."""
    (track, shared), target, reach = relate(*related(20, 3), scales=(1.0,) * 3), randn(20, 3, seed=7), 2.5
    found = way_to(track, target, 100 * reach, (1.0,) * 3, shared)
    for n in range(20):
        mean, blocks, u = track.mean[n].numpy(), track.covariance[n].numpy(), shared[n].numpy()
        spread = np.diag(blocks[:, 0, 0] + reach**2 * (blocks[:, 1, 1] + blocks[:, 2, 2]))
        for _ in range(3):
            weight = np.linalg.inv(spread)
            normal = mean[:, 1:].T @ weight @ mean[:, 1:] + np.eye(2) / reach**2
            way = np.linalg.solve(normal, mean[:, 1:].T @ weight @ (target[n].numpy() - mean[:, 0]))
            lever = np.array([1.0, *way])
            spread = np.diag([lever @ p @ lever for p in blocks]) - np.outer(u @ lever, u @ lever)
        np.testing.assert_allclose(found.displacement[n].numpy(), 100 * way, rtol=1e-7)
        np.testing.assert_allclose(found.covariance[n].numpy(), 1e4 * np.linalg.inv(normal), rtol=1e-7)


def test_the_field_has_no_vertical_curl():
    """On planets, B_H dD/dm - dB_H/dc is what the relation says with the true latitude, and mostly in its spread."""
    generator = torch.Generator().manual_seed(0)
    latitude = 140 * torch.rand(400, generator=generator, dtype=F64) - 70
    longitude = 360 * torch.rand(400, generator=generator, dtype=F64) - 180
    position, ratios = torch.stack((latitude, longitude), -1), []
    for gauss in random_planets(8, seed=3):
        planet = SphericalHarmonicField(gauss)
        elements, gradient = elements_at(planet, position), elements_gradient_at(planet, position)
        good = elements[:, 2] > 4000
        relation = curl_relation(elements)
        found = (relation.weights * gradient).sum((-2, -1))
        convergence = elements[:, 2] * torch.sin(torch.deg2rad(elements[:, 0])) / curvature_radii(latitude)[1]
        exact = convergence * torch.tan(torch.deg2rad(latitude))
        torch.testing.assert_close(found[good], exact[good], rtol=0, atol=1e-6)
        ratios.append(((found - relation.value) / relation.std)[good])
    ratio = torch.cat(ratios)
    assert 0.4 < float(ratio.square().mean().sqrt()) < 1.2
    assert (ratio.abs() < 2).double().mean() > 0.9


def test_a_straight_track_tells_the_gradient_across_it_by_the_curl():
    """Towards magnetic north, the change of D tells how B_H changes across."""
    dipole = SphericalHarmonicField(random_planets(1, seed=1)[0])
    place = f64(10.0, 20.0)
    first = elements_at(dipole, place)
    heading = torch.deg2rad(first[0])
    leg = 40 * torch.stack((torch.cos(heading), torch.sin(heading)))
    track = update(predict(started(first, (0.0,) * 3), leg), elements_at(dipole, place + leg / 111.2), (0.0,) * 3)
    exact = elements_gradient_at(dipole, place + leg / 111.2)[2]
    across = torch.stack((-torch.sin(heading), torch.cos(heading)))
    known, shared = relate(track, curl_relation(track.mean[:, 0] * SCALES))
    before, after = (abs(float((estimated_gradient(x)[2] - exact) @ across)) for x in (track, known))
    assert after < 0.5 * before
    assert shared[2].norm() > shared[1].norm() == 0


# --- the dipole -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dipole():
    """An axial dipole: declination zero everywhere."""
    gauss = torch.zeros(2, 2, dtype=torch.complex128)
    gauss[1, 0] = -30000.0
    return SphericalHarmonicField(gauss)


def elements_on_sphere(field, latitude):
    """Return geocentric latitudes [rad] and D, I, B_H about the normal of the sphere, at points of the reference radius
    above geodetic latitudes [deg]."""
    zero = torch.zeros_like(latitude)
    normal, ground = local_frame(latitude, zero)[:, 2].neg(), to_ecef(latitude, zero)
    lever = (normal * ground).sum(-1)
    altitude = (lever.square() - ground.square().sum(-1) + REFERENCE_RADIUS_KM**2).sqrt() - lever
    place = to_ecef(latitude, zero, altitude)
    geocentric = torch.atan2(place[:, 2], place[:, 0])
    ecef = local_frame(latitude, zero).mT @ field(latitude, zero, altitude).unsqueeze(-1)
    vector = local_frame(torch.rad2deg(geocentric), zero) @ ecef
    return geocentric, measured_elements(vector.squeeze(-1))


def test_dipole_prior_is_the_gradient_of_a_dipole_on_a_sphere(dipole):
    """In both hemispheres, to 1e-5, against central differences."""
    latitude = torch.cat((torch.linspace(-80, -2, 20, dtype=F64), torch.linspace(2, 80, 20, dtype=F64)))
    (south, low), (north, high) = (elements_on_sphere(dipole, latitude + step) for step in (-0.01, 0.01))
    _, reading = elements_on_sphere(dipole, latitude)
    slope = (high - low) / (REFERENCE_RADIUS_KM * (north - south)).unsqueeze(-1)
    found = dipole_prior(reading)
    torch.testing.assert_close(found.azimuth, torch.zeros(40, dtype=F64), rtol=0, atol=1e-12)
    torch.testing.assert_close(found.gradient[:, 1:, 0], slope[:, 1:], rtol=1e-5, atol=0)
    torch.testing.assert_close(found.gradient[:, 0], torch.zeros(40, 2, dtype=F64), rtol=0, atol=0)
    torch.testing.assert_close(found.gradient[..., 1], torch.zeros(40, 3, dtype=F64), rtol=0, atol=1e-12)
    assert (found.gradient[:, 1, 0] > 0).all()
    assert torch.equal(found.gradient[:, 2, 0].sign(), -latitude.sign())


def test_dipole_prior_on_the_ellipsoid(dipole):
    """There the gradient of I is within 1 % up to 70 degrees, that of B_H within 7 nT per 100 km (of up to 460)."""
    latitude = torch.linspace(-70, 70, 29, dtype=F64)
    position = torch.stack((latitude, torch.full_like(latitude, 20.0)), -1)
    found, exact = dipole_prior(elements_at(dipole, position)).gradient, elements_gradient_at(dipole, position)
    torch.testing.assert_close(found[:, 1], exact[:, 1], rtol=0.01, atol=1e-12)
    torch.testing.assert_close(found[:, 2], exact[:, 2], rtol=0, atol=0.07)


def test_dipole_prior_points_at_magnetic_north():
    """With D = 90 deg, magnetic north is east; north of the magnetic equator B_H falls towards it and I grows."""
    prior = dipole_prior(f64(90.0, 40.0, 30000.0))
    torch.testing.assert_close(prior.gradient[:, 0], torch.zeros(3, dtype=F64), rtol=0, atol=1e-12)
    assert prior.gradient[1, 1] > 0
    assert prior.gradient[2, 1] < 0
    assert float(prior.azimuth) == pytest.approx(math.pi / 2)


def test_prior_and_drift_are_those_of_disturbances_of_the_components():
    """At B_H = 30 000 nT and I = 60 deg, F is 60 000 nT: 30 nT turn D by 1 / 1000 rad and I by 1 / 2000 rad."""
    elements = f64(10.0, 60.0, 30000.0)
    unit = f64(math.degrees(1) / 30000, math.degrees(1) / 60000, 1.0)
    torch.testing.assert_close(dipole_prior(elements).std * 100, unit[:, None] * f64(*DIPOLE_STD_NT))
    torch.testing.assert_close(field_curvature(elements), unit * f64(*CURVATURE_NT))


def test_planets_deviate_from_the_dipole_and_curve_as_assumed():
    """Root mean squares over planets, within 20 %."""
    generator = torch.Generator().manual_seed(0)
    place = torch.stack(
        (
            120 * torch.rand(600, generator=generator, dtype=F64) - 60,
            360 * torch.rand(600, generator=generator, dtype=F64),
        ),
        -1,
    )
    heading = 2 * math.pi * torch.rand(600, generator=generator, dtype=F64)
    later = torch.stack(move(*place.unbind(-1), heading, torch.full_like(heading, 100.0)), -1)
    deviations, changes = [], []
    for gauss in random_planets(12, seed=5):
        planet = SphericalHarmonicField(gauss)
        elements, gradient = elements_at(planet, place), elements_gradient_at(planet, place)
        prior = dipole_prior(elements)
        cos, sin = torch.cos(prior.azimuth)[:, None], torch.sin(prior.azimuth)[:, None]
        north, east = (gradient - prior.gradient).unbind(-1)
        turned = torch.stack((cos * north + sin * east, cos * east - sin * north), -1)
        change = elements_gradient_at(planet, later) - gradient
        good = elements[:, 2] > 10000
        deviations.append((turned / prior.std)[good])
        changes.append((100 * change / field_curvature(elements).unsqueeze(-1))[good])
    for ratios, least, most in ((torch.cat(deviations), 0.75, 1.4), (torch.cat(changes), 0.75, 1.4)):
        rms = ratios.square().mean(0).sqrt()
        assert ((rms > least) & (rms < most)).all(), rms


def test_prior_is_narrow_along_the_azimuth():
    """Standard deviations 1 along and 3 across an azimuth of 30 deg, worked by hand."""
    std, turn = 0.01 * f64((1.0, 3.0)).expand(1, 2), torch.tensor(math.radians(30), dtype=F64)
    found = start(f64(0.0), GradientPrior(torch.zeros(1, 2, dtype=F64), std, turn), (0.0,), (1.0,)).covariance[0]
    half, cos2, sin2 = math.sqrt(3) / 4, 0.75, 0.25
    block = f64((cos2 + 9 * sin2, (1 - 9) * half), ((1 - 9) * half, sin2 + 9 * cos2))
    torch.testing.assert_close(found[1:, 1:], block)
    torch.testing.assert_close(found[0], f64(VARIANCE_FLOOR, 0.0, 0.0))


# --- what every function keeps ----------------------------------------------------------------------------------------


def fly(reading, moved, after, target, noise):
    """All functions in a row."""
    prior = dipole_prior(reading)
    track = start(reading, prior, noise)
    track = update(predict(track, moved), after, NOISE)
    known, shared = relate(track, curl_relation(after))
    return (*track, *way_to(known, target, 300.0, shared=shared), estimated_gradient(known))


def flight(dtype=F64):
    reading = f64(8.0, -16.0, 35000.0).expand(5, 3)
    after, target = reading + 0.1 * SCALES * randn(5, 3), reading + SCALES * randn(5, 3, seed=1)
    return [x.to(dtype) for x in (reading, 40 * randn(5, 2, seed=2), after, target, f64(*NOISE).expand(5, 3))]


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("backend", ["eager", "aot_eager"])
def test_filter_is_traced_whole(backend, dtype):
    """Nothing in it breaks the graph that torch.compile makes."""
    torch.compiler.reset()
    inputs = flight(dtype)
    for found, expected in zip(torch.compile(fly, fullgraph=True, backend=backend)(*inputs), fly(*inputs), strict=True):
        torch.testing.assert_close(found, expected)
        assert found.dtype == dtype


@pytest.mark.parametrize("place", range(5))
def test_nan_in_gives_nan_out_in_that_vehicle_alone(place):
    inputs, clean = flight(), fly(*flight())
    inputs[place] = inputs[place].clone()
    inputs[place][2] = NAN
    mean, covariance, way, way_covariance, gradient = fly(*inputs)
    assert way[2].isnan().all()
    if place != 3:  # the target is no part of the state
        assert mean[2].isnan().all()
        assert gradient[2].isnan().all()
    if place != 3 and place != 2:  # covariances do not depend on what is read
        assert covariance[2].isnan().any()
        assert way_covariance[2].isnan().all()
    others = [0, 1, 3, 4]
    for found, expected in zip((mean, covariance, way, way_covariance, gradient), clean, strict=True):
        torch.testing.assert_close(found[others], expected[others], rtol=0, atol=0)


def test_nan_of_an_element_stays_in_it():
    track = random_track(3)
    found = update(track, f64(1.0, NAN, 1.0), NOISE)
    assert found.mean[1].isnan().all()
    assert found.mean[[0, 2]].isfinite().all()
    noisy = update(track, f64(1.0, 1.0, 1.0), f64(1.0, 1.0, -1.0))
    assert noisy.mean[2].isnan().all()  # a negative standard deviation inside a tensor
    assert noisy.mean[:2].isfinite().all()


TRACK = FieldTrack(torch.zeros(4, 3, 3), torch.eye(3).expand(4, 3, 3, 3))
READING = torch.zeros(4, 3)
PRIOR = GradientPrior(torch.zeros(4, 3, 2), torch.ones(4, 3, 2), torch.zeros(4))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: dipole_prior(torch.zeros(4, 2)), r"reading must have the shape \(..., 3\), got \(4, 2\)"),
        (
            lambda: start(READING, PRIOR._replace(gradient=torch.zeros(4, 2, 2)), NOISE),
            r"prior_gradient .*\(4, 2, 2\)",
        ),
        (lambda: start(READING, PRIOR._replace(std=torch.zeros(4, 3)), NOISE), r"prior_std .* got \(4, 3\)"),
        (lambda: start(READING, PRIOR, (0.1, 0.1)), r"sensor_std must be 3 finite numbers, got \(0.1, 0.1\)"),
        (lambda: start(READING, PRIOR, (0.1, -0.2, 1.0)), "sensor_std must be a finite number from 0 on, got -0.2"),
        (lambda: start(READING, PRIOR, NOISE, scales=(1.0, 0.0, 1.0)), "scales must be a finite number above 0, got"),
        (lambda: start(READING, PRIOR, 0.1), "sensor_std must be 3 finite numbers, got 0.1"),
        (lambda: start(READING, PRIOR._replace(azimuth=0.1), NOISE), "azimuth must be a tensor"),
        (lambda: start(torch.tensor(1.0), PRIOR, NOISE), "prior_gradient"),
        (lambda: predict(TRACK, torch.zeros(4, 3)), r"displacement must have the shape \(..., 2\), got \(4, 3\)"),
        (lambda: predict(TRACK, torch.zeros(4, 2), (0.1, 0.1, -8.0)), "curvature must be .* got -8.0"),
        (lambda: predict(TRACK, torch.zeros(4, 2), torch.zeros(4, 2)), r"curvature .* got \(4, 2\)"),
        (lambda: predict(tuple(TRACK), torch.zeros(4, 2)), "track must be a FieldTrack"),
        (lambda: predict(FieldTrack(TRACK.mean, TRACK.mean), torch.zeros(4, 2)), r"shapes .*\(4, 3, 3\), \(4, 3, 3\)"),
        (lambda: update(FieldTrack(TRACK.mean[:2], TRACK.covariance), READING, NOISE), "mean and covariance must have"),
        (lambda: update(FieldTrack(READING[0], TRACK.covariance), READING, NOISE), "mean and covariance must have"),
        (lambda: update(FieldTrack(TRACK.mean[..., :2], TRACK.covariance), READING, NOISE), "mean must have the shape"),
        (lambda: update(TRACK, torch.zeros(4, 1), NOISE), r"reading must have the shape \(..., 3\), got \(4, 1\)"),
        (lambda: update(TRACK, READING, (0.1, -0.2, 1.0)), "sensor_std must be a finite number from 0 on, got -0.2"),
        (lambda: update(TRACK, READING, (0.1, NAN, 1.0)), "sensor_std must be 3 finite numbers"),
        (lambda: update(TRACK, READING, torch.zeros(4, 1)), r"sensor_std .* got \(4, 1\)"),
        (lambda: way_to(TRACK, torch.zeros(2), 300.0), r"target must have the shape \(..., 3\), got \(2,\)"),
        (lambda: way_to(TRACK, READING, 0.0), "range_km must be a finite number above 0, got 0.0"),
        (lambda: estimated_gradient(TRACK, (1.0, 1.0)), "scales must be 3 finite numbers"),
    ],
)
def test_bad_arguments_are_refused_by_name(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()


def test_inputs_are_left_as_they_are():
    track, reading = random_track(2, 3), randn(2, 3)
    before = [x.clone() for x in (*track, reading)]
    update(predict(track, randn(2, 2)), reading, NOISE)
    way_to(track, reading, 300.0)
    assert all(torch.equal(x, y) for x, y in zip((*track, reading), before, strict=True))
