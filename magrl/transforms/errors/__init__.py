"""Errors of sensors, north reference and motion, magnetic weather, and presets of these as conditions."""
