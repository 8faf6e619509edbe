"""`make test-oldest`: a part of the tests with the oldest packages that setup.py allows: `python tools/test_oldest.py [PYTEST OPTION...]`.

They are installed in an environment of its own, with ROS as wheels; the messages are those that `make setup` built, against another numpy:
as on Ubuntu 24.04, where numpy is 1.26.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from setup_workspace import uv_environment

ROOT = Path(__file__).resolve().parent.parent
UV = ROOT / ".venv" / "bin" / "uv"
OLDEST = ROOT / "out" / "oldest"
RESOLVED = ("oldest", "sim", "dev")
"""Lists of requirements/ that bring what they need."""
COMPLETE = ("ros", "arm")
TESTS = (
    "nodes/test_convert.py", "nodes/test_lifecycle.py", "nodes/test_load_model.py", "api", "bags", "checking", "geometry",
    "identification/files", "identification/test_identify.py", "diagnosis/test_diagnose.py", "perception/test_kernels.py",
    "perception/test_pipeline.py", "test_library.py",
)  # fmt: skip
"""Of test/push_ident: what needs neither PyTorch nor Ray, and uses most of the packages."""
MARKERS = "not alone and not live and not long and not release"


def install() -> None:
    """Make the environment anew."""
    install = [UV, "pip", "install", "--quiet", "--python", OLDEST / "bin" / "python"]
    lists = {name: ["-r", ROOT / "requirements" / f"{name}.txt"] for name in RESOLVED + COMPLETE}
    subprocess.run([UV, "venv", "--quiet", "--clear", "--python", sys.executable, OLDEST], check=True)
    environ = uv_environment()
    subprocess.run([*install, *(word for name in RESOLVED for word in lists[name])], env=environ, check=True)
    subprocess.run([*install, "--no-deps", *(word for name in COMPLETE for word in lists[name])], env=environ, check=True)


def environment() -> dict[str, str]:
    """Variables with which the environment finds ROS, the messages and the sources; kernels of another numba have a cache of their own."""
    built = ROOT / "install"
    sources = [ROOT / "src" / name for name in ("push_ident", "push_ident_sim")]
    paths = {
        "PYTHONPATH": [*sources, *built.glob("*_msgs/lib/python3*/site-packages")],
        "LD_LIBRARY_PATH": [*built.glob("*_msgs/lib"), OLDEST / "lib", *OLDEST.glob("lib/python3*/site-packages/ros_*.libs")],
        "AMENT_PREFIX_PATH": [*(path for path in built.iterdir() if path.is_dir()), OLDEST],
    }
    return {
        **os.environ,
        **{name: os.pathsep.join(map(str, folders)) for name, folders in paths.items()},
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(ROOT / "src" / "push_ident" / "config" / "fastdds_local.xml"),
        "NUMBA_CACHE_DIR": str(OLDEST / "kernels"),
        "OMP_NUM_THREADS": "1",
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }


def main() -> int:
    """Exit status of pytest."""
    install()
    tests = [ROOT / "test" / "push_ident" / test for test in TESTS]
    call = [OLDEST / "bin" / "python", "-m", "pytest", "-m", MARKERS, *tests, *sys.argv[1:]]
    return subprocess.run(call, cwd=ROOT, env=environment(), check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
