"""An image older than the latest one is refused where it is of a second camera driver; alone it means that a source starts again."""

from __future__ import annotations

import pytest

from push_ident.errors import PerceptionError
from push_ident.nodes.perception.perception_node import OlderImages


class Camera:
    """How many drivers publish, and what time it is [s]."""

    def __init__(self) -> None:
        self.n_drivers, self.now = 1, 100.0
        self.older = OlderImages(lambda: self.n_drivers, lambda: self.now)


def test_an_older_image_of_the_only_driver_is_of_a_source_that_starts_again() -> None:
    Camera().older.check(5.0)


def test_an_image_of_a_second_driver_is_refused_also_just_after_it_was_stopped() -> None:
    camera = Camera()
    camera.n_drivers = 2
    with pytest.raises(PerceptionError, match=r"2 nodes publish images, and this one is 0\.100 s older"):
        camera.older.check(0.1)
    camera.n_drivers, camera.now = 1, camera.now + 0.9
    with pytest.raises(PerceptionError, match=r"0\.100 s older than the latest: of a node that has just stopped"):
        camera.older.check(0.1)
    camera.now += 0.2
    camera.older.check(0.1)
