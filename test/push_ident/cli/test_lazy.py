"""Commands are imported when they are asked for."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from push_ident.cli.lazy import LazyGroup
from push_ident.cli.main import app


def test_list_of_commands_imports_none_of_them() -> None:
    code = (
        "import sys; from push_ident.cli.main import app\n"
        "try: app(['-h'])\n"
        "except SystemExit: pass\n"
        "print('imported', sorted({'cv2', 'numba', 'numpy', 'rclpy', 'scipy', 'torch'} & set(sys.modules)))"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.endswith("imported []\n")


def test_identify_of_poses_imports_nothing_slow_for_images_arms_pages_or_quantiles() -> None:
    """`scipy.stats` takes half a second; `scipy.special` has the quantiles of the usual distributions."""
    code = (
        "import sys; import push_ident.cli.identify\n"
        "print(sorted({'cv2', 'jinja2', 'matplotlib', 'open3d', 'pinocchio', 'rclpy', 'scipy.stats', 'torch'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


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


@pytest.mark.parametrize("then", ["raise", "sys.exit(130)"])
def test_ctrl_c_while_a_dataclass_is_made_has_the_exit_code_of_any_other(tmp_path: Path, then: str) -> None:
    run = f"def run():\n    try:\n        exec('raise KeyboardInterrupt')\n    except KeyboardInterrupt:\n        {then}\n"
    text = f"import sys\nfrom push_ident.cli.entry import _run\n{run}_run(run, 130)\n"
    (tmp_path / "interrupted.py").write_text(text)
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run([sys.executable, "-m", "interrupted"], env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "")
