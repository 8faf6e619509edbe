"""Mutated depth frames through perception: the failures of former runs, and a few new ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from push_ident.perception.pipeline import Perception
from push_ident.types import DepthFrame
from push_ident_sim.fuzz.frame_runs import FrameRecipe, Step, draw_sequence, run_sequence
from push_ident_sim.fuzz.frame_scenes import RECORDED, scene_of, scenes_here
from push_ident_sim.fuzz.frames import FrameFinding, FrameFuzzSummary, read_sequence
from push_ident_sim.fuzz.mutate_frame import FRAME_MUTATIONS, Around, mutated

CASES = sorted((Path(__file__).parent / "frame_cases").glob("*.json"))
UNTIMED = float("inf")
"""Other tests run beside these: `push-ident fuzz` looks at the time."""


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.stem[:60])
def test_failures_that_were_found_do_not_return(case: Path) -> None:
    recipe = read_sequence(case)
    if recipe.scene not in scenes_here():
        pytest.skip(f"{recipe.scene} is not on this machine")
    assert run_sequence(recipe, UNTIMED).failure == ""


def test_a_sample_of_mutated_frames_is_survived() -> None:
    summary = FrameFuzzSummary(5)
    for number in range(8):
        recipe = draw_sequence(5, number, ("plain",))
        summary.add(recipe, run_sequence(recipe, UNTIMED))
    assert summary.frames > 30 and [(found.failure, found.recipe) for found in summary.findings] == []
    assert summary.to_json()["by_scene"] == {"plain": summary.frames}


@pytest.mark.parametrize("name", FRAME_MUTATIONS)
def test_a_mutation_with_a_seed_is_always_the_same_and_spares_the_original(name: str) -> None:
    scene = scene_of("plain", 160)
    frame = DepthFrame(5.0, scene.at_rest[0], scene.intrinsics)
    before = frame.depth.copy()
    around = Around(scene.other, 4.0)
    for seed in range(20):
        first, second = (mutated(frame, name, seed, around) for _ in range(2))
        np.testing.assert_array_equal(first.depth, second.depth)
        assert first.stamp == second.stamp and repr(first.intrinsics) == repr(second.intrinsics)
    np.testing.assert_array_equal(frame.depth, before)


def test_every_kind_of_wrong_result_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = FrameRecipe("plain", 160, (Step(0, 0.1),))
    assert run_sequence(recipe, UNTIMED).failure == ""
    observe = Perception.observe

    def broken(self: Perception, frame: DepthFrame, *rest: object) -> object:
        observe(self, frame)
        raise ZeroDivisionError("float division by zero")

    monkeypatch.setattr(Perception, "observe", broken)
    assert "ZeroDivisionError in test_frames.py" in run_sequence(recipe).failure


def test_scenes_are_every_sensor_and_the_recorded_images_that_are_here() -> None:
    rendered = [name for name in scenes_here() if not name.startswith(RECORDED)]
    assert "plain" in rendered and "kinect_v1" in rendered and len(rendered) >= 10


def test_a_stored_case_is_read_as_it_was(tmp_path: Path) -> None:
    import json

    recipe = draw_sequence(1, 3, ("plain", "xtion"))
    (tmp_path / "case.json").write_text(json.dumps(FrameFinding("slow", recipe).to_json()))
    assert read_sequence(tmp_path / "case.json") == recipe
