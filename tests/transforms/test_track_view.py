"""The observation of an agent without a map: its 15 numbers, its frame, its state, and the policy that reads it."""

from __future__ import annotations

import math
import pickle
from functools import cache, partial
from pathlib import Path

import pytest
import torch
from support.environments import parallel
from support.readings import first_reading, moved
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from magrl.agents import FieldPolicy, PolicyConfig, load_policy, save_policy
from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.field.regional import RegionalField
from magrl.files import save_tensors
from magrl.transforms import SensorNoise, TrackGradient, TrackView
from magrl.transforms.track_view import track_observation

pytestmark = pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped")
VIEW = TrackView(zeta=0.01, max_steps=50, max_move_km=50.0, max_turn_rad=math.pi / 2)
STD = (0.05, 0.1, 5.0)
float64 = partial(torch.tensor, dtype=torch.float64)


@cache
def field() -> RegionalField:
    return Scenario().build_field()


def nav(num_envs: int = 4, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(field=field()), num_envs=num_envs, **({"seed": 0} | options))


def observing(num_envs: int = 4, std: tuple[float, ...] = STD, **options: object) -> TransformedEnv:
    """The environment that an agent is trained in, without what is for training alone."""
    steps = (SensorNoise(std, seed=1), *VIEW.observation_transforms(), VIEW.action_transform())
    return TransformedEnv(nav(num_envs, **options), Compose(*steps))


def observe(td: TensorDictBase) -> TensorDictBase:
    return Compose(*VIEW.observation_transforms())(td)


# The numbers


def by_hand(**change: Tensor) -> Tensor:
    parts = {
        "way": float64([30.0, 40.0]),
        "way_covariance": float64([[400.0, 100.0], [100.0, 1600.0]]),
        "gradient": float64([[0.01, 0.0], [0.0, 0.02], [1.0, 1.0]]),
        "remaining": float64([0.1, -0.2, 3.0]),
        "weights": float64([100.0, 25.0, 0.01]),
        "noise_std": float64([0.1, 0.0, 5.0]),
        "time": float64([0.3]),
    }
    return track_observation(**(parts | change))


def test_the_numbers_by_hand() -> None:
    """A way of 50 km; standard deviations of 20 and 40 km; the ellipse [[.02, .01], [.01, .02]]; F of 2.09."""
    expected = [
        *(0.6, 0.8),  # direction
        *(math.log(3.5) - 2, 50 / 400 - 0.5),  # length
        *(0.0, math.log(2) / 2, 100 / 800),  # standard deviations over 20 km, and their correlation
        *[math.log(20 * math.sqrt(0.02)) / 2] * 2,  # axes of the ellipse
        0.5,  # their correlation
        math.log(2.1) / 3 - 0.5,  # F over the threshold
        0.3,  # time
        *(math.log(0.1) / 2 + 2, math.log(0.002) / 2 + 2, math.log(0.05) / 2 + 2),  # noise
    ]
    torch.testing.assert_close(by_hand(), float64(expected))
    assert len(expected) == VIEW.size == 15


def test_numbers_at_the_extremes() -> None:
    """No way, no uncertainty, no gradient; and a way beyond all measure, whose direction is still seen."""
    flat = by_hand(way=torch.zeros(2), way_covariance=torch.zeros(2, 2), gradient=torch.zeros(3, 2))
    assert flat.isfinite().all()
    assert flat[:2].tolist() == [0.0, 0.0]
    far = by_hand(way=float64([0.0, -1e6]))
    assert far[:2].tolist() == [0.0, -1.0]
    assert far[3] == 2500 / 400 - 0.5


def observed_flight(turn: float) -> Tensor:
    """The observations of three readings, with world and vehicle turned by an angle [rad] to the right.

    Without the relation of the gradients, in which true north has a meaning: the meridians converge there.
    """
    keys = ("field", "target_field", "move", "heading", "sensor_std")
    track = TrackGradient(keys, relation=None, range_km=VIEW.range_km, frame="vehicle")
    observe = Compose(track, *VIEW.observation_transforms()[1:])
    state, seen, observations = None, first_reading(), []
    seen["heading"] += turn
    seen["target_field"][:, 0] += math.degrees(turn)
    seen["field"][:, 0] += math.degrees(turn)
    for step in range(3):
        for key in ("field", "target_field"):
            seen[key][:, 0] = torch.remainder(seen[key][:, 0] + 180, 360) - 180
        seen["sensor_std"] = float64(STD).expand(4, 3)
        seen["step_count"] = torch.full((4, 1), step)
        state = observe(seen.clone()) if state is None else observe(state.copy().set("next", seen.clone()))["next"]
        observations.append(state["observation"])
        change = float64([0.3, 0.4, -60.0]) / (1 + step)
        seen = moved(seen, 40.0, 0.7, change)
    return torch.stack(observations)


@pytest.mark.parametrize("turn", [0.5, -2.0, 3.0])
def test_a_turn_of_world_and_vehicle_is_not_observed(turn: float) -> None:
    """D turns with the world, and for the last angle passes 180 degrees."""
    plain = observed_flight(0.0)
    torch.testing.assert_close(observed_flight(turn), plain, rtol=1e-9, atol=1e-9)
    assert (plain[1:] - plain[:-1]).abs().amax(-1).min() > 0.01


# The transform in environments


def test_weights_are_those_of_the_first_reading_of_each_row() -> None:
    env = observing()
    td = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
    chosen = torch.tensor([True, False, False, True])
    after = env.reset(td.clone().set("_reset", chosen.unsqueeze(-1)))
    first = observe(after.select(*VIEW.in_keys, "sensor_std", "bias_std"))
    for key in ("observation", "first_field"):
        assert torch.equal(after[key][~chosen], td[key][~chosen]), key
        torch.testing.assert_close(after[key][chosen], first[key][chosen], rtol=1e-5, atol=1e-4, msg=key)
    assert torch.equal(after["first_field"][chosen], after["field"][chosen])
    assert (after["first_field"][~chosen] != after["field"][~chosen]).any(-1).all()
    nexts = env.step(env.rand_action(after))["next"]
    assert torch.equal(nexts["first_field"], after["first_field"])
    remaining = nexts["target_field"] - nexts["estimated_field"]
    floors = torch.tensor((0.05, 0.4, 15.0))
    weights = (after["first_field"] - nexts["target_field"]).abs().maximum(floors).square().reciprocal() / VIEW.zeta
    objective = (weights * remaining.square()).sum(-1)
    torch.testing.assert_close(nexts["observation"][:, 10], torch.log(objective + 1e-2) / 3 - 0.5, rtol=1e-5, atol=1e-4)
    step = torch.where(chosen, 1, 4)
    torch.testing.assert_close(nexts["observation"][:, 11], step / 50)


def chain() -> Compose:
    return Compose(SensorNoise(STD), *VIEW.observation_transforms())


def chained() -> TransformedEnv:
    return TransformedEnv(nav(2), chain())


@pytest.mark.parametrize(
    "make",
    [
        chained,
        lambda: TransformedEnv(nav(2), pickle.loads(pickle.dumps(chain()))),
        lambda: SerialEnv(2, chained),
        lambda: TransformedEnv(SerialEnv(2, partial(nav, 2)), chain()),
        lambda: parallel(chained),
    ],
    ids=["single", "pickled", "serial", "of serial", "parallel"],
)
def test_specs(make) -> None:
    env = make()
    try:
        check_env_specs(env)
        assert "first_field" in env.full_state_spec.keys()  # noqa: SIM118
        assert "observation" not in env.full_state_spec.keys()  # noqa: SIM118
    finally:
        env.close()


def test_specs_of_the_environment_are_not_mutated() -> None:
    base = nav(2)
    before = base.specs.clone()
    TransformedEnv(base, chain()).rollout(2)
    assert base.specs == before


def test_a_step_without_its_state_is_refused() -> None:
    td = observing().rollout(2)[:, 0]
    with pytest.raises(KeyError, match=r"TrackObservation reads its state .*first_field.*reset\(\) or step_mdp\(\)"):
        observe(td.exclude("first_field"))


@pytest.mark.parametrize(("place", "key"), [(1, "aim"), (2, "observation")])
def test_a_step_is_compiled_whole(place: int, key: str) -> None:
    rollout = observing().rollout(2)[:, 0]
    expected = observe(rollout.clone())["next", key]
    torch.compiler.reset()
    compiled = torch.compile(VIEW.observation_transforms()[place], fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(rollout)["next", key], expected, rtol=1e-4, atol=1e-4)


# The policy


def policy() -> FieldPolicy:
    torch.manual_seed(0)
    return FieldPolicy(PolicyConfig(VIEW, (16, 16)))


@pytest.mark.parametrize("std", [STD, (0.0, 0.0, 0.0)])
def test_policy_acts_alike_in_the_plain_and_in_the_training_environment(std: tuple[float, ...]) -> None:
    """Over episodes of different lengths, whose vehicles start again at different steps."""
    agent, options = policy(), {"zeta": 2.5, "max_steps": 9, "start_heading": "random"}
    plain = TransformedEnv(nav(16, **options), SensorNoise(std, seed=1)) if any(std) else nav(16, **options)
    with torch.no_grad():
        one = plain.rollout(40, agent, break_when_any_done=False)
        other = observing(16, std, **options).rollout(40, agent.actor, break_when_any_done=False)
    ended = one["next", "done"].squeeze(-1)
    assert ended.any(0).sum() > 10
    assert not ended.all(0).any()
    assert torch.equal(one["next", "done"], other["next", "done"])
    torch.testing.assert_close(one["next", "position"], other["next", "position"], rtol=0, atol=1e-9)
    torch.testing.assert_close(agent.act.normalize("action", one["action"]), other["action"], rtol=0, atol=1e-6)


def test_policy_starts_again_where_the_batch_is_another() -> None:
    """In the middle of an episode, too: what it kept is of other vehicles."""
    agent, middle = policy(), nav(2).rollout(3)[:, -1]
    nav(5).rollout(3, agent)
    assert torch.equal(agent(middle.clone())["action"], policy()(middle.clone())["action"])


def test_policy_heeds_the_data_sheet_and_no_privileged_key() -> None:
    rollout = TransformedEnv(nav(), SensorNoise(STD, seed=1)).rollout(5, policy())
    public = [*VIEW.in_keys, "sensor_std"]

    def actions(agent: FieldPolicy, *keys: str) -> Tensor:
        return torch.stack([agent(td.select(*keys))["action"] for td in rollout.unbind(1)], 1)

    assert torch.equal(actions(policy(), *public), rollout["action"])
    assert not torch.allclose(actions(policy(), *VIEW.in_keys), rollout["action"])


def test_policy_without_a_map_fits_every_region() -> None:
    policy().check_fits(nav(1))


# Its file


def test_save_and_load_give_the_same_actions(tmp_path: Path) -> None:
    agent, expected = policy(), policy()
    save_policy(tmp_path / "policy.pt", agent)
    loaded = load_policy(tmp_path / "policy.pt")
    assert loaded.config == agent.config
    with torch.no_grad():
        assert torch.equal(nav().rollout(4, loaded)["action"], nav().rollout(4, expected)["action"])
    content = torch.load(tmp_path / "policy.pt", weights_only=True)
    assert content["config"]["kind"] == "track"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "region"}, "does not hold a valid policy"),
        ({"kind": "map"}, r"a kind of \['region', 'track'\]"),
        ({"kind": None}, r"a kind of \['region', 'track'\]"),
        ({"memory_size": 4}, "view must be a ObservationView"),
        ({"view": {"zeta": 0.01}}, "does not hold a valid policy"),
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path: Path, change: dict, message: str) -> None:
    path = tmp_path / "policy.pt"
    save_policy(path, policy())
    content = torch.load(path, weights_only=True)
    save_tensors(content | {"config": content["config"] | change}, path)
    with pytest.raises(ValueError, match=message):
        load_policy(path)
