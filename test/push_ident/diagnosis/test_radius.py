"""A wrong radius of the pusher: the pushes see the sum of it and of an error of the outline, and the diagnosis says so."""

from __future__ import annotations

from dataclasses import replace

from helpers.diagnosis import simulated_pushes
from push_ident.diagnosis.diagnose import diagnose


def test_wrong_radius_asks_for_the_object_and_the_pusher() -> None:
    thicker = [replace(push, pusher=replace(push.pusher, radius=push.pusher.radius - 0.004)) for push in simulated_pushes(8, 1)]
    found = diagnose(thicker)
    assert [effect.name for effect in found.effects] == ["outline_error"]
    assert abs(found.effects[0].parameters["offset"] - 0.004) < 0.001
    assert "pusher's radius" in found.sentence
    assert "the object, and the diameter of the pusher" in found.check
