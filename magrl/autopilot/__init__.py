"""Steer an autopilot by the magnetic field: the loop between a vehicle and its navigator, and links to autopilots."""

from magrl.autopilot.flight import Link as Link
from magrl.autopilot.flight import fly as fly
from magrl.autopilot.loop import Loop as Loop
from magrl.autopilot.loop import Measurement as Measurement
