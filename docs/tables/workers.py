"""Processes of the scripts that make tables and figures."""

from __future__ import annotations

import ctypes
import signal


def die_with_parent() -> None:
    """End this process when its parent ends, also by a kill (Linux), and quietly by Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
