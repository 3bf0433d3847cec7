"""Ctrl-C while a command imports its modules: one line, as :func:`magrl.checks.command` prints it afterwards.

A command imports this module first. Nothing else does: programs that use the library keep their own signals.
"""

import os
import signal
import sys
from types import FrameType


def end(signum: int, frame: FrameType | None) -> None:  # noqa: ARG001
    """End the program in one line, with status 130."""
    os.write(2, f"{os.path.basename(sys.argv[0])}: interrupted\n".encode())
    os._exit(130)


def importer() -> str | None:
    """Return the name of the module that imports this one."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and (frame.f_code.co_filename.startswith("<frozen") or frame.f_globals is globals()):
        frame = frame.f_back
    return None if frame is None else frame.f_globals.get("__name__")


if importer() == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, end)
