"""Render a report as one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident.limits import printable

_COMMON = ("page.html.j2", "figures.html.j2")
"""Templates of this package."""


@dataclass(frozen=True, slots=True)
class FigureSection:
    """A section of figures beside one another; a template shows it with `{% include "figures.html.j2" %}`, its name is `section` there."""

    heading: str
    figures: Sequence[tuple[str, str]]
    """Caption and SVG of each."""
    note: str


def page_text(package: str, template: str, context: Mapping[str, Any]) -> str:
    """HTML of a template of a package; it may extend `page.html.j2`, the common layout, and include `figures.html.j2`."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined, select_autoescape
    from markupsafe import Markup

    def load(name: str) -> str:
        where = files(__package__ if name in _COMMON else package)
        return where.joinpath(name).read_text(encoding="utf-8")

    environment = Environment(
        loader=FunctionLoader(load),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["mm"] = lambda metres, digits=1: "–" if metres is None or metres != metres else f"{1e3 * metres:.{digits}f} mm"
    environment.filters["figure"] = lambda text: Markup(text)
    return printable(environment.get_template(template).render(**context))


def write_page(path: Path, package: str, template: str, context: Mapping[str, Any]) -> None:
    """Fill a template as `page_text` does, and write the page to `path`. Raises InputError where it cannot be written."""
    write_whole(path, page_text(package, template, context), "the report", error=InputError)
