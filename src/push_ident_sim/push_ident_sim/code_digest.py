"""Which code a result depends on, so that a file made by other code is not mistaken for a present one."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Collection, Iterable
from functools import cache
from pathlib import Path

import push_ident

CORE, SIM = Path(push_ident.__file__).parent, Path(__file__).parent


def code_digest(files: Collection[Path]) -> str:
    """Hash of the code of `files`, without comments, docstrings and layout; hexadecimal. Raises OSError where one cannot be read."""
    return hashlib.sha256("\n".join(_code(path) for path in sorted(files)).encode()).hexdigest()


def code_of(root: Path, parts: Iterable[str]) -> set[Path]:
    """Files of some packages and modules, such as `physics` of `CORE` or `objects.py` of `SIM`."""
    return {path for part in parts for path in ((root / part).rglob("*.py") if (root / part).is_dir() else [root / part])}


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
