"""Steer an autopilot by the magnetic field: the loop between a vehicle and its navigator, and links to autopilots."""

from magrl.vehicle.autopilot.flight import Link as Link
from magrl.vehicle.autopilot.flight import fly as fly
from magrl.vehicle.autopilot.loop import Loop as Loop
from magrl.vehicle.autopilot.loop import Measurement as Measurement
