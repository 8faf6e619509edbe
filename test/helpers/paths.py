"""Where the repository and its recordings lie."""

from __future__ import annotations

import ast
import gc
import os
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src"
CONFIG = SOURCE / "push_ident" / "config"
EXAMPLE_BAG = ROOT / "bags" / "hammer_depth"
"""Depth of a real sensor's model, no object poses; part of the repository."""
DATA = Path(os.environ.get("PUSH_IDENT_DATA", ROOT.parent / "shared" / "data"))
"""Recordings of other people, which are not part of the repository."""


def recording(*parts: str) -> Path:
    """A recording of other people; the test is skipped where it is absent."""
    path = DATA.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"no recording at {path}; set PUSH_IDENT_DATA to the folder of recordings")
    return path


# Syntax trees, each parsed once in a process: rules for all sources look at every node of thousands of functions.


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    gc.disable()  # it would look at all trees again and again
    try:
        return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    finally:
        gc.enable()
