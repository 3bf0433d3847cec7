"""A random magnetic field of the Earth's crust, at wavelengths that models of the whole Earth lack.

:class:`~magrl.field.WMMHR` holds wavelengths down to 300 km. :class:`RandomCrust` draws shorter ones on a region, from
a published spectrum; :class:`CrustedField` adds them to any field model.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from magrl.checks import check_number, check_numbers, check_tensor, require
from magrl.field.model import FieldModel, Float64Module, in_chunks
from magrl.geodesy import REFERENCE_RADIUS_KM, WGS84_E2, check_box, curvature_radii


def crustal_spectrum(degree: Tensor) -> Tensor:
    """Return the mean square field of the crust in each degree, at the Earth's surface (Lowes-Mauersberger spectrum).

    ``R_n = 0.52 (n + 1) (1 - exp(-n / 290)) / (n / 290)``: it rises with the degree, and is flat above 290.

    Args:
        degree: ``(...)`` spherical harmonic degree n, above 0; the wavelength is about 40 000 km / n.

    Returns:
        ``(...)`` [nT²] in each degree.

    Raises:
        TypeError: for degrees that are not a tensor of real numbers.
        ValueError: for a degree that is not above 0.

    Source:
        M. G. McLeod and P. J. Coleman, Spatial power spectra of the crustal geomagnetic field and core geomagnetic
        field, Physics of the Earth and Planetary Interiors 23 (1980), abstract.

    Example:
        >>> crustal_spectrum(torch.tensor([30.0, 133.0, 400.0])).round()
        tensor([ 15.,  56., 113.])
    """
    check_tensor(degree=degree)
    require(degree > 0, degree, "degree {} is not above 0")
    scale = degree / 290
    return 0.52 * (degree + 1) * -torch.expm1(-scale) / scale


class RandomCrust(Float64Module):
    """A random field of the crust on a region, at wavelengths that models of the whole Earth lack.

    The potential is a sum of plane waves on a conformal (stereographic) map of the region, with random directions and
    phases. The field is the exact gradient of it, so it has no curl. Each wave decreases with altitude as the solid
    harmonic of its degree. On 20 by 25 degrees the divergence is 0.6 % of the gradient (root mean square). Every wave
    has the power that the spectrum gives to its share of the degrees.

    Args:
        latitude: southern and northern edge [deg].
        longitude: western and eastern edge [deg], rising; may cross the antimeridian (for example 170 to 190).
        seed: random seed; the field is a pure function of the arguments.
        degrees: lowest and highest degree; by default wavelengths of 300 to 100 km.
        strength: factor of the field; 1 is the spectrum's 154 nT (root mean square) at the default degrees.
        waves: number of waves.
        altitude_km: height above the ellipsoid [km].

    Raises:
        ValueError: for a number out of range, an empty or reversed box, or one with a corner more than 20 degrees from
            its center, where the map is not faithful.

    Source:
        Spectrum: :func:`crustal_spectrum`. Stereographic map: J. P. Snyder, Map projections: a working manual, USGS
        Professional Paper 1395 (1987).

    Example:
        >>> crust = RandomCrust((-10, 0), (160, 170), seed=0)
        >>> crust(torch.tensor(-5.0), torch.tensor(165.0)).round()
        tensor([-105.,  129.,   62.], dtype=torch.float64)
    """

    CHUNK = 1024
    """Points evaluated at a time; temporary memory is about 10 kB per point."""
    MAX_RADIUS_DEG = 20.0
    """Longest distance from the center of the region to a corner [degrees of arc]."""
    wave_numbers: Tensor
    phases: Tensor
    sine_weights: Tensor
    cosine_weights: Tensor
    axes: Tensor

    def __init__(
        self,
        latitude: tuple[float, float],
        longitude: tuple[float, float],
        seed: int,
        *,
        degrees: tuple[float, float] = (134, 400),
        strength: float = 1.0,
        waves: int = 256,
        altitude_km: float = 0.0,
    ) -> None:
        super().__init__()
        check_box(latitude, longitude)
        check_number(0, 2**63 - 1, whole=True, seed=seed)
        check_number(1, whole=True, waves=waves)
        check_number(0, altitude_km=altitude_km, strength=strength)
        check_numbers(2, degrees=degrees)
        if not 1 <= degrees[0] < degrees[1]:
            raise ValueError(f"degrees must rise from 1 or more, got {degrees}")
        self.latitude, self.longitude, self.seed = tuple(latitude), tuple(longitude), int(seed)
        self.degrees, self.altitude_km, self.strength = tuple(degrees), float(altitude_km), float(strength)
        for name, values in _drawn_waves(degrees, waves, self.seed, self.altitude_km).items():
            self.register_buffer(name, values * strength if name.endswith("weights") else values)
        self.register_buffer("axes", _map_axes(math.radians(sum(latitude) / 2)))
        self._check_size()

    def forward(self, latitude: Tensor, longitude: Tensor) -> Tensor:
        """Return the field vector.

        Args:
            latitude: ``(...)`` geodetic [deg].
            longitude: ``(...)`` [deg], any turn.

        Returns:
            ``(..., 3)`` float64: north, east, down [nT]; NaN outside the box.
        """
        return self.value_and_gradient(latitude, longitude)[0]

    def value_and_gradient(self, latitude: Tensor, longitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return the field vector and its exact horizontal gradient.

        Args:
            latitude: ``(...)`` geodetic [deg].
            longitude: ``(...)`` [deg], any turn.

        Returns:
            ``(..., 3)`` [nT] and ``(..., 3, 2)`` [nT/km] northward and eastward; NaN outside the box.
        """
        check_tensor(latitude=latitude, longitude=longitude)
        position = torch.stack(torch.broadcast_tensors(latitude.double(), longitude.double()))
        rows = in_chunks(self._rows, [position.reshape(2, -1)], 9, self.CHUNK).reshape(9, *position.shape[1:])
        return rows[:3].movedim(0, -1), rows[3:].unflatten(0, (3, 2)).movedim((0, 1), (-2, -1))

    def _rows(self, position: Tensor) -> Tensor:
        """Return north, east, down [nT], then the derivative of each northward and eastward [nT/km]: ``(9, P)``."""
        latitude, turn = torch.deg2rad(position[0]), self._turn(position[1])
        place, slope, bend = _stereographic(latitude, torch.deg2rad(turn), self.axes)
        angle = self.wave_numbers @ place + self.phases
        sine, cosine = self.sine_weights @ angle.sin(), self.cosine_weights @ angle.cos()
        # Derivatives of the potential by latitude and longitude [rad], by the chain rule over the map.
        first = -torch.einsum("jp,jap->ap", sine[:2], slope)
        outer = cosine[[0, 1, 1, 2]].unflatten(0, (2, 2))
        second = -torch.einsum("iap,ijp,jbp->abp", slope, outer, slope) - torch.einsum("jp,jabp->abp", sine[:2], bend)
        lengths, lengthening = _radian_lengths(position[0], self.altitude_km)
        horizontal, down = -first / lengths, -cosine[3:]
        second[:, 0] += horizontal * lengthening
        gradient = -second / (lengths.unsqueeze(1) * lengths)
        down_gradient = torch.einsum("jp,jap->ap", sine[2:], slope) / lengths
        rows = torch.cat((horizontal, down, gradient.flatten(0, 1), down_gradient))
        return rows.masked_fill_(~self._inside(position[0], turn), torch.nan)

    def _turn(self, longitude: Tensor) -> Tensor:
        """Return the longitude from the middle of the box, in [-180, 180] degrees."""
        turn = longitude - sum(self.longitude) / 2
        return turn - 360 * torch.round(turn / 360)

    def _inside(self, latitude: Tensor, turn: Tensor) -> Tensor:
        """Return where a position is in the box; its edges belong to it, even if rounding moves them out."""
        (south, north), half_width = self.latitude, (self.longitude[1] - self.longitude[0]) / 2
        return (latitude >= south - 1e-9) & (latitude <= north + 1e-9) & (turn.abs() <= half_width + 1e-9)

    def _check_size(self) -> None:
        """Raise unless all corners are near enough to the center."""
        turn = math.radians((self.longitude[1] - self.longitude[0]) / 2)
        corners = torch.tensor([[math.radians(x), turn] for x in self.latitude], dtype=torch.float64)
        radius = torch.rad2deg(torch.acos((self.axes[2] @ _directions(*corners.T)[0]).clamp(-1, 1))).max()
        if not radius <= self.MAX_RADIUS_DEG:
            raise ValueError(
                f"latitudes {self.latitude}, longitudes {self.longitude} reach {radius:.1f} degrees from their center; "
                f"a random crust is valid to {self.MAX_RADIUS_DEG:g} degrees: take a smaller box"
            )

    def extra_repr(self) -> str:
        """Return the box, the seed, the degrees and the altitude as text."""
        return (
            f"latitude={self.latitude}, longitude={self.longitude}, seed={self.seed}, degrees={self.degrees}, "
            f"strength={self.strength:g}, altitude_km={self.altitude_km}"
        )


def _drawn_waves(degrees: tuple[float, float], count: int, seed: int, altitude_km: float) -> dict[str, Tensor]:
    """Return the waves: their wave numbers and phases, and weights of the sums over their sines and cosines.

    The degrees of the waves are stratified: one wave in each of ``count`` equal parts of the interval.
    """
    generator = torch.Generator().manual_seed(seed)
    within, azimuth, phase = torch.rand(3, count, generator=generator, dtype=torch.float64)
    width = (degrees[1] - degrees[0] + 1) / count
    degree = degrees[0] - 0.5 + width * (torch.arange(count) + within)
    wave_number, decay = torch.sqrt(degree * (degree + 1)) / REFERENCE_RADIUS_KM, (degree + 1) / REFERENCE_RADIUS_KM
    # The mean square field of a wave of the potential is half its square times that of wave number and decay.
    amplitude = torch.sqrt(2 * crustal_spectrum(degree) * width / (wave_number**2 + decay**2))
    height = 1 + altitude_km / REFERENCE_RADIUS_KM
    amplitude, decay = amplitude * height ** -(degree + 1), decay / height
    k = wave_number * torch.stack((torch.cos(2 * math.pi * azimuth), torch.sin(2 * math.pi * azimuth)))
    outer = torch.stack((k[0] * k[0], k[0] * k[1], k[1] * k[1], decay))
    return {
        "wave_numbers": k.T.contiguous(),
        "phases": 2 * math.pi * phase.unsqueeze(-1),
        "sine_weights": amplitude * torch.cat((k, k * decay)),
        "cosine_weights": amplitude * outer,
    }


def _map_axes(latitude: float) -> Tensor:
    """Return the axes of the map at a latitude [rad] on the meridian of longitude 0: north, east, up, ``(3, 3)``."""
    sine, cosine = math.sin(latitude), math.cos(latitude)
    return torch.tensor(((-sine, 0, cosine), (0, 1, 0), (cosine, 0, sine)), dtype=torch.float64)


def _directions(latitude: Tensor, longitude: Tensor) -> Tensor:
    """Return unit vectors from latitude and longitude [rad], and their derivatives by these: ``(6, 3, P)``.

    The order is: none, latitude, longitude, latitude twice, both, longitude twice.
    """
    (sp, cp), (sl, cl) = ((x.sin(), x.cos()) for x in (latitude, longitude))
    zero = torch.zeros_like(sp)
    rows = (
        (cp * cl, cp * sl, sp),
        (-sp * cl, -sp * sl, cp),
        (-cp * sl, cp * cl, zero),
        (-cp * cl, -cp * sl, -sp),
        (sp * sl, -sp * cl, zero),
        (-cp * cl, -cp * sl, zero),
    )
    return torch.stack([torch.stack(row) for row in rows])


def _stereographic(latitude: Tensor, longitude: Tensor, axes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Map places conformally on the plane: ``z = 2 R (north, east) / (1 + up)``, with the components of a unit vector.

    Args:
        latitude: ``(P,)`` [rad].
        longitude: ``(P,)`` from the middle of the map [rad].
        axes: ``(3, 3)`` of :func:`_map_axes`.

    Returns:
        Northward and eastward place on the map ``(2, P)`` [km], its derivatives by latitude and longitude ``(2, 2, P)``
        and the second ones ``(2, 2, 2, P)``, from those of ``(1 + up) z = 2 R (north, east)``.
    """
    components = axes @ _directions(latitude, longitude)
    flat, up = 2 * REFERENCE_RADIUS_KM * components[:, :2], components[:, 2:]
    scale = 1 + up[0]
    place = flat[0] / scale
    first = (flat[1:3] - up[1:3] * place) / scale
    second = []
    for row, (a, b) in zip((3, 4, 5), ((0, 0), (0, 1), (1, 1)), strict=True):
        second.append((flat[row] - up[row] * place - up[1 + a] * first[b] - up[1 + b] * first[a]) / scale)
    bend = torch.stack([second[k] for k in (0, 1, 1, 2)], 1).unflatten(1, (2, 2))
    return place, first.movedim(0, 1), bend


def _radian_lengths(latitude: Tensor, altitude_km: float) -> tuple[Tensor, Tensor]:
    """Return the lengths of a radian of latitude and longitude [km], and their derivatives by latitude: ``(2, P)``."""
    meridian, prime_vertical = curvature_radii(latitude)
    phi = torch.deg2rad(latitude)
    north, east = meridian + altitude_km, (prime_vertical + altitude_km) * phi.cos()
    stretch = 3 * WGS84_E2 * meridian * phi.sin() * phi.cos() / (1 - WGS84_E2 * phi.sin() ** 2)
    return torch.stack((north, east)), torch.stack((stretch, -north * phi.sin()))


class CrustedField(nn.Module):
    """A field model with the field of a crust added.

    Args:
        field: field model, for example a :class:`~magrl.field.RegionalField` of IGRF or of :class:`WMMHR`.
        crust: field model of the crust at the same altitude, for example :class:`RandomCrust`.

    Raises:
        TypeError: for an argument that is not a field model.

    Example:
        >>> from magrl.field import IGRF
        >>> field = CrustedField(IGRF("2026-07-01"), RandomCrust((-10, 0), (160, 170), seed=0))
        >>> field(torch.tensor(-5.0), torch.tensor(165.0)).shape
        torch.Size([3])
    """

    def __init__(self, field: FieldModel, crust: FieldModel) -> None:
        super().__init__()
        for name, model in (("field", field), ("crust", crust)):
            if not callable(model) or not hasattr(model, "value_and_gradient"):
                raise TypeError(f"{name} must be a field model, with value_and_gradient, got {model!r}")
        self.field, self.crust = field, crust

    def forward(self, latitude: Tensor, longitude: Tensor) -> Tensor:
        """Return the sum of the field vectors, ``(..., 3)`` [nT], at latitude and longitude ``(...)`` [deg]."""
        return self.field(latitude, longitude) + self.crust(latitude, longitude)

    def value_and_gradient(self, latitude: Tensor, longitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sum of the vectors, and of their derivatives northward and eastward, ``(..., 3, 2)`` [nT/km]."""
        field, crust = (model.value_and_gradient(latitude, longitude) for model in (self.field, self.crust))
        return field[0] + crust[0], field[1] + crust[1]
