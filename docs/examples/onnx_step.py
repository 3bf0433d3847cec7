"""Write one step of the pretrained agent as ONNX, and run it without magrl and PyTorch."""

from magrl import load_pretrained
from magrl.vehicle.onboard import write_step

import numpy as np
import onnxruntime

write_step("anywhere.onnx", load_pretrained("anywhere").adapted(max_steps=120))

session = onnxruntime.InferenceSession("anywhere.onnx")  # from here on, without magrl and PyTorch
state = {"step": 0, "belief_mean": np.zeros(25), "belief_covariance": np.eye(25), "belief_latitude": np.zeros(1)}
state["belief_mean"][:3] = 20000, 0, 40000  # any field that is possible
state["first_field"] = np.zeros(3)
inputs = {
    "field": [-1.2, 73.4, 15050.0],  # the reading: D [deg], I [deg], B_H [nT]
    "target_field": [-11.6, 75.4, 13240.0],
    "course": [0.0, np.radians(290.0)],  # distance [km] and heading [rad] of the move
    "accuracy": [[0.02, 0.02, 2.0], *[[0.0] * 3] * 3],  # noise, bias, drift, iron
}
types = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(int64)": np.int64}
feed = {each.name: np.asarray((inputs | state)[each.name], types[each.type]) for each in session.get_inputs()}
names = [output.name for output in session.get_outputs()]
found = dict(zip(names, session.run(names, feed), strict=True))
distance_km, turn_rad = found["action"]  # and the way, its covariance, and the next state: next_step, ...
state = {name: found[f"next_{name}"] for name in state}
