"""Known objects survive a restart of perception."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER, render
from push_ident.errors import ModelFileError
from push_ident.geometry.se2 import wrap_angle
from push_ident.nodes.perception.object_memory import ObjectMemory
from push_ident.perception.known_object import TrackStatus
from push_ident.perception.pipeline import Perception

FIRST, LATER = np.array([0.03, -0.02, 0.4]), np.array([-0.05, 0.04, 2.1])


def watch(perception: Perception, pose: np.ndarray, start: float, n_frames: int = 15):
    """Observations of the hammer at rest."""
    rng = np.random.default_rng(round(1e3 * start))
    return [perception.observe(render([p.at(pose) for p in HAMMER], rng=rng, stamp=start + 0.1 * i)) for i in range(n_frames)]


@pytest.fixture(scope="module")
def before() -> Perception:
    perception = Perception(CAMERA)
    watch(perception, FIRST, 0.0)
    return perception


def test_object_of_an_earlier_run_is_found_with_its_id_its_cells_and_its_frame_once_it_is_there(before: Perception, tmp_path: Path) -> None:
    own, memory = before.known("o1"), ObjectMemory(str(tmp_path))
    memory.keep("o1", own)
    memory.keep_pose("o1", own.pose)
    after = Perception(CAMERA)
    after.remember(ObjectMemory(str(tmp_path)).load())
    empty = watch(after, np.array([5.0, 0.0, 0.0]), 7.0, n_frames=5)
    assert not any(known.pose is not None for observation in empty for known in observation.objects)
    seen = watch(after, LATER, 9.0)
    ((name, shape),) = (shape for observation in [*empty, *seen] for shape in observation.new_shapes.items())
    assert name == "o1"
    np.testing.assert_array_equal(shape.cells.centres, own.traced.shape.cells.centres)
    (found,) = seen[-1].objects
    assert found.status is TrackStatus.TRACKED and found.pose is not None
    assert wrap_angle(found.pose[2] - own.pose[2]) == pytest.approx(float(wrap_angle(LATER[2] - FIRST[2])), abs=0.02)


def test_only_a_better_outline_and_the_latest_pose_take_the_place_of_what_was_kept(before: Perception, tmp_path: Path) -> None:
    known, memory = before.known("o1"), ObjectMemory(str(tmp_path))
    shape = replace(known.traced.shape, outline=1.01 * known.traced.shape.outline)
    better = replace(known, traced=replace(known.traced, shape=shape))
    memory.keep("o1", known)
    memory.keep("o1", better)
    memory.keep_pose("o1", LATER)
    np.testing.assert_array_equal(memory.load()["o1"].traced.shape.outline, known.traced.shape.outline)
    np.testing.assert_allclose(memory.load()["o1"].pose, LATER)
    memory.keep("o1", better, anew=True)
    np.testing.assert_array_equal(memory.load()["o1"].traced.shape.outline, shape.outline)


def test_what_was_traced_is_kept_and_files_of_earlier_versions_are_read(before: Perception, tmp_path: Path) -> None:
    known, memory = before.known("o1"), ObjectMemory(str(tmp_path))
    rests = (np.array([[0.5, 0.1], [0.4, -0.2]]), np.array([[0.3, 0.2]]))
    hollow = np.zeros(known.traced.top.shape, dtype=bool)
    hollow[4:9, 3:7] = True
    errors = {"displaced": 2e-3, "displaced_std": 1e-3, "displaced_frame": (0.1, 0.2, 0.3), "frame_covariance": 1e-8 * np.eye(3)}
    traced = replace(known.traced, camera_positions=rests, hollow=hollow, keeps_heading=False, **errors)
    memory.keep("o1", replace(known, traced=traced))
    read = memory.load()["o1"].traced
    assert (read.displaced, read.displaced_std, read.displaced_frame) == (2e-3, 1e-3, traced.displaced_frame)
    assert read.camera_positions is not None and not read.keeps_heading
    np.testing.assert_array_equal(read.frame_covariance, traced.frame_covariance)
    np.testing.assert_array_equal(read.hollow, hollow)
    for ours, kept in zip(rests, read.camera_positions, strict=True):
        np.testing.assert_array_equal(ours, kept)
    file = tmp_path / "o1.object.json"
    content = json.loads(file.read_text())
    earlier = {name: value for name, value in content.items() if name not in ("displaced_frame", "frame_covariance")}
    file.write_text(json.dumps(earlier | {"seen_from": rests[0].tolist()}))
    (positions,) = memory.load()["o1"].traced.camera_positions or ()
    np.testing.assert_array_equal(positions, rests[0])
    for wrong in ({"frame_covariance": [[1.0]]}, {"hollow": content["hollow"][1:]}):
        file.write_text(json.dumps(content | wrong))
        with pytest.raises(ModelFileError, match=next(iter(wrong))):
            memory.load()


@pytest.mark.parametrize("content", ["", "[1]", '{"format": "push_ident/object/1"}'])
def test_file_that_is_no_object_is_refused_with_its_name(tmp_path: Path, content: str) -> None:
    (tmp_path / "o1.object.json").write_text(content)
    with pytest.raises(ModelFileError, match=r"o1\.object\.json"):
        ObjectMemory(str(tmp_path)).load()


def test_nothing_is_kept_without_a_folder_nor_of_an_object_that_was_given_up(before: Perception, tmp_path: Path) -> None:
    for folder in ("", str(tmp_path)):
        memory = ObjectMemory(folder)
        memory.keep("o1", before.known("o1"))
        memory.keep_pose("o1", LATER)
        assert len(memory.load()) == bool(folder)
        for _ in range(2):
            memory.forget("o1")
        assert memory.load() == {} and not list(tmp_path.iterdir())
