"""The documents: the site builds without a warning and needs no network, and what the documents at the root promise holds."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from helpers.paths import EXAMPLE_BAG, ROOT
from push_ident.cli.main import app

ROOT_DOCUMENTS = ("README.md", "ARCHITECTURE.md", "CONVENTIONS.md", "bags/README.md")
ROOT_DOCUMENTS += ("changelog/README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
ELSEWHERE = ("camera.yaml", "camera_info.yaml", "edge.yaml", "joint_limits.yaml", "my_cell.yaml", "my_robot.yaml", "parameters.yaml")
ELSEWHERE += ("perception.yaml", "slow.yaml")
"""Files that documents name and that are made by a command or belong to an arm."""

SITE_STYLE = (ROOT / "docs" / "assets" / "site.css").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built in strict mode: a broken link, anchor, reference or equation fails."""
    target = tmp_path_factory.mktemp("site")
    # Not --quiet: it drops the warnings before strict mode counts them.
    call = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(target)]
    environ = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(call, cwd=ROOT, env=environ, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    return target


@pytest.mark.release
def test_pages_load_nothing_from_the_network(site: Path) -> None:
    loads = re.compile(
        r"<(?:script|img|iframe|source)\b[^>]*\bsrc=[\"']?(?:https?:)?//[^>]*>|<link\b[^>]*\bhref=[\"']?(?:https?:)?//[^>]*>"
    )
    found = {page.name: match for page in site.rglob("*.html") for match in loads.findall(page.read_text(encoding="utf-8"))}
    assert not found


@pytest.mark.release
def test_reference_has_every_command_node_message_and_effect(site: Path) -> None:
    from push_ident.physics.effects import EFFECTS

    pages = {
        name: (site / "reference" / f"{name}.html").read_text(encoding="utf-8") for name in ("commands", "nodes", "messages", "effects")
    }
    messages = [path.stem for path in (ROOT / "src" / "push_ident_msgs").glob("*/*.*") if path.suffix in (".msg", ".srv", ".action")]
    expected = {
        "commands": list(typer.main.get_command(app).commands),  # type: ignore[attr-defined]
        "nodes": ["perception_node", "objects/&lt;id&gt;/mass_friction_map", "execute_push", "joint_acceleration_limits"],
        "messages": messages,
        "effects": list(EFFECTS),
    }
    missing = {page: [name for name in names if name not in pages[page]] for page, names in expected.items()}
    assert not any(missing.values()), missing


def test_links_of_the_documents_at_the_root_lead_somewhere_and_files_that_documents_name_exist() -> None:
    """A file or folder in backticks is one of the repository, given by the end of its path."""
    paths = [path for folder in ("src", "test", "tools", "docs", "bags", "changelog") for path in (ROOT / folder).rglob("*")]
    known = {f"/{path.relative_to(ROOT)}" + ("/" if path.is_dir() else "") for path in (*paths, *ROOT.iterdir())}
    documents = [ROOT / name for name in ROOT_DOCUMENTS]
    broken = []
    for document in documents:
        links = re.findall(r"\]\(([^)#\s]+)", document.read_text(encoding="utf-8"))
        broken += [f"{document}: {link}" for link in links if "://" not in link and not (document.parent / link).exists()]
    documents = [
        *documents[:4],
        *(path for folder in ("decisions", "how-to", "concepts") for path in (ROOT / "docs" / folder).glob("*.md")),
    ]
    for document in documents:
        named = set(re.findall(r"`((?:[\w-]+/)*[\w-]+(?:\.py|\.yaml|\.toml|/))`", document.read_text(encoding="utf-8")))
        broken += [f"{document}: {name}" for name in named.difference(ELSEWHERE) if not any(path.endswith(f"/{name}") for path in known)]
    assert not broken


def unbreakable(cell: str) -> int:
    """Characters of the longest word of a cell, links without their addresses."""
    return max(map(len, re.split(r"[\s-]+", re.sub(r"\]\([^)]*\)", "]", cell))), default=0)


def test_commands_in_tables_wrap_and_fit_a_page_of_1600_pixels() -> None:
    """The grid has 72 rem of 22 px there, of which two sidebars take 24.2 and margins 2.4; a letter of code has 0.68 * 0.85 * 0.602 rem."""
    (rule,) = re.findall(r"^\.md-typeset table:not\(\[class\]\) code \{(.*)\}$", SITE_STYLE, re.MULTILINE)
    assert "white-space: normal" in rule
    documents = [*(ROOT / "docs").rglob("*.md"), *(ROOT / name for name in ROOT_DOCUMENTS)]
    tables = [table for path in documents for table in re.findall(r"(?:^ *\|.*\|$\n?)+", path.read_text(encoding="utf-8"), re.MULTILINE)]
    with_commands = [table for table in tables if re.search(r"`(?:push-ident|ros2|make|pip|python) [^`]+`", table)]
    assert len(with_commands) >= 5
    for table in with_commands:
        rows = [re.split(r"(?<!\\)\|", line.strip().strip("|")) for line in table.splitlines()]
        columns = list(zip(*rows, strict=True))
        needed = sum(max(map(unbreakable, column)) * 0.68 * 0.85 * 0.602 + 2 * 1.25 * 0.68 for column in columns)
        assert needed < 72 - 24.2 - 2.4, table


def test_decisions_that_code_and_documents_name_exist() -> None:
    records = {path.name for path in (ROOT / "docs" / "decisions").glob("[0-9]*.md")}
    numbers = {int(name[:4]) for name in records}
    suffixes, missing = (".py", ".md", ".yaml", ".msg", ".action", ".srv"), []
    files = [path for folder in ("src", "test", "tools", "docs") for path in (ROOT / folder).rglob("*") if path.suffix in suffixes]
    for path in (*files, *(ROOT / name for name in (*ROOT_DOCUMENTS, "SAFETY.md"))):
        text = path.read_text(encoding="utf-8")
        missing += [f"{path.name}: {name}" for name in re.findall(r"decisions/(\d{4}[\w-]*\.md)", text) if name not in records]
        missing += [f"{path.name}: {n}" for n in re.findall(r"\b[Dd]ecision (\d+)\b", text) if int(n) not in numbers]
    assert not missing


def run_script(name: str, *arguments: Path) -> None:
    """Run a script of the documentation as its user does, without the seconds of a start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(ROOT / "docs" / "examples" / name), run_name="__main__")


def test_recording_that_a_script_of_the_guide_writes_is_read_as_its_source(tmp_path: Path) -> None:
    from push_ident.bags.importers import TrackedPoses, import_tracked_poses
    from push_ident.offline.loading import load_pushes

    run_script("write_a_bag.py", EXAMPLE_BAG, tmp_path / "own")
    run_script("write_tables.py", EXAMPLE_BAG, tmp_path)
    files = {name: tmp_path / f"{name}.csv" for name in ("poses", "pusher", "outline")}
    report = import_tracked_poses(TrackedPoses(**files, radius=0.018, position_std=1e-3, yaw_std=8.7e-3), tmp_path / "imported")
    before = load_pushes([EXAMPLE_BAG]).records
    assert report.n_pushes == len(before) and report.warnings == ()
    for bag in ("own", "imported"):
        after = load_pushes([tmp_path / bag]).records
        assert [len(record.poses.time) for record in after] == [len(record.poses.time) for record in before], bag
        assert after[1].poses.pose[-1] == pytest.approx(before[1].poses.pose[-1], abs=2e-6), bag


def test_python_of_the_tutorial_runs(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    code = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8"), re.DOTALL)
    assert code is not None
    monkeypatch.chdir(ROOT)
    scope: dict[str, object] = {}
    exec(code[1], scope)
    assert "SolveStatus" in capsys.readouterr().out
