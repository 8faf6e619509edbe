"""The seal of a blind check: truth, decision policy and code are fixed before anything is scored."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Final

import push_ident
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident_sim.code_digest import code_digest
from push_ident_sim.recordings.recording import seal
from push_ident_sim.studies.blind.cases import draw_truth, phase_of
from push_ident_sim.studies.common.study import Case, Json

__all__ = ["CAMERA", "DECIDING_PACKAGES", "ENGINES", "decision_hashes", "seal_cases"]

CAMERA: Final = "camera"
"""Variant through rendered depth images and perception."""
ENGINES: Final = "engines"
"""Variant that compares the engines; it has no truth to be sealed."""
DECIDING_PACKAGES: Final = ("geometry", "physics", "pushing", "identification", "diagnosis", "perception")
"""Packages of the core whose code decides what a diagnosis reports."""


def decision_hashes() -> dict[str, str]:
    """SHA-256 of the values of the default policy, and of the code that decides (without comments and docstrings), hexadecimal."""
    return {"policy_sha256": DiagnosisSettings().policy.sha256, "code_sha256": _code_sha256()}


@cache
def _code_sha256() -> str:
    core = Path(push_ident.__file__).parent
    return code_digest({path for package in DECIDING_PACKAGES for path in (core / package).rglob("*.py")})


def seal_cases(cases: Sequence[Case], folder: Path) -> Json:
    """Write the hashes of truth, policy and code before anything is scored.

    A report set is scored by one policy and one code only: once its seal lies in `folder`, others are refused. Raises InputError for that,
    and for cases of both phases in one run.
    """
    phases = {phase_of(case.model) for case in cases}
    if len(phases) > 1:
        raise InputError("Seeds below 1000 are for setting the policy, those from 1000 on are scored once; give --seed to separate them.")
    truths = [_truth_of(case) for case in cases if case.variant != ENGINES]
    sealed: Json = {
        "phase": phases.pop(),
        "n_cases": len(truths),
        "truth_sha256": seal({"cases": truths}),
        # As it is read back from the file.
        "policy": json.loads(json.dumps(asdict(DiagnosisSettings().policy))),
        **decision_hashes(),
    }
    if sealed["phase"] == "tune":
        return sealed
    path = folder / f"sealed-{sealed['truth_sha256'][:16]}.json"
    if path.is_file():
        before: Json = json.loads(path.read_text(encoding="utf-8"))
        for what in ("policy", "code"):
            if before.get(f"{what}_sha256") != sealed[f"{what}_sha256"]:
                raise InputError(f"These cases were scored with another {what} ({path}); take other seeds from 1000 on for this one.")
        return before
    write_whole(path, json.dumps(sealed, indent=1) + "\n", "the sealed cases")
    return sealed


def _truth_of(case: Case) -> Json:
    truth = draw_truth(case.object_name, case.model, filmed=case.variant == CAMERA)
    return {"case": case.key, "object": case.object_name, "model": case.model, **truth.as_json()}
