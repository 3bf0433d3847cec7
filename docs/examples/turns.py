"""Estimate the iron of 1000 vehicles from ten turns of 36 degrees at one place."""

import math

from magrl.field.elements import axes_of_elements, elements_of_axes
from magrl.pilot.belief import IRON, read, start
from magrl.sensor_std import SensorStd

import torch

torch.manual_seed(0)
here, noise = torch.tensor([2.84, 73.05, 15003.0]).double(), torch.tensor([0.05, 0.02, 5.0]).double()
iron = 100 * torch.randn(1000, 3).double()  # of 1000 vehicles: forward, right, down [nT]
bias = math.degrees(100 / 15003.0), math.degrees(100 / 51480.0), 100.0  # its effect on D, I, B_H
errors = SensorStd(noise, *(torch.tensor(std).double().expand(1000, 3) for std in (bias, bias, (100.0,) * 3)))
belief = None
for heading in torch.arange(0, 361, 36).double():
    attitude = torch.tensor([0.0, 0.0, heading]).double().expand(1000, 3)
    axes = axes_of_elements(here.expand(1000, 3), attitude) + iron
    reading = elements_of_axes(axes, attitude) + noise * torch.randn(1000, 3)
    course = torch.deg2rad(heading).expand(1000)
    belief = start(reading, errors, course) if belief is None else read(belief, reading, noise, course)
print("errors [nT]", (belief.mean[:, IRON] - iron).square().mean(0).sqrt())
print("stated [nT]", belief.covariance[:, IRON, IRON].diagonal(dim1=-2, dim2=-1).mean(0).sqrt())  # what it states
