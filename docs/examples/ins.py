"""Navigate beside an inertial navigation system (INS) with an error of 2 % and 0.6 degrees: Bergen to Reykjavik."""

from magrl import IGRF
from magrl.field import elements_at
from magrl.geodesy import geodesic, move_place
from magrl.onboard import Onboard

import torch

field, random = IGRF("2026-06-30"), torch.Generator().manual_seed(0)
true = ins = torch.tensor((60.4, 5.3), dtype=torch.float64)  # Bergen
vehicle = Onboard("kalman", sensor_std=(0.05, 0.05, 5.0), drift=0.02)
vehicle.start((64.1, -21.9), (60.4, 5.3), date="2026-06-30")  # to Reykjavik
heading, distance = 290.0, 0.0
for number in range(21):
    noise = torch.randn(3, generator=random) * torch.tensor((0.05, 0.05, 5.0))
    reading = (elements_at(field, true) + noise).tolist()
    command = vehicle.step(*reading, heading=heading, distance=distance, distance_std=0.5, heading_std=0.2)
    if number == 20:
        errors = (float(geodesic(*torch.tensor(place), *true)[0]) for place in (ins.tolist(), command.place))
        print(f"leg {number}: error of the INS {next(errors):.0f} km, with the field {next(errors):.0f} km")
    if number == 10:
        vehicle.fix(*true.tolist(), std_km=2.0)
    heading, distance = command.heading_deg, command.distance_km
    leg, course = torch.tensor((distance, heading), dtype=torch.float64)
    ins = move_place(ins, course.deg2rad(), leg)
    wander = torch.randn(2, generator=random) * torch.tensor((0.5, 0.0035))
    true = move_place(true, course.deg2rad() + 0.01 + wander[1], 1.02 * leg + wander[0])
