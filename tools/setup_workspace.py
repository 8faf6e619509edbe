"""`make setup`: from a bare machine to a working workspace, in one repeatable command.

Arguments name further lists in requirements/: `dev docs fleet torch` are what tests and checks need, `pcd` and `mit` read more files.
It runs on the interpreter from which the virtual environment is made and needs only its standard library. Each step writes a stamp of
its inputs; a step whose inputs match its stamp is skipped. The longest, the compiler of the kernels, runs beside those after it.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
VENV_PYTHON = VENV / "bin" / "python"
STAMPS = VENV / ".setup"
LOG = ROOT / "log" / "setup.log"
REQUIREMENTS = ROOT / "requirements"
ENVIRONMENT = ROOT / "tools" / "push_ident_environment.py"
PACKAGES = ("push_ident_msgs", "push_ident", "push_ident_sim")
INTERFACES = ROOT / "tools" / "interfaces"
"""Interface packages of ROS that the wheels lack; built where ROS comes from them."""
CORE = ROOT / "src" / "push_ident" / "push_ident"
KERNELS = (*sorted((CORE / "physics").rglob("*.py")), *sorted((CORE / "perception").glob("*kernels.py")))
TORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"

SYSTEM_COMMANDS = {"gcc": "gcc", "g++": "g++", "cmake": "cmake", "make": "make"}
"""Commands that the build needs, and their Debian packages."""


class SetupError(Exception):
    """Set-up cannot continue; the text gives cause and remedy."""


@dataclass(frozen=True)
class Ros:
    """The ROS 2 Jazzy in use: a sourced installation, or the wheels of requirements/ros.txt."""

    prefixes: tuple[str, ...]
    """Prefixes of the sourced installation, in order; empty for the wheels."""

    @property
    def interfaces(self) -> tuple[str, ...]:
        """Interface packages that are built here because this ROS lacks them."""
        return tuple(sorted(folder.name for folder in INTERFACES.iterdir())) if self.is_wheels else ()

    @property
    def is_wheels(self) -> bool:
        """Whether ROS comes from the wheels."""
        return not self.prefixes

    @classmethod
    def find(cls, environ: Mapping[str, str]) -> Ros:
        """The sourced installation if there is one, else the wheels. The virtual environment itself does not count as one."""
        own = (str(VENV), str(ROOT / "install"))
        prefixes = [p for p in environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p and not p.startswith(own)]
        if environ.get("ROS_DISTRO") == "jazzy" and any((Path(p) / "share" / "rclpy").is_dir() for p in prefixes):
            return cls(tuple(prefixes))
        return cls(())


@dataclass(frozen=True)
class Step:
    """One step of the set-up."""

    name: str
    what: str
    """Text shown while it runs."""
    made_from: Callable[[], str]
    """Text of its inputs: the step runs again when it changes."""
    run: Callable[[], object]
    products: tuple[Path, ...] = ()
    """Files that the step makes; without one of them it runs again."""
    beside: bool = False
    """Whether the steps after it need not wait for it."""


def main() -> int:
    """Run all steps; exit status of the command."""
    ros = Ros.find(os.environ)
    try:
        check_interpreter()
        check_ros(ros)
        LOG.parent.mkdir(exist_ok=True)
        LOG.write_text("")
        run_steps(steps(ros, sys.argv[1:]))
    except SetupError as error:
        print(f"make setup: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("make setup: stopped; run it again to continue", file=sys.stderr)
        return 130
    return 0


def steps(ros: Ros, further: Sequence[str]) -> list[Step]:
    """All steps, in order; those of `further` lists before the build."""
    version = "{}.{}".format(*sys.version_info[:2])
    rebuilt = "; PyBullet has no wheel for it and is built from source, some minutes" if sys.version_info >= (3, 12) else ""
    ros_name = "ROS 2 Jazzy wheels" if ros.is_wheels else f"ROS 2 Jazzy of {ros.prefixes[-1]}"
    command = VENV / "bin" / "push-ident"
    packages = ["python", "viewer", "colcon", *(["arm", "ros"] if ros.is_wheels else [])]
    last = [] if ros.is_wheels else ["noble"]
    result = [
        Step("system", "compilers", lambda: "", install_system_packages),
        Step("venv", f".venv of Python {version}", lambda: f"{version} {ros.prefixes} {VENV}", lambda: make_venv(ros), (VENV_PYTHON,)),
        Step("installer", "uv, setuptools", lambda: digest(REQUIREMENTS / "build.txt", REQUIREMENTS / "installer.txt"), install_tools),
        install_step("packages", "numpy, scipy, numba, OpenCV, Rerun, colcon and more", packages, last),
        Step(
            "kernels",
            "kernels of physics and perception compiled, beside the other steps (two minutes)",
            made_from=lambda: digest(*KERNELS),
            run=compile_kernels,
            beside=True,
        ),
        install_step("sim", f"simulators: PyBullet, Embree, MuJoCo{rebuilt}", ["sim"]),
        Step(
            "build",
            f"colcon build on {ros_name} (about a minute)",
            made_from=workspace_digest,
            run=lambda: build(ros),
            products=tuple(package_xml(package) for package in PACKAGES),
        ),
        Step(
            "commands",
            "python, pytest, push-ident in .venv/bin: nothing to source",
            made_from=lambda: environment_line(ros) + digest(ENVIRONMENT),
            run=lambda: write_environment(ros),
            products=(command,),
        ),
    ]
    torch = Step("torch", "PyTorch, the CPU build where available", lambda: digest(REQUIREMENTS / "torch.txt"), install_torch)
    result[-2:-2] = [torch if name == "torch" else install_step(name, f"requirements/{name}.txt", [name], last) for name in further]
    return result


def run_steps(todo: list[Step]) -> None:
    """Run the steps whose inputs changed."""
    with ThreadPoolExecutor() as others:
        beside: list[Future[None]] = []
        for number, step in enumerate(todo, 1):
            head = f"[{number}/{len(todo)}] {step.what}"
            if step.name == "system":
                step.run()  # fast, and it checks files outside the repository
                print(f"{head}: found")
                continue
            made_from, stamp = step.made_from(), STAMPS / step.name
            if stamp.is_file() and stamp.read_text() == made_from and all(path.exists() for path in step.products):
                print(f"{head}: up to date")
                continue
            print(f"{head} ...", flush=True)
            if step.beside:
                beside.append(others.submit(run_step, step, made_from))
            else:
                run_step(step, made_from)
        for future in beside:
            future.result()


def run_step(step: Step, made_from: str) -> None:
    """Run a step and keep what it was made from."""
    start = time.monotonic()
    step.run()
    STAMPS.mkdir(exist_ok=True)
    (STAMPS / step.name).write_text(made_from)
    print(f"      {step.name}: done in {time.monotonic() - start:.0f} s", flush=True)


# --- the machine


def check_interpreter() -> None:
    """Refuse a Python for which there is no ROS 2 Jazzy."""
    if sys.version_info[:2] not in ((3, 11), (3, 12)):
        raise SetupError(
            f"{sys.executable} is Python {sys.version.split()[0]}, expected 3.11 or 3.12 (ROS 2 Jazzy); "
            "choose another one, e.g. `make setup PYTHON=python3.12`"
        )


def check_ros(ros: Ros) -> None:
    """Refuse to replace an environment made on an installed ROS when ROS was not sourced."""
    if ros.is_wheels and venv_settings().get("include-system-site-packages") == "true":
        raise SetupError(
            ".venv was made on an installed ROS, and none is sourced now; source it (e.g. `. /opt/ros/jazzy/setup.bash`), "
            "or remove .venv to use the ROS wheels"
        )


def missing_system_packages() -> list[str]:
    """Debian packages whose commands or headers this machine lacks."""
    missing = [package for command, package in SYSTEM_COMMANDS.items() if shutil.which(command) is None]
    python = "python{}.{}".format(*sys.version_info[:2])
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        missing.append(f"{python}-dev")
    if importlib.util.find_spec("ensurepip") is None:
        missing.append(f"{python}-venv")
    return missing


def install_system_packages() -> None:
    """Install the missing Debian packages, where this user may."""
    missing = missing_system_packages()
    if not missing:
        return
    command = "apt-get install -y --no-install-recommends " + " ".join(missing)
    apt = apt_get()
    if apt is None:
        raise SetupError(f"this machine lacks {', '.join(missing)}; as root: {command}")
    print(f"      {command}", flush=True)
    run([*apt, "update", "-qq"])
    run([*apt, "install", "-qq", "-y", "--no-install-recommends", *missing])
    if missing_system_packages():
        raise SetupError(f"still missing after apt-get: {', '.join(missing_system_packages())}")


def apt_get() -> list[str] | None:
    """Command with which this user may call apt-get without a password, None if there is none."""
    if shutil.which("apt-get") is None:
        return None
    # Waits for a lock: a machine that updates itself is common.
    call = ["env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-o", "DPkg::Lock::Timeout=300"]
    if os.geteuid() == 0:
        return call
    allowed = shutil.which("sudo") and subprocess.run(["sudo", "-n", "true"], capture_output=True, check=False).returncode == 0
    return ["sudo", "-n", *call] if allowed else None


# --- the virtual environment


def make_venv(ros: Ros) -> None:
    """Make .venv unless a suitable one exists: same version, same access to the system's packages, same folder."""
    if venv_fits(ros):
        return
    system = [] if ros.is_wheels else ["--system-site-packages"]
    run([sys.executable, "-m", "venv", "--clear", *system, str(VENV)])


def venv_fits(ros: Ros) -> bool:
    """Whether .venv can be kept."""
    settings, pip = venv_settings(), VENV / "bin" / "pip"
    if not (VENV_PYTHON.exists() and pip.is_file()):
        return False
    version = ".".join(settings.get("version", "").split(".")[:2])
    return (
        version == "{}.{}".format(*sys.version_info[:2])
        and settings.get("include-system-site-packages") == str(not ros.is_wheels).lower()
        and pip.read_text().splitlines()[0].startswith(f"#!{VENV}/")
    )


def venv_settings() -> dict[str, str]:
    """Settings in pyvenv.cfg; empty without the file."""
    config = VENV / "pyvenv.cfg"
    return dict(re.findall(r"^([\w-]+) *= *(.*)$", config.read_text(), re.MULTILINE)) if config.is_file() else {}


def install_step(name: str, what: str, lists: Sequence[str], last: Sequence[str] = ()) -> Step:
    """Install complete lists of requirements, then those that replace some. No dependencies are resolved: nothing else is installed."""
    parts = [[REQUIREMENTS / f"{part}.txt" for part in names] for names in (lists, last) if names]

    def run() -> None:
        for paths in parts:
            install(*(word for path in paths for word in ("-r", str(path))))

    return Step(name, what, lambda: digest(*(path for paths in parts for path in paths)), run)


def install(*arguments: str, check: bool = True) -> bool:
    """Install packages in .venv without their dependencies; return whether it succeeded.

    uv takes a fraction of pip's time. Where it cannot, pip tries. Bytecode is left to the first import of each module.
    """
    common = ["--no-deps", "--no-build-isolation", *arguments]
    uv = VENV / "bin" / "uv"
    if uv.exists() and run([str(uv), "pip", "install", "--python", str(VENV_PYTHON), *common], environ=uv_environment(), check=False):
        return True
    return pip_install("--no-compile", *common, check=check)


def pip_install(*arguments: str, check: bool = True) -> bool:
    """Run pip in .venv; return whether it succeeded."""
    call = [str(VENV_PYTHON), "-m", "pip", "install", "--no-input", "--progress-bar", "off", "--disable-pip-version-check", *arguments]
    return run(call, check=check)


def install_tools() -> None:
    """Install what builds packages that come as sources, and uv where there is one for this machine."""
    pip_install("-r", str(REQUIREMENTS / "build.txt"))
    pip_install("-r", str(REQUIREMENTS / "installer.txt"), check=False)


def uv_environment() -> dict[str, str]:
    """The environment with pip's index, certificates and folders of wheels, which uv does not read by itself."""
    done = subprocess.run([str(VENV_PYTHON), "-m", "pip", "config", "list"], capture_output=True, text=True, check=False)
    pip = dict(re.findall(r"^[^=]*\.([\w-]+)='(.*)'$", done.stdout, re.MULTILINE))
    names = {"cert": "SSL_CERT_FILE", "index-url": "UV_DEFAULT_INDEX", "find-links": "UV_FIND_LINKS"}
    return {**{uv: pip[name] for name, uv in names.items() if name in pip}, "UV_LINK_MODE": "copy", **os.environ}


def install_torch() -> None:
    """Install the CPU build of PyTorch, else the default one."""
    lines = (REQUIREMENTS / "torch.txt").read_text()
    pins = dict(re.findall(r"^([\w-]+)==(\S+)", lines, re.MULTILINE))
    torch = pins.pop("torch")
    install(*(f"{name}=={version}" for name, version in pins.items()))
    cpu = ["--retries", "1", "--timeout", "20", "--extra-index-url", TORCH_CPU_INDEX, "--no-deps", "--no-compile", f"torch=={torch}+cpu"]
    if pip_install(*cpu, check=False):
        return
    print("      no CPU build available: installing the one with CUDA (several GB)", flush=True)
    pip_install("-c", str(REQUIREMENTS / "python.txt"), f"torch=={torch}")


# --- the workspace


def workspace_digest() -> str:
    """Digest of the inputs of the build. Python modules and data files are linked, so only the names of the latter count."""
    read, named = [ROOT / "tools" / "ros_wheels.cmake", REQUIREMENTS / "ros.txt"], []
    for folder in (*(ROOT / "src" / package for package in PACKAGES), *sorted(INTERFACES.iterdir())):
        read += [folder / name for name in ("package.xml", "setup.py", "setup.cfg", "CMakeLists.txt")]
        read += sorted(path for kind in ("msg", "srv", "action") for path in folder.glob(f"{kind}/*"))
        named += sorted(str(path.relative_to(ROOT)) for kind in ("launch", "config") for path in folder.glob(f"{kind}/*"))
    python = (STAMPS / "venv").read_text() if (STAMPS / "venv").is_file() else ""
    return "\n".join([digest(*(path for path in read if path.is_file())), *named, python])


def build(ros: Ros) -> None:
    """colcon build. Modules and data files are linked into install/, so that an edit needs no second build."""
    environ = dict(os.environ)
    for name in ("MAKELEVEL", "MFLAGS", "MAKEFLAGS"):  # of the make that runs this
        environ.pop(name, None)
    environ["PATH"] = os.pathsep.join([str(VENV / "bin"), environ.get("PATH", os.defpath)])
    environ["MAKEFLAGS"] = f"-j{len(os.sched_getaffinity(0))}"
    cmake = [f"-DPython3_EXECUTABLE={VENV_PYTHON}", "-DCMAKE_BUILD_TYPE=MinSizeRel", "-DBUILD_TESTING=ON"]
    if ros.is_wheels:
        environ.pop("PYTHONPATH", None)
        environ["AMENT_PREFIX_PATH"] = environ["CMAKE_PREFIX_PATH"] = str(VENV)
        environ["LD_LIBRARY_PATH"] = os.pathsep.join(wheel_libraries())
        cmake.append(f"-DCMAKE_PROJECT_INCLUDE={ROOT / 'tools' / 'ros_wheels.cmake'}")
    colcon = [str(VENV / "bin" / "colcon"), "--log-base", str(ROOT / "log")]
    bases = [str(ROOT / "src"), *(str(INTERFACES / package) for package in ros.interfaces)]
    run([*colcon, "build", "--symlink-install", "--base-paths", *bases, "--cmake-args", *cmake], environ=environ)
    unbuilt = [package for package in (*PACKAGES, *ros.interfaces) if not package_xml(package).exists()]
    if unbuilt:
        # colcon treats a package with an invalid package.xml as a plain Python package without any message.
        raise SetupError(f"colcon did not build {', '.join(unbuilt)} as ROS packages; check their package.xml")


def compile_kernels() -> None:
    """Fill numba's cache, so that no node waits for the compiler at its start or first push."""
    perception = "import push_ident.perception.kernels"
    physics = "from push_ident.physics.simulation import compile_kernels; compile_kernels(effects=True)"
    planning = "from push_ident.planning.library import compile_planning; compile_planning()"
    sources = os.pathsep.join(str(ROOT / "src" / package) for package in PACKAGES[1:])
    call = [str(VENV_PYTHON), "-c", f"{perception}; {physics}; {planning}"]
    run(call, environ={**os.environ, "PYTHONPATH": sources}, log=LOG.with_name("setup_kernels.log"))


def package_xml(package: str) -> Path:
    """Manifest of a package after the build."""
    return ROOT / "install" / package / "share" / package / "package.xml"


# --- the environment of every process


def environment_line(ros: Ros) -> str:
    """Content of the .pth file: folders for sys.path, then one call that sets the environment. Python runs it at each start."""
    install = ROOT / "install"
    # The sources come first; the build folders hold the metadata that the installed executables need.
    folders = [str(ROOT / base / package) for base in ("src", "build") for package in PACKAGES[1:]]
    interfaces = ("push_ident_msgs", *ros.interfaces)
    folders += [str(path) for package in interfaces for path in sorted(install.glob(f"{package}/lib/python3*/site-packages"))]
    libraries = [str(install / package / "lib") for package in interfaces]
    prefixes = [str(install / package) for package in (*PACKAGES, *ros.interfaces)]
    defaults: dict[str, str] = {}
    if ros.is_wheels:
        libraries += wheel_libraries()
        prefixes.append(str(VENV))
        defaults = {
            "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
            # The profile binds every socket to 127.0.0.1; LOCALHOST would add sockets on every interface (nodes/base/network.py).
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(ROOT / "src" / "push_ident" / "config" / "fastdds_local.xml"),
        }
    else:
        folders += path_variable("PYTHONPATH")
        libraries += path_variable("LD_LIBRARY_PATH")
        prefixes += list(ros.prefixes)
    arguments = ", ".join(json.dumps(argument) for argument in (libraries, prefixes, defaults))
    return "\n".join([*dict.fromkeys(folders), f"import _push_ident_environment; _push_ident_environment.enter({arguments})"]) + "\n"


def write_environment(ros: Ros) -> None:
    """Write the .pth file and its module, and link the command `push-ident`."""
    site_packages = VENV / "lib" / "python{}.{}".format(*sys.version_info[:2]) / "site-packages"
    module = "_push_ident_environment"  # the underscore sorts it before the .pth files of other packages
    shutil.copyfile(ENVIRONMENT, site_packages / f"{module}.py")
    (site_packages / f"{module}.pth").write_text(environment_line(ros))
    command = VENV / "bin" / "push-ident"
    command.unlink(missing_ok=True)
    command.symlink_to(ROOT / "install" / "push_ident" / "lib" / "push_ident" / "push-ident")
    run([str(VENV_PYTHON), "-c", "import rclpy, push_ident_msgs.msg, push_ident, push_ident_sim"], environ={"PATH": os.defpath})


def wheel_libraries() -> list[str]:
    """Folders of the libraries that the ROS wheels bring."""
    return [str(VENV / "lib"), *(str(path) for path in sorted(VENV.glob("lib/python3*/site-packages/ros_*.libs")))]


# --- helpers


def path_variable(name: str) -> list[str]:
    """Folders in an environment variable."""
    return [folder for folder in os.environ.get(name, "").split(os.pathsep) if folder]


def digest(*paths: Path) -> str:
    """Hash of names and contents of files."""
    result = hashlib.sha256()
    for path in paths:
        result.update(path.name.encode() + b"\0" + path.read_bytes())
    return result.hexdigest()


def run(call: list[str], *, environ: Mapping[str, str] | None = None, check: bool = True, log: Path = LOG) -> bool:
    """Run a command; return whether it succeeded. Its output goes to the log and is shown only when it fails.

    Raises:
        SetupError: The command failed and `check` is true.
    """
    with log.open("a") as file:
        print(f"$ {shlex.join(call)}", file=file, flush=True)
        start = file.tell()
        code = subprocess.run(call, env=environ, check=False, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT).returncode
    if code != 0 and check:
        with log.open() as file:
            file.seek(start)
            print("\n".join(file.read().splitlines()[-40:]), file=sys.stderr)
        raise SetupError(f"failed with exit code {code}: {shlex.join(call)} (full log: {log})")
    return code == 0


if __name__ == "__main__":
    sys.exit(main())
