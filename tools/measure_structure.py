"""Measure how readable the structure of the code is: sizes of functions and modules, and the path of the pushes through a computation.

    python tools/measure_structure.py sizes [--root DIR]                       from the syntax trees of the sources
    python tools/measure_structure.py walk [--bag BAG] [--entry MODULE:NAME]   from one run of `identify`, `diagnose` and perception

**Sizes.** Lines of a function run from its `def` to its last line, docstring included, decorators excluded. Parameters count positional,
keyword and starred ones, `self` and `cls` excluded. Functions that numba compiles and commands of the command line (a parameter per option)
are counted in the totals and again on their own, since they may be long. Lines of a module are all its lines.

**Walk.** One run of the entry function records which function of the package calls which, in the order of the first call. Comprehensions,
lambdas, nested functions and generated methods belong to the function around them; compiled kernels are not followed; threads run one after
the other; values of `types.py` and `known_object.py` count as data. The reader's walk starts at the entry function and reads every function
once, in the order of the calls, depth first. Reported are

- `modules`: the different modules entered,
- `stays`: the uninterrupted stretches of the walk in one module,
- `returns`: stays minus modules, the times that the walk enters a module which it had left.

`all` follows every call. `pushes` follows only calls that hand on a push (perception: a depth frame): an argument is one of the records, a
part of one (its shape, poses, pusher path ...), or a container or dataclass that holds such an object. Each is counted twice: through the
whole package, and within the folder of the entry function, where calls that leave the folder are not followed.
"""

from __future__ import annotations

import argparse
import ast
import concurrent.futures
import dataclasses
import functools
import importlib
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy

ROOT = Path(__file__).resolve().parent.parent
LONG, MANY, LARGE = 60, 8, 800
"""Lines of a function, parameters of a function, lines of a module."""
PERCEPTION = "push_ident.perception.pipeline:Perception.observe"
"""The entry that takes the depth frames of the bag, one after the other."""
ENTRIES = ("push_ident.identification.identify:identify", "push_ident.diagnosis.diagnose:diagnose", PERCEPTION)
LOADERS = ("push_ident.offline.loading:load_pushes", "push_ident.bags.loading:load_pushes")
"""Where the pushes of a bag are loaded; the second place is that of older versions."""
DATA = frozenset({"types.py", "perception/known_object.py"})
"""Modules that hold values, not steps of a computation."""
DEPTH = 4
"""Levels of containers that are searched for a push."""


# --- sizes


@dataclasses.dataclass(frozen=True)
class Function:
    """A function in a source file."""

    place: str
    n_lines: int
    n_parameters: int
    is_kernel: bool
    is_command: bool


def functions_in(path: Path, name: str) -> Iterator[Function]:
    """All functions of a file, methods and nested ones included."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            decorators = [ast.unparse(d).split("(")[0].split(".")[-1].lstrip("_") for d in node.decorator_list]
            a = node.args
            names = [p.arg for p in (*a.posonlyargs, *a.args, *a.kwonlyargs, *(s for s in (a.vararg, a.kwarg) if s))]
            yield Function(
                f"{name}:{node.name}",
                (node.end_lineno or node.lineno) - node.lineno + 1,
                len(names) - (names[:1] in (["self"], ["cls"])),
                any(d in ("kernel", "fast_kernel", "njit") for d in decorators),
                node.name.endswith("_command") or "command" in decorators,
            )


def sizes(root: Path) -> None:
    """Print the numbers of large functions and modules, and which they are."""
    files = [path for folder in ("src", "test", "tools", "benchmarks") for path in sorted((root / folder).rglob("*.py"))]
    functions = [
        f for path in files if path.is_relative_to(root / "src") for f in functions_in(path, path.relative_to(root / "src").as_posix())
    ]
    n_lines = {path.relative_to(root).as_posix(): len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    long = [f for f in functions if f.n_lines > LONG]
    many = [f for f in functions if f.n_parameters > MANY]
    large = {name: n for name, n in n_lines.items() if n > LARGE}
    rows = (
        (f"functions over {LONG} lines", len(long), sum(not f.is_kernel for f in long)),
        (f"functions with more than {MANY} parameters", len(many), sum(not (f.is_kernel or f.is_command) for f in many)),
        (f"modules over {LARGE} lines (tests and tools included)", len(large), len(large)),
    )
    print(f"{'':52}{'all':>6}  without kernels and commands")
    for title, n_all, n_plain in rows:
        print(f"{title:52}{n_all:6}{n_plain:6}")
    for f in (f for f in long if not f.is_kernel):
        print(f"    {f.n_lines:4} lines       {f.place}")
    for f in (f for f in many if not (f.is_kernel or f.is_command)):
        print(f"    {f.n_parameters:4} parameters  {f.place}")
    for name, n in large.items():
        print(f"    {n:4} lines       {name}")


# --- walk


class SerialExecutor:
    """Stands in for a pool of threads: each call runs at once, where it is handed over."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __enter__(self) -> SerialExecutor:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def map(self, function: Callable[..., Any], *arguments: Iterable[Any]) -> list[Any]:
        """As `Executor.map`."""
        return [function(*values) for values in zip(*arguments, strict=False)]

    def submit(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> concurrent.futures.Future[Any]:
        """As `Executor.submit`."""
        future: concurrent.futures.Future[Any] = concurrent.futures.Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


Place = tuple[str, str]
"""Module, relative to the package, and qualified name of a function."""


def parts_of(value: object, depth: int) -> Iterator[object]:
    """A value and what it holds: items of containers, fields and attributes of objects."""
    yield value
    if depth == 0 or value is None or isinstance(value, str | bytes | int | float | type):
        return
    inner: Iterable[object] = ()
    if isinstance(value, dict):
        inner = value.values()
    elif isinstance(value, list | tuple | set | frozenset):
        inner = value
    elif dataclasses.is_dataclass(value):
        inner = [getattr(value, field.name, None) for field in dataclasses.fields(value)]
    elif type(value).__module__.startswith("push_ident"):
        inner = list(getattr(value, "__dict__", {}).values())
    for part in inner:
        yield from parts_of(part, depth - 1)


class Trace:
    """Calls between functions of a package, in the order of the first one, and whether that one handed on a push."""

    def __init__(self, package: Path, records: Iterable[object]) -> None:
        self._root = f"{package}/"
        # Small immutable values are shared by the interpreter and mark nothing.
        self._kept = [p for p in parts_of(list(records), DEPTH) if dataclasses.is_dataclass(p) or hasattr(p, "__array__")]
        self._ids = {id(part) for part in self._kept}
        self.calls: dict[Place, dict[Place, bool]] = {}

    def run(self, function: Callable[[], object]) -> None:
        """Record the calls that a function makes."""
        sys.setprofile(self._on_event)
        try:
            function()
        finally:
            sys.setprofile(None)

    def _on_event(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call" and (callee := self._place(frame)) is not None:
            caller = self._caller(frame)
            if caller is not None and caller != callee and not self.calls.setdefault(caller, {}).get(callee, False):
                self.calls[caller][callee] = self._hands_on_a_push(frame)

    def _place(self, frame: FrameType) -> Place | None:
        """Where a frame belongs; None outside the package, and in what belongs to the function around it."""
        code = frame.f_code
        module = code.co_filename.removeprefix(self._root)
        return None if module == code.co_filename or module in DATA or "<" in code.co_qualname else (module, code.co_qualname)

    def _caller(self, frame: FrameType) -> Place | None:
        outer = frame.f_back
        while outer is not None:
            code = outer.f_code
            module = code.co_filename.removeprefix(self._root)
            if module != code.co_filename and module not in DATA:
                return module, code.co_qualname.split(".<")[0]  # `f.<locals>.g` belongs to `f`
            outer = outer.f_back
        return None

    def _hands_on_a_push(self, frame: FrameType) -> bool:
        code = frame.f_code
        n = code.co_argcount + code.co_kwonlyargcount + bool(code.co_flags & 4) + bool(code.co_flags & 8)
        values = (frame.f_locals.get(name) for name in code.co_varnames[:n])
        return any(id(part) in self._ids for value in values for part in parts_of(value, DEPTH))


def walk(calls: dict[Place, dict[Place, bool]], entry: Place, *, pushes_only: bool, own_folder: bool) -> list[str]:
    """Modules of the reader's walk, one entry per function."""
    folder = entry[0].rpartition("/")[0] + "/" if own_folder else ""
    visited: set[Place] = set()
    modules: list[str] = []

    def visit(place: Place) -> None:
        visited.add(place)
        modules.append(place[0])
        for callee, hands_on in calls.get(place, {}).items():
            if callee not in visited and callee[0].startswith(folder) and (hands_on or not pushes_only):
                visit(callee)

    visit(entry)
    return modules


def stays_of(modules: Iterable[str]) -> list[str]:
    """The same without repetitions in a row."""
    return [module for module, _ in itertools.groupby(modules)]


def named(name: str) -> Any:
    """What MODULE:NAME names."""
    module, _, attributes = name.partition(":")
    return functools.reduce(getattr, attributes.split("."), importlib.import_module(module))


def load_records(bag: Path) -> list[Any]:
    """The pushes of a bag."""
    for loader in LOADERS:
        try:
            return list(named(loader)([bag]).records)
        except ModuleNotFoundError:
            continue
    sys.exit(f"none of {', '.join(LOADERS)} is there")


def frames_and_perception(bag: Path) -> tuple[list[Any], Callable[[list[Any]], None]]:
    """The depth frames of a bag, and what processes them; the tool is where the recorded pusher was."""
    content = named("push_ident.bags.reader:read_bag")(bag)
    perception = named("push_ident.perception.pipeline:Perception")(content.camera_in_table)
    cylinder, path = named("push_ident.perception.frame.robot:Cylinder"), content.pusher

    def process(frames: list[Any]) -> None:
        for frame in frames:
            x, y = (float(numpy.interp(frame.stamp, path.time, path.value[:, axis])) for axis in (0, 1))
            perception.observe(frame, [cylinder(x, y, content.pusher_radius or 0.0)])

    return list(content.depth_frames()), process


def walks(bag: Path, entries: Iterable[str], show: bool) -> None:
    """Run the entry functions on the pushes of a bag and print their walks."""
    concurrent.futures.ThreadPoolExecutor = SerialExecutor  # type: ignore[misc, assignment]
    sys.setrecursionlimit(10000)
    package = Path(importlib.import_module("push_ident").__file__ or "").resolve().parent
    records = load_records(bag)
    print(f"{package}: {len(records)} pushes of {bag}")
    print(f"{'':28}{'whole package':>25}   {'own folder':>25}")
    print(f"{'':28}" + f"{'modules':>9}{'stays':>7}{'returns':>9}   " * 2)
    for entry in entries:
        function, name = named(entry), entry.partition(":")[2]
        given, run = frames_and_perception(bag) if entry == PERCEPTION else (records, function)
        trace = Trace(package, given)
        trace.run(functools.partial(run, given))
        start = (Path(function.__code__.co_filename).relative_to(package).as_posix(), name)
        for title, pushes_only in (("all", False), ("pushes", True)):
            paths = [stays_of(walk(trace.calls, start, pushes_only=pushes_only, own_folder=own)) for own in (False, True)]
            (a, b, c), (d, e, f) = ((len(set(path)), len(path), len(path) - len(set(path))) for path in paths)
            print(f"{name:20}{title:8}{a:9}{b:7}{c:9}   {d:9}{e:7}{f:9}")
            if show:
                print(*("    " + " > ".join(path) for path in paths), sep="\n")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    measured = commands.add_parser("sizes", help="large functions and modules")
    measured.add_argument("--root", type=Path, default=ROOT, help="root of the repository")
    walked = commands.add_parser("walk", help="modules that pushes pass through")
    walked.add_argument("--bag", type=Path, default=ROOT / "bags" / "hammer_depth")
    walked.add_argument("--entry", action="append", metavar="MODULE:NAME", help="function of records; default: identify, diagnose")
    walked.add_argument("--show", action="store_true", help="print the stays in order")
    given = parser.parse_args()
    if given.command == "sizes":
        sizes(given.root)
    else:
        walks(given.bag.resolve(), given.entry or ENTRIES, given.show)


if __name__ == "__main__":
    main()
