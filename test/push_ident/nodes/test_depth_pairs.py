"""Which camera info is taken for a depth image, by the period of the stream itself."""

from __future__ import annotations

import numpy as np
import pytest

from push_ident.nodes.convert.messages import depth_frame_to_msgs, stamp_to_msg
from push_ident.nodes.input.depth_pairs import DepthPairs
from push_ident.types import CameraIntrinsics, DepthFrame


class Stream:
    """Images and infos of a camera; what was taken (stamp, focal length) and refused. Info number k has the focal length 600 + k."""

    def __init__(self, period: float, max_skew: float = 0.0) -> None:
        self.period, self.taken, self.refused = period, [], []
        self.pairs = DepthPairs(
            "depth/camera_info",
            on_frame=lambda frame, stamp: self.taken.append((round(frame.stamp / period), frame.intrinsics.fx - 600.0)),
            refuse=lambda kind, why: self.refused.append(why),
            max_skew=lambda: max_skew,
        )

    def send(self, number: float, parts: str) -> None:
        """Image (`i`) and info (`c`), in this order, of the time `number` periods."""
        at, frame = (
            number * self.period,
            DepthFrame(0.0, np.ones((2, 3), np.float32), CameraIntrinsics(3, 2, 600.0 + number, 600.0, 1.0, 1.0)),
        )
        image, info = depth_frame_to_msgs(frame, stamp_to_msg(at))
        for part in parts:
            if part == "i":
                self.pairs.on_image(image)
            else:
                self.pairs.on_info(info)


@pytest.mark.parametrize("period", [1 / 90, 1 / 15, 1 / 5])
def test_a_lost_info_costs_no_image_at_any_rate(period: float) -> None:
    stream = Stream(period)
    for number, parts in enumerate(("ic", "ci", "ic", "i", "ci", "ic"), 10):
        stream.send(number, parts)
    assert [number for number, _ in stream.taken] == list(range(10, 16)) and not stream.refused
    assert [focal for _, focal in stream.taken if focal != 13] == [10, 11, 12, stream.taken[3][1], 14, 15], "its own where it came"


def test_an_info_that_stays_away_is_named_with_the_limit_of_the_stream_or_of_the_user() -> None:
    stream, strict = Stream(1 / 15), Stream(1 / 15, max_skew=0.01)
    for number, parts in enumerate(("ci", "ci", "i", "i", "i", "i"), 10):
        stream.send(number, parts)
        strict.send(number, parts)
    assert [number for number, _ in stream.taken] == [10, 11, 12] and [number for number, _ in strict.taken] == [10, 11]
    assert stream.refused[0] == "depth image and nearest camera info are 133 ms apart, expected at most 100 ms"
    assert strict.refused[0] == "depth image and nearest camera info are 67 ms apart, expected at most 10 ms"
