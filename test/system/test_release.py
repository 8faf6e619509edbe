"""A release: one version everywhere, and a changelog from the fragments."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import push_ident
from helpers.paths import ROOT

KINDS = ("added", "changed", "fixed", "removed")
VERSIONED = (
    "src/push_ident/push_ident/__init__.py",
    "src/push_ident_sim/setup.py",
    *(f"src/{p}/package.xml" for p in ("push_ident", "push_ident_msgs", "push_ident_sim")),
    "CITATION.cff",
)

ADDRESSED = ("src/push_ident/setup.py", "SECURITY.md")


def release(root: Path, version: str) -> subprocess.CompletedProcess[str]:
    call = [sys.executable, ROOT / "tools" / "release.py", version, "--date", "2031-02-03", "--root", root]
    return subprocess.run(call, capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """What a release touches, with an address of the owner, and two fragments."""
    for name in (*VERSIONED, *ADDRESSED, "pyproject.toml", "CHANGELOG.md", "tools/changelog.md.j2", "changelog/README.md"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        text = (ROOT / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(text.replace("push-ident.example", "push-ident.invalid"), encoding="utf-8")
    (tmp_path / "changelog" / "wheel.added.md").write_text("First line\nand second.\n")
    (tmp_path / "changelog" / "door.fixed.md").write_text("A door.\n")
    return tmp_path


def test_release_writes_one_version_and_gathers_the_fragments(copy: Path) -> None:
    for version in ("7.8.9", "7.9.0"):  # the second finds what the first has written
        done = release(copy, version)
        assert done.returncode == 0, done.stdout + done.stderr
        for name in VERSIONED:
            assert (copy / name).read_text().count(version) == 1, name
    assert yaml.safe_load((copy / "CITATION.cff").read_text())["date-released"] == "2031-02-03"
    assert [path.name for path in (copy / "changelog").iterdir()] == ["README.md"]
    text = (copy / "CHANGELOG.md").read_text()
    assert "## 7.8.9 (2031-02-03)\n\n### Added\n\n- First line\n  and second.\n\n### Fixed\n\n- A door.\n" in text
    assert text.index("## 7.9.0") < text.index("## 7.8.9") and "wheel.added" not in text and "door.fixed" not in text


def test_a_version_of_another_form_changes_nothing(copy: Path) -> None:
    done = release(copy, "v2")
    assert done.returncode == 1 and "MAJOR.MINOR.PATCH" in done.stderr
    assert push_ident.__version__ in (copy / "CITATION.cff").read_text() and (copy / "changelog" / "door.fixed.md").exists()


@pytest.mark.parametrize("name", ["src/push_ident_msgs/package.xml", "src/push_ident_sim/setup.py", "SECURITY.md"])
def test_no_release_is_made_without_an_address_of_the_owner(copy: Path, name: str) -> None:
    text = (ROOT / name).read_text()
    (copy / name).write_text(text if "push-ident.example" in text else f"{text}\n# push-ident.example\n")
    done = release(copy, "7.8.9")
    assert done.returncode == 1 and name in done.stderr
    assert "7.8.9" not in (copy / "CITATION.cff").read_text()


def test_every_fragment_has_a_kind_and_the_citation_the_paper_and_this_version() -> None:
    names = [path.name for path in (ROOT / "changelog").iterdir() if path.name != "README.md"]
    assert [name for name in names if not re.fullmatch(rf"[\w-]+\.({'|'.join(KINDS)})\.md", name)] == []
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == push_ident.__version__ and citation["license"] == "Apache-2.0"
    assert [author["family-names"] for author in citation["references"][0]["authors"]] == ["Song", "Boularias"]
