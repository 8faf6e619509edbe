"""Commands of `push-ident` in the process of the test."""

from __future__ import annotations

import io
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout

import pytest

from push_ident.cli.main import main


def run_here(*args: object) -> subprocess.CompletedProcess[str]:
    """One command in this process: the same function, without the seconds of a start."""
    output, error, code = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output), redirect_stderr(error):
        patch.setattr(sys, "argv", ["push-ident", *map(str, args)])
        try:
            main()
        except SystemExit as ended:
            code = int(ended.code or 0)
    return subprocess.CompletedProcess(args, code, output.getvalue(), error.getvalue())


def check_refused(reason: str, *args: object) -> None:
    """That a command ends with one line that has the reason."""
    done = run_here(*args)
    assert done.returncode == 1 and reason in done.stderr and done.stderr.strip().count("\n") == 0, done.stderr
