"""What a frame does besides its poses: a little of it in each frame, and all of it in time."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np
import pytest

from helpers.depth_scene import CAMERA, Prism, hammer, rectangle, render
from push_ident.perception.frame import occupancy, table
from push_ident.perception.frame.view import FrameView
from push_ident.perception.known_object import Template
from push_ident.perception.pipeline import Perception
from push_ident.perception.search import search
from push_ident.perception.settings import PerceptionSettings
from push_ident.perception.tracking import pose_fit, tracker

SETTINGS = PerceptionSettings(rest_frames=3)
HAMMER_AT = np.array([0.1, 0.1, 0.4])
BOX = Prism(rectangle(-0.15, -0.15, -0.07, -0.09), 0.05)
NEW = Prism(rectangle(-0.15, 0.05, -0.07, 0.12), 0.05)


class Watched:
    """Perception of things at rest; which functions each frame calls."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, rate: float) -> None:
        self.perception, self.rate, self.n = Perception(CAMERA, SETTINGS), rate, 0
        self.calls: dict[int, Counter[str]] = defaultdict(Counter)
        self.rng = np.random.default_rng(3)
        functions = ((search, "cover_hollows"), (search, "find_segments"), (tracker, "compare_upper_side"), (occupancy, "top_down"))
        for owner, name in (*functions, (table.TableCamera, "check_plane")):
            monkeypatch.setattr(owner, name, self._counted(name, getattr(owner, name)))
        while not self.see().new_shapes:
            assert self.n < 10
        assert len(self.see().objects) == 2
        self.calls.clear()

    def _counted(self, name, function):
        def call(*args):
            self.calls[self.n][name] += 1
            return function(*args)

        return call

    def see(self, *more: Prism):
        self.n += 1
        return self.perception.observe(render([*hammer(HAMMER_AT), BOX, *more], rng=self.rng, stamp=self.n / self.rate))


def test_no_frame_of_a_usual_camera_does_two_slow_things(monkeypatch):
    watched = Watched(monkeypatch, 30.0)
    first = watched.n
    for _ in range(45):
        watched.see()
    slow = ("cover_hollows", "find_segments", "top_down", "check_plane")
    assert max(sum(calls[name] for name in slow) for calls in watched.calls.values()) == 1
    assert max(calls["compare_upper_side"] for calls in watched.calls.values()) == 1
    total = sum(watched.calls.values(), Counter())
    assert all(total[name] >= least for name, least in zip(slow, (4, 4, 1, 1), strict=True))
    checked = [n - first for n, calls in watched.calls.items() if calls["compare_upper_side"]]
    assert len(checked) >= 2 * 4 and max(np.diff(checked)) * 1000 / 30 <= 2 * 250  # two objects, each about four times a second


@pytest.mark.parametrize(("rate", "latest"), [(30.0, 0.25 + 5 / 30), (2.0, 0.5)])
def test_a_new_thing_is_seen_within_a_search_period_and_what_a_search_takes(monkeypatch, rate, latest):
    watched = Watched(monkeypatch, rate)
    for _ in range(int(rate)):
        assert not watched.see().refused
    start = watched.n
    while not watched.see(NEW).refused:
        assert (watched.n - start) / rate <= latest
    while not watched.see(NEW).new_shapes:
        assert (watched.n - start) / rate <= SETTINGS.rest_frames * latest + 1 / rate


def test_a_pose_is_fitted_in_few_steps(monkeypatch):
    watched = Watched(monkeypatch, 30.0)
    frame = render([*hammer(HAMMER_AT), BOX], rng=watched.rng, stamp=9.0)
    steps, compare = [], pose_fit.compare_lines
    monkeypatch.setattr(pose_fit, "compare_lines", lambda *args: steps.append(args[0]) or compare(*args))
    view = FrameView(frame, watched.perception.camera_in_table)
    for known in (watched.perception.known(name) for name in ("o1", "o2")):
        template, fits = Template(known.traced), []
        for sign in (-1.0, 1.0):
            steps.clear()
            fits.append(pose_fit.fit_pose(template, view, known.pose + sign * np.array([0.002, -0.002, 0.02])))
            assert len(steps) <= 9
        # Where the iterations end does not depend on where they begin, to less than a tenth of the noise of a pose.
        np.testing.assert_array_less(np.abs(fits[0].pose - fits[1].pose), 0.15 * np.sqrt(np.diag(fits[0].covariance)) + [5e-6, 5e-6, 5e-5])


def test_without_an_occupancy_grid_poses_and_shapes_are_the_same() -> None:
    with_grid, without = Perception(CAMERA, SETTINGS), Perception(CAMERA, SETTINGS, occupancy=False)
    rng, grids = np.random.default_rng(3), 0
    for n in range(15):
        frame = render([*hammer(np.add(HAMMER_AT, (2e-3 * max(n - 8, 0), 0.0, 0.0))), BOX], rng=rng, stamp=n / 10)
        seen, other = with_grid.observe(frame), without.observe(frame)
        grids += seen.occupancy is not None
        assert other.occupancy is None and seen.new_shapes.keys() == other.new_shapes.keys()
        for one, two in zip(seen.objects, other.objects, strict=True):
            np.testing.assert_array_equal(one.pose, two.pose)
    assert grids > 1 and len(seen.objects) == 2
