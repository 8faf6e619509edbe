"""Which code a result depends on, so that a file made by other code is not mistaken for a present one."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Collection, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Final

import push_ident

_PREFIXES: Final = ("push_ident.", "push_ident_sim.")
_ROOTS: Final = {"push_ident": Path(push_ident.__file__).parent, "push_ident_sim": Path(__file__).parent}


def code_digest(files: Collection[Path]) -> str:
    """Hash of the code of `files`, without comments, docstrings and layout; hexadecimal. Raises OSError where one cannot be read."""
    return hashlib.sha256("\n".join(_code(path) for path in sorted(files)).encode()).hexdigest()


def files_behind(start: Path, without: Collection[str] = ()) -> set[Path]:
    """A module and all modules of the two packages that it imports, directly or indirectly, or names in a string to run as a process.

    Args:
        start: File of the module.
        without: Names of modules that are not followed, such as `push_ident_sim.studies.common.tables`.
    """
    found, waiting = {start}, [start]
    while waiting:
        for name in _names_in(waiting.pop()):
            path = None if name in without else _file_of(name)
            if path is not None and path not in found:
                found.add(path)
                waiting.append(path)
    return found


@cache
def _file_of(name: str) -> Path | None:
    package, *rest = name.split(".")
    if package not in _ROOTS:
        return None
    path = _ROOTS[package].joinpath(*rest)
    return next((p for p in (path.parent / f"{path.name}.py", path / "__init__.py") if p.is_file()), None)


@cache
def _names_in(path: Path) -> tuple[str, ...]:
    return tuple(_names(ast.parse(path.read_text(encoding="utf-8"))))


def _names(tree: ast.Module) -> Iterator[str]:
    for node in _executed(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith(_PREFIXES):
            yield node.value


def _executed(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes but imports for types, and those of names that a module offers and does not need itself (`__getattr__`, PEP 562)."""
    if isinstance(node, ast.FunctionDef) and node.name == "__getattr__":
        return
    yield node
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        children: Iterable[ast.AST] = node.orelse
    else:
        children = ast.iter_child_nodes(node)
    for child in children:
        yield from _executed(child)


@cache
def _code(path: Path) -> str:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [statement for statement in node.body if not _explains(statement)]
    return ast.dump(tree)


def _explains(statement: ast.stmt) -> bool:
    """A statement that is only a string, such as a docstring."""
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant) and isinstance(statement.value.value, str)
