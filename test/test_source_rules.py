"""What keeps the sources readable: sizes, documented public names, effects named in one place, tests that use public names only."""

from __future__ import annotations

import ast
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from helpers.paths import ROOT, SOURCE, nodes, tree

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
    "push_ident_sim/studies/blind/cases.py": "what each engine of the check can inject, and what a camera can film",
    "push_ident_sim/studies/blind/summary.py": "the effects whose figures are shown one by one",
}


@dataclass(frozen=True)
class Module:
    """One file of the packages."""

    path: Path
    tree: ast.Module

    @property
    def name(self) -> str:
        """Path inside the package folder: push_ident/physics/step.py."""
        return str(self.path.relative_to(SOURCE)).split("/", 1)[1]

    def functions(self) -> Iterator[Function]:
        """All of them, methods and nested ones included."""
        yield from (node for node in nodes(self.path) if isinstance(node, Function))


@cache
def modules() -> tuple[Module, ...]:
    return tuple(Module(path, tree(path)) for root in (CORE, SIM) for path in sorted(root.rglob("*.py")))


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
    for module in modules():
        for function in module.functions():
            n_lines = (function.end_lineno or 0) - function.lineno + 1
            if n_lines > MAX_FUNCTION_LINES and not is_kernel(function):
                found[f"{module.name}:{function.name}"] = n_lines
    assert not beyond(LONG_FUNCTIONS, found)


def test_no_function_outside_kernels_and_commands_has_many_parameters() -> None:
    found: dict[str, object] = {}
    for module in modules():
        for function in module.functions():
            if n_parameters(function) > MAX_PARAMETERS and not is_kernel(function) and not is_command(function):
                found[f"{module.name}:{function.name}"] = n_parameters(function)
    assert not found


def test_long_modules_are_named() -> None:
    """A module has one purpose, whatever its length; a long one may have more."""
    files = [path for folder in (SOURCE, ROOT / "test") for path in sorted(folder.rglob("*.py"))]
    lines = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").count("\n") for path in files}
    if long := {name: n for name, n in lines.items() if n > LONG_MODULE}:
        warnings.warn(f"modules of more than {LONG_MODULE} lines, is each one concept? {long}", stacklevel=1)


def public(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, ast.ClassDef | Function]]:
    """Public functions, classes, and their public methods."""
    for node in body:
        if isinstance(node, ast.ClassDef | Function) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node.body, f"{prefix}{node.name}.")


@pytest.mark.parametrize("package", [CORE, SIM], ids=lambda p: p.name)
def test_every_public_name_has_a_docstring(package: Path) -> None:
    missing = []
    for module in modules():
        if package in module.path.parents:
            missing += [] if ast.get_docstring(module.tree) else [module.name]
            missing += [f"{module.name}:{name}" for name, node in public(module.tree.body) if not ast.get_docstring(node)]
    assert missing == []


def test_effects_are_named_only_in_their_own_files() -> None:
    """Everything else asks an effect for what it needs to know. `pusher_friction` is a quantity of every model as well."""
    names = {path.stem for path in EFFECTS.glob("*.py")} - {"__init__", "pusher_friction"}
    assert "table_tilt" in names
    found: dict[str, object] = {}
    for module in modules():
        if EFFECTS in module.path.parents or any(SIM / room in module.path.parents for room in ("injected", "engines")):
            continue
        constants = (node.value for node in nodes(module.path) if isinstance(node, ast.Constant) and isinstance(node.value, str))
        if literal := sorted(names.intersection(constants)):
            found[module.name] = literal
    assert not beyond(EFFECT_NAMES_OUTSIDE, found)


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def test_tests_use_public_names_only_and_do_not_import_each_other() -> None:
    private: dict[str, object] = {}
    for path in sorted((ROOT / "test").rglob("*.py")):
        reached = []
        for node in nodes(path):
            if isinstance(node, ast.ImportFrom):
                full = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
                assert not any(part.startswith("test_") for part in full), f"{path.name} imports a test"
                reached += [part for part in full if is_private(part)]
            elif isinstance(node, ast.Import):
                assert not any(part.startswith("test_") for alias in node.names for part in alias.name.split(".")), path.name
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr":
                patched = [arg.value for arg in node.args[:2] if isinstance(arg, ast.Constant) and isinstance(arg.value, str)]
                reached += [name for name in patched if is_private(name.rpartition(".")[2])]
            elif isinstance(node, ast.Attribute) and is_private(node.attr):
                owner = node.value
                if not (isinstance(owner, ast.Name) and owner.id in ("self", "cls")):
                    reached.append(ast.unparse(node))
        if reached:
            private[str(path.relative_to(ROOT))] = sorted(set(reached))
    assert not private
