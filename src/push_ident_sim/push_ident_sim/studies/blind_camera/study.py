"""The blind check through rendered depth images and perception, with enough cases to tell its figures."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from push_ident_sim.studies.blind.page import draw
from push_ident_sim.studies.blind.study import STUDY as BLIND

__all__ = ["STUDY"]

STUDY = replace(
    BLIND,
    name="blind-camera",
    place=131,
    title="Blind check of the diagnosis through the camera",
    question=(
        "Does a diagnosis of 8 pushes that a depth camera saw name the right cause? The blind check with every case through rendered "
        "depth images and perception: poses, outlines and the covariance of poses are those of perception. An effect that cannot be "
        "filmed, as one of published poses, is left out, and its case has none. No requested push is made, since the object of a rendered "
        "scene lies where it came to rest."
    ),
    variants=("camera",),
    every={},
    stages=(*BLIND.stages, "perception"),
    draw=partial(draw, name="blind-camera"),
)
