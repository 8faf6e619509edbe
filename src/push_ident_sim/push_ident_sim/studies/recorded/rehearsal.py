"""Files of the form of the MIT pushing dataset from pushes of the planar engine, each surface with one known law of friction.

    .venv/bin/python -m push_ident_sim.studies.recorded.rehearsal FOLDER [--pushes 20] [--seed 0]

They show what recordings of this kind could show, before anyone trusts what is found in the real ones: a square plate of steel under its
own weight, pushes of 50 mm from any side at 10 to 500 mm/s, filtered poses of a tracker at 250 Hz that hardly scatter, but are off
by a constant amount in each push and stamped late, and forces at 250 Hz.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.importers import MIT_SHAPES
from push_ident.bags.importers.shapes import CELL_SIZE
from push_ident.files import write_whole
from push_ident.types import Float64Array, PoseTrack, PusherPath, WrenchTrack
from push_ident_sim.engines.planar import PlanarWorld
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import SimObject
from push_ident_sim.recordings.truth import CameraNoise, observe_motion

__all__ = ["SURFACES", "RehearsalSettings", "plate_of", "write_rehearsal"]

SURFACES: Final[Mapping[str, Mapping[str, tuple[float, ...]]]] = {
    "even": {},
    "speed": {"speed_dependent_friction": (0.15,)},
    "place": {"position_dependent_friction": (1.0, -1.0)},
    "direction": {"table_anisotropy": (0.15, 0.0)},
    "wear": {"wear": (-0.015,)},
}
"""Name of a surface -> the law of its friction, in sizes that slow pushes with measured forces should show."""
_SPEEDS: Final = (0.01, 0.02, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
"""At which the authors of the dataset scanned friction [m/s]."""
_RADIUS: Final = 0.00475
"""Of the probe [m]."""
_WAY: Final = 0.05
"""Of the probe in one push [m]: that of the published file."""
_GAP: Final = 1e-3
"""Between probe and outline before a push [m]."""
_ACCELERATION: Final = 10.0
"""Of the probe at both ends of a push [m/s^2]: a start without a ramp."""
_THICKNESS: Final = 0.013
"""Of the plates of the dataset [m]."""
_FRICTION: Final = 0.25
"""Of plate on table, and of probe on plate [-]."""
_EVERY: Final = 30.0
"""Time from the start of a push to that of the next one [s]."""


@dataclass(frozen=True, slots=True)
class RehearsalSettings:
    """How the pushes are recorded."""

    shape: str = "rect1"
    """One of `MIT_SHAPES`, a square: others have no whole number of square cells on both edges."""
    n_pushes: int = 20
    """Of each surface."""
    scatter: tuple[float, float] = (5e-6, 2.6e-5)
    """Standard deviation of position and yaw from frame to frame at rest [m, rad]: that of the published file."""
    correlation: float = 0.85
    """Of neighbouring frames at rest [1], as of filtered poses: that of the published file is 0.84 +- 0.17."""
    shift: tuple[float, float] = (3e-4, 3e-3)
    """Standard deviation of an error that all frames of a push share [m, rad]: half a millimetre at the rim, as in the published file."""
    latency: float = 5e-3
    """By which poses are stamped late [s]: 0.8 mm at 150 mm/s, as in the published file."""
    force_std: float = 0.03
    """Standard deviation of a measured force [N]: that of the published file before contact."""
    rate: float = 250.0
    """Of poses, probe and forces [Hz]."""


def write_rehearsal(
    folder: Path,
    settings: RehearsalSettings | None = None,
    *,
    seed: int = 0,
    surfaces: Mapping[str, Mapping[str, tuple[float, ...]]] = SURFACES,
) -> None:
    """Write the files of each surface to FOLDER/SURFACE/SHAPE, and what is true of them to FOLDER/known.json."""
    settings = settings or RehearsalSettings()
    known: dict[str, Any] = {}
    for number, (surface, law) in enumerate(surfaces.items()):
        rng = np.random.default_rng([seed, number])
        effects = InjectedEffects.of({**law, "pose_latency": settings.latency, "noise_correlation": settings.correlation})
        thing = plate_of(settings.shape)
        world = PlanarWorld(thing, _RADIUS, time_step=1.0 / settings.rate, effects=effects)
        for push in range(settings.n_pushes):
            name, content = _push(world, thing, effects, push, rng, settings)
            file = folder / surface / settings.shape / f"motion_surface={surface}_shape={settings.shape}_{name}_rep={push:04d}.json"
            file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(file, json.dumps(content), "the push")
        known[f"{surface}-*"] = {
            "friction": _FRICTION,
            "effects": {effect: ", ".join(f"{value:g}" for value in values) for effect, values in law.items()},
            "source": "injected",
        }
    write_whole(folder / "known.json", json.dumps(known, indent=1), "what is known")


def plate_of(shape: str) -> SimObject:
    """A square plate of the dataset with even friction, on square cells of about 10 mm that fill it whole."""
    published = MIT_SHAPES[shape]
    assert published.outline is not None
    extent = np.ptp(published.outline, axis=0)
    size = float(extent.min() / np.round(extent.min() / CELL_SIZE))
    along, across = ((np.arange(int(np.round(edge / size))) + 0.5) * size - 0.5 * edge for edge in extent)
    cells = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
    n = len(cells)
    even = np.ones(n)
    return SimObject(shape, size, cells, _THICKNESS * even, published.mass / n * even, _FRICTION * even, _FRICTION)


def _push(
    world: PlanarWorld, thing: SimObject, effects: InjectedEffects, number: int, rng: np.random.Generator, settings: RehearsalSettings
) -> tuple[str, dict[str, Any]]:
    """The part of a file's name that gives the plan, and the content of the file."""
    start = np.array([rng.uniform(0.28, 0.42), rng.uniform(-0.15, 0.09), rng.uniform(-np.pi, np.pi)])
    side, place, angle = int(rng.integers(len(thing.outline))), rng.uniform(0.05, 0.95), float(np.radians(rng.integers(-2, 3) * 20))
    speed = float(rng.choice(_SPEEDS))
    path = _path(thing.outline, start, side, place, angle, speed, settings.rate)
    motion = world.push(start, path, pushes_done=number)
    noise = CameraNoise(*settings.scatter, rate=settings.rate, rest=0.2, force_std=settings.force_std, force_rate=settings.rate)
    poses, pusher, wrench = observe_motion(motion, _RADIUS, noise, rng, effects)
    assert wrench is not None
    shift = rng.normal(size=3) * [settings.shift[0], settings.shift[0], settings.shift[1]]
    name = f"a=0_v={1e3 * speed:.0f}_i={side:.3f}_s={place:.3f}_t={angle:.3f}"
    return name, _content(poses, pusher, wrench, shift, 1.46e9 + _EVERY * number, settings.rate)


def _path(outline: Float64Array, start: Float64Array, side: int, place: float, angle: float, speed: float, rate: float) -> PusherPath:
    """Of the probe, from a gap before a place on a side of the object, at an angle to the inward normal."""
    first, last = outline[side], outline[(side + 1) % len(outline)]
    along = (last - first) / np.linalg.norm(last - first)
    heading = np.array([-along[1], along[0]])
    cos, sin = np.cos(angle), np.sin(angle)
    heading = np.array([cos * heading[0] - sin * heading[1], sin * heading[0] + cos * heading[1]])
    # The probe starts clear of the side, however obliquely it moves.
    inward = np.array([-along[1], along[0]])
    begin = first + place * (last - first) - (_RADIUS + _GAP) * inward
    ramp = speed / _ACCELERATION
    total = _WAY / speed + ramp
    time = np.append(np.arange(0.0, total, 1.0 / rate), total)
    travel = 0.5 * _ACCELERATION * np.minimum(time, ramp) ** 2 + speed * np.clip(time - ramp, 0.0, total - 2 * ramp)
    slowing = np.clip(time - (total - ramp), 0.0, ramp)
    travel += speed * slowing - 0.5 * _ACCELERATION * slowing**2
    in_object = begin + travel[:, None] * heading
    cos, sin = np.cos(start[2]), np.sin(start[2])
    return PusherPath(time, start[:2] + in_object @ np.array([[cos, sin], [-sin, cos]]), _RADIUS)


def _content(poses: PoseTrack, pusher: PusherPath, wrench: WrenchTrack, shift: Float64Array, start: float, rate: float) -> dict[str, Any]:
    """The three fields of a file; the force is that on the probe."""
    time = np.arange(0.0, pusher.time[-1], 1.0 / rate)
    tip = np.column_stack([np.interp(time, pusher.time, pusher.position[:, axis]) for axis in (0, 1)])
    return {
        "tip_pose": np.column_stack([start + time, tip, np.zeros(len(time))]).tolist(),
        "object_pose": np.column_stack([start + poses.time, poses.pose + shift]).tolist(),
        "ft_wrench": np.column_stack([start + wrench.time, -wrench.force, np.zeros(len(wrench.time))]).tolist(),
    }


def main() -> None:
    """Write them from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pushes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    write_rehearsal(arguments.folder, RehearsalSettings(n_pushes=arguments.pushes), seed=arguments.seed)


if __name__ == "__main__":
    main()
