"""Entry point of `push-ident`: ready for Ctrl-C before anything that takes long is imported."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from typing import Final, NoReturn

from push_ident.nodes.base.lifetime import LIFETIME

_INTERRUPTED: Final = 130
"""Exit code of a command that Ctrl-C ended, as shells have it: 128 + SIGINT."""
_ENDED_BY_CTRL_C: Final = ("up",)
"""Commands whose regular end is Ctrl-C: exit code 0."""


def main() -> None:
    """Run the command line."""
    interrupted = 0 if sys.argv[1:2] and sys.argv[1] in _ENDED_BY_CTRL_C else _INTERRUPTED
    LIFETIME.begin(interrupted)
    from push_ident.cli.main import main

    _run(main, interrupted)


def _run(command: Callable[[], None], interrupted: int) -> NoReturn:
    """Run a command line that Ctrl-C may interrupt, and leave with its exit code."""
    code = _exit_code(command, interrupted)
    if code == interrupted:
        # Where the KeyboardInterrupt has passed the making of a dataclass, Python notes it and would end by SIGINT under `python -m`.
        LIFETIME.leave(interrupted)
    sys.exit(code)


def _exit_code(run: Callable[[], None], interrupted: int) -> int | str | None:
    try:
        try:
            LIFETIME.interruptible()
            run()
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # the end of the interpreter is no place for a KeyboardInterrupt
    except KeyboardInterrupt:
        return interrupted
    except SystemExit as end:
        return interrupted if end.code == _INTERRUPTED else end.code
    return 0
