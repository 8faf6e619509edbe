"""Commands of `push-ident` in the process of the test."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

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


PROGRAM = """
import io, json, runpy, sys
from contextlib import redirect_stderr, redirect_stdout
from numba.core import event
from push_ident.cli.main import main
done, compiled = [], event.RecordingListener()
event.register("numba:compile", compiled)
for program, *arguments in json.load(sys.stdin):
    sys.argv, text, code = [program, *arguments], io.StringIO(), 0
    with redirect_stdout(text), redirect_stderr(text):
        try:
            main() if program == "push-ident" else runpy.run_path(program, run_name="__main__")
        except SystemExit as ended:
            code = ended.code or 0
    done.append((code, text.getvalue()))
print(json.dumps([done, len(compiled.buffer)]))
"""


def run_in_one_process(
    calls: Sequence[Sequence[object]], env: Mapping[str, str], python: str | Path = sys.executable
) -> tuple[list[tuple[int, str]], int]:
    """Exit status and output of `push-ident` and of files of Python, one after another, and how many kernels that process compiled.

    Started for each alone, a process would take a second, and compile the kernels of an effect in a folder anew.
    """
    lines = json.dumps([[str(word) for word in call] for call in calls])
    ended = subprocess.run([python, "-c", PROGRAM], input=lines, env=env, capture_output=True, text=True, timeout=1800, check=False)
    assert ended.returncode == 0, ended.stderr
    done, n_compiled = json.loads(ended.stdout.splitlines()[-1])
    return [(code, text) for code, text in done], n_compiled
