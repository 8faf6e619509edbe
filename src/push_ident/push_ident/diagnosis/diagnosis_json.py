"""A diagnosis as JSON, with the keys of the command-line contract."""

from __future__ import annotations

from typing import Any

import numpy as np

from push_ident.diagnosis.account import Account
from push_ident.diagnosis.fits import BASE_WITH_FORCES
from push_ident.diagnosis.held_out import Gap, MotionGap
from push_ident.diagnosis.odds import SOMETHING_ELSE
from push_ident.diagnosis.residuals import ResidualGroup
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.shares import closed_by_cause
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
        "effects": _effects(diagnosis),
        "confusable": list(diagnosis.confusion_set),
        "gap": _gap(diagnosis.gap),
        "causes": _causes(diagnosis),
        "shared_with_reference": _shared(diagnosis.selection),
        "remainder_m": _remainder_m(diagnosis.gap),
        "motion": diagnosis.gap and diagnosis.gap.motion and _motion(diagnosis.gap.motion),
        "account": _account(diagnosis.account),
        "where": {by: [_group(group) for group in groups] for by, groups in diagnosis.where.items()},
        "ranking": _ranking(diagnosis.selection),
        "next_push": None if diagnosis.next_push is None else _push(diagnosis.next_push),
        "check": diagnosis.check,
        "unknown": _unknown(diagnosis.something_else),
        "probabilities": p and {**p.effects, SOMETHING_ELSE: p.something_else, "nothing": p.nothing},
        "mechanisms": p and dict(p.mechanisms),
        "subsystems": p and {part.value: value for part, value in p.subsystems.items()},
        "something_else": _something_else(diagnosis),
        "simulator": diagnosis.simulator and diagnosis.simulator.as_json(),
        "warnings": list(diagnosis.warnings),
        "gates": [{"passed": g.passed, "found": g.finding, "remedy": g.remedy} for g in diagnosis.gates],
    }


def _effects(diagnosis: Diagnosis) -> list[Json]:
    return [*map(_effect, diagnosis.effects), *([_free_law(diagnosis.free_law)] if diagnosis.free_law else [])]


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
        return {**lengths, "shrink_interval": [nan, nan], "before_per_push_m": [], "after_per_push_m": [], "stages": []}
    return {
        "before_m": float(np.mean(gap.before)),
        "after_m": float(np.mean(gap.after)),
        "noise_m": float(np.mean(gap.noise)),
        "shrink": gap.shrink,
        "shrink_interval": list(gap.shrink_interval),
        "before_per_push_m": gap.before.tolist(),
        "after_per_push_m": gap.after.tolist(),
        "stages": [{"effects": names.split(", "), "after_m": float(np.mean(errors))} for names, errors in gap.stages.items()],
    }


def _motion(motion: MotionGap) -> Json:
    """The gap over the whole motion: root mean square over the frames."""
    return {
        "before_m": float(np.mean(motion.before)),
        "after_m": float(np.mean(motion.after)),
        "noise_m": float(np.mean(motion.noise)),
        "before_per_push_m": motion.before.tolist(),
        "after_per_push_m": motion.after.tolist(),
    }


def _shared(selection: Selection | None) -> list[str] | None:
    """Effects that pushes of a reference have, too; None without a reference."""
    shared = None if selection is None else selection.base.unknowns.shared
    return None if shared is None else [name for name in shared.names if name not in BASE_WITH_FORCES]


def _causes(diagnosis: Diagnosis) -> list[Json]:
    """Each named cause with what it closes of the error on held-out pushes; of several that were added together, what they close."""
    if diagnosis.gap is None:
        return []
    closed = {name: one for one in closed_by_cause(diagnosis.gap) for name in one.names}
    causes = []
    for effect in _effects(diagnosis):
        at_end, over_motion = closed[effect["name"]].at_end, closed[effect["name"]].over_motion
        # What a free law changes is known at the ends of the pushes.
        of_motion = None if over_motion is None or diagnosis.free_law else over_motion.mean
        causes.append(
            {
                **{key: effect[key] for key in ("name", "mechanism", "law", "parameters", "std")},
                "closes_m": at_end.mean,
                "interval": list(at_end.interval),
                "share": at_end.share,
                "closes_over_motion_m": of_motion,
                "together_with": [name for name in closed[effect["name"]].names if name != effect["name"]],
            }
        )
    return causes


def _remainder_m(gap: Gap | None) -> float | None:
    """Error on held-out pushes beside all named causes, without what the noise of the poses makes [m]."""
    return None if gap is None else float(np.mean(gap.after - gap.noise))


def _account(account: Account | None) -> Json:
    """Parts of the error on held-out pushes, which add up to `before_m` of the gap."""
    if account is None:
        nan = float("nan")
        parts, intervals = dict.fromkeys(_PARTS, nan), {key: [nan, nan] for key in _PARTS}
        nothing: Json = {"per_push_m": {}, "more_pushes": None}
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
