"""A diagnosis on one page: what an engineer does not know of statistics, the first sentence and the last section say without."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from push_ident import __version__
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.report.figures import draw_proposal, draw_ranking, draw_shrink, draw_where
from push_ident.diagnosis.settings import Thresholds
from push_ident.diagnosis.verdict import Diagnosis, Verdict
from push_ident.diagnosis.wording import size_of
from push_ident.pages.page import svg, write_page
from push_ident.physics.effects import EFFECTS

__all__ = ["write_report"]

_TITLES = {
    Verdict.NO_GAP: "no gap beyond noise",
    Verdict.NAMED: "the cause is named",
    Verdict.ONE_OF: "one of a few causes",
    Verdict.SEVERAL: "several causes",
    Verdict.UNKNOWN: "an unknown cause",
    Verdict.NOT_TRUSTWORTHY: "these data cannot be diagnosed",
}


def write_report(path: Path, diagnosis: Diagnosis, *, object_id: str, sources: Sequence[str], notes: Sequence[str] = ()) -> None:
    """Write the page. Raises InputError where the file cannot be written."""
    thresholds = Thresholds()
    context: dict[str, Any] = {
        "title": f"Simulation against reality, object {object_id}: {_TITLES[diagnosis.verdict]}",
        "sentence": diagnosis.sentence,
        "failed": [g for g in diagnosis.gates if not g.passed],
        "gates": diagnosis.gates,
        "trusted": diagnosis.selection is not None,
        "seen": thresholds.seen,
        "apart": thresholds.apart,
        "check": diagnosis.check,
        "provenance": [
            *(("push", source) for source in sources),
            *(("note", note) for note in notes),
            ("version", f"push_ident {__version__}, Python {platform.python_version()}"),
        ],
    }
    selection, gap = diagnosis.selection, diagnosis.gap
    if selection is not None and gap is not None and diagnosis.frames is not None:
        is_wrench = diagnosis.verdict is Verdict.UNKNOWN and diagnosis.unknown is not None
        added = ("a smooth wrench",) if is_wrench else selection.found
        context |= {
            "where": svg(draw_where(diagnosis.frames, diagnosis.where)),
            "ranking": svg(draw_ranking(selection, thresholds.seen)),
            "shrink": svg(draw_shrink(gap, added)),
            "shrink_text": _shrink_text(gap, added),
            "effects": [
                {"name": e.name, "what": EFFECTS[e.name].what, "size": size_of(e), "evidence": e.evidence} for e in diagnosis.effects
            ],
            "doubts": diagnosis.doubts,
            "what": {name: EFFECTS[name].what for name in diagnosis.confusable},
            "special_cases": selection.special_cases(thresholds.apart),
            "apart_text": "No other effect of the catalogue explains these pushes nearly as well."
            if diagnosis.effects
            else "Nothing was found that would have to be told from something else.",
            "next_push": _proposal(diagnosis),
        }
    write_page(path, __package__ or "", "report.html.j2", context)


def _shrink_text(gap: Gap, found: tuple[str, ...]) -> str:
    before, after, noise = (1e3 * float(np.mean(v)) for v in (gap.before, gap.after, gap.noise))
    if not gap.is_above_noise:
        return (
            f"Pushes held out are predicted to {before:.1f} mm. As far as these pushes can tell, that is what the noise of the poses makes "
            f"({noise:.1f} mm)."
        )
    if not found:
        return f"Pushes held out are predicted to {before:.1f} mm; noise is {noise:.1f} mm. No effect of the catalogue explains the rest."
    low, high = gap.shrink_interval
    return (
        f"Pushes held out: {before:.1f} mm without, {after:.1f} mm with {', '.join(found)}; noise is {noise:.1f} mm. "
        f"Of the gap above the noise, {100 * gap.shrink:.0f} % are gone (90 % interval {100 * low:.0f} to {100 * high:.0f} %)."
    )


def _proposal(diagnosis: Diagnosis) -> dict[str, Any] | None:
    proposal = diagnosis.next_push
    if proposal is None or proposal.push.plan is None or diagnosis.selection is None:
        return None
    plan = proposal.push.plan
    x, y = map(float, plan.contact_point)
    goal = (
        f"{{mode: 0, frame_id: table, contact_point: {{x: {x:.4f}, y: {y:.4f}}}, direction: {plan.direction:.4f}, "
        f"distance: {plan.distance:.4f}, speed: {plan.speed:.3f}}}"
    )
    return {
        "figure": svg(draw_proposal(proposal, diagnosis.selection.base.parameters.shape)),
        "aim": proposal.aim,
        "x": x,
        "y": y,
        "heading": float(np.degrees(plan.direction)),
        "distance": plan.distance,
        "speed": plan.speed,
        "verdict": "It is expected to settle it." if proposal.settles else "It will hardly settle it alone; make several.",
        "command": f'ros2 action send_goal execute_push push_ident_msgs/action/ExecutePush "{goal}"',
    }
