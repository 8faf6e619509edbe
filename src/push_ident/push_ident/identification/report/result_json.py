"""The outcome of an identification as JSON, in the form of the command-line contract."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from push_ident.identification.predicting.prediction import PushErrors
from push_ident.identification.results.identifiability import Identifiability, Support, identifiability, supports
from push_ident.identification.results.result import Candidate, Identification


def result_json(result: Identification, object_id: str, train: PushErrors, test: PushErrors, notes: Sequence[str] = ()) -> dict[str, Any]:
    """The outcome in the form of the command-line contract.

    `train`: errors of the pushes of the fit; `test`: of the others, which are held out; `notes`: what was missing, dropped or assumed.
    """
    posterior, model = result.posterior, result.model
    x, y = model.shape.cells.centres.T
    return {
        "method": result.method,
        "object_id": object_id,
        "n_cells": len(model.mass),
        "n_simulations": result.n_simulations,
        "time_s": result.time_s,
        "train": _errors(train),
        "test": _errors(test),
        "map": {
            "x": x.tolist(),
            "y": y.tolist(),
            "area": model.shape.cells.areas.tolist(),
            "mass": model.mass.tolist(),
            "friction": model.friction.tolist(),
            "mass_friction": (model.mass * model.friction).tolist(),
            "mass_friction_std": posterior.mass_friction_std.tolist(),
        },
        "centre_of_friction_m": model.centre_of_friction.tolist(),
        "pusher_friction": {"value": posterior.pusher_friction.value, "std": posterior.pusher_friction.std},
        "total_mass": {
            "value": posterior.total_mass.value,
            "std": posterior.total_mass.std,
            "identifiable": posterior.total_mass_identifiable,
        },
        "knowledge": knowledge_json(identifiability(posterior)),
        "priors": [_candidate(candidate) for candidate in result.candidates],
        "pose_noise_factor": posterior.pose_noise_factor,
        "misfit": result.reduced_chi2,
        "status": result.status.name.lower(),
        "notes": [*notes, *result.notes],
        "warnings": list(result.warnings),
    }


def _candidate(candidate: Candidate) -> dict[str, Any]:
    return {
        "name": candidate.name,
        "log_evidence": candidate.log_evidence,
        "probability": candidate.probability,
        "maps": None if candidate.maps is None else asdict(candidate.maps),
        "feet": None if candidate.on_feet is None else [_support(support) for support in supports(candidate.on_feet)],
    }


def _support(support: Support) -> dict[str, Any]:
    return {
        "place_m": support.position.tolist(),
        "place_std_m": support.position_std.tolist(),
        "share": support.share,
        "share_std": support.share_std,
    }


def knowledge_json(known: Identifiability, n_shown: int = 4) -> dict[str, Any]:
    """Identifiability: named quantities, and the combinations of all cells, the best determined first, `n_shown` of them cell by cell."""
    return {
        "quantities": [
            {"name": q.name, "unit": q.unit, "value": q.value, "std": q.std, "prior_std": q.prior_std, "verdict": q.knowledge.name.lower()}
            for q in known.quantities
        ],
        "combinations": {
            "pinned": known.n_pinned,
            "open": known.n_open,
            "all": len(known.combinations),
            "share_left": [c.std_ratio for c in known.combinations],
            "best_known": [
                {"share_left": c.std_ratio, "log_mass": c.log_mass.tolist(), "log_friction": c.log_friction.tolist()}
                for c in known.combinations[:n_shown]
            ],
        },
    }


def _errors(errors: PushErrors) -> dict[str, Any]:
    per_model = {"uniform": errors.uniform, "scalar": errors.scalar, "identified": errors.identified}
    mean = {f"{name}_m": float(np.mean(values)) if len(values) else float("nan") for name, values in per_model.items()}
    return {"pushes": list(errors.pushes), **mean, "per_push_m": errors.identified.tolist()}
