"""When the hand is a fist."""

from __future__ import annotations

from dataclasses import replace

import pytest

from push_ident.pushing.hand import HandState

FIST = HandState(activated=True, mode=0, going=True, readiness=3, motion=2, fault=0, request=255)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({}, ""),
        ({"motion": 3}, ""),
        ({"motion": 0}, "moving"),
        ({"fault": 0x0D}, "0x0D"),
        ({"activated": False}, "not activated"),
        ({"readiness": 1}, "not activated"),
        ({"mode": 1}, "mode 1"),
        ({"request": 120}, "open"),
        ({"going": False}, "open"),
    ],
)
def test_hand_is_a_fist_only_when_closed_still_and_without_fault(change: dict[str, int], text: str) -> None:
    reason = replace(FIST, **change).why_no_fist
    assert text in reason and bool(reason) == bool(text)
