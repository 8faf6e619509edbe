"""The table of the suite: as JSON, and as a page of the site."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from system.faults.hold import BRAKING
from system.faults.suite import Fault, Trial

from push_ident_sim.workers import describe_machine

HEAD = """# Faults

`make faults` injects each fault into live nodes: by signals, by a proxy between them, by the file system; `pytest test/system/faults -k
NAME` tries one. The arm is simulated. {summary}

**Time to hold**: from the fault to the standing arm, by the arm's clock; of several trials the longest. Allowed are the time to notice the
fault, 100 ms, the braking from the joint speed at the fault at {braking:g} rad/s², two joint states (20 ms), and what this machine made the
suite wait meanwhile.

After every fault: no motion is commanded after the hold; no command breaks a limit of velocity or acceleration of a joint; no
acknowledged push is lost, at most the one under way, and none learned that was not whole; masses are not negative and covariances positive
semi-definite; no log holds a traceback; every process that should run does. Faults of one node alone are in its tests.

"""


class Results:
    """Rows as they are made; written to `path` at the end, where there is one. Rows that were not tried now stay as they were."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._rows: dict[int, dict[str, Any]] = {}
        self._trial: Trial | None = None

    def failed(self, row: Fault) -> bool:
        return bool(self._rows[row.number]["result"] == "failed")

    def begin(self, trial: Trial) -> None:
        self._trial = trial

    def take(self, row: Fault, report: pytest.TestReport, call: pytest.CallInfo[None]) -> None:
        """The outcome of a part of a test: set-up, call, and the oracles after it."""
        content = self._rows.setdefault(row.number, _row(row)) if report.when == "setup" else self._rows[row.number]
        content["seconds"] = round(content["seconds"] + report.duration, 1)
        if call.excinfo is not None:
            content["result"] = "skipped" if report.skipped else "failed"
            content["reasons"].append(call.excinfo.exconly().partition("\n")[0].removeprefix("AssertionError: "))
        if (trial := self._trial) is not None and trial.fault is row:
            content["note"] = trial.note
            if trial.holds:
                worst = max(trial.holds, key=lambda hold: hold.seconds)
                content["time_to_hold_s"], content["allowed_s"] = round(worst.seconds, 3), round(worst.allowed, 3)

    def write(self) -> None:
        if self._path is None:
            return
        before = json.loads(self._path.read_text(encoding="utf-8"))["faults"] if self._path.is_file() else []
        rows = {row["number"]: row for row in before} | self._rows
        content = _summary([rows[number] for number in sorted(rows)])
        self._path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        self._path.with_suffix(".md").write_text(_page(content), encoding="utf-8")


def _row(row: Fault) -> dict[str, Any]:
    return {
        "number": row.number,
        "name": row.name,
        "fault": row.what,
        "expected": row.expected,
        "result": "passed",
        "reasons": [],
        "time_to_hold_s": None,
        "allowed_s": None,
        "note": "",
        "seconds": 0.0,
    }


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    count = {word: sum(row["result"] == word for row in rows) for word in ("passed", "failed", "skipped")}
    return {"machine": describe_machine(1), "time_s": round(sum(row["seconds"] for row in rows), 1), **count, "faults": rows}


def _page(content: dict[str, Any]) -> str:
    machine, rows = content["machine"], content["faults"]
    summary = (
        f"{content['passed']} held, {content['failed']} did not, {content['skipped']} could not be injected; "
        f"{content['time_s'] / 60:.0f} minutes on {machine['processor']}, {machine['cores']} cores."
    )
    lines = ["row | fault | expected | time to hold [ms]", "---|---|---|---"]
    for row in rows:
        cells = (str(row["number"]), row["fault"], row["expected"], _time(row))
        lines.append(" | ".join(_escaped(cell) for cell in cells))
    if failed := [row for row in rows if row["result"] != "passed"]:
        lines += ["", "## What did not hold, or was not injected", ""]
        lines += [f"- **{row['number']} {row['name']}** ({row['result']}): {_escaped('; '.join(row['reasons']))}" for row in failed]
    return HEAD.format(summary=summary, braking=BRAKING) + "\n".join(lines) + "\n"


def _time(row: dict[str, Any]) -> str:
    return "–" if row["time_to_hold_s"] is None else f"{1e3 * row['time_to_hold_s']:.0f} of {1e3 * row['allowed_s']:.0f}"


def _escaped(text: str) -> str:
    for mark, safe in (("\\", "\\\\"), ("|", "\\|"), ("<", "&lt;"), ("\n", " "), ("*", "\\*"), ("_", "\\_"), ("[", "\\["), ("`", "\\`")):
        text = text.replace(mark, safe)
    return text
