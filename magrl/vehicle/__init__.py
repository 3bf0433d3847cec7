"""A navigator on board one vehicle, and readings that vehicles recorded. Nothing else in magrl imports it."""
