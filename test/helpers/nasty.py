"""Names from outside that try to be more than text."""

from __future__ import annotations

from html.parser import HTMLParser

NASTY = [
    "[/x]",
    "[bold red]x[/bold red]",
    "[link=http://evil.example]x[/link]",
    ":pile_of_poo:",
    "\x1b[2J\x1b[31mred",
    "\x1b]0;title\x07\x1b]8;;http://evil.example\x07link",
    "\x9b31m",
    "a\rb\bc\0d\x7f",
    "line\u2028other\u202egnp.exe\u200b",
    "$a$ $\\frac$",
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onmouseover='alert(1)",
    "--><svg onload=alert(1)>",
    "{{ 7 * 7 }}{% raw %}%s %n",
    "../../etc/passwd",
    "\udc80\ud800",
    "x" * 100_000,
]
NASTY_ID = '[b]$a$ $\\q$<img src=x onerror=alert(1)>&"\x1b[31m\x07:smile:{{ 7 * 7 }}'
"""All of it in one object id; without `/`, which would end the id in the name of a topic."""
CONTROL = {chr(c) for c in (*range(9), *range(11, 32), *range(127, 160), 0x200B, 0x2028, 0x202E, *range(0xD800, 0xE000))}


class Page(HTMLParser):
    """What a browser would make of a page."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data: str) -> None:
        self.text += data

    def check(self) -> None:
        """No element and no attribute that runs or loads anything."""
        assert not self.tags & {"script", "img", "iframe", "object", "embed", "link", "base", "form"}, self.tags
        assert not {name for name in self.attributes if name.startswith("on")}
