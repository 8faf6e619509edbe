"""Syntax trees of source files, each parsed once in a process: rules for all sources look at every node of thousands of functions."""

from __future__ import annotations

import ast
import gc
from functools import cache
from pathlib import Path


@cache
def tree(path: Path) -> ast.Module:
    """The tree of a file."""
    gc.disable()  # it would look at all trees again and again
    try:
        return ast.parse(path.read_text(encoding="utf-8"))
    finally:
        gc.enable()


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All nodes of a file."""
    gc.disable()
    try:
        return tuple(ast.walk(tree(path)))
    finally:
        gc.enable()
