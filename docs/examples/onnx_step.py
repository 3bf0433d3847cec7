"""Write one step of the pretrained agent as ONNX, and run it without magrl and PyTorch."""

from magrl.tracking import load_pilot
from magrl.tracking.network import pretrained
from magrl.vehicle.onboard import write_step

import numpy as np
import onnxruntime

rules, network = load_pilot(pretrained("anywhere"))
write_step("anywhere.onnx", rules.replace(confidence=0.8, max_steps=120), network)

session = onnxruntime.InferenceSession("anywhere.onnx")  # from here on, without magrl and PyTorch
types = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(int64)": np.int64}
state = {
    each.name: np.zeros(each.shape, types[each.type]) for each in session.get_inputs()
}  # any before the first step
inputs = {
    "field": [-1.2, 73.4, 15050.0],  # the reading: D [deg], I [deg], B_H [nT]
    "target": [-11.6, 75.4, 13240.0],
    "distance": 0.0,  # of the move before the reading [km]
    "heading": np.radians(290.0),  # of it [rad]
    "std": [[0.02, 0.02, 2.0], *[[0.0] * 3] * 3],  # noise, bias, drift, iron
    "step": 0,
}
feed = state | {name: np.asarray(value, state[name].dtype) for name, value in inputs.items()}
names = [output.name for output in session.get_outputs()]
found = dict(zip(names, session.run(names, feed), strict=True))
distance_km, turn_rad, declared = found["action"]  # the vehicle has arrived where declared > 0
state |= {name: found[f"next_{name}"] for name in state if f"next_{name}" in found}
