"""Flights: the vehicles of a scenario with the errors of their sensors, and the policies that navigate them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv

from magrl.checks import check_choice, check_device
from magrl.envs import GeomagneticNavEnv, Scenario, Tasks, named_tasks
from magrl.evaluation.episodes import episode_measures, evaluation_rollout
from magrl.evaluation.navigators import make_navigator
from magrl.navigators import Navigator, policy_env
from magrl.sensor_std import PERFECT, SensorStd
from magrl.tracking import Rules, earth_model
from magrl.tracking.earth import EarthModel
from magrl.transforms import Conditions, KnownPlace, TargetErrors, TrackField, conditions_named, with_conditions
from magrl.transforms.errors.north import MAGNETIC
from magrl.transforms.track import known_keys

Errors: TypeAlias = Conditions | Sequence[float] | str | Path
NORTHS = ("true", MAGNETIC)


class Flight:
    """Vehicles in a scenario, with the errors of their sensors and the accuracy that they know.

    Args:
        scenario: scenario.
        errors: standard deviations of white noise on D [deg], I [deg], B_H [nT]; or the errors of a real vehicle:
            :class:`~magrl.transforms.Conditions`, a name of :data:`magrl.transforms.CONDITIONS`, or a file of
            conditions (:func:`magrl.transforms.load_conditions`). The stated weather is for the longest distance of the
            scenario.
        north: ``"true"``, or ``"magnetic"`` for vehicles that have no true north: they measure I and B_H, and steer by
            their compass (:class:`magrl.transforms.MagneticNorth`), whatever ``errors`` say of a north reference.
        model: model of the Earth that the vehicles carry, as of the date of the scenario
            (:func:`magrl.tracking.earth_model`): ``"IGRF-14"``, ``"IGRF-13"``, ``"IGRF-2005"``; None without one, as in
            the paper.
        start_km: root mean square error of the place where they start [km]; None where they do not know it.
        target_km: the same of the destination, where they know the start.
        target_std: standard deviations of D [deg], I [deg], B_H [nT] of the elements at the destination, which have
            such errors (:class:`magrl.transforms.TargetErrors`) and state them; None for vehicles that know the start
            and take the elements from their own model.
        rules: further values of :class:`magrl.tracking.Rules`, such as ``step_price``.
        confidence: minimum probability at which navigators declare an arrival, with arrival ``"declared"``.
        num_envs: number of vehicles; by default one for each task of the scenario, and one without tasks.
        seed: random seed of the errors, random start headings and metaheuristics.
        device: device of the environment.
        options: further options of :class:`~magrl.envs.GeomagneticNavEnv`, such as ``max_steps`` or ``zeta``.

    Attributes:
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
        *,
        errors: Errors = PERFECT.noise,
        north: str = "true",
        model: EarthModel | str | None = None,
        start_km: float | None = None,
        target_km: float = 0.0,
        target_std: Sequence[float] | None = (0.0, 0.0, 0.0),
        rules: Mapping[str, Any] | None = None,
        confidence: float = 0.0,
        num_envs: int | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
        **options: Any,
    ) -> None:
        check_device(device)
        self.seed = seed
        self.rules: dict[str, Any] = {"confidence": confidence, **(rules or {})}
        tasks = 1 if scenario.tasks is None else len(scenario.tasks.start)
        options |= {"num_envs": tasks if num_envs is None else num_envs, "seed": seed, "device": device}
        errors = conditions_named(str(errors)) if isinstance(errors, str | Path) else errors
        check_choice(NORTHS, north=north)
        if not isinstance(errors, Conditions):
            noise = SensorStd.of(errors).noise
            errors = Conditions("noise", errors={"sensors": {"noise": noise}} if any(noise) else {})
        if north == MAGNETIC:
            errors = errors.replace_errors(north=MAGNETIC)
        if "weather" in errors.errors:
            trip_km = max(500.0, scenario.distance_range_km[1])
            errors = errors.replace_errors(weather={"trip_km": trip_km, **errors.errors["weather"]})
        drift = {"drift_km": errors.drift_km(options.get("max_leg_km", scenario.max_leg_km))}
        self.base = GeomagneticNavEnv(scenario, **drift | options)
        self.env = with_conditions(self.base, errors, seed)
        self.sensor_std = errors.std
        if model is not None:
            self.rules["model"] = earth_model(model, scenario.date, scenario.altitude_km)
        if target_std is not None and any(target_std):
            self.rules["target_std"] = target_std
            drawn = (0.0 if errors.std.magnetic else target_std[0], *target_std[1:])  # by a compass, D is 0 everywhere
            self.env = TransformedEnv(self.env, TargetErrors(drawn, seed=seed), auto_unwrap=True)
        if start_km is not None:
            told = {"start_km": start_km, "target_km": target_km, "target_std": target_std}
            told |= dict(zip(("drift", "wander_km"), errors.motion_std, strict=True))
            self.rules |= told if model is not None else {}
            self.env = TransformedEnv(self.env, KnownPlace(start_km, target_km, seed=seed), auto_unwrap=True)

    def navigator(self, policy: TensorDictModuleBase | str, **options: Any) -> TensorDictModuleBase:
        """Return a policy that flies within the limits of the environment, with the accuracy of its sensors.

        Args:
            policy: policy or navigator of the plain environment, or the text that names one, as
                :func:`magrl.evaluation.navigators.make_navigator` takes it.
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


def evaluate(policy: TensorDictModuleBase | str, tasks: Scenario | Tasks | str, **options: Any) -> TensorDict:
    """Fly each task exactly once, without exploration, and return the measures of the episodes.

    Args:
        policy: policy or navigator of the plain environment, or the text that names one, as
            :func:`magrl.evaluation.navigators.make_navigator` takes it: ``"secant"``, ``"sac.onnx"``. A
            trained policy is flown within the limits of the environment (:meth:`magrl.FieldPolicy.for_env`).
        tasks: scenario with tasks; or tasks, or the name of a frozen set such as ``"test-1000"``, in the paper's
            region.
        options: of :class:`Flight`, such as ``errors``. All tasks are flown at once: split a set that is too large.

    Returns:
        ``(M,)``, one row for each task in its order, with the measures of
        :func:`magrl.evaluation.episode_measures`. :func:`magrl.evaluation.summarize` takes it, and
        ``pandas.DataFrame(episodes.to_dict(convert_tensors="numpy"))`` is its data frame.

    Raises:
        TypeError: for a policy that is not callable, or tasks of another type.
        ValueError: for a scenario without tasks, a policy of another field or of longer legs, or another value out of
            its range.

    Example:
        >>> episodes = evaluate("secant", "paper-100")
        >>> episodes.shape, episodes["success"].double().mean()
        (torch.Size([100]), tensor(1., dtype=torch.float64))
    """
    flight = Flight(_with_tasks(tasks), **options)
    return TensorDict(episode_measures(flight.fly(policy)), [flight.base.num_envs])


def _with_tasks(tasks: Scenario | Tasks | str) -> Scenario:
    """Return a scenario with tasks; raise if it has none."""
    tasks = named_tasks(tasks) if isinstance(tasks, str) else tasks
    scenario = tasks if isinstance(tasks, Scenario) else Scenario().with_tasks(tasks)
    if scenario.tasks is None:
        raise ValueError("the scenario has no tasks to fly: scenario.with_tasks(scenario.random_tasks(300, seed=0))")
    return scenario
