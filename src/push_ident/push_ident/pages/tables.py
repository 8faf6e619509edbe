"""Small tables of HTML for notebooks, without styles of a page."""

from __future__ import annotations

from collections.abc import Sequence

from push_ident.pages.chart import clean


def html_table(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]], *, note: str = "") -> str:
    """A table with a sentence above and one below; all texts are escaped."""

    def cells(tag: str, texts: Sequence[str]) -> str:
        return "".join(f'<{tag} style="text-align:{"left" if i == 0 else "right"}">{clean(text)}</{tag}>' for i, text in enumerate(texts))

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    table = f"<table><thead><tr>{cells('th', heads)}</tr></thead><tbody>{body}</tbody></table>" if rows else ""
    return f"<div><p><strong>{clean(title)}</strong></p>{table}{f'<p>{clean(note)}</p>' if note else ''}</div>"
