"""A diagnosis as the command-line contract has it."""

from __future__ import annotations

from typing import Any

import numpy as np

from push_ident.diagnosis.verdict import Diagnosis
from push_ident.physics.effects import EFFECTS

__all__ = ["to_json"]


def to_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """The outcome; lengths in metres, angles in radians."""
    gap, selection, proposal = diagnosis.gap, diagnosis.selection, diagnosis.next_push
    first = selection.steps[0] if selection and selection.steps else None
    refitted = {c.name: c for c in first.candidates} if first else {}
    nan = float("nan")
    return {
        "verdict": diagnosis.verdict.value,
        "sentence": diagnosis.sentence,
        "effects": [{"name": e.name, "parameters": e.parameters, "std": e.std, "evidence": e.evidence} for e in diagnosis.effects],
        "confusable": list(diagnosis.confusable),
        "gap": {
            "before_m": float(np.mean(gap.before)) if gap else nan,
            "after_m": float(np.mean(gap.after)) if gap else nan,
            "noise_m": float(np.mean(gap.noise)) if gap else nan,
            "shrink": gap.shrink if gap else nan,
            "shrink_interval": list(gap.shrink_interval) if gap else [nan, nan],
            "before_per_push_m": gap.before.tolist() if gap else [],
            "after_per_push_m": gap.after.tolist() if gap else [],
            "stages": [{"effects": names.split(", "), "after_m": float(np.mean(errors))} for names, errors in gap.stages.items()]
            if gap
            else [],
        },
        "where": {
            by: [
                {
                    "name": g.name,
                    "n": g.n,
                    "along": g.rms[0],
                    "across": g.rms[1],
                    "rotation": g.rms[2],
                    "mean_m": g.mean_m,
                    "by_chance": dict(zip(("along", "across", "rotation"), g.by_chance, strict=True)),
                }
                for g in groups
            ]
            for by, groups in diagnosis.where.items()
        },
        "ranking": [
            {
                "name": score.name,
                "evidence": refitted[score.name].gain if score.name in refitted else score.gain,
                "refitted": score.name in refitted,
                "smallest": score.smallest,
                "unit": EFFECTS[score.name].parameters[0].unit,
            }
            for score in (first.scores if first else ())
        ],
        "next_push": None
        if proposal is None or proposal.push.plan is None
        else {
            "contact_point_m": proposal.push.plan.contact_point.tolist(),
            "direction_rad": float(proposal.push.plan.direction),
            "distance_m": proposal.push.plan.distance,
            "speed_mps": proposal.push.plan.speed,
            "frame": "table",
            "pose_object_in_table": proposal.push.pose_object_in_table.tolist(),
            "between": list(proposal.between),
            "distance2": proposal.distance2,
        },
        "check": diagnosis.check,
        "unknown": None
        if diagnosis.unknown is None
        else {
            "evidence": diagnosis.unknown.gain,
            "acts_on": diagnosis.unknown.acts_on,
            "varies_with": diagnosis.unknown.varies_with,
        },
        "gates": [{"passed": g.passed, "found": g.found, "remedy": g.remedy} for g in diagnosis.gates],
    }
