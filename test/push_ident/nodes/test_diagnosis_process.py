"""Diagnoses in a process of their own: the next one starts at the fits of the one before, and outlives its end."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from typing import Any

import pytest

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import PushIdentError
from push_ident.nodes.gap_diagnosis import diagnosis_process
from push_ident.nodes.gap_diagnosis.diagnosis_process import DiagnosisProcess
from push_ident.pushing.push import PushSettings


def test_each_diagnosis_starts_at_the_latest_that_succeeded(monkeypatch: pytest.MonkeyPatch) -> None:
    def diagnose(records: str, settings: None, *, earlier: str | None, **others: Any) -> str:
        if records == "bad":
            raise PushIdentError("No push.")
        if records == "worse":
            raise ValueError("x")
        return f"{records} after {earlier}"

    for name, value in {"diagnose": diagnose, "to_json": str, "end_with_parent": lambda: None}.items():
        monkeypatch.setattr(diagnosis_process, name, value)
    own, other = multiprocessing.Pipe()
    thread = threading.Thread(target=diagnosis_process.diagnose_requests, args=(other,))
    thread.start()
    answers = []
    for records in ("a", "bad", "worse", "b"):
        own.send((records, None, None))
        answers.append(own.recv())
    own.close()
    thread.join(5.0)
    assert not thread.is_alive()
    assert answers == [("done", "a after None"), ("failed", "No push."), ("failed", "ValueError: x"), ("done", "b after a after None")]


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
