"""Whether the outline seen from above is what the tool meets."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER, Prism, circle, rectangle, render
from push_ident.perception.pipeline import Perception
from push_ident.perception.settings import PerceptionSettings
from push_ident.survey.survey import survey_frames

BOX = rectangle(-0.06, -0.04, 0.06, 0.04)


def doubts_of(prisms, **settings):
    rng = np.random.default_rng(0)
    perception = Perception(CAMERA, PerceptionSettings(rest_frames=3, **settings))
    observations = [perception.observe(render(prisms, rng=rng, stamp=0.3 * i)) for i in range(4)]
    assert any(observation.new_shapes for observation in observations)
    return [doubt for observation in observations for doubt in observation.doubts.values()]


@pytest.mark.parametrize(
    "prisms",
    [[Prism(BOX, 0.05)], list(HAMMER), [Prism(BOX, 0.15)], [Prism(circle(0.03), 0.02), Prism(circle(0.05), 0.07, 0.05)]],
    ids=["box", "hammer", "box higher than the tool", "mushroom whose cap the tool meets"],
)
def test_what_the_tool_meets_is_the_outline(prisms):
    assert doubts_of(prisms) == []


def test_tool_passes_over_what_is_lower_than_its_tip():
    (doubt,) = doubts_of([Prism(BOX, 0.010)], min_object_height=0.004)
    assert "mm high" in doubt and "lower the tool" in doubt
    assert doubts_of([Prism(BOX, 0.010)], min_object_height=0.004, tool_reach=(0.006, 0.092)) == []


def test_tool_passes_over_a_low_foot_of_something_higher():
    (doubt,) = doubts_of([Prism(BOX, 0.010), Prism(0.6 * BOX, 0.025)], min_object_height=0.004)
    assert "of its edge is lower" in doubt


def test_a_high_edge_without_a_side_below_it_may_overhang():
    high = [Prism(circle(0.015), 0.10), Prism(circle(0.05), 0.12, 0.10)]
    (doubt,) = doubts_of(high)
    assert "no side below it is seen" in doubt


def test_a_survey_says_so():
    rng = np.random.default_rng(0)
    survey = survey_frames([render([Prism(BOX, 0.010)], rng=rng, stamp=i / 30) for i in range(10)], CAMERA)
    assert any(note.startswith("object o1: it is") and "lower the tool" in note for note in survey.notes)
