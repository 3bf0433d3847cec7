"""Navigation by the Earth's magnetic field: a TorchRL environment, transforms and what trains on them.

Importing the package registers the named tasks of :mod:`magrl.envs.gymnasium` with Gymnasium. The names in
``magrl.__all__``, listed in ``__init__.pyi``, are loaded when first used, so that the import does not load torch.
"""

import multiprocessing as _multiprocessing
import os as _os

import gymnasium as _gymnasium
import lazy_loader as _lazy_loader

from magrl.named_tasks import NAMED_TASKS as _NAMED_TASKS

_os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

__version__ = "0.2.0"

_load, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Load a public name, or a class for Gymnasium; the latter does not change how the program starts processes."""
    if not name.endswith(("GymEnv", "VectorEnv")):
        return _load(name)
    method = _multiprocessing.get_start_method(allow_none=True)
    from magrl.envs import gymnasium

    _multiprocessing.set_start_method(method, force=True)  # importing TorchRL sets "spawn"
    return getattr(gymnasium, name)


for _name, _task in _NAMED_TASKS.items():
    if _task.id not in _gymnasium.registry:
        _gymnasium.register(
            _task.id,
            entry_point="magrl:GeomagneticNavGymEnv",
            vector_entry_point="magrl:GeomagneticNavVectorEnv",
            reward_threshold=_task.threshold,
            kwargs={"task": _name},
        )
