"""What is slow is imported when it is asked for, and a command is bounded, quiet and single-threaded from its first line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from push_ident.cli.lazy import LazyGroup
from push_ident.cli.main import app


def run(code: str, *, how: str = "-c", **environment: str) -> subprocess.CompletedProcess[str]:
    paths = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    known = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    return subprocess.run([sys.executable, how, code], env=known | paths | environment, capture_output=True, text=True, timeout=60)


def test_nothing_slow_is_imported_before_it_is_needed() -> None:
    """`scipy.stats` takes half a second; `scipy.special` has the quantiles of the usual distributions."""
    code = """
import sys
def slow(*names):
    return set(names) & set(sys.modules)
import push_ident as pi
from push_ident.cli.main import app
try: app(["-h"])
except SystemExit: pass
assert "identify" in dir(pi) and not slow("cv2", "matplotlib", "numba", "numpy", "rclpy", "scipy", "torch"), slow("numpy")
pi.identify
import push_ident.cli.identify
print("imported", slow("cv2", "jinja2", "matplotlib", "open3d", "pinocchio", "rclpy", "scipy.stats", "torch"))
"""
    done = run(code)
    assert done.stdout.endswith("imported set()\n"), done.stdout + done.stderr


@pytest.mark.parametrize(
    ("module", "chosen", "used"),
    [("push_ident.nodes.executables", {}, "1"), ("push_ident.cli.entry", {"OPENBLAS_NUM_THREADS": "3"}, "3")],
)
def test_linear_algebra_has_one_thread_before_numpy_is_loaded(module: str, chosen: dict[str, str], used: str) -> None:
    done = run(f"import {module}, os, sys; assert 'numpy' not in sys.modules; print(os.environ['OPENBLAS_NUM_THREADS'])", **chosen)
    assert done.stdout.strip() == used, done.stderr


def test_every_command_has_a_summary_and_help() -> None:
    runner = CliRunner()
    listed = runner.invoke(app, ["--help"]).output.splitlines()
    for name, command in LazyGroup.lazy_subcommands.items():
        line = next(line for line in listed if line.startswith(f"  {name} "))
        assert line.split(maxsplit=1)[1] == command.summary, "the whole summary stands in one line"
        asked = runner.invoke(app, [name, "--help"])
        assert asked.exit_code == 0 and f"push-ident {name}" in asked.output.replace("root", "push-ident")
    misspelt = runner.invoke(app, ["identfy"])
    assert misspelt.exit_code == 2 and "identify" in misspelt.output


def test_shells_can_complete_options() -> None:
    asked = {"_PUSH_IDENT_COMPLETE": "complete_bash", "COMP_WORDS": "push-ident import csv --rad", "COMP_CWORD": "3"}
    done = run("import sys; sys.argv[0] = 'push-ident'; from push_ident.cli.entry import main; main()", **asked)
    assert done.stdout.split() == ["--radius"]


@pytest.mark.parametrize("then", ["raise", "sys.exit(130)"])
def test_ctrl_c_while_a_dataclass_is_made_has_the_exit_code_of_any_other(tmp_path: Path, then: str) -> None:
    own = f"def own():\n    try:\n        exec('raise KeyboardInterrupt')\n    except KeyboardInterrupt:\n        {then}\n"
    (tmp_path / "interrupted.py").write_text(f"import sys\nfrom push_ident.cli.entry import _run\n{own}_run(own, 130)\n")
    done = run("interrupted", how="-m", PYTHONPATH=os.pathsep.join([str(tmp_path), *sys.path]))
    assert (done.returncode, done.stderr) == (130, "")


def test_an_allocation_beyond_free_memory_is_an_error_and_the_next_one_succeeds() -> None:
    code = """
import resource
from push_ident.cli.memory import limit_memory
limit_memory()
limit, _ = resource.getrlimit(resource.RLIMIT_DATA)
try:
    bytearray(limit)
except MemoryError:
    print(len(bytearray(2**20)))
"""
    assert run(code).stdout == f"{2**20}\n"
