"""Names and texts from outside stay text: in the terminal, in pages, in figures."""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import pytest
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from typer.testing import CliRunner

from helpers.commands import run_here
from helpers.paths import ROOT
from push_ident.api.plots import draw
from push_ident.bags.records import write_records
from push_ident.cli.main import app
from push_ident.cli.output import Description, PlainConsole, warn
from push_ident.cli.supervisor import NodeCommand, Supervisor
from push_ident.fleet import FleetOptions, write_index
from push_ident.fleet.job import identify_bag
from push_ident.limits import plain_text, printable
from push_ident.offline.loading import load_pushes

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
NASTY_NAME = "[b]$x$ \x1b[31m<i>"
CONTROL = {chr(c) for c in (*range(9), *range(11, 32), *range(127, 160), 0x200B, 0x2028, 0x202E, *range(0xD800, 0xE000))}


class Page(HTMLParser):
    """What a browser would make of a page."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: set[str] = set()
        self.attributes: list[tuple[str, str | None]] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes += attrs

    def handle_data(self, data: str) -> None:
        self.text += data

    def check(self) -> None:
        """No element and no attribute that runs or loads anything."""
        assert not self.tags & {"script", "img", "iframe", "object", "embed", "link", "base", "form"}, self.tags
        assert not [name for name, value in self.attributes if name.startswith("on") or "javascript:" in (value or "")]


TILT = ROOT / "test" / "system" / "baseline" / "bags" / "tilt"


def check_terminal(said: str) -> None:
    assert not CONTROL & set(said), sorted(CONTROL & set(said))
    assert "Traceback" not in said


def test_console_and_warnings_show_text_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    for text in NASTY:
        out = io.StringIO()
        console = PlainConsole(file=out, width=400)
        table = Table(title=text)
        table.add_column(text)
        table.add_row(text)
        console.print(text, soft_wrap=True)
        console.print(table)
        with Progress(Description(), console=console) as progress:
            progress.add_task(text)
        check_terminal(out.getvalue())
        assert printable(text)[:50] in out.getvalue()
        warn(text)
    check_terminal(capsys.readouterr().err)


@pytest.mark.parametrize("command", [["identify"], ["replay"], ["export", "--format", "sdf"]], ids=lambda command: command[0])
def test_a_file_of_that_name_is_refused_in_plain_text(command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for text in NASTY[:-2]:
        name = text.replace("\0", "").replace("/", "_")
        (tmp_path / name).write_bytes(b"\x89MCAP0\r\n" + bytes(50))
        done = run_here(*command, f"./{name}")
        assert done.returncode == 1
        check_terminal(done.stderr + done.stdout)


def test_lines_of_nodes_reach_the_terminal_as_plain_text(tmp_path: Path) -> None:
    script = f"import sys; sys.stdout.reconfigure(errors='surrogatepass'); print(*{[text[:300] for text in NASTY]!r}, sep='\\n')"
    command, out = NodeCommand("own", (sys.executable, "-S", "-c", script), may_end=True), io.StringIO()
    Supervisor([command], console=Console(file=out, width=500, force_terminal=False)).run()
    check_terminal(out.getvalue())
    assert "[bold red]x[/bold red]" in out.getvalue()


def test_figures_hold_text_and_no_formula() -> None:
    pushes = load_pushes([TILT]).records
    for text in (" ".join(NASTY[9:-1]), NASTY[-1]):
        figure, picture = draw(pushes[0], text), io.StringIO()
        with matplotlib.rc_context({"svg.fonttype": "none"}):  # labels stay text
            figure.savefig(picture, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
        page = Page(picture.getvalue()[picture.getvalue().index("<svg") :])
        page.check()
        assert plain_text(text)[:20] in page.text


def test_an_object_of_that_name_goes_through_the_commands_and_their_pages(tmp_path: Path) -> None:
    bag, out = tmp_path / "bag" / NASTY_NAME, tmp_path / NASTY_NAME
    write_records(bag, [replace(record, object_id=NASTY_ID) for record in load_pushes([TILT]).records[:3]])
    model = str(out / "model.json")
    for arguments in (
        ["identify", str(bag), "--out", str(out), "--train", "0,1"],
        ["predict", model, str(bag)],
        *(["export", model, "--format", name, "--out", str(out / f"model.{name}")] for name in ("sdf", "urdf", "mjcf")),
    ):
        result = CliRunner().invoke(app, arguments, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        check_terminal(result.output)
        assert "[b]" in result.output
    outcome = identify_bag(bag, FleetOptions(held_out=3)) | {"model_file": "models/[b]\"' onclick=alert(1).json"}
    write_index(tmp_path / "index.html", [outcome, {**outcome, "state": "failed", "error": " ".join(t[:300] for t in NASTY)}])
    for page in (out / "report.html", tmp_path / "index.html"):
        html = page.read_text(encoding="utf-8")
        found = Page(html)
        found.check()
        assert "<img src=x onerror=alert(1)>" in found.text and "{{ 7 * 7 }}" in found.text
        assert not CONTROL & set(html)
