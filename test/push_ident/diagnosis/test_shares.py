"""What each cause closes of the gap, at the end of held-out pushes and over their motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.diagnosis import gap_of
from push_ident.diagnosis.held_out import MotionGap
from push_ident.diagnosis.shares import closed_by_cause


def test_each_cause_closes_what_it_removes_beside_those_before_it() -> None:
    gap = replace(gap_of([4e-3, 6e-3], [1e-3, 1e-3], 5e-4, names=("table_tilt", "pose_latency")), stages={"table_tilt": np.full(2, 1.2e-3)})
    motion = MotionGap(np.full(2, 5e-3), np.full(2, 1e-3), np.full(2, 5e-4), {"table_tilt": np.full(2, 3e-3)})
    tilt, latency = closed_by_cause(replace(gap, motion=motion))
    assert (tilt.names, latency.names) == (("table_tilt",), ("pose_latency",))
    assert tilt.at_end.mean == pytest.approx(3.8e-3) and tilt.at_end.share == pytest.approx(0.76)
    assert latency.at_end.mean == pytest.approx(2e-4)
    # A latency changes the motion, not its end.
    assert latency.over_motion is not None and latency.over_motion.mean == pytest.approx(2e-3)
    assert latency.over_motion.interval == pytest.approx((2e-3, 2e-3))
    assert closed_by_cause(gap)[0].over_motion is None and closed_by_cause(gap_of([1e-3], [1e-3], 1e-3)) == ()


def test_effects_that_predict_held_out_pushes_no_better_close_nothing() -> None:
    assert gap_of([3e-3, 3e-3, 3e-3], [1e-3, 1e-3, 1e-3], 1e-3, -1.0).closes_error
    worse = gap_of([1e-3, 1e-3, 1e-3], [3e-3, 3e-3, 3e-3], 1e-3, -1.0)
    assert not worse.closes_error and not worse.is_more_probable
    assert replace(worse, log_density_gain=np.array([5.0, 6.0, 7.0])).is_more_probable
    assert not replace(worse, log_density_gain=np.array([-5.0, 1.0, 7.0])).is_more_probable
