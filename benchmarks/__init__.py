"""Benchmarks: ``python -m benchmarks``."""

import magrl as magrl  # before torch: see recipes/ruff.toml
