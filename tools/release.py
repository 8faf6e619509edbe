"""Give the repository a version and gather the changelog: `python tools/release.py VERSION [--date YYYY-MM-DD]`.

`push_ident.__version__` is what the package, its wheel and its commands report. ROS manifests, the simulated cell and the citation must
state the version as text; all are written here, and a test holds them equal. Fragments become a section of CHANGELOG.md (towncrier) and
are removed. Nothing is committed or tagged.
"""

from __future__ import annotations

import argparse
import datetime
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PLACES = {
    "src/push_ident/push_ident/__init__.py": r'(?<=__version__ = ")[^"]+',
    "src/push_ident/package.xml": r"(?<=<version>)[^<]+",
    "src/push_ident_msgs/package.xml": r"(?<=<version>)[^<]+",
    "src/push_ident_sim/package.xml": r"(?<=<version>)[^<]+",
    "src/push_ident_sim/setup.py": r'(?<= version=")[^"]+',
}
"""File, and where the version stands in it."""


STAND_IN = "push-ident.example"
"""A reserved name in place of the owner's own addresses, which only the owner knows."""
ADDRESSED = ("src/*/package.xml", "src/*/setup.py", "SECURITY.md")


def check_owner(root: Path) -> None:
    """Exit with the files where the owner's address is still to be given."""
    files = [path for pattern in ADDRESSED for path in sorted(root.glob(pattern)) if STAND_IN in path.read_text(encoding="utf-8")]
    if files:
        names = ", ".join(str(path.relative_to(root)) for path in files)
        sys.exit(f"{STAND_IN} still stands for the maintainer's e-mail, website, repository and issues in {names}; put the real ones in")


def replaced(file: str, pattern: str, value: str, root: Path) -> None:
    """Replace the one place of a pattern in a file."""
    path = root / file
    text, n = re.subn(pattern, value, path.read_text(encoding="utf-8"))
    if n != 1:
        sys.exit(f"{file} has {n} places of a version or date, expected one")
    path.write_text(text, encoding="utf-8")


def main() -> None:
    """Exit status 1 where the version has another form, a file has not its place, or the owner's address is missing."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("version")
    parser.add_argument("--date", type=datetime.date.fromisoformat, default=datetime.date.today())
    parser.add_argument("--root", type=Path, default=ROOT, help="a copy of the repository, to try it")
    given = parser.parse_args()
    if not re.fullmatch(r"\d+\.\d+\.\d+", given.version):
        sys.exit(f"the version is {given.version}, expected MAJOR.MINOR.PATCH")
    check_owner(given.root)
    for file, pattern in PLACES.items():
        replaced(file, pattern, given.version, given.root)
    dated = f'version: {given.version}\ndate-released: "{given.date}"'
    replaced("CITATION.cff", r'(?<=\n)version: \S+(\ndate-released: "\S+")?', dated, given.root)
    call = [sys.executable, "-m", "towncrier", "build", "--yes", "--version", given.version, "--date", str(given.date)]
    sys.exit(subprocess.run([*call, "--dir", str(given.root)], check=False).returncode)


if __name__ == "__main__":
    main()
