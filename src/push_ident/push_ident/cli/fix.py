"""`push-ident fix`: a scene of somebody else, corrected by what recorded pushes show."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from push_ident.cli.checks import writable_file
from push_ident.cli.identify import MapOption, ObjectOption, TotalMassOption, prior_of_options, read_options
from push_ident.cli.output import BagsArgument, JsonOption, progress, say, warn, write_json
from push_ident.cli.scene import EngineFrictionOption, ObjectBodyOption, ObjectInBodyOption, PusherBodyOption, TableInSceneOption, scene_of
from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.errors import InputError
from push_ident.extras import need
from push_ident.identification.identify import identify
from push_ident.identification.results.result import Identification
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import load_pushes
from push_ident.simulators.bullet_scene import BulletScene
from push_ident.simulators.gap import SimulatorGap, check_number_of_pushes, corrected_by, simulator_gap
from push_ident.simulators.measured import Measured, of_the_data
from push_ident.simulators.mujoco_scene import MujocoScene
from push_ident.simulators.page import write_gap_page
from push_ident.simulators.protocol import CorrectableSimulator

_NOMINAL = Prior()
_OutOption = Annotated[
    Path | None, typer.Option("--out", metavar="FILE", callback=writable_file, help="Default: beside the scene.", show_default=False)
]
_WithOption = Annotated[
    list[str] | None,
    typer.Option("--with", metavar="EFFECT", help="Add this cause instead of those of a diagnosis; may be repeated.", show_default=False),
]
_PageOption = Annotated[
    Path | None, typer.Option("--page", metavar="FILE", help="Write a page (HTML).", callback=writable_file, show_default=False)
]
_SceneArgument = Annotated[
    Path, typer.Argument(metavar="SCENE", help="MJCF file of MuJoCo, or URDF or SDF of the object, for Bullet.", show_default=False)
]


def fix_command(
    scene: _SceneArgument,
    bags: BagsArgument,
    object_body: ObjectBodyOption = "",
    pusher_body: PusherBodyOption = "",
    table_in_scene: TableInSceneOption = "",
    object_in_body: ObjectInBodyOption = "",
    engine_friction: EngineFrictionOption = "",
    with_: _WithOption = None,
    out: _OutOption = None,
    page: _PageOption = None,
    json: JsonOption = None,
    object_id: ObjectOption = "",
    map_: MapOption = None,
    total_mass: TotalMassOption = None,
) -> None:
    """Correct a scene of MuJoCo or an object of Bullet by recorded pushes, and show in that engine how far its gap shrinks.

    The object gets a foot with mass and friction under each cell, its outline the friction of the pusher; a tilt of the table becomes
    gravity, contacts become precise. Causes of tool, clocks and camera are corrections of the data: they stand in the JSON result.
    """
    if page is not None:
        need("report")
    simulator = scene_of(scene, object_body, pusher_body, table_in_scene, object_in_body, engine_friction)
    path = out or scene.with_name(f"{scene.stem}_fixed{scene.suffix}")
    if path.exists() and path.samefile(scene):
        raise InputError(f"{path} is the scene itself; name another file with --out.")
    prior = prior_of_options(total_mass, _NOMINAL.total_mass, _NOMINAL.friction, _NOMINAL.pusher_friction)
    with progress() as report:
        loaded = load_pushes(bags, object_id=object_id, options=read_options(map_, None), on_progress=report)
        check_number_of_pushes(loaded.records)
        effects = with_
        if effects is None:
            diagnosis = diagnose(loaded.records, DiagnosisSettings(prior=prior), proposes_push=False, on_progress=report)
            effects = [effect.name for effect in diagnosis.effects]
        gap = simulator_gap(loaded.records, simulator, prior, effects=effects, nuisances=loaded.nuisances, on_progress=report)
        report("identifying from all pushes")
        fit = identify(loaded.records, prior, effects=tuple(dict.fromkeys((*loaded.nuisances, *effects))))
        if fit.status.is_failure:
            raise InputError(f"The pushes identify no object, so that the scene cannot be corrected: {fit.status.value}.")
        corrected = _corrected(simulator, fit)
        written = corrected.write(path)
    for note in loaded.notes:
        warn(f"note: {note}")
    words = _words(gap, fit, f"written {' and '.join(map(str, written))}; in it: {corrected.contact_settings}")
    for text in (*gap.lines(), *words):
        say(text)
    if page is not None:
        write_gap_page(page, gap, loaded.records[0].shape.outline, words)
        say(f"written: {page}")
    write_json(
        json, {**gap.as_json(), "effects": dict(zip(fit.posterior.effects.labels, map(float, fit.posterior.effects.values), strict=True))}
    )


def _corrected(simulator: MujocoScene | BulletScene, fit: Identification) -> CorrectableSimulator:
    """The scene with the object of a fit."""
    corrected = corrected_by(simulator, fit)
    assert isinstance(corrected, Measured) and isinstance(corrected.simulator, CorrectableSimulator)
    return corrected.simulator


def _words(gap: SimulatorGap, fit: Identification, written: str) -> list[str]:
    """What came of it, for people."""
    before, after = (float(np.mean(errors)) for errors in (gap.errors[0], gap.corrected))
    outside = of_the_data(fit.posterior.effects)
    in_data = f"{', '.join(outside)}: corrected in the data, not in the scene; the values stand in --json."
    shrinks = f"On pushes that no fit has seen, the error of this scene falls from {1e3 * before:.1f} to {1e3 * after:.1f} mm."
    return [shrinks, *([in_data] if outside else []), written]
