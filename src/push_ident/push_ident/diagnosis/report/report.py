"""A diagnosis on one page: the first sentence and the last section need no statistics."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from push_ident import __version__
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.odds import SOMETHING_ELSE
from push_ident.diagnosis.report.figures import (
    EXAGGERATION,
    account_bar,
    draw_held_out,
    draw_proposal,
    heat_of_headings,
    heat_of_pushes,
    ranking_bars,
    shrink_bars,
)  # fmt: skip
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.verdict import Verdict
from push_ident.diagnosis.wording import amplitude_of, in_mm, sentence_of_more_pushes, size_of
from push_ident.pages.page import write_page
from push_ident.physics.effects import EFFECTS

_TITLES = {
    Verdict.NO_GAP: "no gap beyond noise",
    Verdict.UNKNOWN: "an unknown cause",
    Verdict.NOT_TRUSTWORTHY: "these data cannot be diagnosed",
}


def write_report(path: Path, diagnosis: Diagnosis, *, object_id: str, sources: Sequence[str], notes: Sequence[str] = ()) -> None:
    """Write the page. Raises InputError where the file cannot be written."""
    policy = diagnosis.policy.selection
    context: dict[str, Any] = {
        "title": f"Simulation against reality, object {object_id}: {_title(diagnosis)}",
        "sentence": diagnosis.sentence,
        "failed": [g for g in diagnosis.gates if not g.passed],
        "gates": diagnosis.gates,
        "warnings": diagnosis.warnings,
        "trusted": diagnosis.selection is not None,
        "min_log_bayes_factor": policy.min_log_bayes_factor,
        "tie_margin": policy.tie_margin,
        "check": diagnosis.check,
        "provenance": [
            *(("push", source) for source in sources),
            *(("note", note) for note in notes),
            ("version", f"push_ident {__version__}, Python {platform.python_version()}"),
        ],
        **_findings(diagnosis),
    }
    write_page(path, __package__ or "", "report.html.j2", context)


def _title(diagnosis: Diagnosis) -> str:
    """The verdict; where causes are named, these with their size and what they close together."""
    account, gap, selection = diagnosis.account, diagnosis.gap, diagnosis.selection
    has_reference = selection is not None and selection.base.unknowns.shared is not None
    if diagnosis.verdict is Verdict.NO_GAP and has_reference:
        return "no change since the reference"
    law = diagnosis.free_law
    if (diagnosis.effects or law) and gap is not None:
        since = "changed since the reference, " if has_reference else ""
        causes = since + " and ".join(f"{e.name} {size_of(e)}{' by another law' if e.is_free else ''}" for e in diagnosis.effects)
        causes += f"{law.mechanism.value} {amplitude_of(law)}" if law else ""
        before, after, where = gap.before, gap.after, "at the end"
        if gap.motion is not None and np.mean(gap.motion.before - gap.motion.after) > np.mean(before - after):
            before, after, where = gap.motion.before, gap.motion.after, "over the motion"
        closes = float(np.mean(before - after))
        return f"{causes}: {'closes' if closes > 0.0 else 'of'} {in_mm(max(closes, 0.0))} of {in_mm(float(np.mean(before)))} {where}"
    if diagnosis.verdict is Verdict.NO_GAP and account is not None:
        if account.is_unexplained:
            return "nothing named, part of the error unexplained"
        if account.maps_are_open:
            return "nothing found, too few pushes to know"
    return _TITLES[diagnosis.verdict]


def _findings(diagnosis: Diagnosis) -> dict[str, Any]:
    """Figures and texts of all sections; nothing where the diagnosis abstains."""
    selection, gap, frames, account = diagnosis.selection, diagnosis.gap, diagnosis.base_residuals, diagnosis.account
    if selection is None or gap is None or frames is None or account is None:
        return {}
    policy = diagnosis.policy.selection
    added = selection.selected or tuple(name.replace("_", " ") for name in gap.names)
    no_rival = "No other effect of the catalogue explains these pushes nearly as well."
    return {
        "account": account_bar(account),
        "more_pushes": sentence_of_more_pushes(account, None).strip(),
        "heat_of_pushes": heat_of_pushes(diagnosis.where["push"]),
        "heat_of_headings": heat_of_headings(frames),
        "held_out": [] if gap.motion is None else draw_held_out(gap.motion),
        "subsystems": _likely_parts(diagnosis),
        "exaggeration": EXAGGERATION,
        "ranking": ranking_bars(selection, policy.min_log_bayes_factor),
        "shrink": shrink_bars(gap, added),
        "shrink_text": _shrink_text(gap, added),
        "motion_text": _motion_text(gap, selection.selected),
        "effects": [
            {"name": e.name, "what": EFFECTS[e.name].what, "size": size_of(e), "log_bayes_factor": e.log_bayes_factor}
            for e in diagnosis.effects
        ]
        + _free_law(diagnosis),
        "confusion_sets": diagnosis.confusion_sets,
        "what": {name: EFFECTS[name].what if name in EFFECTS else _what(name) for name in diagnosis.confusion_set},
        "probabilities": _probable(diagnosis),
        "pattern": diagnosis.pattern,
        "patterns": _patterns(diagnosis),
        "special_cases": selection.special_cases(policy.tie_margin),
        "no_rival_text": no_rival if diagnosis.effects else "No effect was found, so that there is nothing to distinguish it from.",
        "next_push": _proposal(diagnosis),
    }


def _free_law(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    law, words = diagnosis.free_law, diagnosis.pattern
    if law is None or words is None:
        return []
    what = f"{words.what}, {words.where}"
    size = {"size": amplitude_of(law), "log_bayes_factor": law.log_bayes_factor}
    return [{"name": law.mechanism.value, "what": f"{what[0].upper()}{what[1:]}.", **size}]


def _likely_parts(diagnosis: Diagnosis) -> str:
    """Parts of the cell where something probably acts, the most probable first."""
    probabilities = diagnosis.probabilities
    if probabilities is None:
        return ""
    parts = sorted(probabilities.subsystems.items(), key=lambda item: -item[1])
    return ", ".join(f"{part.value} {value:.2f}" for part, value in parts if value >= 0.005)


def _what(cause: str) -> str:
    """Of a cause that is no effect."""
    return "A cause outside the catalogue." if cause == SOMETHING_ELSE else "By no formula of the catalogue, but by a smooth law."


def _probable(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Causes with their probability, the largest first."""
    probabilities = diagnosis.probabilities
    if probabilities is None:
        return []
    named = {"nothing": ("nothing beyond the base model", ""), SOMETHING_ELSE: ("something else", "A cause outside the catalogue.")}
    named |= {name: (name, effect.what) for name, effect in EFFECTS.items()}
    laws = {name: value for name, value in probabilities.free.items() if name not in EFFECTS}
    named |= {name: (f"{name}, free law", _what(name)) for name in laws}
    values = {"nothing": probabilities.nothing, SOMETHING_ELSE: probabilities.something_else, **probabilities.effects, **laws}
    return [
        {"name": named[name][0], "what": named[name][1], "value": value}
        for name, value in sorted(values.items(), key=lambda item: -item[1])
        if value >= 0.005  # 1 % as it is printed
    ]


def _patterns(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """The most probable structures outside the catalogue."""
    something_else = diagnosis.something_else
    if something_else is None:
        return []
    return [
        {"acts_on": p.family.acts_on.value, "varies_with": p.family.varies_with.value, "evidence": p.log_bayes_factor, "share": p.share}
        for p in something_else.patterns[:4]
    ]


def _shrink_text(gap: Gap, selected: tuple[str, ...]) -> str:
    before, after, noise = (1e3 * float(np.mean(v)) for v in (gap.before, gap.after, gap.noise))
    error = f"The mean error on held-out pushes is {before:.1f} mm"
    if not gap.is_above_noise:
        return f"{error}. It does not differ significantly from the {noise:.1f} mm that the noise of the poses causes."
    if not selected:
        return f"{error}; the noise of the poses causes {noise:.1f} mm. No effect of the catalogue explains the difference."
    low, high = gap.shrink_interval
    return (
        f"{error} without and {after:.1f} mm with {', '.join(selected)}; the noise of the poses causes {noise:.1f} mm. Of the gap above "
        f"the noise, {100 * gap.shrink:.0f} % is closed (90 % interval {100 * low:.0f} to {100 * high:.0f} %)."
    )


def _motion_text(gap: Gap, selected: tuple[str, ...]) -> str:
    """The gap over the whole motion."""
    motion = gap.motion
    if motion is None or (gap.names and not selected):  # patterns are known at the ends only
        return ""
    before, after, noise = (in_mm(float(np.mean(values))) for values in (motion.before, motion.after, motion.noise))
    with_them = f" and {after} with {', '.join(selected)}" if selected else ""
    return f"Over the whole motion, root mean square over the frames: {before} without{with_them}; the noise of the poses causes {noise}."


def _proposal(diagnosis: Diagnosis) -> dict[str, Any] | None:
    proposal = diagnosis.next_push
    if proposal is None or proposal.plan is None or diagnosis.selection is None:
        return None
    plan = proposal.plan
    x, y = map(float, plan.contact_point)
    return {
        "figure": draw_proposal(proposal, diagnosis.selection.base.unknowns.shape),
        "x": x,
        "y": y,
        "heading": float(np.degrees(plan.direction)),
        "distance": plan.distance,
        "speed": plan.speed,
        "command": (
            f"push-ident push --at={x:.4f},{y:.4f} --direction={plan.direction:.4f} --distance {plan.distance:.4f} --speed {plan.speed:.3f}"
        ),
    }
