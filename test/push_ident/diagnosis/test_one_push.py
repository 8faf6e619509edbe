"""An effect that gains by one push alone is not reported."""

from __future__ import annotations

import pytest

from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.verdict import Verdict
from push_ident_sim.recordings.truth import CameraNoise
from push_ident_sim.studies.blind.cases import draw_truth, make_records


@pytest.mark.long
def test_diagnosis_rejects_an_effect_that_only_one_push_supports() -> None:
    """There is no effect in this case; one of its pushes lies at an edge of sliding, and gains 40 nat for a friction of the pusher."""
    truth = draw_truth("hammer", 6030)
    found = diagnose(make_records(truth, "hammer", 6030, 14, CameraNoise()))
    assert truth.scenario.kind == "null" and found.verdict == Verdict.NO_GAP and found.effects == ()
    assert "Only push" in found.sentence and "so that it is not reported" in found.sentence
