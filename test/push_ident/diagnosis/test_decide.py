"""The verdict, and the effects that may be there in place of those that were found."""

from __future__ import annotations

import pytest

from helpers.diagnosis import stub_fit
from push_ident.diagnosis.decide import confusion_sets, verdict_of
from push_ident.diagnosis.policy import SelectionPolicy
from push_ident.diagnosis.selection import Candidate, RivalFit, Selection, Step
from push_ident.diagnosis.verdict import FoundEffect, Verdict


def selection_of(*found: str, swaps: tuple[RivalFit, ...] = ()) -> Selection:
    steps = tuple(Step(stub_fit(), None, (), (Candidate(name, stub_fit(name), 50.0),)) for name in found)
    return Selection(stub_fit(), stub_fit(*found), steps, swaps)


def test_exact_twins_are_confused_unless_both_are_there() -> None:
    policy = SelectionPolicy()
    assert confusion_sets(selection_of("tool_offset"), policy) == {"tool_offset": ("camera_translation",)}
    assert confusion_sets(selection_of("tool_offset", "camera_translation"), policy) == {} == confusion_sets(selection_of("wear"), policy)


def test_tied_rivals_of_every_effect_are_in_its_confusion_set() -> None:
    swaps = (RivalFit("pose_latency", "pusher_lag", stub_fit(), 2.0), RivalFit("outline_error", "pusher_lag", stub_fit(), 30.0))
    assert confusion_sets(selection_of("pusher_lag", "wear", swaps=swaps), SelectionPolicy()) == {"pusher_lag": ("pose_latency",)}


@pytest.mark.parametrize(
    ("names", "sets", "verdict"),
    [
        ((), {}, Verdict.NO_GAP),
        (("wear",), {}, Verdict.NAMED),
        (("wear",), {"wear": ("tether",)}, Verdict.ONE_OF),
        (("wear", "pusher_lag"), {"wear": ("tether",)}, Verdict.SEVERAL),
    ],
)
def test_verdict_follows_from_the_number_of_effects_and_of_rivals(
    names: tuple[str, ...], sets: dict[str, tuple[str, ...]], verdict: Verdict
) -> None:
    assert verdict_of([FoundEffect(name, {}, {}, 30.0) for name in names], sets) is verdict
