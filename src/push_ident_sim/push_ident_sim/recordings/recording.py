"""Simulated pushes, with or without injected effects, as a bag of the contract: with poses, or with depth images."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from push_ident.bags.records import write_records
from push_ident.bags.writer import BagWriter
from push_ident.errors import InputError
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array, PushRecord
from push_ident_sim.cell.robot import PUSHER_LENGTH, PUSHER_RADIUS
from push_ident_sim.cell.sensor_unit import Sensor
from push_ident_sim.cell.sensors import PLAIN, check_name, suitable_pose
from push_ident_sim.engines.true_motion import TrueMotion
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.injected.sensing import check_rendered, kept_frames, stamp_delay, true_camera
from push_ident_sim.objects import OBJECT_NAMES, SimObject, make_object
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, make_pushes, observe_motion, true_model

_TIP_HEIGHT = 0.012
"""Height of the filmed tool above the table [m]."""


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """What a bag contains."""

    object_name: str = "hammer"
    model: int = 0
    """Which ground truth of the object: `make_object(object_name, model)`."""
    n_pushes: int = 14
    seed: int = 0
    """Of the pushes and of all noise."""
    effects: InjectedEffects = field(default_factory=InjectedEffects)
    speed_range: tuple[float, float] = (0.1, 0.2)
    """Of the pushes [m/s]."""
    noise: CameraNoise = field(default_factory=lambda: CameraNoise(force_std=0.05))
    camera: bool = False
    """Depth images in place of poses; each push then starts where the last one ended, and the tool is a bare rod."""
    sensor: str = PLAIN
    """Model of the camera that takes them, one of `SENSOR_NAMES`; its pose is one from which it sees the workspace."""

    def __post_init__(self) -> None:
        if self.object_name not in OBJECT_NAMES:
            raise InputError(f"Object {self.object_name!r} is not known, expected one of {', '.join(OBJECT_NAMES)}.")
        for name, lowest in (("n_pushes", 1), ("model", 0), ("seed", 0)):
            if getattr(self, name) < lowest:
                raise InputError(f"`{name}` is {getattr(self, name)}, expected at least {lowest}.")
        check_name(self.sensor)
        if self.camera:
            check_rendered(self.effects)
        elif self.sensor != PLAIN:
            raise InputError(f"Sensor {self.sensor} takes depth images, and the bag has poses; ask for a camera as well.")


def record_pushes(out: Path, settings: RecordingSettings) -> dict[str, Any]:
    """Write a new bag. Raises BagError where it exists already or cannot be written.

    Returns:
        The truth, which the bag does not contain: object, masses, frictions, effects.
    """
    if out.exists():
        raise InputError(f"{out}: exists already and is not overwritten; give another name.")
    sim_object = make_object(settings.object_name, settings.model)
    drawn = TruthSettings(n_train=settings.n_pushes, n_test=0, effects=settings.effects)
    pushes = replace(drawn.pushes, speed_range=settings.speed_range)
    if settings.camera:
        # In the field of view, and with the tool that the camera renders.
        pushes = PushSettings(speed_range=settings.speed_range, pusher_radius=PUSHER_RADIUS)
    drawn = replace(drawn, pushes=pushes)
    seed = [settings.model, OBJECT_NAMES.index(settings.object_name), settings.seed]
    motions = make_pushes(sim_object, seed, drawn, in_a_row=settings.camera)
    rngs = [np.random.default_rng([*seed, i, 1]) for i in range(len(motions))]
    if settings.camera:
        _film(out, sim_object, motions, settings, pushes.pusher_radius, rngs)
    else:
        shape, name = true_model(sim_object).shape, settings.object_name
        records = [
            PushRecord(name, shape, *observe_motion(m, pushes.pusher_radius, settings.noise, rng, settings.effects))
            for m, rng in zip(motions, rngs, strict=True)
        ]
        write_records(out, records)
    return _truth(sim_object, settings)


def seal(truth: dict[str, Any]) -> str:
    """SHA-256 of a truth, to be published before anything is scored against it."""
    return hashlib.sha256(json.dumps(truth, sort_keys=True).encode()).hexdigest()


def _truth(sim_object: SimObject, settings: RecordingSettings) -> dict[str, Any]:
    return {
        "object": settings.object_name,
        "model": settings.model,
        "seed": settings.seed,
        "effects": {name: list(values) for name, values in settings.effects.values},
        "cells_m": sim_object.cells.tolist(),
        "mass_kg": sim_object.mass.tolist(),
        "friction": sim_object.friction.tolist(),
        "pusher_friction": sim_object.pusher_friction,
    }


def _film(
    out: Path,
    sim_object: SimObject,
    motions: list[TrueMotion],
    settings: RecordingSettings,
    radius: float,
    rngs: list[np.random.Generator],
) -> None:
    look, pause = 2.0, 3.0  # before the first push, and between two of them [s]
    noise, effects = settings.noise, settings.effects
    sensor, reported = Sensor(settings.sensor, settings.seed), suitable_pose(settings.sensor)
    camera = sensor.camera(sim_object, *true_camera(effects, reported, sensor.intrinsics))
    with BagWriter(out) as writer:
        start = 1.0
        writer.write_extrinsics(start, reported)
        writer.write_pusher_shape(start, radius, height=PUSHER_LENGTH)
        start += look
        for number, (motion, rng) in enumerate(zip(motions, rngs, strict=True)):
            _, path, wrench = observe_motion(motion, radius, noise, rng, effects)
            begin, end = noise.rest, noise.rest + float(motion.time[-1])
            first = -look if number == 0 else 0.0
            times = np.arange(first, end + noise.rest, 1.0 / noise.rate)
            times = times[kept_frames(effects, len(times), rng)]
            for time in times:
                pose, tool = motion.pose_at(time - begin), motion.pusher_at(time - begin)
                links = {"hand_pusher": standing_tool(tool)} if begin <= time <= end else {}
                depth = sensor.read(sensor.look(camera, pose, links), rng)
                stamp = start + time + stamp_delay(effects, float(time))
                writer.write_camera_info(stamp, sensor.intrinsics)
                in_millimetres = sensor.encoding == "16UC1"
                writer.write_depth(stamp, np.nan_to_num(np.rint(1e3 * depth), nan=0.0).astype(np.uint16) if in_millimetres else depth)
            inside = (path.time >= begin) & (path.time <= end)
            for time, position in zip(path.time[inside], path.position[inside], strict=True):
                writer.write_pusher(start + float(time), position, z=_TIP_HEIGHT)
            if wrench is not None:
                for time, force in zip(wrench.time, wrench.force, strict=True):
                    writer.write_wrench(start + float(time), force)
            writer.write_push_record(number + 1, "", start + begin, start + end)
            start += end + noise.rest + pause


def standing_tool(tool: Float64Array) -> Float64Array:
    """Pose, shape (4, 4), of the pusher's link, which points down, with its tip over `tool` (x, y) [m]."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = [*tool, _TIP_HEIGHT + PUSHER_LENGTH]
    return pose
