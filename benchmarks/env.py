"""Cost of the environment's step: transforms and collector, number of regions and of vehicles."""

from __future__ import annotations

import time

from benchmarks.timing import Row, alternate
from magrl.envs import GeomagneticNavEnv, Scenario, planet_scenario
from magrl.errors import SensorErrors, VectorErrors, north_reference
from magrl.training.collectors import make_collector
from magrl.transforms import AlignmentReward, FieldGradient, GradientHeading

from torchrl.envs import Compose, RewardScaling, RewardSum, TransformedEnv

VEHICLES = 1024
REGIONS = 2048
NUMBERS = [2**k for k in range(6, 15)]


class Stepper:
    """Steps an environment with fixed actions, past the end of episodes: a step costs the same anywhere."""

    def __init__(self, env: GeomagneticNavEnv) -> None:
        self.env, self.state = env, env.rand_action(env.reset())

    def __call__(self) -> None:
        self.env._step(self.state)


class Running:
    """Random legs with automatic resets, begun when episodes end at different steps."""

    def __init__(self, env: GeomagneticNavEnv, begun: int = 60) -> None:
        self.env, self.state = env, env.reset()
        for _ in range(begun):
            self()

    def __call__(self) -> None:
        _, self.state = self.env.step_and_maybe_reset(self.env.rand_action(self.state))


class Collecting:
    """Steps of the recipe's whole environment in a collector with a random policy, resets included."""

    def __init__(self, num_envs: int) -> None:
        base = GeomagneticNavEnv(num_envs=num_envs, seed=0)
        view = base.observation_view()
        guidance = [
            FieldGradient(base.field),
            GradientHeading(),
            AlignmentReward(out_keys=["reward", "reward_alignment"]),
        ]
        steps = [*guidance, *view.observation_transforms(), view.action_transform()]
        steps += [RewardSum(), RewardScaling(loc=0.0, scale=0.05)]
        env = TransformedEnv(base, Compose(*steps))
        collector = make_collector(env, env.rand_action, frames_per_batch=num_envs, total_frames=-1)
        self.batches = iter(collector)

    def __call__(self) -> None:
        next(self.batches)


def with_every_sensor_error(env: GeomagneticNavEnv) -> TransformedEnv:
    """Return an environment with all errors of its sensors and of its north reference."""
    vector = VectorErrors((20.0,) * 3, ((1e-3,) * 3,) * 3, (0.1, 0.1))
    sensors = SensorErrors(
        (0.05, 0.05, 5.0),
        bias=(0.05, 0.05, 5.0),
        scale=(0.0, 0.0, 1e-3),
        drift=(0.05, 0.05, 5.0),
        drift_length=200.0,
        resolution=(0.01, 0.01, 1.0),
        outage_rate=0.02,
        vector=vector,
    )
    return TransformedEnv(env, Compose(sensors, north_reference("marine", speed_km_h=20.0)))


def rows(repeats: int = 15) -> list[Row]:
    """Return what guidance, regions and errors of sensors cost, as the speed of all beside the speed of less."""
    step = Stepper(GeomagneticNavEnv(num_envs=VEHICLES, seed=0))
    over_bank, over_one = (
        Running(GeomagneticNavEnv(scenario, num_envs=VEHICLES, start_heading="random", seed=0))
        for scenario in (planet_scenario(REGIONS, seed=0), Scenario())
    )
    disturbed, plain = (
        Running(make(GeomagneticNavEnv(num_envs=VEHICLES, seed=0)))
        for make in (with_every_sensor_error, TransformedEnv)
    )
    options = {"repeats": repeats, "inner": 50}
    return [
        alternate("guided env in a Collector: raw env step", Collecting(VEHICLES), step, goal="≥ 0.25", **options),
        alternate(f"env over {REGIONS} regions: over one", over_bank, over_one, goal="≥ 0.50", **options),
        alternate("env with all sensor errors: without", disturbed, plain, goal="≥ 0.67", **options),
    ]


def cost_by_number(seconds: float = 0.5) -> list[dict[str, float]]:
    """Return microseconds per vehicle-step, raw and guided in a collector, by number of vehicles."""
    rows = []
    for number in NUMBERS:
        raw = time_of(Stepper(GeomagneticNavEnv(num_envs=number, seed=0)), seconds)
        guided = time_of(Collecting(number), seconds)
        rows.append({"vehicles": number, "raw_us": 1e6 * raw / number, "guided_us": 1e6 * guided / number})
    return rows


def time_of(function: Stepper | Collecting, seconds: float) -> float:
    """Return the median time of a call [s], from calls over some seconds."""
    function()
    times, began = [], time.perf_counter()
    while time.perf_counter() - began < seconds or len(times) < 3:
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return sorted(times)[len(times) // 2]


if __name__ == "__main__":
    for row in rows():
        print(row)
    for line in cost_by_number():
        print(line)
