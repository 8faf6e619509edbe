"""Render a report as one self-contained HTML file."""

from __future__ import annotations

import io
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident.limits import plain_text, printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["figure_text", "page_text", "svg", "write_page"]


def figure_text(text: str) -> str:
    """Foreign text for a figure: one line, and no formula; matplotlib would parse what stands between two `$`, and fail."""
    return plain_text(text).replace("$", r"\$")


def svg(figure: Figure) -> str:
    """A figure as an SVG element for a page. Labels stay text, so that they can be searched and read aloud."""
    import matplotlib

    buffer = io.StringIO()
    # With a fixed salt the same report gives the same file.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "push_ident"}):
        figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def page_text(package: str, template: str, context: Mapping[str, Any]) -> str:
    """Fill a template.

    Args:
        package: package that contains the template.
        template: name of the template; it may extend `page.html.j2`, the common layout.
        context: values of the template's variables.

    Returns:
        The page, HTML.
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined, select_autoescape
    from markupsafe import Markup

    def load(name: str) -> str:
        where = files(__package__ if name == "page.html.j2" else package)
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
