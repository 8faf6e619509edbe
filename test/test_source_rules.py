"""What keeps the sources readable: sizes, effects named in one place, tests that use public names only."""

from __future__ import annotations

import ast
import warnings
from collections.abc import Iterator
from pathlib import Path

from helpers.paths import ROOT, SOURCE, nodes

CORE = SOURCE / "push_ident" / "push_ident"
SIM = SOURCE / "push_ident_sim" / "push_ident_sim"
EFFECTS = CORE / "physics" / "effects"
MAX_FUNCTION_LINES = 60
MAX_PARAMETERS = 8
LONG_MODULE = 800
Function = ast.FunctionDef | ast.AsyncFunctionDef

# Exceptions of each rule, with the reason. They may only become fewer.
LONG_FUNCTIONS: dict[str, str] = {}
EFFECT_NAMES_OUTSIDE: dict[str, str] = {
    "push_ident/nodes/push_executor/parameters.py": "push_height is a parameter of the arm's motion: the height of the tool over the table",
    "push_ident/physics/active_effects.py": "restitution is also a quantity of the contact",
    "push_ident/physics/effect.py": "restitution is also a quantity of the contact",
    "push_ident_sim/studies/recorded_scenes.py": "what is not known exactly of recordings of others",
    "push_ident_sim/studies/scenes.py": "what only the world of a case has, with its size",
    "push_ident_sim/studies/blind/cases.py": "what each engine of the check can inject, and what a camera can film",
    "push_ident_sim/studies/blind/summary.py": "the effects whose figures are shown one by one",
}


FILES = [path for root in (CORE, SIM) for path in sorted(root.rglob("*.py"))]


def name_of(path: Path) -> str:
    """Inside the package folder: push_ident/physics/step.py."""
    return str(path.relative_to(SOURCE)).split("/", 1)[1]


def functions() -> Iterator[tuple[str, Function]]:
    """Each with the name of its file; methods and nested ones included."""
    yield from ((name_of(path), node) for path in FILES for node in nodes(path) if isinstance(node, Function))


def is_kernel(function: Function) -> bool:
    """Whether numba compiles it: splitting it or packing its arguments may cost speed."""
    return any(
        ast.unparse(d).split("(")[0].split(".")[-1].lstrip("_") in ("kernel", "fast_kernel", "njit") for d in function.decorator_list
    )


def is_command(function: Function) -> bool:
    """Whether it is a command of the command line: one parameter an option."""
    return any("command" in ast.unparse(d).split("(")[0] for d in function.decorator_list) or function.name.endswith("_command")


def n_parameters(function: Function) -> int:
    given = function.args
    names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def beyond(exceptions: dict[str, str], found: dict[str, object]) -> dict[str, object]:
    """What was found and is no exception, and exceptions that are not needed any more."""
    unneeded = {name: "no exception is needed any more" for name in exceptions if name not in found}
    return {name: what for name, what in found.items() if name not in exceptions} | unneeded


def test_no_function_outside_the_kernels_is_longer_than_a_screen() -> None:
    found: dict[str, object] = {}
    for name, function in functions():
        n_lines = (function.end_lineno or 0) - function.lineno + 1
        if n_lines > MAX_FUNCTION_LINES and not is_kernel(function):
            found[f"{name}:{function.name}"] = n_lines
    assert not beyond(LONG_FUNCTIONS, found)


def test_no_function_outside_kernels_and_commands_has_many_parameters() -> None:
    many = [(name, f.name) for name, f in functions() if n_parameters(f) > MAX_PARAMETERS and not is_kernel(f) and not is_command(f)]
    assert many == []


def test_long_modules_are_named() -> None:
    """A module has one purpose, whatever its length; a long one may have more."""
    files = [path for folder in (SOURCE, ROOT / "test") for path in sorted(folder.rglob("*.py"))]
    lines = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").count("\n") for path in files}
    if long := {name: n for name, n in lines.items() if n > LONG_MODULE}:
        warnings.warn(f"modules of more than {LONG_MODULE} lines, is each one concept? {long}", stacklevel=1)


def test_effects_are_named_only_in_their_own_files() -> None:
    """Everything else asks an effect for what it needs to know. `pusher_friction` is a quantity of every model as well."""
    names = {path.stem for path in EFFECTS.glob("*.py")} - {"__init__", "pusher_friction"}
    assert "table_tilt" in names
    found: dict[str, object] = {}
    for path in FILES:
        if {EFFECTS, SIM / "injected", SIM / "engines"}.intersection(path.parents):
            continue
        constants = (node.value for node in nodes(path) if isinstance(node, ast.Constant) and isinstance(node.value, str))
        if literal := sorted(names.intersection(constants)):
            found[name_of(path)] = literal
    assert not beyond(EFFECT_NAMES_OUTSIDE, found)


def names_reached(node: ast.AST) -> Iterator[str]:
    """By an import, an attribute of anything but `self` and `cls`, or `setattr`."""
    if isinstance(node, ast.ImportFrom | ast.Import):
        yield from (getattr(node, "module", None) or "").split(".")
        yield from (part for alias in node.names for part in alias.name.split("."))
    elif isinstance(node, ast.Attribute) and not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
        yield node.attr
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr":
        yield from (arg.value.rpartition(".")[2] for arg in node.args[:2] if isinstance(arg, ast.Constant) and isinstance(arg.value, str))


def test_tests_use_public_names_only_and_do_not_import_each_other() -> None:
    for path in (ROOT / "test").rglob("*.py"):
        for node in nodes(path):
            for name in names_reached(node):
                is_private = name.startswith("_") and not name.endswith("__")
                assert not is_private, f"{path} reaches {name}"
                assert not name.startswith("test_") or not isinstance(node, ast.ImportFrom | ast.Import), f"{path} imports {name}"
