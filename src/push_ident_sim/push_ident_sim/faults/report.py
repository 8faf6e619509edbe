"""The table of the suite: as JSON, and as a page of the site."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from push_ident.errors import PushIdentError
from push_ident.files import write_whole
from push_ident_sim.faults.run import FaultResult
from push_ident_sim.studies.common.files import read_json, write_json

__all__ = ["result_json", "write_page", "write_results"]

_HEAD: Final = """# Faults

Made by `make faults` (`push-ident faults --json {json}`). Each row is one fault, injected from outside into live nodes in processes of
their own: by signals, by a proxy between the nodes, by the file system. A fault that is tried again alone (`--only`) replaces its row.
The arm is simulated; its time to stop is read from its joint states. {date}

**Time to hold**: from the fault to the standing arm, by the arm's own clock. Allowed are the time that the suite is given to notice the
fault, 100 ms, the braking from the joint speed at the fault at {braking:g} rad/s², two joint states (20 ms), and what this machine made
the suite wait meanwhile.

After every fault it is also checked that no motion is commanded after the hold, that no push that was acknowledged is lost and none
learned that was not whole, that masses are not negative and covariances positive semi-definite, that no log holds a traceback, and that
every process that should run still does.
"""


def result_json(results: Sequence[FaultResult]) -> dict[str, Any]:
    """All results as JSON: times in seconds."""
    return _summary([_row(result) for result in results])


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    count = {word: sum(row["result"] == word for row in rows) for word in ("passed", "failed", "skipped")}
    return {
        "machine": {"processor": _processor(), "cores": os.cpu_count(), "python": platform.python_version(), "load": os.getloadavg()[0]},
        "time_s": round(sum(row["seconds"] for row in rows), 1),
        **count,
        "faults": rows,
    }


def _row(result: FaultResult) -> dict[str, Any]:
    fault, hold = result.fault, result.hold
    return {
        "number": fault.number,
        "name": fault.name,
        "fault": fault.what,
        "holds": fault.holds,
        "expected": fault.expected,
        "result": "failed" if result.failures else "skipped" if result.impossible else "passed",
        "reasons": list(result.failures) or ([result.impossible] if result.impossible else []),
        "time_to_hold_s": None if hold is None or hold.seconds is None else round(hold.seconds, 3),
        "allowed_s": None if hold is None else round(hold.allowed, 3),
        "lost": result.lost,
        "note": result.note,
        "seconds": round(result.seconds, 1),
    }


def write_results(path: Path, content: dict[str, Any]) -> list[Path]:
    """Write the JSON, and the page beside it; rows of an existing file whose faults were not tried now stay.

    Raises PushIdentError where they cannot be written.
    """
    rows = {row["number"]: row for row in read_json(path)["faults"]} if path.is_file() else {}
    # Of a fault that was tried several times, a failure counts.
    rows |= {row["number"]: row for row in sorted(content["faults"], key=lambda row: bool(row["result"] == "failed"))}
    write_json(path, _summary([rows[number] for number in sorted(rows)]))
    return [path, write_page(path)]


def write_page(path: Path) -> Path:
    """Write the page (Markdown) of a file that `write_results` wrote, beside it; the page."""
    from push_ident_sim.faults.harness.hold import BRAKING

    content, page = read_json(path), path.with_suffix(".md")
    machine = content["machine"]
    date = (
        f"{content['passed']} held, {content['failed']} did not, {content['skipped']} could not be injected; "
        f"{content['time_s'] / 60:.0f} minutes on {machine['processor']}, {machine['cores']} cores."
    )
    parts = [_HEAD.format(json=path, braking=BRAKING, date=date), _table(content["faults"])]
    open_ones = [row for row in content["faults"] if row["result"] != "passed"]
    if open_ones:
        parts.append("## What did not hold, or was not injected\n")
        parts += [f"- **{row['number']} {row['name']}** ({row['result']}): {_escaped('; '.join(row['reasons']))}" for row in open_ones]
    try:
        write_whole(page, "\n".join(parts) + "\n", "the page")
    except OSError as error:
        raise PushIdentError(f"Cannot write {page}: {error.strerror}; choose a folder with write permission.") from None
    return page


def _table(rows: Sequence[dict[str, Any]]) -> str:
    lines = ["| # | fault | what holds it | time to hold | lost | result |", "|---|---|---|---|---|---|"]
    for row in rows:
        cells = (str(row["number"]), row["fault"], f"{row['holds']}: {row['expected']}", _time(row), row["lost"], row["result"])
        lines.append("| " + " | ".join(_escaped(cell) for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _time(row: dict[str, Any]) -> str:
    if row["allowed_s"] is None:
        return "–"
    took = "never" if row["time_to_hold_s"] is None else f"{1e3 * row['time_to_hold_s']:.0f} ms"
    return f"{took} of {1e3 * row['allowed_s']:.0f} ms"


def _escaped(text: str) -> str:
    """Text of nodes and messages in a cell of a table."""
    for mark, safe in (("\\", "\\\\"), ("|", "\\|"), ("<", "&lt;"), ("\n", " "), ("*", "\\*"), ("_", "\\_"), ("[", "\\["), ("`", "\\`")):
        text = text.replace(mark, safe)
    return text


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or "unknown"
