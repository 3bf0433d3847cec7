"""A navigator on board one vehicle, logs of vehicles, links to autopilots. Nothing else in magrl imports it."""
