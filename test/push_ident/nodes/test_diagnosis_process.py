"""Diagnoses in a process of their own, which the next one finds or, where it was killed, starts again."""

from __future__ import annotations

import os
import signal

import pytest

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import PushIdentError
from push_ident.nodes.gap_diagnosis.diagnosis_process import DiagnosisProcess
from push_ident.pushing.push import PushSettings


def test_process_stays_until_it_is_stopped_and_is_replaced_when_it_was_killed() -> None:
    process, settings = DiagnosisProcess(), (DiagnosisSettings(), PushSettings())
    stages: list[str] = []

    def refused() -> int | None:
        with pytest.raises(PushIdentError):
            process.diagnose([], *settings, on_stage=stages.append, should_continue=lambda: True)
        return process.pid

    try:
        first = refused()
        assert first is not None and refused() == first
        os.kill(first, signal.SIGKILL)
        os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)
        diagnosis = process.diagnose(simulated_pushes(3, 1), *settings, on_stage=stages.append, should_continue=lambda: True)
        assert diagnosis is not None and diagnosis["verdict"] and stages
        assert refused() == process.pid != first
        assert process.diagnose(simulated_pushes(3, 1), *settings, on_stage=stages.append, should_continue=lambda: False) is None
        assert process.pid is None
    finally:
        process.stop()
