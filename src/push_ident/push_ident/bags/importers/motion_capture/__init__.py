"""Exports of motion capture programs as they are: one module for each program, `export.py` for all of them."""

from __future__ import annotations

from push_ident.bags.importers.motion_capture.reading import read_body

__all__ = ["read_body"]
