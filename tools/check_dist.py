"""Install the wheel from dist/ as a stranger would, and identify a bag with it: `python tools/check_dist.py`.

An empty environment, the packages of the index (a download of some 250 MB), no ROS, a folder outside the repository. The result must be
that of the project's own command, whose packages are pinned: equal to a part in a hundred, since other versions round differently. The
identification that compiles the kernels also rounds differently (the last digits of its sums), and so ends at another point within the
stated deviations; results are compared of the one after it, which loads them.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / "bags" / "hammer_depth"
TOLERANCE = 1e-2
"""Relative, of an error on held-out pushes."""
COMMANDS = (
    ("--help",),
    ("--version",),
    ("identify", str(BAG), "--train", "0-2", "--json", "first.json"),
    ("identify", str(BAG), "--train", "0-2", "--out", "out", "--json", "own.json"),
    ("predict", "out/model.json", str(BAG)),
    ("look", str(BAG), "--out", "look"),
    ("doctor",),
    ("diagnose", str(BAG), "--out", "diagnosis"),
)
LIBRARY = f"import push_ident as pi; print(pi.identify(pi.load({str(BAG)!r})[:3]).status)"


def run(call: list[str | Path], folder: Path, environ: dict[str, str]) -> None:
    """Run a command, its output shown where it fails."""
    start = time.monotonic()
    done = subprocess.run(call, cwd=folder, env=environ, capture_output=True, text=True, check=False)
    print(f"{time.monotonic() - start:6.1f} s  {' '.join(str(part) for part in call[:3])}", flush=True)
    if done.returncode:
        sys.exit(f"exit status {done.returncode}:\n{done.stdout}{done.stderr}")


def main() -> None:
    """Exit status 1 where a step fails or the results differ."""
    (wheel,) = (ROOT / "dist").glob("*.whl")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start = time.monotonic()
        venv.create(folder / "venv", with_pip=True)
        own = folder / "venv" / "bin"
        plain = {"PATH": f"{own}:{os.defpath}", "HOME": name, **{k: v for k, v in os.environ.items() if k.startswith("PIP_")}}
        run([own / "pip", "install", "--quiet", f"{wheel}[report]"], folder, plain)
        for arguments in COMMANDS:
            run([own / "push-ident", *arguments], folder, plain)
        run([own / "python", "-c", LIBRARY], folder, plain)
        here = ROOT / ".venv" / "bin" / "push-ident"
        run([here, "identify", BAG, "--train", "0-2", "--json", folder / "project.json"], ROOT, dict(os.environ))
        files = ("project.json", "own.json", "first.json")
        ours, theirs, first = (json.loads((folder / file).read_text())["test"]["identified_m"] for file in files)
        print(f"error on the held-out push: {1e3 * theirs:.4f} mm (while compiling {1e3 * first:.4f} mm), of the clone {1e3 * ours:.4f} mm")
        print(f"{time.monotonic() - start:.0f} s in all")
        if not math.isclose(ours, theirs, rel_tol=TOLERANCE):
            sys.exit("the results differ")


if __name__ == "__main__":
    main()
