"""The ROS packages as colcon, ros2 and a plain shell see them."""

from __future__ import annotations

import ast
import configparser
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

import push_ident
from helpers.paths import ROOT
from push_ident.extras import EXTRAS, how_to_get
from push_ident.nodes.executables import NODES
from push_ident_sim.executables import NODES as SIM_NODES

PACKAGES = {"push_ident": "ament_python", "push_ident_sim": "ament_python", "push_ident_msgs": "ament_cmake"}
PYTHON_PACKAGES = [name for name, kind in PACKAGES.items() if kind == "ament_python"]
LAUNCH_FILES = sorted(ROOT.glob("src/*/launch/*.launch.py"))
KEYS = {
    "coal": "pinocchio",
    "cv2": "python3-opencv",
    "jinja2": "python3-jinja2",
    "markupsafe": "python3-jinja2",
    "matplotlib": "python3-matplotlib",
    "numpy": "python3-numpy",
    "rich": "python3-rich",
    "scipy": "python3-scipy",
    "yaml": "python3-yaml",
}
"""Import: key of rosdep, where their names differ; each in base.yaml or python.yaml of rosdistro, or a package of Jazzy."""
NOT_SEEN_IN_IMPORTS = {"launch", "launch_ros", "control_msgs"}
"""Keys of what launch files import, and of what the executor imports where a parameter asks for it."""
ONLY_WITH_ROS = {"tf2_ros", "rerun", "rerun_cli"}
"""What only nodes import, beside messages and rclpy."""
PLAIN_SHELL = {"PATH": "/usr/bin:/bin"}


def console_scripts(package: str) -> dict[str, tuple[str, str]]:
    """Executable: (module, function), as setup.py has them."""
    tree = ast.parse((ROOT / "src" / package / "setup.py").read_text())
    lines = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    found = [re.fullmatch(r"([\w-]+) = ([\w.]+):(\w+)", line) for line in lines]
    return {match[1]: (match[2], match[3]) for match in found if match}


def in_plain_shell(*arguments: str, **extra: str) -> subprocess.CompletedProcess[str]:
    """Run .venv's python as somebody would who sourced and exported nothing."""
    python = ROOT / ".venv" / "bin" / "python"
    return subprocess.run([python, *arguments], env=PLAIN_SHELL | extra, capture_output=True, text=True, timeout=60, check=False)


def test_manifests_are_of_format_3_with_all_that_a_release_needs_and_one_version() -> None:
    versions = set(re.findall(r'version="([^"]+)"', (ROOT / "src" / "push_ident_sim" / "setup.py").read_text()))
    for package, kind in PACKAGES.items():
        manifest = ET.parse(ROOT / "src" / package / "package.xml").getroot()
        assert (manifest.get("format"), manifest.findtext("name"), manifest.findtext("license")) == ("3", package, "Apache-2.0")
        maintainer = manifest.find("maintainer")
        assert maintainer is not None and re.fullmatch(r"[\w.-]+@[\w-]+\.\w{2,}", maintainer.get("email", ""))
        assert manifest.findtext("export/build_type") == kind
        versions.add(manifest.findtext("version", ""))
    assert versions == {push_ident.__version__}  # which setup.py of push_ident reads


def test_colcon_sees_ros_packages() -> None:
    # With an invalid package.xml colcon says `(python)` and builds it without its resources.
    call = [sys.executable, "-c", "from colcon_core.command import main; main()", "--log-base", os.devnull, "list", "--base-paths", "src"]
    done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    seen = {line.split("\t")[0]: line.split("\t")[2] for line in done.stdout.splitlines()}
    assert seen == {package: f"(ros.{kind})" for package, kind in PACKAGES.items()}


@pytest.mark.parametrize("package", PYTHON_PACKAGES)
def test_every_executable_has_its_function(package: str) -> None:
    scripts = console_scripts(package)
    for name, (module, function) in scripts.items():
        path = ROOT / "src" / package / Path(*module.split(".")).with_suffix(".py")
        defined = {node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)}
        assert function in defined, f"{name}: {module} has no {function}()"
    table = {"push_ident": NODES, "push_ident_sim": SIM_NODES}[package]
    assert {name for name in scripts if name.endswith("_node")} == set(table)
    assert all(importlib.util.find_spec(module) is not None for module in table.values())


@pytest.mark.parametrize("package", PYTHON_PACKAGES)
def test_executables_go_where_ros2_run_looks(package: str) -> None:
    config = configparser.ConfigParser()
    config.read(ROOT / "src" / package / "setup.cfg")
    assert config["develop"]["script_dir"] == config["install"]["install_scripts"] == f"$base/lib/{package}"
    for name in console_scripts(package):
        first = (ROOT / "install" / package / "lib" / package / name).read_text().splitlines()[0]
        assert first.startswith(f"#!{ROOT}/.venv/bin/python"), "the executable must run on the interpreter that has the dependencies"


def test_launch_files_start_executables_that_exist() -> None:
    executables = {name for package in PYTHON_PACKAGES for name in console_scripts(package)}
    assert {path.name for path in LAUNCH_FILES} == {"replay.launch.py", "arm.launch.py", "simulation.launch.py"}
    for path in LAUNCH_FILES:
        tree = ast.parse(path.read_text())
        assert "generate_launch_description" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        text = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
        nodes = {word for word in text if re.fullmatch(r"\w+_node", word)}
        assert nodes and nodes <= executables, path
        assert all(list(ROOT.glob(f"src/*/config/{word}")) for word in text if word.endswith(".yaml")), path


def test_packages_are_imported_and_talk_in_a_plain_shell_and_in_the_processes_that_it_spawns(tmp_path: Path) -> None:
    # Publishing loads the type support libraries of the interface package and of the middleware.
    program = tmp_path / "program.py"
    program.write_text("""
import multiprocessing
def talk(_):
    import rclpy, push_ident, push_ident_sim
    from push_ident_msgs.msg import MassFrictionMap
    rclpy.init()
    rclpy.create_node("probe").create_publisher(MassFrictionMap, "map", 1).publish(MassFrictionMap())
    rclpy.shutdown()
    return push_ident.__file__
if __name__ == "__main__":
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(talk, [0]) == [talk(0)]
    print(talk(0))
""")
    done = in_plain_shell(str(program), HOME=str(tmp_path), ROS_DOMAIN_ID=os.environ["ROS_DOMAIN_ID"])
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(ROOT / "src" / "push_ident" / "push_ident" / "__init__.py")


def test_arguments_and_values_of_the_user_survive_the_restart_of_the_interpreter() -> None:
    names = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LD_LIBRARY_PATH")
    program = "import os, sys; print(sys.argv[1:4], sys.flags.optimize, *map(os.environ.get, sys.argv[4:]))"
    done = in_plain_shell("-O", "-c", program, "a b", "", "--c=*", *names, **dict(zip(names, ("SUBNET", "/some/folder"), strict=True)))
    assert done.stdout.startswith("['a b', '', '--c=*'] 1 SUBNET ") and done.stdout.strip().split(":")[-1] == "/some/folder"


@pytest.mark.release
def test_colcon_test_runs_the_part_of_each_package_and_leaves_result_files(tmp_path: Path) -> None:
    few = "interface_is_a_type or outline_and_se2 or (sensors and box)"
    results = ["--test-result-base", str(tmp_path)]
    call = [sys.executable, "-c", "from colcon_core.command import main; main()", "--log-base", os.devnull]
    run_few = [*call, "test", "--base-paths", "src", "--packages-select", *PACKAGES, *results, "--pytest-args", "-k", few]
    done = subprocess.run(run_few, cwd=ROOT, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    shown = subprocess.run([*call, "test-result", "--all", *results], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    passed = re.findall(r"^.*/(push_ident\w*)/.*\.xml: [1-9]\d* tests?, 0 errors, 0 failures, 0 skipped$", shown.stdout, re.MULTILINE)
    assert set(passed) == set(PACKAGES), shown.stdout


def test_no_requirement_is_left_unpinned_or_has_two_pins() -> None:
    pins: dict[str, set[str]] = {}
    for path in sorted((ROOT / "requirements").glob("*.txt")):
        lines = [line.split("#")[0].strip() for line in path.read_text().splitlines()]
        unpinned = [line for line in lines if line and not re.fullmatch(r"[\w.-]+==[\w.+]+", line)]
        assert unpinned == [], f"{path.name}: {unpinned}"
        if path.stem not in ("oldest", "noble"):  # which replace pins
            for name, version in (line.split("==") for line in lines if line):
                pins.setdefault(name, set()).add(version)
    assert {name: versions for name, versions in pins.items() if len(versions) > 1} == {}


def imports(package: str) -> set[str]:
    """Top-level names of others that the modules of a package import, wherever in them."""
    found = set()
    for path in (ROOT / "src" / package / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []
            found |= {name.partition(".")[0] for name in names}
    # Python 3.14 has `compression`.
    return found - sys.stdlib_module_names - {package, "compression"}


@pytest.mark.parametrize("package", PYTHON_PACKAGES)
def test_every_import_has_a_rosdep_key_or_a_line_in_the_guide_and_every_key_an_import(package: str) -> None:
    tree = ET.parse(ROOT / "src" / package / "package.xml").getroot()
    keys = {element.text for element in tree if element.tag in ("depend", "exec_depend")}
    guide = (ROOT / "docs" / "how-to" / "installed-ros.md").read_text()
    without_key = set(re.findall(r"`(\w+)`", guide.split("## Packages without a key")[1]))
    imported = imports(package)
    missing = {name for name in imported if KEYS.get(name, name) not in keys and name not in without_key}
    assert missing == set(), "give package.xml the rosdep key, or the guide a line"
    assert keys - {KEYS.get(name, name) for name in imported} <= NOT_SEEN_IN_IMPORTS, "keys of package.xml that nothing imports"


def test_what_push_ident_imports_without_ros_is_required_by_the_wheel_or_an_extra() -> None:
    text = (ROOT / "src" / "push_ident" / "setup.py").read_text()
    required = {name.lower() for name in re.findall(r'"([\w-]+)>=', text)}
    optional = {module for modules in EXTRAS.values() for module in modules}
    brought = {module: set(map(canonicalize_name, names)) for module, names in importlib.metadata.packages_distributions().items()}
    ros = {name for name in imports("push_ident") if how_to_get(name) and name not in optional} | ONLY_WITH_ROS
    left = {name for name in imports("push_ident") - ros - optional if not brought[name] & required}
    assert left == set(), "imported, and no requirement in setup.py"


@pytest.mark.parametrize("what", ["torch", "open3d", "ray"])
def test_no_node_and_no_command_loads_what_only_some_need(what: str) -> None:
    modules = sorted({*NODES.values(), *SIM_NODES.values(), "push_ident.cli.main", "push_ident.cli.identify", "push_ident.cli.diagnose"})
    program = f"import importlib, sys\nfor name in {modules}: importlib.import_module(name)\nassert {what!r} not in sys.modules"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
