"""Hooks of the documentation site (mkdocs.yml): pages made from the code and from the documents at the root, equations as SVG.

Nothing that is made here is stored in the repository, so it cannot be out of date.
"""

from __future__ import annotations

import functools
import html
import posixpath
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ziamath
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.nav import Navigation
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(Path(__file__).resolve().parent))

import document_commands  # noqa: E402
import document_effects  # noqa: E402
import document_limits  # noqa: E402
import document_messages  # noqa: E402
import document_nodes  # noqa: E402
import document_notebook  # noqa: E402
import document_policy  # noqa: E402
import document_python  # noqa: E402

ROOT_DOCUMENTS = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "SAFETY.md": "safety.md",
    "SECURITY.md": "security.md",
    "CONVENTIONS.md": "reference/conventions.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "bags/README.md": "reference/bags.md",
}
"""Documents outside docs/ that are pages of the site, and where."""

GENERATED: dict[str, Callable[[], str]] = {
    "examples/bag-to-next-push.md": document_notebook.document,
    "reference/commands.md": document_commands.document,
    "reference/effects.md": document_effects.document,
    "reference/limits.md": document_limits.document,
    "reference/messages.md": document_messages.document,
    "reference/nodes.md": document_nodes.document,
    "reference/policy.md": document_policy.document,
}

EQUATION_SIZE = 20
"""Of the letters of an equation in its drawing [px]."""

ziamath.config.svg2 = False  # outlines in place of symbols, whose names would meet on a page

_INCLUDE = re.compile(r"<!-- include: (\S+) -->")
_LINK = re.compile(r"(!?\[[^\]]*\]\()([^)#\s]+)(#[^)]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made, and those of the documents at the root."""
    pages = {target: write() for target, write in GENERATED.items()}
    pages |= {target: moved_links((ROOT / source).read_text(encoding="utf-8"), source, target) for source, target in ROOT_DOCUMENTS.items()}
    conventions, glossary = split_glossary(pages["reference/conventions.md"])
    pages["reference/conventions.md"], pages["reference/glossary.md"] = conventions, glossary
    pages["decisions/index.md"] = index_of_decisions(ROOT / "docs" / "decisions")
    pages |= document_python.pages()
    for target, text in pages.items():
        files.append(File.generated(config, target, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links to documents at the root (`../README.md`) become links to their pages; `<!-- include: FILE -->` becomes the file."""

    def resolve(match: re.Match[str]) -> str:
        head, target, anchor = match[1], match[2], match[3] or ""
        if "://" in target or target.startswith("mailto:"):
            return match[0]
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page.file.src_uri), target))
        if path not in ROOT_DOCUMENTS:
            return match[0]
        return f"{head}{posixpath.relpath(ROOT_DOCUMENTS[path], posixpath.dirname(page.file.src_uri) or '.')}{anchor})"

    def included(match: re.Match[str]) -> str:
        return f"\n```python\n{(ROOT / match[1]).read_text(encoding='utf-8')}```"

    return _INCLUDE.sub(included, _LINK.sub(resolve, markdown))


def on_page_content(content: str, **_: Any) -> str:
    """Equations become pictures: no script, no font and no network is needed to read them."""
    content = re.sub(
        r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', lambda m: picture_of(m[1], is_block=True), content, flags=re.DOTALL
    )
    return re.sub(r'<span class="arithmatex">\\\((.*?)\\\)</span>', lambda m: picture_of(m[1], is_block=False), content, flags=re.DOTALL)


def on_nav(nav: Navigation, config: MkDocsConfig, files: Files) -> Navigation:
    """Check that every page is reachable from the navigation."""
    listed = {page.file.src_uri for page in nav.pages}
    missing = sorted(file.src_uri for file in files.documentation_pages() if file.src_uri not in listed)
    if missing:
        raise PluginError(f"Pages that no entry of the navigation in mkdocs.yml leads to: {', '.join(missing)}")
    return nav


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Entries of the navigation that end with a slash stand for all pages of that folder."""
    decisions = ["decisions/index.md", *sorted(f"decisions/{path.name}" for path in (ROOT / "docs" / "decisions").glob("[0-9]*.md"))]
    pages = sorted(f"results/{path.name}" for path in (ROOT / "docs" / "results").glob("*.md") if path.name != "index.md")
    folders = {"decisions/": decisions, "reference/python/": sorted(document_python.pages()), "results/": ["results/index.md", *pages]}

    def expand(entry: Any) -> Any:
        if isinstance(entry, dict):
            return {name: folders.get(value) or expand(value) if isinstance(value, str) else expand(value) for name, value in entry.items()}
        return [expand(value) for value in entry] if isinstance(entry, list) else entry

    config.nav = expand(config.nav)
    return config


@functools.cache
def picture_of(latex: str, *, is_block: bool) -> str:
    """An equation as SVG in the colour of the text; its LaTeX is the text for readers who cannot see it.

    Raises:
        PluginError: The equation is not understood.
    """
    latex = " ".join(html.unescape(latex).split())
    try:
        equation = ziamath.Latex(latex, size=EQUATION_SIZE, color="currentColor", inline=not is_block)
        drawing, below = equation.svg(), equation.getyofst()
    except Exception as error:
        raise PluginError(f"Equation `{latex}`: {error!r}") from error
    width, height = (float(re.search(rf'\b{name}="([\d.]+)"', drawing)[1]) / EQUATION_SIZE for name in ("width", "height"))  # type: ignore[index]
    style = f"width:{width:.3f}em;height:{height:.3f}em;vertical-align:{below / EQUATION_SIZE:.3f}em"
    start = f'<svg class="equation" role="img" aria-label="{html.escape(latex)}" style="{style}"'
    drawing = drawing.replace("<svg", start, 1)
    return f'<div class="equation">{drawing}</div>' if is_block else drawing


def moved_links(text: str, source: str, target: str) -> str:
    """`text` of the document `source` with its links as the page `target` needs them; links to what is no page become plain text."""

    def move(match: re.Match[str]) -> str:
        head, link, anchor = match[1], match[2], match[3] or ""
        if "://" in link:
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), link))
        page = ROOT_DOCUMENTS.get(path) or (path.removeprefix("docs/") if path.startswith("docs/") else None)
        if link.endswith("/") and page is not None:
            page = f"{page}/index.md"
        if page is None:
            return re.sub(r"^!?\[([^\]]*)\]\($", r"\1", head)
        return f"{head}{posixpath.relpath(page, posixpath.dirname(target) or '.')}{anchor})"

    return _LINK.sub(move, text)


def split_glossary(conventions: str) -> tuple[str, str]:
    """CONVENTIONS.md without its glossary, and the glossary as a page of its own."""
    start = conventions.index("## Glossary")
    end = conventions.index("\n## ", start + 3) + 1
    glossary = conventions[start:end].replace("## Glossary", "# Glossary", 1)
    return conventions[:start] + conventions[end:], glossary


def index_of_decisions(folder: Path) -> str:
    """The list of the records of decisions, with their states."""
    lines = [
        "# Decisions",
        "",
        "Why things are as they are: one record for each topic that had an alternative, with the measurement that decided. "
        "Numbers in a record were measured when it was written; those of this version are in the [results](../results/index.md).",
        "",
        "| no. | decision | status |",
        "|---|---|---|",
    ]
    for path in sorted(folder.glob("[0-9]*.md")):
        text = path.read_text(encoding="utf-8")
        title = re.match(r"# \d+\. (.*)", text)
        status = re.search(r"^\*\*Status\*\*: (.*)$", text, re.MULTILINE)
        if title is None or status is None:
            raise PluginError(f"{path.name}: expected a title `# N. Title` and a line `**Status**: …`")
        lines.append(f"| {path.name[:4]} | [{title[1]}]({path.name}) | {status[1]} |")
    return "\n".join(lines) + "\n"
