"""Conditions that vehicles navigate in: the table of errors, files of them, and presets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import Compose, EnvBase, TransformedEnv

from magrl.checks import check_number, check_type
from magrl.errors.base import LEG_ERROR, TYPICAL_FIELD, EpisodeErrors
from magrl.errors.magnetic_weather import MagneticWeather
from magrl.errors.motion import MotionError
from magrl.errors.north import NorthReferenceError
from magrl.errors.sensors import SensorErrors
from magrl.errors.spikes import Spikes
from magrl.files import read_document
from magrl.sensor_std import SensorStd

ERRORS: dict[str, type[EpisodeErrors]] = {
    "motion": MotionError,
    "weather": MagneticWeather,
    "sensors": SensorErrors,
    "spikes": Spikes,
    "north": NorthReferenceError,
}
"""Errors by their names in files, in the order of an environment. An error of one's own is a further row."""
LEG_KM = 50.0
"""Leg that the noise of a log belongs to [km]."""


@dataclass(frozen=True)
class Conditions:
    """Errors under which a vehicle navigates.

    Args:
        name: name for messages and tables.
        speed_km_h: speed of the vehicle [km/h], for currents, the drift of a gyrocompass and the weather.
        errors: options of each error by its name in :data:`ERRORS`. ``"north"`` may be a unit of
            :data:`~magrl.errors.NORTH_REFERENCES`, or ``"magnetic"`` for a vehicle that has no true north
            (:class:`~magrl.errors.MagneticNorth`).

    Raises:
        ValueError: for an unknown error, option, unit or record, or an option that is out of its range.
        TypeError: for an option that is missing, or of another type.

    Example:
        >>> ship = Conditions("ship", 24.0, {"sensors": {"noise": (0.02, 0.02, 5.0)}, "north": {"constant_deg": 0.1}})
        >>> ship.std
        SensorStd(noise=(0.02, 0.02, 5.0), bias=(0.1, 0.0, 0.0), drift=(0.0, 0.0, 0.0), iron=(0.0, 0.0, 0.0))
    """

    name: str
    speed_km_h: float = 24.0
    errors: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_type(str, name=self.name)
        check_number(0, above=True, speed_km_h=self.speed_km_h)
        for name in self.errors:
            if name not in ERRORS:
                raise ValueError(f"Conditions have name, speed_km_h and the errors {', '.join(ERRORS)}, got {name!r}")
        _ = self._errors  # a wrong option raises here

    def transforms(self, seed: int = 0) -> list[EpisodeErrors]:
        """Return the errors as transforms, in the order of an environment; see :func:`with_conditions`.

        Args:
            seed: seed of the errors.

        Example:
            >>> [type(error).__name__ for error in CONDITIONS["aircraft"].transforms()]
            ['MotionError', 'MagneticWeather', 'SensorErrors', 'NorthReferenceError']
        """
        chosen = [(kind, self.errors[name]) for name, kind in ERRORS.items() if name in self.errors]
        return [kind.from_options(options, self.speed_km_h, seed) for kind, options in chosen]

    def replace_errors(self, **errors: Any) -> Conditions:
        """Return conditions with other errors, and the rest as here.

        Example:
            >>> len(CONDITIONS["aircraft"].replace_errors(spikes={"sizes": (1.0, 1.0, 99.0), "rate": 0.1}).errors)
            5
        """
        return replace(self, errors={**self.errors, **errors})

    @cached_property
    def _errors(self) -> list[EpisodeErrors]:
        """The errors, built once: what a vehicle knows of them does not depend on a seed."""
        return self.transforms()

    def drift_km(self, max_leg_km: float) -> float:
        """Return how much farther than a longest leg the errors may carry a vehicle, rounded up [km].

        It is at least 1 with errors of motion: they turn a leg, which an environment without drift does not allow.

        Args:
            max_leg_km: longest leg that a policy may command [km].

        Raises:
            ValueError: for a leg that is not above 0.

        Example:
            >>> CONDITIONS["laboratory"].drift_km(50.0), CONDITIONS["ship"].drift_km(50.0)
            (0.0, 4.0)
        """
        added = [error.farthest_km(max_leg_km) - max_leg_km for error in self._errors]
        moved = any(LEG_ERROR in error.true_keys for error in self._errors)
        return float(max(moved, math.ceil(max(added, default=0.0))))

    @cached_property
    def std(self) -> SensorStd:
        """Standard deviations of the errors of the readings, as a vehicle knows them, at :data:`TYPICAL_FIELD`."""
        field = torch.tensor(TYPICAL_FIELD, dtype=torch.float64)
        variances = [torch.stack(error.accuracy(field)).square() for error in self._errors]
        rows = sum(variances, torch.zeros(4, 3, dtype=torch.float64)).sqrt().tolist()
        return SensorStd(*(tuple(round(std, 6) for std in row) for row in rows))

    @cached_property
    def motion_std(self) -> tuple[float, float]:
        """Errors of dead reckoning along each axis, as a vehicle knows them.

        They are its constant drift [share of the distance], and the random part after 1 km [km].

        Log, current and the constant error of true north drift; eddies and the noise of the log are random.

        Example:
            >>> [round(number, 3) for number in CONDITIONS["ship"].motion_std]
            [0.027, 0.0]
        """
        motion = next((error for error in self._errors if isinstance(error, MotionError)), MotionError())
        log, noise = motion.log
        north = self.std.bias[0] if math.isfinite(self.std.bias[0]) else 0.0
        shares = log, motion.current_km_h / self.speed_km_h, math.radians(north)
        eddies = (motion.eddies_km_h / self.speed_km_h) ** 2 / 2 * motion.eddy_km / math.pi
        random = eddies + noise**2 / 2 * LEG_KM
        return math.hypot(*shares) / math.sqrt(2), math.sqrt(random)


def load_conditions(path: Path | str) -> Conditions:
    """Read conditions from a TOML or JSON file, whose keys are ``name``, ``speed_km_h`` and those of :data:`ERRORS`.

    The name is the file's by default. A program gives keys and seeds, not a file.

    Raises:
        ValueError: for a file that cannot be read, or an option that is unknown or out of its range, with the file.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "boat.toml"
        >>> _ = path.write_text("north.constant_deg = 0.5" + chr(10) + "sensors.vector.hard_iron_nt = [20, 20, 20]")
        >>> boat = load_conditions(path)
        >>> boat.name, boat.std.bias[2]
        ('boat', 20.0)
    """
    path = Path(path)
    try:
        return _conditions(path.stem, read_document(path))
    except (ValueError, TypeError, OSError, OverflowError) as error:
        raise ValueError(f"{path}: {error}") from error


def _conditions(name: str, content: Mapping[str, Any]) -> Conditions:
    """Return the conditions that a table of a file holds."""
    own = {key: content[key] for key in ("name", "speed_km_h") if key in content}
    return Conditions(**{"name": name, **own}, errors={key: content[key] for key in content if key not in own})


CONDITIONS: Mapping[str, Conditions] = {
    name: _conditions(name, content)
    for name, content in read_document(Path(__file__).with_name("presets.toml")).items()
}
"""Presets, each with its sources: ``presets.toml``."""


def conditions_named(name: str) -> Conditions:
    """Return a preset of :data:`CONDITIONS`, or the conditions of a file; see :func:`load_conditions`.

    Args:
        name: name of a preset, perhaps with a record of :data:`magrl.field.WEATHER` in which it travels; or path of a
            file that ends in .toml or .json.

    Raises:
        ValueError: for an unknown name, listing those known, or a file that is wrong.

    Example:
        >>> conditions_named("aircraft").errors["north"]
        'fiber-optic'
        >>> conditions_named("ship, disturbed").errors["weather"]
        {'record': 'disturbed', 'span_h': 200.0}
    """
    if isinstance(name, str) and name.endswith((".toml", ".json")):
        return load_conditions(name)
    vehicle, _, record = name.partition(", ")
    if vehicle not in CONDITIONS:
        names = ", ".join(map(repr, CONDITIONS))
        raise ValueError(f"conditions must be one of {names}, or a file that ends in .toml or .json, got {name!r}")
    chosen = CONDITIONS[vehicle]
    weather = {**chosen.errors.get("weather", {}), "record": record}
    return replace(chosen.replace_errors(weather=weather), name=name) if record else chosen


def with_conditions(env: EnvBase, conditions: Conditions | str, seed: int = 0) -> EnvBase:
    """Return an environment under conditions, or the environment itself if they have no error.

    Args:
        env: navigation environment; errors of motion need ``drift_km=conditions.drift_km(max_leg_km)``.
        conditions: conditions, or the name of a preset.
        seed: seed of the errors.

    Raises:
        ValueError: for an unknown preset, or an environment that does not allow the farthest leg.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> aircraft = CONDITIONS["aircraft"]
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0, drift_km=aircraft.drift_km(50.0))
        >>> sorted(set(with_conditions(env, aircraft).reset().keys()) & {"true_field", "sensor_std", "bias_std"})
        ['bias_std', 'sensor_std', 'true_field']
    """
    conditions = conditions_named(conditions) if isinstance(conditions, str) else conditions
    check_type(Conditions, conditions=conditions)
    if not conditions.errors:
        return env
    env = TransformedEnv(env, Compose(*conditions.transforms(seed)))
    _ = env.action_spec  # an error before the first episode
    return env
