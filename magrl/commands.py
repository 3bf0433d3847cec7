"""The start and the end of a command: what it prints, its errors in one line, its exit status."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable
from typing import Any

from magrl.checks import printable


class UsageError(ValueError):
    """A command that cannot run as given; its message is shown without a traceback.

    Example:
        >>> raise UsageError("there is no run to resume in runs/a")
        Traceback (most recent call last):
        magrl.commands.UsageError: there is no run to resume in runs/a
    """


def command(name: str, main: Callable[[], Any], *errors: type[Exception]) -> None:
    """Run a program from the command line.

    What it prints is UTF-8 in every locale, with escapes for other bytes of a path. A :class:`UsageError` and an
    :class:`OSError`, such as of a full disk, are printed in one line, with exit status 2; Ctrl-C ends it with status
    130. Where the reader of the output ends first, as in ``command --help | head``, the command ends without a message,
    with status 141, as after ``SIGPIPE``.

    Args:
        name: name of the program in the message.
        main: function that reads the command line.
        errors: other errors that are printed in one line.

    Example:
        >>> command("mine.py", lambda: None)
    """
    usage: tuple[type[Exception], ...] = (UsageError, OSError, *errors)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")
    try:
        try:
            main()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is still buffered is written at exit
        raise SystemExit(141) from None
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except usage as error:
        print(f"{name}: {printable(error)}", file=sys.stderr)
        raise SystemExit(2) from None
