"""A diagnosis as JSON, with the keys of the command-line contract."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from push_ident.diagnosis.account import Account
from push_ident.diagnosis.fits import BASE_WITH_FORCES
from push_ident.diagnosis.held_out import Gap
from push_ident.diagnosis.next_push import SeparatingPush
from push_ident.diagnosis.odds import SOMETHING_ELSE
from push_ident.diagnosis.residuals import ResidualGroup
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.shares import Closed, closed_by_cause
from push_ident.diagnosis.something_else.evidence import SomethingElse
from push_ident.diagnosis.verdict import FoundEffect, FreeLaw
from push_ident.identification.predicting.next_push import PlannedPush
from push_ident.physics.effects import EFFECTS

Json = dict[str, Any]
_PARTS = {"noise_m": "noise", "maps_m": "maps", "model_m": "model", "unexplained_m": "unexplained"}
"""Keys of the parts of an account that every diagnosis has."""
_AXES = ("along", "across", "rotation")


def to_json(diagnosis: Diagnosis) -> Json:
    """The outcome; lengths in metres, angles in radians."""
    # Of effects and something else that they act, alone or beside others.
    p = diagnosis.probabilities
    return {
        "verdict": diagnosis.verdict.value,
        "sentence": diagnosis.sentence,
        "effects": [*map(_effect, diagnosis.effects), *([_free_law(diagnosis.free_law)] if diagnosis.free_law else [])],
        "confusable": list(diagnosis.confusion_set),
        "gap": _gap(diagnosis.gap),
        "causes": _causes(diagnosis),
        "shared_with_reference": _shared(diagnosis.selection),
        "remainder": _remainder(diagnosis.gap),
        "account": _account(diagnosis.account, diagnosis.first_push),
        "where": {by: [_group(group) for group in groups] for by, groups in diagnosis.where.items()},
        "ranking": _ranking(diagnosis.selection),
        "next_push": _next_push(diagnosis.next_push),
        "check": diagnosis.check,
        "unknown": _unknown(diagnosis.something_else),
        "probabilities": p and {**p.effects, SOMETHING_ELSE: p.something_else, "nothing": p.nothing},
        "mechanisms": p and dict(p.mechanisms),
        "subsystems": p and {part.value: value for part, value in p.subsystems.items()},
        "something_else": _something_else(diagnosis),
        "gates": [{"passed": g.passed, "found": g.finding, "remedy": g.remedy} for g in diagnosis.gates],
    }


def _effect(e: FoundEffect) -> Json:
    law = "free" if e.is_free else e.name
    return {
        "name": e.name, "mechanism": EFFECTS[e.name].mechanism, "law": law, "parameters": e.parameters, "std": e.std,
        "evidence": e.log_bayes_factor,
    }  # fmt: skip


def _free_law(law: FreeLaw) -> Json:
    """As an effect whose name is that of its mechanism."""
    name = law.mechanism.value
    return {
        "name": name, "mechanism": name, "law": "free", "parameters": {"largest": law.largest}, "std": {"largest": law.std},
        "evidence": law.log_bayes_factor,
    }  # fmt: skip


def _unknown(something_else: SomethingElse | None) -> Json | None:
    """Shares of what acts and of what it follows, if there is something else."""
    if something_else is None:
        return None
    shares: Json = {"acts_on": {}, "varies_with": {}}
    for pattern in something_else.patterns:
        for by, of in shares.items():
            value = getattr(pattern.family, by).value
            of[value] = of.get(value, 0.0) + pattern.share
    return {"evidence": something_else.log_bayes_factor, **shares}


def _something_else(diagnosis: Diagnosis) -> Json | None:
    something_else, words, probabilities = diagnosis.something_else, diagnosis.pattern, diagnosis.probabilities
    if something_else is None or words is None or probabilities is None:
        return None
    return {
        "probability": probabilities.something_else,
        "evidence": something_else.log_bayes_factor,
        "p_value": something_else.p_value,
        "what": words.what,
        "where": words.where,
        "look_for": words.look_for,
        "patterns": [
            {
                "acts_on": pattern.family.acts_on.value,
                "varies_with": pattern.family.varies_with.value,
                "at": list(pattern.member.key) if isinstance(pattern.member.key, tuple) else pattern.member.key,
                "evidence": pattern.log_bayes_factor,
                "share": pattern.share,
            }
            for pattern in something_else.patterns
        ],
    }


def _gap(gap: Gap | None) -> Json:
    """Not a number, rather than a plausible number, where the diagnosis abstains."""
    if gap is None:
        nan = float("nan")
        lengths = dict.fromkeys(("before_m", "after_m", "noise_m", "shrink"), nan)
        return {**lengths, "shrink_interval": [nan, nan], "before_per_push_m": [], "after_per_push_m": [], "stages": [], "motion": None}
    return {
        "before_m": float(np.mean(gap.before)),
        "after_m": float(np.mean(gap.after)),
        "noise_m": float(np.mean(gap.noise)),
        "shrink": gap.shrink,
        "shrink_interval": list(gap.shrink_interval),
        "before_per_push_m": gap.before.tolist(),
        "after_per_push_m": gap.after.tolist(),
        "stages": [{"effects": names.split(", "), "after_m": float(np.mean(errors))} for names, errors in gap.stages.items()],
        "motion": gap.motion
        and {
            "before_m": float(np.mean(gap.motion.before)),
            "after_m": float(np.mean(gap.motion.after)),
            "noise_m": float(np.mean(gap.motion.noise)),
            "before_per_push_m": gap.motion.before.tolist(),
            "after_per_push_m": gap.motion.after.tolist(),
        },
    }


def _shared(selection: Selection | None) -> list[str] | None:
    """Effects that pushes of a reference have, too; None without a reference."""
    shared = None if selection is None else selection.base.unknowns.shared
    return None if shared is None else [name for name in shared.names if name not in BASE_WITH_FORCES]


def _causes(diagnosis: Diagnosis) -> list[Json]:
    """What each named cause closes of the error on held-out pushes."""
    if diagnosis.gap is None or not (diagnosis.effects or diagnosis.free_law):
        return []
    return [
        {
            "names": list(cause.names),
            "at_end": _closed(cause.at_end),
            "over_motion": None if cause.over_motion is None else _closed(cause.over_motion),
        }
        # What a free law changes is known at the ends of the pushes.
        for cause in closed_by_cause(replace(diagnosis.gap, motion=None) if diagnosis.free_law else diagnosis.gap)
    ]


def _closed(closed: Closed) -> Json:
    return {"closes_m": closed.mean, "interval_m": list(closed.interval), "share": closed.share}


def _remainder(gap: Gap | None) -> Json | None:
    """Error on held-out pushes that remains beside all named causes, and the part of it that noise makes."""
    if gap is None:
        return None
    motion = gap.motion
    over_motion = motion and {"error_m": float(np.mean(motion.after)), "noise_m": float(np.mean(motion.noise))}
    return {"at_end": {"error_m": float(np.mean(gap.after)), "noise_m": float(np.mean(gap.noise))}, "over_motion": over_motion}


def _account(account: Account | None, first_push: PlannedPush | None) -> Json:
    """Parts of the error on held-out pushes, which add up to `before_m` of the gap."""
    if account is None:
        nan = float("nan")
        parts, intervals = dict.fromkeys(_PARTS, nan), {key: [nan, nan] for key in _PARTS}
        nothing: Json = {"per_push_m": {}, "more_pushes": None, "first_push": None}
        return {**parts, "effects": {}, "intervals": {**intervals, "effects": {}}, **nothing}
    means = {part.name: part.mean for part in account.parts}
    intervals = {part.name: list(part.interval) for part in account.parts}
    effects = [part.name for part in account.effects]
    return {
        **{key: means[name] for key, name in _PARTS.items()},
        "effects": {name: means[name] for name in effects},
        "intervals": {**{key: intervals[name] for key, name in _PARTS.items()}, "effects": {name: intervals[name] for name in effects}},
        "per_push_m": {name: values.tolist() for name, values in account.per_push.items()},
        "more_pushes": account.more_pushes,
        "first_push": None if first_push is None else _push(first_push),
    }


def _group(group: ResidualGroup) -> Json:
    rms = dict(zip(_AXES, group.rms, strict=True))
    return {"name": group.name, "n": group.n, **rms, "mean_m": group.mean_m, "by_chance": dict(zip(_AXES, group.p_value, strict=True))}


def _ranking(selection: Selection | None) -> list[Json]:
    """All effects of the first step by their score, with the log Bayes factor of those that were refitted."""
    if selection is None or not selection.steps:
        return []
    first = selection.steps[0]
    refitted = {c.name: c.log_bayes_factor for c in first.candidates}
    return [
        {
            "name": score.name,
            "evidence": refitted.get(score.name, score.expected_log_bayes_factor),
            "refitted": score.name in refitted,
            "smallest": selection.smallest_detectable[score.name],
            "unit": EFFECTS[score.name].parameters[0].unit,
        }
        for score in first.scores
    ]


def _next_push(proposal: SeparatingPush | None) -> Json | None:
    if proposal is None or proposal.push.plan is None:
        return None
    return {**_push(proposal.push), "between": list(proposal.between), "distance2": proposal.mahalanobis2}


def _push(push: PlannedPush) -> Json:
    plan = push.plan
    assert plan is not None, "only planned pushes are proposed"
    return {
        "contact_point_m": plan.contact_point.tolist(),
        "direction_rad": float(plan.direction),
        "distance_m": plan.distance,
        "speed_mps": plan.speed,
        "frame": "table",
        "pose_object_in_table": push.pose_object_in_table.tolist(),
    }
