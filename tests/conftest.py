"""One thread is as fast as several on small tensors, and a busy neighbour then costs nothing."""

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # read when torch is imported

import torch

torch.set_num_threads(1)
