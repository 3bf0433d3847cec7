"""One thread is as fast as several on small tensors, and a busy neighbour then costs nothing."""

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # read when torch is imported

import torch
from hypothesis import settings

torch.set_num_threads(1)

# Every run checks the same examples, so that a failure is a change in the code. HYPOTHESIS_PROFILE=search draws others.
settings.register_profile("ci", derandomize=True, max_examples=50, deadline=None, database=None)
settings.register_profile("search", max_examples=1000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))
