"""The step of a pilot flies the same in simulation, on board, as an exported program and as ONNX."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from onnxruntime import InferenceSession
from tensordict import TensorDict
from torch import Tensor, nn

from magrl.navigators import Anywhere, Kalman
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import Rules, State, load_pilot
from magrl.tracking.network import pretrained
from magrl.vehicle.onboard import Onboard, PilotStep, write_step
from magrl.vehicle.onboard.export import INPUTS, OUTPUTS, first_inputs

HERE, TARGET = torch.tensor([3.5, 73.0, 15000.0]), torch.tensor([3.1, 74.1, 14300.0])
SLOPE = torch.tensor([[-0.002, 0.012], [0.008, -0.001], [-6.0, 0.5]])  # of a linear field, per km
STATED = SensorStd((0.02, 0.02, 2.0), (0.1, 0.05, 10.0), (0.05, 0.02, 5.0))
CHANGES = {"arrival": "declared", "confidence": 0.3, "radius_km": 60.0, "max_steps": 40, "drift": 0.0, "wander_km": 0.0}
Step = Callable[[dict[str, Tensor]], tuple[Tensor, ...]]


def fly(module: Step, number: int) -> tuple[list[dict[str, Tensor]], Tensor]:
    """Fly one vehicle to its declaration by a step; the noise is four times the stated one.

    Returns:
        The inputs of each step, and the declaration, distance and turn of each ``(T, 3)``.
    """
    generator, place, actions, seen = torch.Generator().manual_seed(number), torch.zeros(2), [], []
    inputs = first_inputs() | {"target": TARGET, "std": torch.tensor([*STATED], dtype=torch.float64)}
    inputs |= {"heading": torch.tensor(1.0)}
    for step in range(40):
        noise = 4 * torch.tensor(STATED.noise) * torch.randn(3, generator=generator)
        inputs |= {"field": HERE + SLOPE @ place + noise, "step": torch.tensor(step)}
        seen.append(inputs)
        action, _, _, _, *state = module(inputs)
        actions.append(action)
        if action[2] > 0:
            break
        heading = (inputs["heading"] + action[1]).remainder(2 * math.pi)
        place = place + action[0] * torch.stack((heading.cos(), heading.sin()))
        inputs = inputs | {"distance": action[0], "heading": heading} | dict(zip(State._fields, state, strict=True))
    return seen, torch.stack(actions)


def simulated(navigator: Kalman, flight: list[dict[str, Tensor]]) -> Tensor:
    """The actions of the navigator of the environment on the readings of a flight."""
    actions, navigator = [], navigator.adapted()
    for inputs in flight:
        rows = {"field": inputs["field"], "target_field": inputs["target"], "heading": inputs["heading"].reshape(1)}
        rows |= {
            "move": torch.stack((inputs["distance"], inputs["distance"] * 0)),
            "elapsed_steps": inputs["step"].reshape(1),
        }
        rows |= dict(zip(STD_KEYS, inputs["std"].float(), strict=True))
        seen = TensorDict({key: row.unsqueeze(0) for key, row in rows.items()}, [1])
        actions.append(navigator(seen)["action"][0])
    return torch.stack(actions)


def on_board(vehicle: Onboard, flight: list[dict[str, Tensor]]) -> Tensor:
    """The commands of the vehicle on the readings of a flight, in the form of actions."""
    vehicle.start(TARGET)
    actions = []
    for inputs in flight:
        reading = inputs["field"].tolist()
        command = vehicle.step(*reading, math.degrees(inputs["heading"]), inputs["distance"])
        actions.append(
            (command.distance_km, math.radians(command.turn_deg), 1.0 if command.stop == "arrived" else -1.0)
        )
    return torch.tensor(actions)


def check(pilot: str, module: nn.Module, steps: dict[str, Step], number: int) -> None:
    """All fly the same: simulation, vehicle, module, and what was written of it."""
    navigator = Kalman(**CHANGES) if pilot == "kalman" else Anywhere(**CHANGES)
    vehicle = Onboard(pilot, sensor_std=STATED, **CHANGES)
    with torch.inference_mode():
        flight, actions = fly(lambda inputs: module(*inputs.values()), number)
        torch.testing.assert_close(simulated(navigator, flight), actions, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(on_board(vehicle, flight), actions, rtol=1e-3, atol=1e-3)
        for step in steps.values():
            found = torch.stack([step(inputs)[0] for inputs in flight])
            torch.testing.assert_close(found, actions, rtol=2e-3, atol=2e-3)
    assert len(flight) > 5
    assert actions[-1, 2] > 0
    assert flight[-1]["log_ratio"].max() > 0.3  # the stated noise was corrected


def pilots(name: str) -> PilotStep:
    rules, network = (Rules(), None) if name == "kalman" else load_pilot(pretrained("anywhere"))
    return PilotStep(rules.replace(**CHANGES), network)


@pytest.mark.parametrize(("name", "number"), [("kalman", 0), ("anywhere", 1)])
def test_one_step_flies_in_simulation_and_on_board(name: str, number: int) -> None:
    check(name, pilots(name), {}, number)


@pytest.mark.slow
def test_one_step_flies_in_four_ways(tmp_path: Path) -> None:
    """Also as a program and as ONNX; the program runs in a process that can import neither TorchRL nor magrl."""
    module = pilots("anywhere")
    for suffix in ("pt2", "onnx"):
        write_step(tmp_path / f"step.{suffix}", module.rules, module.network)
    program, session = torch.export.load(tmp_path / "step.pt2").module(), InferenceSession(tmp_path / "step.onnx")
    assert tuple(each.name for each in session.get_outputs()) == OUTPUTS

    def onnx(inputs: dict[str, Tensor]) -> tuple[Tensor, ...]:
        given = {each.name: inputs[each.name].numpy() for each in session.get_inputs()}
        return tuple(map(torch.as_tensor, session.run(None, given)))

    check("anywhere", module, {"pt2": lambda inputs: program(*inputs.values()), "onnx": onnx}, 0)
    torch.save(tuple(first_inputs().values()), tmp_path / "inputs.pt")
    code = """
import sys, torch
for name in ("torchrl", "tensordict", "magrl"):
    sys.modules[name] = None
print(*torch.export.load(sys.argv[1]).module()(*torch.load(sys.argv[2]))[0].shape)
"""
    command = [sys.executable, "-W", "ignore", "-c", code, str(tmp_path / "step.pt2"), str(tmp_path / "inputs.pt")]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == "3"


def test_inputs_have_names_and_a_wrong_file_is_refused() -> None:
    """Each input is a tensor of its own: an export would take two that are the same tensor for one."""
    assert tuple(first_inputs()) == INPUTS
    assert len({value.data_ptr() for value in first_inputs().values()}) == len(INPUTS)
    with pytest.raises(ValueError, match=r"must end with \.pt2 or \.onnx, got 'step\.pt'"):
        write_step("step.pt", Rules())
