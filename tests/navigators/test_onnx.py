"""Policies of any algorithm and library as ONNX files: exported, compared, saved, loaded, flown and refused."""

from __future__ import annotations

import json
import logging
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from onnx import ModelProto, TensorProto
from onnx.parser import parse_model
from support.networks import network_file
from support.paths import ROOT, with_paths
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal

from magrl import GeomagneticNavEnv, evaluate, evaluation_rollout, score
from magrl.errors import SensorErrors
from magrl.navigators import FieldPolicy, PolicyConfig, export_policy, load_policy, save_policy
from magrl.transforms import ReadingView

NOISE = (0.05, 0.05, 5.0)
LIMITS = {"max_leg_km": 50.0, "max_turn_rad": math.pi / 2}
READINGS = ReadingView(**LIMITS)
OTHERS = (torch.float64, torch.bfloat16, torch.float16)


def plain_env(**options: object) -> EnvBase:
    return TransformedEnv(GeomagneticNavEnv(num_envs=5, seed=3, **options), SensorErrors(NOISE, seed=1))


# Exports


def test_a_stochastic_actor_of_torchrl_flies_alike_after_saving(tmp_path: Path) -> None:
    """By its deterministic sample, under noise; the export changes neither the actor nor random numbers."""
    base = plain_env(max_steps=8)
    view = base.base_env.observation_view()
    env = TransformedEnv(base, Compose(*view.observation_transforms(), view.action_transform()), auto_unwrap=True)
    torch.manual_seed(0)
    network = nn.Sequential(MLP(view.size, 4, num_cells=[16]), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec_unbatched,
        distribution_class=TanhNormal,
    )
    state = torch.get_rng_state()
    save_policy(tmp_path / "own.onnx", actor, view)
    assert torch.equal(torch.get_rng_state(), state)
    assert actor.training
    assert with_paths(tmp_path) == []
    policy = load_policy(tmp_path / "own.onnx")
    assert (policy.view, policy.in_keys) == (view, ["field", "target_field", "leg", "heading", "elapsed_steps"])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        wanted = evaluation_rollout(env, actor)
    found = evaluation_rollout(plain_env(max_steps=8), policy)
    assert wanted["action"].std(0).min() > 1e-3
    torch.testing.assert_close(found["next", "position"], wanted["next", "position"], rtol=1e-5, atol=1e-4)


def squashed(x: Tensor) -> Tensor:
    return x[..., :2].sigmoid()


class Calling(nn.Module):
    """A module of a function."""

    def __init__(self, function: Callable) -> None:
        super().__init__()
        self.function = function

    def forward(self, x: Tensor) -> Tensor:
        return self.function(x)


def test_what_cannot_be_exported_is_refused_with_its_reason() -> None:
    network = nn.Linear(READINGS.size, 2)
    for actor, message in (
        (Calling(lambda x: squashed(x - x.mean(0))), "acts differently, by .* must depend on the same row"),
        (Calling(lambda x: squashed(x) if x.sum() > 0 else squashed(-x)), "PyTorch cannot export it: "),
        *((nn.Linear(READINGS.size, 2, dtype=dtype), r"float32 weights.*\.float\(\)") for dtype in OTHERS),
        (torch.jit.script(network), "give the module that was scripted"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            export_policy(actor, READINGS)
    warns = []
    log = logging.getLogger("torch.onnx.exporter")
    export_policy(Calling(lambda x: warns.append(log.isEnabledFor(logging.WARNING)) or squashed(x)), READINGS)
    assert not any(warns)
    assert log.isEnabledFor(logging.WARNING)


# Flights


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """The file of a network of another library."""
    save_policy(tmp_path / "own.onnx", network_file(tmp_path, READINGS.size), READINGS)
    return tmp_path / "own.onnx"


def test_a_file_stands_in_tables_by_its_name(own: Path) -> None:
    episodes, alike = (evaluate(name, "paper-100", errors=NOISE, max_steps=4) for name in (str(own), load_policy(own)))
    torch.testing.assert_close(episodes["length_km"], alike["length_km"])


def test_a_policy_of_three_numbers_declares_its_arrival(tmp_path: Path) -> None:
    view = ReadingView(keys=["elapsed_steps"], **LIMITS)
    for bias, steps in ((9.0, 1), (-9.0, 50)):
        save_policy(tmp_path / "own.onnx", network_file(tmp_path, 1, actions=3, bias=bias), view)
        assert (evaluate(str(tmp_path / "own.onnx"), "paper-100", arrival="declared")["steps"] == steps).all()
    with pytest.raises(ValueError, match=r"declares its arrival: fly it with arrival 'declared', not 'objective'"):
        evaluate(str(tmp_path / "own.onnx"), "paper-100")


def test_no_file_holds_a_path_of_a_machine(own: Path, tmp_path: Path) -> None:
    """Written: those of other libraries with such metadata, and weights. Shipped: weights, records, results."""
    model = ModelProto.FromString(own.read_bytes())
    model.graph.doc_string = str(ROOT)
    model.graph.node[0].metadata_props.add(key="stack_trace", value=str(ROOT))
    (tmp_path / "raw.onnx").write_bytes(model.SerializeToString())
    assert with_paths(tmp_path) == [tmp_path / "raw.onnx"]
    save_policy(tmp_path / "raw.onnx", tmp_path / "raw.onnx", READINGS)
    save_policy(tmp_path / "policy.safetensors", FieldPolicy(PolicyConfig(READINGS, (8,))))
    assert with_paths(tmp_path, ROOT / "magrl", ROOT / "docs" / "results", ROOT / "docs" / "figures") == []


# Refusals


def described(change: Callable[[dict], dict]) -> Callable[[ModelProto], None]:
    """Return a function that changes the description of a policy in its file."""

    def apply(model: ModelProto) -> None:
        (entry,) = model.metadata_props
        entry.value = json.dumps(change(json.loads(entry.value)))

    return apply


def renamed(model: ModelProto) -> None:
    model.graph.input[0].name = model.graph.node[0].input[0] = "obs"


def of_one_row(model: ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1


def doubled(model: ModelProto) -> None:
    model.graph.input[0].type.tensor_type.elem_type = TensorProto.DOUBLE


def elsewhere(folder: Path) -> bytes:
    model = ModelProto.FromString(network_file(folder, 13).read_bytes())
    model.graph.initializer[0].data_location = TensorProto.EXTERNAL
    model.graph.initializer[0].external_data.add(key="location", value="own")
    return model.SerializeToString()


def written(nodes: str) -> bytes:
    head = '<ir_version: 10, opset_import: ["": 18]> network (float[N,13] observation) => (float[N,2] action)'
    return parse_model(f"{head} {{ two = Constant<value = int64[2] {{0, 1}}>() {nodes} }}").SerializeToString()


GATHER = "seen = Gather<axis = 1>(observation, two)"
BODY = "once (int64 i, bool more, float[N,2] x) => (bool on, float[N,2] y) { on = Identity(more) y = Identity(x) }"
YEARS = "years = Constant<value = int64 {4000000000000}>() go = Constant<value = bool {1}>()"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda _: written(f"{GATHER} mean = ReduceMean(seen) action = Sub(seen, mean)"), "depend on the same row"),
        (lambda _: written(f"{GATHER} {YEARS} action = Loop<body = {BODY}>(years, go, seen)"), "without Loop"),
        (elsewhere, "weights' is in another file"),
    ],
)
def test_a_network_acts_by_its_file_and_one_row_and_ends(content, message: str, tmp_path: Path) -> None:
    """Else it is refused, with a view as without."""
    path, view = tmp_path / "own.onnx", GeomagneticNavEnv(seed=3).observation_view()
    path.write_bytes(content(tmp_path))
    for read in (lambda: export_policy(path, view), lambda: score(path, "box", episodes=2)):
        with pytest.raises(ValueError, match=rf"{re.escape(str(path))} does not hold a valid policy: .*{message}"):
            read()


def test_damaged_files_are_refused(own: Path, tmp_path: Path) -> None:
    """Also without one of the nodes of the graph."""
    for change, message in (
        (renamed, "it must take 'observation' and return 'action'"),
        (of_one_row, r"'observation' must be float32 \(N, 9\) for any N \(dynamic_axes"),
        (doubled, ""),
        *((lambda model, number=number: model.graph.node.pop(number), "") for number in range(3)),
        (described(lambda _: {}), ""),
        (described(lambda content: content | {"format": 7}), ""),
        (described(lambda content: content | {"kind": "map"}), ""),
        (described(lambda content: content | {"view": {"max_leg_km": -1}}), ""),
        (lambda model: model.ClearField("metadata_props"), "a bare network: score it with magrl.score, or save it"),
    ):
        model, path = ModelProto.FromString(own.read_bytes()), tmp_path / "changed.onnx"
        change(model)
        path.write_bytes(model.SerializeToString())
        with pytest.raises(ValueError, match=rf"{re.escape(str(path))} does not hold a valid policy: .*{message}"):
            load_policy(path)


def test_wrong_arguments_are_refused(own: Path, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "small").mkdir()
    for call, error, message in (
        (lambda: export_policy(network_file(tmp_path / "small", 8), READINGS), ValueError, "got tensor.float. .*8"),
        (lambda: save_policy(tmp_path / "a.onnx", nn.Linear(9, 2)), TypeError, r"save_policy\('policy.onnx', network,"),
        (lambda: save_policy(tmp_path / "a.pt", load_policy(own)), ValueError, r"ends with \.onnx, .*got '.*a\.pt'"),
        (lambda: ReadingView(keys=["position"], **LIMITS), ValueError, r"keys must be some of .*got \['position'\]"),
    ):
        with pytest.raises(error, match=message):
            call()
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ImportError, match=r"the package onnx: pip install 'magrl\[onnx\]'"):
        save_policy(tmp_path / "other.onnx", own, READINGS)
