"""What a camera sees of a table without a number given, and the check of focal length and depth scale."""

from __future__ import annotations

import base64
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from helpers.depth_scene import CAMERA, HAMMER, INTRINSICS, Prism, circle, look_at, rectangle, render
from helpers.paths import recording
from push_ident.errors import FrameError, InputError, PerceptionError
from push_ident.geometry.se2 import rotation
from push_ident.geometry.se3 import quaternion_of_pose
from push_ident.offline.depth_images import DepthImages
from push_ident.perception.pipeline import Perception
from push_ident.perception.refusals import Reason
from push_ident.survey import survey as survey_of_frames
from push_ident.survey.parameter_file import parameter_text
from push_ident.survey.scale_check import KnownSize, ScaleError, check_scale
from push_ident.survey.survey import frames_at_rest, survey_frames
from push_ident.survey.survey_picture import draw_survey
from push_ident.types import DepthFrame

SIZE = (0.2, 0.12, 0.1)
BOX = Prism(rectangle(-0.1, -0.06, 0.1, 0.06), SIZE[2]).at((0.02, 0.03, 0.4))
SMALL = Prism(rectangle(-0.03, -0.03, 0.03, 0.03), 0.05).at((-0.15, -0.2, 0.1))
VIEWS = {"oblique": CAMERA, "flat": look_at((0.9, 0.1, 0.6), (0.0, 0.0, 0.0)), "above": look_at((0.02, 0.0, 0.95), (0.0, 0.0, 0.0))}


def frames(camera, things, n=4, seed=0):
    rng = np.random.default_rng(seed)
    return [render(things, camera, rng=rng, stamp=i / 30) for i in range(n)]


@pytest.fixture(scope="module")
def seen():
    """Frames of two boxes from three places."""
    return {name: frames(camera, [BOX, SMALL]) for name, camera in VIEWS.items()}


@pytest.fixture(scope="module")
def survey(seen):
    return survey_frames(seen["oblique"])


@pytest.fixture(scope="module")
def survey_of_cut():
    """Of one frame of the box and of a cylinder that the image cuts, with a corner where nothing is measured."""
    (frame,) = frames(CAMERA, [BOX, Prism(circle(0.05), 0.08).at((0.1, -0.5, 0.0))], n=1)
    depth = frame.depth.copy()
    depth[:60, :80] = np.nan
    return survey_frames([replace(frame, depth=depth)])


def misread(some, focal=1.0, scale=1.0):
    """The same images with a wrong focal length and a wrong unit of the depth."""
    camera = replace(INTRINSICS, fx=focal * INTRINSICS.fx, fy=focal * INTRINSICS.fy)
    return [DepthFrame(frame.stamp, frame.depth * np.float32(scale), camera) for frame in some]


def test_table_camera_and_objects_are_found_without_a_number(survey):
    assert survey.camera_in_table[2, 3] == pytest.approx(0.85, abs=0.001)
    assert np.degrees(survey.tilt) == pytest.approx(32.9, abs=0.2)
    np.testing.assert_allclose(np.add(survey.settings.workspace_low, survey.settings.workspace_high), 0.0, atol=1e-9)
    sizes = sorted((*own.size, own.top) for own in survey.objects)
    np.testing.assert_allclose(sizes, [(0.06, 0.06, 0.05), SIZE], atol=0.003)
    assert not survey.refused and not survey.failure and not survey.is_pose_given


def test_noise_of_a_height_grows_with_the_distance_as_in_the_renderer(survey):
    """Its depths have a deviation of 1.2 mm + 1.9 mm (z/m - 0.4)^2; a height has that times the cosine of the line of sight."""
    for band in survey.bands:
        middle = 0.5 * (band.near + band.far)
        height = (0.0012 + 0.0019 * (middle - 0.4) ** 2) * 0.85 / middle
        assert band.deviation == pytest.approx(height, rel=0.15) and band.over_time == pytest.approx(height, rel=0.15)
        assert abs(band.median) < 0.0003
    assert len(survey.bands) >= 4


def test_a_table_that_bulges_raises_the_least_height_and_a_flat_one_does_not(seen, survey):
    assert survey.settings.min_object_height == 0.003
    bulging = []
    for frame in seen["oblique"]:
        row = np.linspace(-1.0, 1.0, frame.depth.shape[0], dtype=np.float32)[:, None]
        bulging.append(replace(frame, depth=frame.depth + np.float32(0.012) * row**2))
    found = survey_frames(bulging[:1])
    assert max(abs(band.median) for band in found.bands) > 0.002
    assert found.settings.min_object_height > 0.008
    assert f"min_object_height: {found.settings.min_object_height}" in parameter_text(found, "bag")


def test_a_given_pose_is_corrected_by_the_plane(seen):
    lifted = CAMERA.copy()
    lifted[2, 3] += 0.01
    found = survey_frames(seen["oblique"][:1], lifted)
    assert found.is_pose_given  # One that is not near it is named: cli/test_look.py.
    np.testing.assert_allclose(found.camera_in_table, CAMERA, atol=0.001)


def test_a_second_plane_is_no_error_of_a_pose_that_nobody_gave(seen, monkeypatch):
    tilt = np.eye(4)
    tilt[1:3, 1:3] = rotation(0.09)
    monkeypatch.setattr(survey_of_frames, "Perception", lambda camera, settings: Perception(tilt @ camera, settings))
    failure = survey_frames(seen["oblique"]).failure
    assert "are not the same" in failure and "calibrate" not in failure


def test_one_image_is_enough_and_what_is_no_object_is_said(survey_of_cut):
    assert [own.object_id for own in survey_of_cut.objects] == ["o1"]
    assert Reason.AT_IMAGE_BORDER in [refusal.reason for refusal in survey_of_cut.refused]
    assert survey_of_cut.bands[0].over_time is None


def test_what_reaches_in_like_an_arm_may_be_a_robot_and_what_is_too_low_for_its_tool_is_named():
    """A forearm from the border of the image to above the table, and its tool."""
    low = Prism(rectangle(-0.06, -0.04, 0.06, 0.04), 0.010).at((0.1, -0.2, 0.0))
    arm = [Prism(rectangle(-0.75, -0.06, -0.12, 0.06), 0.4, 0.25), Prism(circle(0.018) + np.array([-0.15, 0.0]), 0.26, 0.01)]
    with_arm, without = (survey_frames(frames(CAMERA, [BOX.at((0.05, 0.2, 0.0)), low, *some])) for some in (arm, []))
    assert len(with_arm.objects) == len(without.objects) == 2
    assert any("may be a robot" in note and "turn it out of the view" in note for note in with_arm.notes)
    assert not any("robot" in note for note in without.notes)
    assert any(note.startswith("object o") and "lower the tool" in note for note in without.notes)


def test_only_frames_at_rest_are_used(seen):
    moving = [render([BOX.at((0.02 * i, 0.0, 0.0))], stamp=i / 30) for i in range(3)]
    rest, note = frames_at_rest([*moving, *seen["oblique"]])
    assert rest == seen["oblique"] and note.startswith("3 of the first 7")
    again, nothing = frames_at_rest(seen["oblique"])
    assert again == seen["oblique"] and nothing == ""


def test_no_frame_no_depth_and_no_table_are_errors():
    with pytest.raises(FrameError, match="no depth frames"):
        survey_frames([])
    with pytest.raises(PerceptionError, match="0 valid"):
        survey_frames([DepthFrame(0.0, np.full((480, 640), np.nan, np.float32), INTRINSICS)])
    clutter = np.random.default_rng(0).uniform(0.5, 2.0, (480, 640)).astype(np.float32)
    with pytest.raises(PerceptionError, match="lie on one plane"):
        survey_frames([DepthFrame(0.0, clutter, INTRINSICS)])


# The scale


@pytest.mark.parametrize(
    ("view", "focal", "scale", "error"),
    [
        ("oblique", 1.0, 1.0, ScaleError.NONE),
        ("oblique", 1.1, 1.05, ScaleError.BOTH),
        ("flat", 0.8, 1.0, ScaleError.FOCAL),
        ("above", 1.0, 1.02, ScaleError.DEPTH),
    ],
)
def test_a_wrong_focal_length_and_a_wrong_unit_are_named_and_told_apart(seen, survey, view, focal, scale, error):
    is_right = error is ScaleError.NONE
    found = check_scale(survey if is_right else survey_frames(misread(seen[view], focal, scale)), KnownSize(*SIZE))
    assert found.error is error, found.sentence
    hidden = 0.005 if view == "flat" else 0.0  # the box then ends 2 to 4 mm behind the rear edge of its top, by noise
    assert found.focal == pytest.approx(focal, rel=0.012) and found.depth_scale == pytest.approx(scale, rel=0.007 + hidden)
    assert not is_right or found.within < 0.015
    assert error is not ScaleError.FOCAL or f"{100 * abs(found.focal - 1):.1f} % too small" in found.sentence


def test_from_above_a_size_without_height_tells_nothing_apart(seen):
    found = check_scale(survey_frames(misread(seen["above"][:1], 1.25)), KnownSize(*SIZE[:2]))
    assert found.error is ScaleError.EITHER and "--known WxDxH" in found.sentence


def test_a_right_angled_mark_is_as_good_as_a_box_and_a_thing_of_another_kind_is_not_taken_for_it():
    mark = Prism(np.array([(0.0, 0.0), (0.18, 0.0), (0.0, 0.12)]), 0.08).at((-0.05, -0.03, 0.8))
    hammer = [prism.at((-0.05, -0.25, 0.3)) for prism in HAMMER]
    found = check_scale(survey_frames(misread(frames(CAMERA, [mark, *hammer]), 1.25)), KnownSize(0.12, 0.18, 0.08))
    assert found.error is ScaleError.FOCAL and found.focal == pytest.approx(1.25, rel=0.015)


def test_what_is_not_of_the_known_size_is_no_proof_of_an_error(survey):
    with pytest.raises(PerceptionError, match="None of 2 objects is about as large"):
        check_scale(survey, KnownSize(0.6, 0.4))
    assert check_scale(survey, KnownSize(0.16, 0.16, 0.1)).error is ScaleError.NEITHER
    round_one = survey_frames(frames(CAMERA, [Prism(circle(0.06, 60), 0.1)], n=1))
    found = check_scale(round_one, KnownSize(0.11, 0.11, 0.1))
    assert found.error is ScaleError.NEITHER and "neither a rectangle" in found.sentence
    for wrong in ((0.001, 0.1, None), (0.1, 3.0, None), (0.1, 0.1, float("nan"))):
        with pytest.raises(InputError, match="The known size has a length of"):
            KnownSize(*wrong)


# What is written


def test_parameter_file_holds_what_was_found_and_is_read_as_parameters(survey):
    import yaml

    text = parameter_text(survey, "a\nname: 1")
    values = yaml.safe_load(text)["/**/perception_node"]["ros__parameters"]
    stds = {"camera_position_std", "camera_heading_std"}
    assert set(values) == {"extrinsics", "camera_position", "camera_quaternion", "workspace_low", "workspace_high"} | stds
    assert {name: values[name] for name in stds} == {"camera_position_std": 2e-3, "camera_heading_std": 5e-3}
    np.testing.assert_allclose(values["camera_position"], survey.camera_in_table[:3, 3], atol=1e-6)
    np.testing.assert_allclose(values["camera_quaternion"], quaternion_of_pose(survey.camera_in_table), atol=1e-7)
    np.testing.assert_allclose(values["workspace_high"], survey.settings.workspace_high, atol=1e-3)


def test_picture_marks_objects_refusals_and_what_is_not_measured(survey_of_cut):
    figure = draw_survey(survey_of_cut)
    image = cv2.imdecode(np.frombuffer(base64.b64decode(re.search(r"base64,([^\"]+)", figure.svg)[1]), np.uint8), cv2.IMREAD_COLOR)
    purple = np.all(image == (167, 121, 204), axis=2)
    assert image.shape[:2] == (480, 640) and purple[:60, :80].mean() > 0.2 and purple[100:, 100:].mean() < 0.05
    assert figure.svg.count('class="object"') == 1 and figure.svg.count('class="refused"') >= 1
    assert {text.partition(",")[0] for _, text in figure.legend} >= {"object", "not taken in", "striped: nothing measured"}


@pytest.mark.release  # Open3D reads the cloud
def test_recorded_scene_of_a_kinect():
    """Against the smallest rectangle around the labelled points of the object."""
    some, _ = frames_at_rest(DepthImages(recording("kinect_tabletop", "learn0.pcd")).frames())
    found = survey_frames(some)
    assert not found.failure and 0.001 < found.noise < 0.0025 and 0.5 < found.camera_in_table[2, 3] < 0.7
    (thing,) = found.objects
    np.testing.assert_allclose((*thing.size, thing.height), (0.157, 0.064, 0.246), atol=0.006)
    assert [refusal.reason for refusal in found.refused] == [Reason.BEHIND_ANOTHER]
