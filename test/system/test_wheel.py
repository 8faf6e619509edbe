"""The wheel, where there is no ROS and nothing that it does not require: it identifies a bag as the project's own command does."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Iterator
from email import message_from_bytes
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from packaging.requirements import Requirement

from helpers.commands import run_here, run_in_one_process
from helpers.paths import EXAMPLE_BAG, ROOT, SOURCE
from push_ident import __version__
from push_ident.extras import EXTRAS, how_to_get
from push_ident.physics.simulation import compile_kernels

pytestmark = pytest.mark.release
EXTRA = "report"
NEEDS_ROS = (
    ("up", "sim"),
    ("replay", EXAMPLE_BAG),
    ("push", "--random", 1),
    ("push-to", "--x", 0, "--y", 0, "--yaw", 0),
    ("demo",),
    ("look", "--live"),
)
NEEDS_MORE = {("simulate", "--effects"): "make setup", ("identify", EXAMPLE_BAG, "--method", "autograd"): "pip install 'push_ident[torch]'"}


def requirements(lines: list[str], extra: str) -> Iterator[Requirement]:
    for line in lines:
        requirement = Requirement(line)
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            yield requirement


def closure(lines: list[str], extra: str) -> dict[str, importlib.metadata.Distribution]:
    """The distributions that these requirements and theirs bring, by name."""
    found: dict[str, importlib.metadata.Distribution] = {}
    waiting = list(requirements(lines, extra))
    while waiting:
        requirement = waiting.pop()
        if requirement.name not in found:
            found[requirement.name] = importlib.metadata.distribution(requirement.name)
            for wanted in ["", *requirement.extras]:
                waiting += requirements(found[requirement.name].requires or [], wanted)
    return found


def link(distribution: importlib.metadata.Distribution, folder: Path) -> None:
    """Make what a distribution has installed importable from a folder, without its neighbours."""
    for top in {file.parts[0] for file in distribution.files or () if file.parts[0] not in ("..", "__pycache__")}:
        target = folder / top
        if not target.exists():
            target.symlink_to(Path(str(distribution.locate_file(top))))


def take_kernels(site_packages: Path) -> None:
    """The compiled kernels of these sources, which are those of the wheel; numba knows a source by its time and size."""
    for file in (SOURCE / "push_ident").rglob("*.py"):
        if (copy := site_packages / file.relative_to(SOURCE / "push_ident")).exists():
            assert copy.read_bytes() == file.read_bytes()
            os.utime(copy, ns=(file.stat().st_atime_ns, file.stat().st_mtime_ns))
    for cache in (SOURCE / "push_ident").rglob("__pycache__"):
        compiled = [*cache.glob("*.nb?"), *cache.glob("kernels.sha256")]
        target = site_packages / cache.relative_to(SOURCE / "push_ident")
        for file in compiled:
            target.mkdir(exist_ok=True)
            shutil.copy(file, target)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """The file, and what its metadata requires."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, ROOT / "tools" / "make_dist.py", folder], check=True, capture_output=True, timeout=120)
    (file,) = folder.glob("*.whl")
    with zipfile.ZipFile(file) as archive:
        metadata = message_from_bytes(archive.read(f"push_ident-{__version__}.dist-info/METADATA"))
    return SimpleNamespace(file=file, requires=metadata.get_all("Requires-Dist"), extras=metadata.get_all("Provides-Extra"))


@pytest.fixture(scope="module")
def python(wheel: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment that has the wheel and what it requires with one extra."""
    compile_kernels()
    folder = tmp_path_factory.mktemp("empty")
    venv.create(folder / "venv")
    own = folder / "venv" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", own, "install", "--quiet", "--no-deps", "--no-index", "--no-compile", wheel.file]
    subprocess.run(pip, check=True, timeout=120)
    (site_packages,) = folder.glob("venv/lib/python3*/site-packages")
    (folder / "others").mkdir()
    for distribution in closure(wheel.requires, EXTRA).values():
        link(distribution, folder / "others")
    (site_packages / "others.pth").write_text(f"{folder / 'others'}\n")
    take_kernels(site_packages)
    return own


def test_wheel_identifies_a_bag_without_ros_as_the_project_does_and_says_what_needs_more(python: Path, tmp_path: Path) -> None:
    asked = ("identify", EXAMPLE_BAG, "--train", "0-2")
    own = (*asked, "--out", tmp_path / "out", "--json", tmp_path / "own.json")
    predicted = ("predict", tmp_path / "out" / "model.json", EXAMPLE_BAG)
    calls = [("--version",), own, *NEEDS_ROS, *NEEDS_MORE, predicted]
    (tmp_path / "loads.py").write_text("import sys, push_ident as pi\nprint(len(pi.load(sys.argv[1])), pi.__file__)")
    plain = {"PATH": os.defpath, "HOME": str(tmp_path), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    programs = [*(("push-ident", *call) for call in calls), (tmp_path / "loads.py", EXAMPLE_BAG)]
    done, _ = run_in_one_process(programs, plain, python)
    said: dict[Any, tuple[int, str]] = dict(zip([*calls, "loads"], done, strict=True))
    assert said["loads"][1].startswith(f"4 {python.parent.parent}")
    assert said["--version",][1].strip() == f"push-ident {__version__}"
    for call in (own, predicted):
        assert said[call][0] == 0, said[call][1]
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
    for call in NEEDS_ROS:
        code, text = said[call]
        assert code == 1 and "this needs ROS 2" in text and "make setup" in text and text.count("\n") == 1, (call, text)
    for call, remedy in NEEDS_MORE.items():
        code, text = said[call]
        assert code == 1 and remedy in text and "Traceback" not in text, (call, text)
    assert run_here(*asked, "--json", tmp_path / "project.json").returncode == 0
    ours, theirs = (json.loads((tmp_path / name).read_text()) for name in ("project.json", "own.json"))
    assert theirs["test"]["identified_m"] == pytest.approx(ours["test"]["identified_m"], rel=1e-9)
    assert theirs["total_mass"] == ours["total_mass"]


def test_every_requirement_of_the_wheel_is_met_by_a_pin_and_every_extra_has_its_modules(wheel: SimpleNamespace) -> None:
    lines = [line.split("#")[0].strip() for path in (ROOT / "requirements").glob("*.txt") for line in path.read_text().splitlines()]
    pinned = {name.lower(): version for name, version in (line.split("==") for line in lines if line)}
    for requirement in map(Requirement, wheel.requires):
        assert requirement.specifier.contains(pinned[requirement.name.lower()]), requirement
    assert set(wheel.extras) == {*EXTRAS, "all", "test"}
    brought = importlib.metadata.packages_distributions()
    for extra, modules in EXTRAS.items():
        names = {r.name.lower() for r in map(Requirement, wheel.requires) if r.marker and f'"{extra}"' in str(r.marker)}
        for module in modules:
            if module in brought:  # what only few need is not in every environment
                assert names & {name.lower() for name in brought[module]}, module
            assert f"'push_ident[{extra}]'" in str(how_to_get(f"{module}.below"))
    assert how_to_get("no_such_module") is None
