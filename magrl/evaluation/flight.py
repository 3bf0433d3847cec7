"""Flights: the vehicles of a scenario with the errors of their sensors, and the policies that navigate them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field, PlainValidator, field_serializer
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv

from magrl.checks import check_device
from magrl.envs import GeomagneticNavEnv, Scenario, Trips, named_trips
from magrl.errors import KnownPlace, TargetErrors, with_conditions
from magrl.errors.conditions import CONDITIONS, Conditions, conditions_named
from magrl.errors.north import MAGNETIC
from magrl.evaluation.episodes import episode_measures, evaluation_rollout
from magrl.navigators import Navigator, policy_env
from magrl.navigators.names import make_navigator
from magrl.pilot import Rules, earth_model
from magrl.pilot.records import Known
from magrl.sensor_std import PERFECT, Noise, North, SensorStd
from magrl.transforms import TrackField
from magrl.transforms.track import known_keys

_NOISE = "Errors of the readings [deg, deg, nT]"
_ERRORS = f"""White noise on D [deg], I [deg], B_H [nT] (standard deviations), or the errors of a vehicle:
{", ".join(CONDITIONS)}, or a file (docs/results.md). By default none, or the noise of the training."""


def _errors(value: Any) -> Any:
    """Return errors in plain form: three numbers, conditions, or the text that names some."""
    if isinstance(value, str | Path):
        conditions_named(str(value))  # an unknown name raises here
        return str(value)
    return value if value is None or isinstance(value, Conditions) else SensorStd.of(value).noise


class Sheet(Known):
    """The data sheet of simulated vehicles: errors of their sensors, and what they know of them and of their trip.

    Options of commands and tables, files of results and the lines below tables follow from its fields: for a new one,
    declare it here, or in :class:`~magrl.pilot.records.Known` if the pilot uses it, and use it.

    Args:
        errors: also :class:`~magrl.errors.Conditions`.
        start_km: as in :class:`~magrl.pilot.records.Known`, with ``target_std`` and ``confidence``.

    Raises:
        ValueError: for unknown conditions, or a value out of its range.

    Example:
        >>> Sheet.lines(Sheet(errors="ship", start_km=5.0).model_dump())
        ['Error of the known start: 5 km', 'Errors of the readings: ship']
    """

    errors: Annotated[Noise | str | None, PlainValidator(_errors), Field(title=_NOISE, description=_ERRORS)] = (
        PERFECT.noise
    )
    north: Annotated[North, Field(title="North")] = "true"
    """North of the vehicles: true (they measure D), or magnetic (I and B_H alone), as for boat and drone."""
    model: Annotated[str | None, Field(title="Model of the Earth")] = None
    """Model of the Earth that vehicles carry, of the date: IGRF-14, IGRF-13, IGRF-2005, ...; none by default."""

    @field_serializer("errors")
    def _plain_errors(self, errors: Any) -> Any:
        """Return the name of conditions, without a path of this machine."""
        return Path(errors).name if isinstance(errors, str) else getattr(errors, "name", errors)

    @staticmethod
    def lines(record: Mapping[str, Any]) -> list[str]:
        """Return what is not as by default in a record with the fields of a sheet, as text with units."""
        lines = list[str]()
        for name, field in Sheet.model_fields.items():
            label, _, units = (field.title or "").rstrip("]").partition(" [")
            if not label or (value := record.get(name, field.default)) == field.default:
                continue
            if isinstance(value, float | tuple):
                numbers = value if isinstance(value, tuple) else (value,)
                value = ", ".join(map("{:g} {}".format, numbers, units.split(", ")))
            lines.append(f"{label}: {'not measured' if value is None else value}")
        return lines

    @property
    def conditions(self) -> Conditions:
        """Errors of readings and motion, with the north of the vehicles."""
        errors: Any = conditions_named(self.errors) if isinstance(self.errors, str) else self.errors
        if not isinstance(errors, Conditions):
            errors = Conditions("noise", errors={"sensors": {"noise": errors}} if any(errors or ()) else {})
        return errors.replace_errors(north=MAGNETIC) if self.north == MAGNETIC else errors

    def rules(self, scenario: Scenario, conditions: Conditions) -> dict[str, Any]:
        """Return the values of :class:`~magrl.pilot.Rules` that vehicles know in a scenario under conditions."""
        known = {name: value for name in Known.model_fields if (value := getattr(self, name)) is not None}
        if self.model is None:
            known.pop("start_km", None)
            return known
        known["model"] = earth_model(self.model, scenario.date, scenario.altitude_km)
        if self.start_km is not None:
            known |= {"target_km": 0.0, "target_std": self.target_std}
            known |= dict(zip(("drift", "wander_km"), conditions.motion_std, strict=True))
        return known


class Flight:
    """Vehicles in a scenario, with the errors of their sensors and what they know.

    Args:
        scenario: scenario. The stated weather is for its longest distance.
        sheet: data sheet of the vehicles; perfect sensors, and no other knowledge, by default.
        num_envs: number of vehicles; by default one for each trip of the scenario, and one without trips.
        seed: random seed of the errors, random start headings and metaheuristics.
        device: device of the environment.
        options: fields of :class:`Sheet` that replace the sheet's, such as ``errors``; and further options of
            :class:`~magrl.envs.GeomagneticNavEnv`, such as ``max_steps`` or ``zeta``.

    Attributes:
        sheet: data sheet, with the north that the errors decide.
        rules: values of :class:`~magrl.pilot.Rules` that vehicles know beside the limits of the environment.
        base: environment without errors.
        env: environment with errors.
        sensor_std: accuracy of the sensors as the vehicles know it.

    Raises:
        ValueError: for unknown conditions, or an option out of its range.

    Example:
        >>> flight = Flight(Scenario(), errors=(0.05, 0.05, 5.0), num_envs=3)
        >>> flight.fly("secant")["next", "success"].any(1).all()
        tensor(True)
    """

    def __init__(
        self,
        scenario: Scenario,
        sheet: Sheet | None = None,
        *,
        num_envs: int | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
        **options: Any,
    ) -> None:
        check_device(device)
        sheet, self.seed = (sheet or Sheet()).taking(options), seed
        conditions, trip_km = sheet.conditions, max(500.0, scenario.distance_range_km[1])
        if "weather" in conditions.errors:
            conditions = conditions.replace_errors(weather={"trip_km": trip_km, **conditions.errors["weather"]})
        self.sensor_std = conditions.std
        north = MAGNETIC if conditions.std.magnetic else "true"
        self.sheet = sheet.replace(errors=sheet.errors or PERFECT.noise, north=north)
        self.rules = sheet.rules(scenario, conditions)
        trips = 1 if scenario.trips is None else len(scenario.trips.start)
        options |= {"num_envs": trips if num_envs is None else num_envs, "seed": seed, "device": device}
        drift = {"drift_km": conditions.drift_km(options.get("max_leg_km", scenario.max_leg_km))}
        self.base = GeomagneticNavEnv(scenario, **drift | options)
        self.env = with_conditions(self.base, conditions, seed)
        if sheet.target_std is not None and any(sheet.target_std):
            drawn = (0.0 if conditions.std.magnetic else sheet.target_std[0], *sheet.target_std[1:])  # compass: D is 0
            self.env = TransformedEnv(self.env, TargetErrors(drawn, seed=seed), auto_unwrap=True)
        if sheet.start_km is not None:
            self.env = TransformedEnv(self.env, KnownPlace(sheet.start_km, seed=seed), auto_unwrap=True)

    def navigator(self, policy: TensorDictModuleBase | str, **options: Any) -> TensorDictModuleBase:
        """Return a policy that flies within the limits of the environment, with the accuracy of its sensors.

        Args:
            policy: policy or navigator of the plain environment, or the text that names one, as
                :func:`magrl.navigators.names.make_navigator` takes it.
            options: of that function.

        Raises:
            ValueError: for an unknown name, or a policy of another field or of longer legs.
        """
        if isinstance(policy, str):
            policy = make_navigator(policy, self.base, sensor_std=self.sensor_std, **{"seed": self.seed} | options)
        return policy.fitted(self.base, self.rules) if isinstance(policy, Navigator) else policy

    def env_of(self, policy: TensorDictModuleBase, *, track: bool = False) -> EnvBase:
        """Return the environment with what a policy reads, as :func:`~magrl.navigators.policy_env` does.

        With arrival ``"declared"``, navigators and trained agents declare from a track of their own readings; another
        policy writes the third action itself.

        Args:
            policy: policy or navigator.
            track: whether to add the track of the vehicle (:class:`~magrl.transforms.TrackField`) for any policy.
        """
        env = policy_env(self.env, policy, **self.rules)
        if not track or "track" in env.observation_spec.keys():  # noqa: SIM118 - a Composite is no mapping
            return env
        rules = Rules(**self.base.limits | self.rules)
        estimates = TrackField(rules, known_keys(env.observation_spec), out_keys=["track"])
        return TransformedEnv(env, estimates, auto_unwrap=True)

    def fly(self, policy: TensorDictModuleBase | str) -> TensorDict:
        """Return a rollout of the first episode of each vehicle, as :func:`evaluation_rollout` does.

        Args:
            policy: as of :meth:`navigator`.

        Raises:
            TypeError: for a policy that is not callable.
            ValueError: as :meth:`navigator`.
        """
        policy = self.navigator(policy)
        return evaluation_rollout(self.env_of(policy), policy)


def evaluate(policy: TensorDictModuleBase | str, trips: Scenario | Trips | str, **options: Any) -> TensorDict:
    """Fly each trip exactly once, without exploration, and return the measures of the episodes.

    Args:
        policy: policy or navigator of the plain environment, or the text that names one, as
            :func:`magrl.navigators.names.make_navigator` takes it: ``"secant"``, ``"sac.onnx"``. A
            trained policy is flown within the limits of the environment (:meth:`magrl.FieldPolicy.for_env`).
        trips: scenario with trips; or trips, or the name of a frozen set such as ``"test-1000"``, in the paper's
            region.
        options: of :class:`Flight`, such as ``errors`` and other fields of :class:`Sheet`. All trips are flown at once:
            split a set that is too large.

    Returns:
        ``(M,)``, one row for each trip in its order, with the measures of
        :func:`magrl.evaluation.episode_measures`. :func:`magrl.evaluation.summarize` takes it, and
        ``pandas.DataFrame(episodes.to_dict(convert_tensors="numpy"))`` is its data frame.

    Raises:
        TypeError: for a policy that is not callable, or trips of another type.
        ValueError: for a scenario without trips, a policy of another field or of longer legs, or another value out of
            its range.

    Example:
        >>> episodes = evaluate("secant", "paper-100")
        >>> episodes.shape, episodes["success"].double().mean()
        (torch.Size([100]), tensor(1., dtype=torch.float64))
    """
    flight = Flight(_with_trips(trips), **options)
    return TensorDict(episode_measures(flight.fly(policy)), [flight.base.num_envs])


def _with_trips(trips: Scenario | Trips | str) -> Scenario:
    """Return a scenario with trips; raise if it has none."""
    trips = named_trips(trips) if isinstance(trips, str) else trips
    scenario = trips if isinstance(trips, Scenario) else Scenario().with_trips(trips)
    if scenario.trips is None:
        raise ValueError("the scenario has no trips to fly: scenario.with_trips(scenario.random_trips(300, seed=0))")
    return scenario
