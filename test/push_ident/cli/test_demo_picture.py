"""The pushes of the demo are drawn over the camera's picture, where they are seen."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from push_ident.cli.demo_picture import PushPicture, draw_pushes
from push_ident.identification.ways import Way
from push_ident.types import CameraIntrinsics, DepthFrame

SQUARE = 0.05 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
HEIGHT, ABOVE = 0.04, 0.8
"""Of the object, and of the camera over the table [m]."""
CAMERA = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, ABOVE], [0.0, 0.0, 0.0, 1.0]])
"""Looks straight down."""


def frame() -> DepthFrame:
    """A square on a table."""
    depth = np.full((240, 320), ABOVE, dtype=np.float32)
    half = round(300.0 * 0.05 / (ABOVE - HEIGHT))
    depth[120 - half : 120 + half, 160 - half : 160 + half] = ABOVE - HEIGHT
    return DepthFrame(0.0, depth, CameraIntrinsics(320, 240, 300.0, 300.0, 160.0, 120.0))


def picture(x: float = 0.0, y: float = 0.0) -> PushPicture:
    """Before a push of a square that is thought to lie at a place [m]."""
    return PushPicture(frame(), CAMERA, np.array([x, y, 0.0]), SQUARE)


def test_height_is_that_of_the_pixels_within_the_outline() -> None:
    assert abs(picture().top - HEIGHT) < 1e-3
    assert picture(5.0, 5.0).top == 0.0


def test_a_panel_for_each_push_says_what_was_expected_and_what_came(tmp_path: Path) -> None:
    first = picture()
    ways = [Way(0.7, np.array([0.05, 0.0, 0.3])), Way(0.3, np.array([0.05, 0.0, -0.3]))]
    second = picture()
    second.ways, second.expected_m = ways, 0.0041
    assert first.caption(1) == "push 1: nothing known yet\n"
    assert second.caption(2) == "push 2: expected to 4.1 mm, 70% or 30%\n"
    draw_pushes(tmp_path / "pushes.png", [first, second], title="before")
    before = cv2.imread(str(tmp_path / "pushes.png"))
    second.seen, second.error_m = np.array([0.05, 0.01, 0.2]), 0.002
    assert second.caption(2).endswith("was 2.0 mm off")
    draw_pushes(tmp_path / "pushes.png", [first, second], title="before")
    after = cv2.imread(str(tmp_path / "pushes.png"))
    # What was predicted stays where it was, orange of the other way included.
    orange = np.array([0x00, 0x9F, 0xE6])
    shown = [np.all(np.abs(picture.astype(int) - orange) < 40, axis=2) for picture in (before, after)]
    assert shown[0].sum() > 50 and shown[1].sum() > 50


def test_an_object_that_was_hidden_takes_the_contrast_of_no_panel(tmp_path: Path) -> None:
    def plain(*pushes: PushPicture) -> float:
        """Share of the commonest grey in the first panel: nearly all where the object does not stand out."""
        draw_pushes(tmp_path / "pushes.png", pushes, title="seen")
        panel = cv2.imread(str(tmp_path / "pushes.png"), cv2.IMREAD_GRAYSCALE)[100:440, 20:360]
        return float(np.bincount(panel.ravel()).max() / panel.size)

    hidden = picture(0.02)
    hidden.frame.depth[:] = np.nan
    assert plain(picture()) < 0.8
    assert plain(picture(), hidden) < 0.8
    assert plain(hidden) > 0.9, "nothing is seen, and drawn without an error"
