"""Bad calls of magrl.envs, navigators, agents, evaluation and training."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import gymnasium
import torch
from refusals import (
    INF,
    NAN,
    Nan,
    Rows,
    bad_numbers,
    bad_tensors,
    bad_vectors,
    folder,
    int64,
    refused,
    t,
    text_file,
    written,
    zeros,
)
from rows_physics import NARROW, igrf
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from magrl import agents, onboard, training, transforms
from magrl.agents.program import TensorProgram
from magrl.envs import (
    PAPER_REGION,
    GeomagneticNavEnv,
    Region,
    Regions,
    RegionTasks,
    Scenario,
    Tasks,
    earth_scenario,
    load_scenario,
    named_tasks,
    planet_scenario,
    task_set,
)
from magrl.envs.gymnasium import GeomagneticNavGymEnv, GeomagneticNavVectorEnv
from magrl.evaluation import episode_measures, evaluate, evaluation_rollout, summarize
from magrl.navigators import (
    Geodesic,
    Kalman,
    MapMatching,
    MeanJacobian,
    Navigator,
    ParallelApproach,
    QuasiNewton,
    RunAndTumble,
    Secant,
    metaheuristics,
)


@cache
def nav() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=2, seed=0, render_mode="rgb_array")


@cache
def flight() -> TensorDictBase:
    return nav().rollout(2)


def stepped(action: Tensor) -> object:
    return nav().step(nav().reset().set("action", action))


def aboard() -> onboard.Onboard:
    vehicle = onboard.Onboard("secant")
    vehicle.start((-11.6, 75.4, 13240.0))
    return vehicle


def begun() -> GeomagneticNavEnv:
    nav().reset()
    return nav()


def scenario_file(text: str) -> Path:
    return text_file("own.toml", text)


TWO_REGIONS = Regions.of([Region((-10, 0), (160, 170)), Region((40, 50), (0, 10))])
ENVS: Rows = {
    "envs.Region": [
        *(
            refused(lambda v=v: Region(v, (0, 1)), ValueError, "latitudes", repr(v))
            for v in (5, ("a", "b"), (0, 1, 2), (0, NAN), (1, 0), (0, 91))
        ),
        refused(lambda: Region((0, 1), (170, -170)), ValueError, "longitudes", "(170, -170)"),
    ],
    "envs.Region.contains": bad_vectors(PAPER_REGION.contains, "position", 2),
    "envs.Region.expanded": bad_numbers(PAPER_REGION.expanded, margin_deg=(-1.0, NAN, INF, "a", None)),
    "envs.Region.reachable": bad_numbers(PAPER_REGION.reachable, max_move_km=(-1.0, INF, "a")),
    "envs.Region.unwrapped": [
        *bad_vectors(PAPER_REGION.unwrapped, "position", 2),
        Nan(lambda: PAPER_REGION.unwrapped(t(NAN, NAN))),
    ],
    "envs.Region.holding": [
        *bad_vectors(PAPER_REGION.holding, "position", 2),
        refused(lambda: PAPER_REGION.holding(zeros(0, 2)), ValueError, "position", "size=(0, 2)"),
        refused(lambda: PAPER_REGION.holding(t(NAN, 165.0)), ValueError, "position", "nan"),
        refused(lambda: PAPER_REGION.holding(t(-91.0, 165.0)), ValueError, "-91"),
    ],
    "envs.Region.grid": bad_numbers(PAPER_REGION.grid, points=(0, -1, 2.5, "a", True)),
    "envs.Regions": [
        *bad_vectors(lambda edges: Regions(edges, zeros(1, 2)), "latitude", 2),
        refused(lambda: Regions(zeros(0, 2), zeros(0, 2)), ValueError, "(0, 2)", "K >= 1"),
        refused(lambda: Regions(zeros(1, 2), zeros(1, 2)), ValueError, "latitudes (0.0, 0.0) of box 0"),
    ],
    "envs.Regions.contains": [
        *bad_vectors(lambda position: TWO_REGIONS.contains(position, int64(1)), "position", 2),
        refused(lambda: TWO_REGIONS.contains(zeros(1, 2), int64(1) + 2), ValueError, "index 2", "[0, 2)"),
        refused(lambda: TWO_REGIONS.contains(zeros(1, 2), zeros(1)), TypeError, "index", "float32"),
    ],
    "envs.Regions.expanded": bad_numbers(TWO_REGIONS.expanded, margin_deg=(-1.0, NAN, INF, "a", None)),
    "envs.Regions.reachable": bad_numbers(TWO_REGIONS.reachable, max_move_km=(-1.0, INF, "a")),
    "envs.Regions.grid": bad_numbers(TWO_REGIONS.grid, points=(1, 0, 2.5, "a", True)),
    "envs.RegionTasks": [
        refused(
            lambda: planet_scenario(2, 0).with_tasks(RegionTasks(zeros(1, 2), zeros(1, 2) + 1, int64(1) + 2)),
            ValueError,
            "tasks.region 2",
            "[0, 2)",
        )
    ],
    "envs.planet_scenario": [
        *bad_numbers(lambda count: planet_scenario(count, 0), count=(0, 1.5, "a", True)),
        *bad_numbers(lambda seed: planet_scenario(2, seed), seed=(-1, 1.5, "a", None)),
        *bad_numbers(
            lambda **option: planet_scenario(2, 0, **option),
            half_size_deg=(0, -1.0, 61, NAN, "a"),
            max_latitude=(0, 91, NAN, "a"),
            min_intensity_nt=(-1.0, NAN, "a"),
            margin_deg=(-1.0, INF),
            max_move_km=(-1.0, INF),
            degree=(0, 1.5),
            tolerance_nt=(0.0, NAN),
            distance_range_km=((500.0, 300.0),),
            distance_law=("even",),
        ),
    ],
    "envs.earth_scenario": [
        *bad_numbers(lambda count: earth_scenario(count, 0), count=(0, 1.5, "a", True)),
        *bad_numbers(lambda date: earth_scenario(2, 0, date), date=("May",)),
        refused(lambda: earth_scenario(2, 0, "2055-01-01"), ValueError, "2055-01-01"),
        refused(lambda: earth_scenario(2, 0, generation=12), ValueError, "12"),
        refused(lambda: earth_scenario(2, 0, crust=1), TypeError, "crust"),
        refused(lambda: earth_scenario(2, 0, "2020-01-01", crust=True), ValueError, "2020"),
    ],
    "envs.task_set": [
        *bad_numbers(lambda num_tasks: task_set(num_tasks, 0), num_tasks=(0, 1.5, "a", True)),
        *bad_numbers(lambda seed: task_set(1, seed), seed=(1.5, "a", None)),
        refused(lambda: task_set(1, 0, None), TypeError, "region", "None"),
        *(
            refused(lambda v=v: task_set(1, 0, PAPER_REGION, v), ValueError, "distance_range_km", repr(v))
            for v in (5, (1,), (2, 1), (-1, 1), (0, NAN), (0, INF), ("a", "b"), "ab", (5000, 6000))
        ),
    ],
    "envs.named_tasks": [
        refused(lambda: named_tasks("paper"), ValueError, "'paper'", "paper-100"),
        refused(lambda: named_tasks(5), ValueError, "5"),
    ],
    "envs.Scenario": [
        *bad_numbers(
            Scenario,
            region=(5, ((0, 1), (0, 1))),
            distance_range_km=((5.0, 4.0), (0.0, NAN), (5000.0, 6000.0)),
            generation=(12, "13"),
            altitude_km=(-16.0, NAN, 1001.0, "a"),
            margin_deg=(-1.0, NAN, "a"),
            objective_floors=(5, "abc"),
            field=("IGRF",),
            names=(("a",),),
        ),
        refused(lambda: Scenario(objective_floors=(1.0, 2.0, 0.0)), ValueError, "objective_floors", "0.0"),
        refused(lambda: Scenario(region={"latitude": [0, 1]}), ValueError, "region", "{'latitude': [0, 1]}"),
        refused(lambda: Scenario(date="May"), ValueError, "'May'"),
        refused(lambda: Scenario(date="2031-01-01"), ValueError, "2031-01-01"),
        refused(lambda: Scenario(wings=2), ValueError, "'wings'", "region"),
        refused(lambda: Scenario(tasks=Tasks(zeros(1, 2), zeros(1, 2) + 50)), ValueError, "[0.0, 0.0]"),
        refused(lambda: Scenario(tasks=Tasks(zeros(0, 2), zeros(0, 2))), ValueError, "(0, 2)"),
        refused(lambda: Scenario(tasks=Tasks(zeros(2, 2), zeros(2, 3))), ValueError, "(2, 3)"),
        refused(lambda: Scenario(tasks=Tasks(*[zeros(1, 2) + NAN] * 2)), ValueError, "latitude nan"),
        refused(lambda: Scenario(region=Region((30, 40), (0, 300))).build_field(), ValueError, "misses the model"),
        refused(lambda: Scenario(margin_deg=90.0).build_field(), ValueError, "(-90.0, 90.0)"),
    ],
    "envs.Scenario.reachable": bad_numbers(Scenario().reachable, max_move_km=(-1.0, INF, "a")),
    "envs.Scenario.build_field": bad_numbers(Scenario().build_field, max_move_km=(-1.0, NAN, "a")),
    "envs.Scenario.random_tasks": [refused(lambda: Scenario().random_tasks(0, 1), ValueError, "num_tasks", "0")],
    "envs.Scenario.with_tasks": [refused(lambda: Scenario().with_tasks("ab"), ValueError, "tasks", "'ab'")],
    "envs.load_scenario": [
        refused(lambda: load_scenario(5), TypeError, "path", "5"),
        refused(lambda: load_scenario("nowhere.toml"), FileNotFoundError, "nowhere.toml"),
        refused(lambda: load_scenario(written(1)), ValueError, "content.pt", "'.pt'"),
        refused(lambda: load_scenario(scenario_file("date = 2022-01-01")), ValueError, "own.toml", "region is missing"),
        refused(lambda: load_scenario(scenario_file("wings = ")), ValueError, "own.toml", "not valid TOML"),
    ],
    "envs.GeomagneticNavEnv": [
        *bad_numbers(
            GeomagneticNavEnv,
            num_envs=(0, 1.5, "a"),
            max_steps=(0, "a"),
            max_move_km=("a", 0.0, 1001.0),
            max_turn_rad=(INF, "a", 4.0),
            zeta=("a", t(0.01), 0.0),
            arrival=("said", []),
            arrival_radius_km=("a", 0.0, INF),
            start_heading=([], "south"),
            destination_weight=("a", -1.0),
            proximity_weight=("a", NAN),
            objective_limit=("a", 0.0, NAN),
            render_mode=("human", 5),
            seed=(1.5, -1, "a", NAN, True, 2**64),
        ),
        refused(lambda: GeomagneticNavEnv(5), TypeError, "scenario", "5"),
        refused(
            lambda: GeomagneticNavEnv(Scenario(zeta=0.02), zeta=0.01),
            ValueError,
            "zeta is 0.02 in the scenario",
            "0.01",
        ),
        refused(lambda: GeomagneticNavEnv(Scenario(field=lambda lat, _: lat)), ValueError, "(81, 81)"),
        refused(lambda: nav().set_seed(None), ValueError, "seed", "None"),
        refused(lambda: stepped(torch.tensor([[1.0, 0.0], [NAN, 0.0]])), ValueError, "vehicles [1]", "nan"),
        refused(lambda: stepped(torch.tensor([[1.0, 0.0], [51.0, 0.0]])), ValueError, "vehicles [1]", "51.0"),
    ],
    "envs.GeomagneticNavEnv.track": [
        refused(lambda: GeomagneticNavEnv(seed=0).track(0), RuntimeError, "render_mode='rgb_array'"),
        refused(lambda: GeomagneticNavEnv(seed=0, render_mode="rgb_array").track(0), RuntimeError, "reset"),
        refused(lambda: begun().track(2), IndexError, "vehicle 2"),
        *bad_numbers(lambda vehicle: begun().track(vehicle), vehicle=("a", 0.5, None)),
    ],
    "envs.GeomagneticNavEnv.render": [
        refused(lambda: begun().render([5]), IndexError, "vehicle 5"),
        refused(lambda: begun().render([]), ValueError, "path", "0"),
        refused(lambda: begun().render([0], size_px=0), ValueError, "size_px", "0"),
    ],
    "envs.GeomagneticNavEnv.observation_view": bad_numbers(
        nav().observation_view, observe_heading=("a", None), observe_difference=(1,)
    ),
    "envs.gymnasium.GeomagneticNavGymEnv": [
        *bad_numbers(
            GeomagneticNavGymEnv,
            render_mode=("human",),
            zeta=("a",),
            observation=("flag",),
            reward=(5,),
        ),
        refused(lambda: GeomagneticNavGymEnv(alignment_weight=NAN), ValueError, "weight", "nan"),
        refused(lambda: GeomagneticNavGymEnv(scale_actions="a"), TypeError, "scale_actions", "'a'"),
        refused(lambda: GeomagneticNavGymEnv(wings=2), TypeError, "'wings'"),
        refused(lambda: GeomagneticNavGymEnv(num_envs=2), TypeError, "num_envs", "2"),
        refused(lambda: GeomagneticNavGymEnv().step(zeros(2).numpy()), gymnasium.error.ResetNeeded, "reset()"),
    ],
    "envs.gymnasium.GeomagneticNavVectorEnv": [
        refused(lambda: GeomagneticNavVectorEnv(0), ValueError, "num_envs", "0"),
        refused(lambda: GeomagneticNavVectorEnv(seed=1.5), ValueError, "seed", "1.5"),
        refused(lambda: GeomagneticNavVectorEnv(2, render_mode="human"), ValueError, "render_mode", "'human'"),
    ],
}

BOUNDS = {"max_move_km": (0.0, NAN, "a", None), "max_turn_rad": (0.0, 4.0, NAN, "a")}
NAVIGATORS: Rows = {
    "navigators.Navigator": bad_numbers(
        lambda **options: Navigator(**({"max_move_km": 50.0, "max_turn_rad": 1.5} | options)), **BOUNDS
    ),
    "navigators.ParallelApproach": [
        *bad_numbers(lambda **options: ParallelApproach(igrf(), **options), **BOUNDS),
        *bad_numbers(ParallelApproach, field=("IGRF", None)),
        refused(lambda: ParallelApproach(igrf(), pair="DI"), ValueError, "'DI'"),
        refused(lambda: ParallelApproach(igrf(), pair=("D",)), ValueError, "('D',)"),
        refused(lambda: ParallelApproach(igrf())(TensorDict(field=zeros(2, 3))), KeyError, "target_field"),
    ],
    "navigators.QuasiNewton": [
        *bad_numbers(
            lambda **options: QuasiNewton(**({"max_move_km": 50.0, "max_turn_rad": 1.5} | options)),
            **BOUNDS,
            noise=(5, (1.0, 2.0), (1.0, 2.0, NAN)),
        ),
        refused(lambda: QuasiNewton(50.0, 1.5, noise=(0.1, -0.1, 5.0)), ValueError, "noise", "-0.1"),
    ],
    "navigators.QuasiNewton.prior": [
        refused(lambda: QuasiNewton(50.0, 1.5).prior(zeros(2, 3)), NotImplementedError, "QuasiNewton", "GradientPrior")
    ],
    "navigators.Secant": [
        *bad_numbers(Secant, **BOUNDS, probe_km=(0.0, 60.0, NAN, "a"), noise=(5, (1.0, 2.0), (1.0, 2.0, NAN))),
        refused(lambda: Secant(elements=("D", "D")), ValueError, "('D', 'D')"),
    ],
    "navigators.Kalman": bad_numbers(
        Kalman,
        **BOUNDS,
        noise=(5, (1.0,)),
        bias=(5, (1.0,)),
        max_steps=(0, 1.5),
        caution=(-1.0, NAN),
        step_km=(0.0,),
        range_km=(0.0,),
    ),
    "navigators.MapMatching": [
        *bad_numbers(
            lambda **options: MapMatching(**({"field": igrf(), "region": PAPER_REGION} | options)),
            **BOUNDS,
            noise=(5, (1.0, 2.0), (1.0, 2.0, NAN)),
            map_error=(5, (1.0,), (1.0, 2.0, NAN)),
            hypotheses=(0, 1.5, 2000),
            field=("IGRF", None),
        ),
        refused(lambda: MapMatching(igrf(), "box"), TypeError, "region", "'box'"),
        refused(lambda: MapMatching(igrf(), PAPER_REGION, map_error=(1.0, -2.0, 3.0)), ValueError, "map_error", "-2.0"),
        refused(lambda: MapMatching(nav().field, Region((0, 20), (160, 170))), ValueError, "not defined", "larger box"),
        refused(lambda: MapMatching(igrf(), Regions.of([PAPER_REGION] * 2)), ValueError, "1 maps", "2 boxes"),
    ],
    "navigators.MeanJacobian": [
        *bad_numbers(lambda **options: MeanJacobian(igrf(), zeros(4, 2), **options), **BOUNDS, noise=(5, (1.0, NAN))),
        *bad_numbers(lambda field: MeanJacobian(field, zeros(4, 2)), field=("IGRF", None)),
        refused(lambda: MeanJacobian(igrf(), zeros(1, 2)), ValueError, "position", "(1, 2)"),
        refused(lambda: MeanJacobian(igrf(), zeros(3)), ValueError, "position", "(3,)"),
    ],
    "navigators.Geodesic": bad_numbers(Geodesic, **BOUNDS),
    "navigators.RunAndTumble": bad_numbers(RunAndTumble, **BOUNDS, objective_floors=(5, (1, 2), (1, 2, NAN))),
    "navigators.metaheuristics.build": [
        refused(lambda: metaheuristics.build("ants", nav(), "flown", 0), ValueError, "'ants'", "ga"),
        refused(lambda: metaheuristics.build("ga", nav(), "dreamt", 0), ValueError, "'dreamt'"),
        refused(lambda: metaheuristics.build("ga", None, "flown", 0), TypeError, "env", "None"),
        refused(lambda: metaheuristics.build("ga", nav(), "flown", 1.5), ValueError, "seed", "1.5"),
        refused(lambda: metaheuristics.build("ga", nav(), "flown", 0, wings=2), TypeError, "wings"),
    ],
    "navigators.metaheuristics.Metaheuristic": [
        *bad_numbers(
            lambda **options: metaheuristics.Metaheuristic(**({"mode": "flown"} | options)),
            **BOUNDS,
            mode=("dreamt", None),
            population_size=(1, 2.5, "a"),
            generations=(0, 1.5, "a"),
            spread=(0.0, 2.0, NAN, "a"),
            objective_floors=(5, (1, 2), (1, 2, 0.0), (1, 2, NAN)),
            seed=(1.5, "a", None),
        ),
        refused(lambda: metaheuristics.Metaheuristic(mode="look-ahead"), ValueError, "None", "look-ahead"),
        refused(lambda: metaheuristics.Metaheuristic(mode="look-ahead", field="IGRF"), TypeError, "field", "'IGRF'"),
    ],
    "navigators.metaheuristics.ArtificialFishSwarm": bad_numbers(
        lambda **options: metaheuristics.ArtificialFishSwarm(mode="flown", **options),
        visual=(0.0, NAN, "a"),
        step=(0.0, 11.0, "a"),
        crowding=(-0.1, 1.1, "a"),
        tries=(0, 1.5, "a"),
    ),
    "navigators.metaheuristics.GeneticAlgorithm": bad_numbers(
        lambda **options: metaheuristics.GeneticAlgorithm(mode="flown", **options),
        tournament_size=(0, 1.5, "a"),
        crossover_rate=(-0.1, 1.1, NAN, "a"),
        blend=(-1.0, "a"),
        mutation_rate=(1.5, "a"),
        mutation_scale=(-1.0, INF, "a"),
        elites=(-1, 8, 0.5, "a"),
    ),
    "navigators.metaheuristics.ParticleSwarm": bad_numbers(
        lambda **options: metaheuristics.ParticleSwarm(mode="flown", **options),
        inertia=(-0.1, 3.0, "a"),
        cognitive=(-1.0, NAN, "a"),
        social=(11.0, "a"),
        max_velocity=(0.0, INF, "a"),
    ),
}


@cache
def view() -> transforms.ObservationView:
    return nav().observation_view()


def halves() -> TensorProgram:
    return TensorProgram(1, [["mul.Tensor", [{"value": 0}, 0.5], {}]], [], [1])


def policy_config(**options: Any) -> agents.PolicyConfig:
    return agents.PolicyConfig(**({"view": view(), "num_cells": (8,)} | options))


SOUND = {"gamma": 0.99, "policy_noise": 0.2, "noise_clip": 0.5}


def td3_loss(kind: type[agents.TD3Loss] = agents.TD3Loss, actor: Any = None, **options: Any) -> agents.TD3Loss:
    actor = agents.make_actor(13, (8,)) if actor is None else actor
    return kind(actor, agents.make_critic(13, (8,)), **(SOUND | options))


NOISES: dict[str, Any] = {"gamma": (-0.1, 1.1, NAN, "a"), "policy_noise": (-1.0, NAN), "noise_clip": (-1.0, INF, "a")}

AGENTS: Rows = {
    "agents.make_actor": [
        *bad_numbers(
            lambda **options: agents.make_actor(**({"num_cells": (8,)} | options)), observation_size=(0, 1.5, "a")
        ),
        refused(lambda: agents.make_actor(13, 5), TypeError, "num_cells", "5"),
        refused(lambda: agents.make_actor(13, (0,)), ValueError, "num_cells", "0"),
        refused(lambda: agents.make_actor(13, (1.5,)), ValueError, "num_cells", "1.5"),
    ],
    "agents.make_critic": [
        *bad_numbers(
            lambda **options: agents.make_critic(**({"num_cells": (8,)} | options)), observation_size=(0, "a")
        ),
        refused(lambda: agents.make_critic(13, 5), TypeError, "num_cells", "5"),
        refused(lambda: agents.make_critic(13, (65537,)), ValueError, "num_cells", "65537"),
    ],
    "agents.make_recurrent_actor": [
        refused(lambda: agents.make_recurrent_actor(view(), (8,), 0), ValueError, "memory_size", "0"),
        refused(lambda: agents.make_recurrent_actor(view(), (0,), 4), ValueError, "num_cells", "0"),
    ],
    "agents.PolicyConfig": [
        *bad_numbers(policy_config, num_cells=((), (1.5,), (0,)), memory_size=(-1, 1.5, "a")),
        refused(lambda: policy_config(layer_norm=1), TypeError, "layer_norm", "1"),
        refused(lambda: policy_config(view=5), TypeError, "view", "5"),
    ],
    "agents.FieldPolicy": [refused(lambda: agents.FieldPolicy(5), TypeError, "config", "5")],
    "agents.FieldPolicy.check_fits": [
        refused(lambda: agents.FieldPolicy(policy_config()).check_fits(5), TypeError, "env", "5"),
        refused(lambda: agents.FieldPolicy(policy_config(view=NARROW)).check_fits(nav()), ValueError, "I is", "-40.0°"),
    ],
    "agents.VehicleStep": [
        refused(lambda: agents.VehicleStep(5), TypeError, "policy", "5"),
        refused(
            lambda: agents.VehicleStep(agents.FieldPolicy(policy_config())), ValueError, "TrackView", "ObservationView"
        ),
    ],
    "agents.write_step": [
        refused(lambda: agents.write_step("a.onnx", agents.FieldPolicy(policy_config())), ValueError, ".pt2", "a.onnx"),
    ],
    "onboard.Onboard": [
        *bad_numbers(onboard.Onboard, zeta=(0.0, NAN, 3.5), arrival_km=(0.0, "a"), confidence=(0.0, 1.5)),
        refused(lambda: onboard.Onboard("dowsing"), ValueError, "dowsing", "kalman"),
        refused(lambda: onboard.Onboard(5), TypeError, "navigator", "5"),
    ],
    "onboard.Onboard.start": [refused(lambda: aboard().start((1.0, NAN, 2.0)), ValueError, "target", "nan")],
    "onboard.Onboard.step": [
        refused(lambda: onboard.Onboard("secant").step(3.5, 73.0, 15000.0, 0.0), RuntimeError, "start(target)"),
        *bad_numbers(lambda **given: aboard().step(3.5, 73.0, 15000.0, **given), heading=(NAN, "a", 400.0)),
    ],
    "onboard.Onboard.save": [refused(lambda: onboard.Onboard("secant").save("a"), RuntimeError, "start(target)")],
    "onboard.Onboard.restore": [
        refused(lambda: aboard().restore(written({"a": 1})), ValueError, "not the state of a vehicle"),
        refused(lambda: aboard().restore(text_file("a.pt", "b")), ValueError, "a.pt", "damaged"),
    ],
    "agents.save_policy": [
        refused(lambda: agents.save_policy(folder() / "policy.pt", 5), TypeError, "policy", "5"),
        refused(lambda: agents.save_policy("a.pt", agents.make_actor(13, (8,))), TypeError, "TensorDictSequential"),
    ],
    "agents.export_policy": [
        refused(lambda: agents.export_policy(5, nav()), TypeError, "actor", "5"),
        refused(lambda: agents.export_policy(agents.make_actor(13, (8,)), 5), TypeError, "env", "5"),
        refused(lambda: agents.export_policy(agents.make_actor(13, (8,)), nav()), ValueError, "'observation'"),
    ],
    "agents.ExportedPolicy": [
        refused(lambda: agents.ExportedPolicy(["move"], 5), TypeError, "program", "5"),
        refused(lambda: agents.ExportedPolicy("move", halves()), TypeError, "in_keys", "'move'"),
        refused(lambda: agents.ExportedPolicy(["position"], halves()), ValueError, "in_keys", "position"),
        refused(lambda: agents.ExportedPolicy([], halves()), ValueError, "in_keys", "[]"),
        refused(lambda: agents.ExportedPolicy(["move", "field"], halves()), ValueError, "2 keys", "1 inputs"),
        refused(lambda: agents.ExportedPolicy(["move"], halves(), 5), TypeError, "view", "5"),
    ],
    "agents.ExportedPolicy.check_fits": [
        refused(lambda: agents.ExportedPolicy(["move"], halves()).check_fits(5), TypeError, "env", "5"),
        refused(
            lambda: agents.ExportedPolicy(["move"], halves(), NARROW).check_fits(nav()), ValueError, "I is", "-40.0°"
        ),
    ],
    "agents.ExportedPolicy.write_torch": [
        refused(lambda: agents.ExportedPolicy(["move"], halves()).write_torch("a.pt"), ValueError, ".pt2", "'a.pt'")
    ],
    "agents.load_policy": [
        refused(lambda: agents.load_policy("nowhere.pt"), FileNotFoundError, "nowhere.pt"),
        refused(lambda: agents.load_policy(written([1])), ValueError, "content.pt"),
        refused(lambda: agents.load_policy(written({"format": 1})), ValueError, "content.pt", "format 1"),
        refused(lambda: agents.load_policy(text_file("a.pt", "no policy")), ValueError, "a.pt"),
    ],
    "agents.load_pretrained": [
        refused(lambda: agents.load_pretrained("nowhere"), ValueError, "nowhere", "anywhere"),
        refused(lambda: agents.load_pretrained(5), TypeError, "name", "5"),
    ],
    "agents.TD3Loss": [
        *bad_numbers(td3_loss, **NOISES),
        refused(lambda: td3_loss(actor=5), TypeError, "actor", "5"),
        refused(lambda: td3_loss(precision="half"), ValueError, "precision", "'half'", "bfloat16"),
        refused(lambda: agents.TD3Loss(agents.make_actor(13, (8,)), 5, **SOUND), TypeError, "critic", "5"),
    ],
    "agents.RecurrentTD3Loss": [
        *bad_numbers(lambda **options: td3_loss(agents.RecurrentTD3Loss, **options), **NOISES),
        refused(lambda: td3_loss(agents.RecurrentTD3Loss, actor=5), TypeError, "actor", "5"),
    ],
    "agents.saturation_penalty": [
        *bad_tensors(agents.saturation_penalty, "logits"),
        Nan(lambda: agents.saturation_penalty(t(0.0, NAN))),
    ],
}


def without(name: str) -> dict[str, Tensor]:
    return {key: value for key, value in episode_measures(flight()).items() if key != name}


@cache
def parsed(*args: str) -> training.RunConfig:
    return training.parse_config(training.RunConfig, {"fast": training.RunConfig()}, "mine.py", None, args)


def entered(**options: Any) -> None:
    with training.Run(training.RunConfig(**options), recipe="mine.py", name="mine"):
        pass


TRAINING: Rows = {
    "evaluation.episode_measures": [
        refused(lambda: episode_measures(5), TypeError, "rollout", "5"),
        refused(lambda: episode_measures(flight(), 5), TypeError, "env", "5"),
        refused(lambda: episode_measures(flight()[0]), ValueError, "(2,)"),
        refused(lambda: episode_measures(flight()[:0]), ValueError, "(0, 2)"),
        refused(lambda: episode_measures(flight().exclude("next")), KeyError, "next"),
    ],
    "evaluation.summarize": [
        refused(lambda: summarize({"success": zeros(0).bool()}), ValueError, "M >= 1", "tensor([]"),
        refused(lambda: summarize({"success": zeros(2)}), ValueError, "tensor([0., 0.])"),
        refused(lambda: summarize({}), KeyError, "success"),
        refused(lambda: summarize(without("spl")), KeyError, "spl"),
    ],
    "evaluation.evaluate": [
        *bad_numbers(lambda **options: evaluate("secant", "paper-100", **options), num_envs=(0, 1.5, "a"), seed=(-1,)),
        refused(lambda: evaluate(5, "figure-4-1"), TypeError, "policy", "5"),
        refused(lambda: evaluate("dowsing", "figure-4-1"), ValueError, "'dowsing'"),
        refused(lambda: evaluate("secant", 5), TypeError, "tasks", "5"),
        refused(lambda: evaluate("secant", "figure-9"), ValueError, "'figure-9'"),
        refused(lambda: evaluate("secant", Scenario()), ValueError, "no tasks"),
        refused(lambda: evaluate("secant", "figure-4-1", noise=(0.1, -1.0, 5.0)), ValueError, "-1.0"),
        refused(lambda: evaluate("secant", "figure-4-1", conditions="storm"), ValueError, "'storm'"),
        refused(lambda: evaluate("secant", "figure-4-1", conditions="ship", noise=(1, 1, 1)), ValueError, "(1, 1, 1)"),
        refused(
            lambda: evaluate(agents.FieldPolicy(policy_config(view=NARROW)), "figure-4-1"), ValueError, "I is", "-40.0°"
        ),
    ],
    "evaluation.evaluation_rollout": [
        refused(lambda: evaluation_rollout(5, None), TypeError, "env", "5"),
        refused(lambda: evaluation_rollout(nav(), 5), TypeError, "policy", "5"),
    ],
    "training.RunConfig": [
        *bad_numbers(
            training.RunConfig,
            seed=(-1, 1.5, "a", True, 2_000_000_000),
            device=("nowhere",),
            logger=("paper",),
            wandb_mode=("sometimes",),
            checkpoint_every=(-1.0, NAN, "a"),
            total_frames=(0, 1.5, "a"),
            eval_every=(0,),
            eval_tasks=(0,),
        ),
        refused(lambda: training.RunConfig(wings=2), ValueError, "'wings'", "seed"),
        refused(lambda: training.RunConfig(scenario=Path("nowhere.toml")), ValueError, "nowhere.toml"),
    ],
    "training.parse_config": [
        refused(lambda: parsed("--resume", "run", "--seed", "1"), training.UsageError, "--seed 1"),
        refused(lambda: parsed("--resume", "nowhere"), training.UsageError, "nowhere", "config.json"),
    ],
    "training.Run": [
        refused(lambda: entered(out=text_file("a.txt", "").parent), training.UsageError, "not empty"),
    ],
}

ROWS = ENVS | NAVIGATORS | AGENTS | TRAINING
