"""`push-ident diagnose`: where a simulation differs from recorded pushes, and why."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Column, Table

from push_ident.cli.checks import above_zero, parse_numbers
from push_ident.cli.identify import (
    CameraOption,
    DepthUnitOption,
    FrictionOption,
    MapOption,
    NoForcesOption,
    NominalMassOption,
    ObjectOption,
    PoseStdOption,
    TotalMassOption,
    WithoutOption,
    leave_out,
    prior_of_options,
    read_camera,
    read_options,
)
from push_ident.cli.output import BagsArgument, JsonOption, OutOption, console, progress, say, warn, write_json
from push_ident.cli.scene import EngineFrictionOption, ObjectBodyOption, ObjectInBodyOption, PusherBodyOption, TableInSceneOption, scene_of
from push_ident.diagnosis.diagnose import diagnose, with_simulator
from push_ident.diagnosis.diagnosis_json import to_json
from push_ident.diagnosis.report import write_report
from push_ident.diagnosis.result import Diagnosis
from push_ident.diagnosis.selection import Selection
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.wording import describe_push, detectable_size
from push_ident.extras import need
from push_ident.identification.results.model_file import save_model
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import load_pushes
from push_ident.simulators.gap import check_number_of_pushes
from push_ident.types import PushRecord

_NOMINAL = Prior()

_AgainstOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--against",
        metavar="BAG",
        help="Name what changed since this recording of the same object and cell; may be repeated.",
        show_default=False,
    ),
]
_WithOption = Annotated[
    list[str] | None,
    typer.Option("--with", metavar="EFFECT", help="Put this effect into the base model; may be repeated.", show_default=False),
]
_FromCameraOption = Annotated[
    bool, typer.Option("--from-camera", help="Poses and outline in the bags come from a camera, not from a model.")
]
_SimulatorOption = Annotated[
    Path | None,
    typer.Option(
        "--simulator",
        metavar="SCENE",
        help="Divide the gap of this scene of MuJoCo (MJCF) or object of Bullet (URDF) as well.",
        show_default=False,
    ),
]
_PusherFrictionOption = Annotated[float, typer.Option(callback=above_zero, help="Nominal pusher friction: another value is an effect.")]


def diagnose_command(
    bags: BagsArgument,
    base: _WithOption = None,
    against: _AgainstOption = None,
    without: WithoutOption = "",
    no_forces: NoForcesOption = False,
    simulator: _SimulatorOption = None,
    object_body: ObjectBodyOption = "",
    pusher_body: PusherBodyOption = "",
    table_in_scene: TableInSceneOption = "",
    object_in_body: ObjectInBodyOption = "",
    engine_friction: EngineFrictionOption = "",
    out: OutOption = None,
    json: JsonOption = None,
    object_id: ObjectOption = "",
    camera: CameraOption = None,
    map_: MapOption = None,
    depth_unit: DepthUnitOption = None,
    pose_std: PoseStdOption = "",
    from_camera: _FromCameraOption = False,
    total_mass: TotalMassOption = None,
    nominal_mass: NominalMassOption = _NOMINAL.total_mass,
    friction: FrictionOption = _NOMINAL.friction,
    pusher_friction: _PusherFrictionOption = _NOMINAL.pusher_friction,
) -> None:
    """Report where the simulation differs from recorded pushes, which missing effect causes it, and how far the gap shrinks with it."""
    if out is not None:
        need("report")
    prior = prior_of_options(total_mass, nominal_mass, friction, pusher_friction)
    settings = DiagnosisSettings(prior=prior, base_effects=tuple(base or ()), outline_from_camera=from_camera)
    scene = simulator and scene_of(simulator, object_body, pusher_body, table_in_scene, object_in_body, engine_friction)
    left_out = parse_numbers(without, "--without") if without else []
    options, in_table = read_options(map_, depth_unit, pose_std), read_camera(camera)
    with progress() as report:
        loaded = load_pushes(bags, object_id=object_id, camera_in_table=in_table, options=options, on_progress=report)
        loaded, kept = leave_out(loaded, left_out, no_forces=no_forces)
        records = [loaded[i] for i in kept]
        reference: Sequence[PushRecord] = ()
        if against:
            # Read together, so that it is certainly the same object with the same cells.
            both = load_pushes([*bags, *against], object_id=loaded.object_id, camera_in_table=in_table, options=options, on_progress=report)
            reference = leave_out(both[len(loaded) :], [], no_forces=no_forces)[0]
        if scene:
            check_number_of_pushes(records)
        diagnosis = diagnose(records, settings, against=reference, on_progress=report)
        if scene:
            diagnosis = with_simulator(diagnosis, records, scene, prior, nuisances=loaded.nuisances, on_progress=report)
    _show(diagnosis, loaded.notes)
    content = to_json(diagnosis)
    for file in (json, None if out is None else out / "diagnosis.json"):
        write_json(file, content)
    if out is not None:
        sources = [record.source for record in records]
        write_report(out / "report.html", diagnosis, object_id=loaded.object_id, sources=sources, notes=loaded.notes)
        names = ["report.html", "diagnosis.json"]
        if diagnosis.fit is not None and not against:
            save_model(out / "model.json", diagnosis.fit.posterior, object_id=loaded.object_id, sources=sources)
            names.append("model.json")
        say(f"written: {', '.join(str(out / name) for name in names)}")


def _show(diagnosis: Diagnosis, notes: Sequence[str]) -> None:
    for note in notes:
        warn(f"note: {note}")
    for gate in diagnosis.gates:
        if not gate.passed:
            warn(f"! {gate.finding}: {gate.remedy}")
    for warning in diagnosis.warnings:
        warn(f"warning: {warning}")
    say(f"{diagnosis.verdict.value}: {diagnosis.sentence}")
    if diagnosis.check:
        say(f"To check: {diagnosis.check}")
    if diagnosis.next_push is not None and (push := describe_push(diagnosis.next_push)) not in diagnosis.sentence:
        say(f"The push that teaches most: {push}.")
    for line in diagnosis.simulator.lines() if diagnosis.simulator else ():
        say(line)
    if diagnosis.selection is not None:
        console.print(_ranking(diagnosis.selection))


def _ranking(selection: Selection) -> Table:
    """The eight most promising effects of the first step."""
    first = selection.steps[0]
    refitted = {c.name: c.log_bayes_factor for c in first.candidates}
    numbers = (Column(heading, justify="right") for heading in ("log Bayes factor [nat]", "smallest detectable size"))
    table = Table("effect", *numbers, "", title="effects beside the base model")
    ranked = sorted(first.scores, key=lambda s: -refitted.get(s.name, s.expected_log_bayes_factor))
    for score in ranked[:8]:
        value = refitted.get(score.name, score.expected_log_bayes_factor)
        smallest = detectable_size(score.name, selection.smallest_detectable[score.name]) or "none"
        table.add_row(score.name, f"{value:.1f}", smallest, "found" if score.name in selection.selected else "")
    return table
