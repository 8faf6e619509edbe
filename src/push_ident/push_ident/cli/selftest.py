"""`push-ident selftest`: what the pushes of a recording can tell, and what not."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Column, Table

from push_ident.cli.checks import above_zero, parse_numbers, writable_file
from push_ident.cli.identify import (
    CameraOption,
    DepthUnitOption,
    FrictionOption,
    MapOption,
    NoForcesOption,
    NominalMassOption,
    ObjectOption,
    PoseStdOption,
    PusherFrictionOption,
    TotalMassOption,
    WithoutOption,
    leave_out,
    prior_of_options,
    read_camera,
    read_options,
)
from push_ident.cli.output import BagsArgument, JsonOption, console, millimetres, progress, say, warn, write_json
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.extras import need
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import load_pushes
from push_ident.recovery.page import write_selftest_page
from push_ident.recovery.run import SelfTest, SelfTestOptions, selftest
from push_ident.recovery.wording import can_tell, cannot_tell, effect_rows, proof_text, quantity_rows, selftest_json, would_help

_NOMINAL, _DEFAULT = Prior(), SelfTestOptions()
_PageOption = Annotated[
    Path | None, typer.Option("--page", metavar="FILE", help="Write a page (HTML).", callback=writable_file, show_default=False)
]


def selftest_command(
    bags: BagsArgument,
    seconds: Annotated[
        float, typer.Option(callback=above_zero, help="Wall time after which nothing more is begun [s].")
    ] = _DEFAULT.seconds,
    maps: Annotated[int, typer.Option(min=1, help="Objects drawn from the prior.")] = _DEFAULT.maps,
    seed: Annotated[int, typer.Option(min=0, help="Seed of objects and noise.")] = _DEFAULT.seed,
    without: WithoutOption = "",
    no_forces: NoForcesOption = False,
    page: _PageOption = None,
    json: JsonOption = None,
    object_id: ObjectOption = "",
    camera: CameraOption = None,
    map_: MapOption = None,
    depth_unit: DepthUnitOption = None,
    pose_std: PoseStdOption = "",
    from_camera: Annotated[
        bool, typer.Option("--from-camera", help="Poses and outline in the bags come from a camera, not from a model.")
    ] = False,
    total_mass: TotalMassOption = None,
    nominal_mass: NominalMassOption = _NOMINAL.total_mass,
    friction: FrictionOption = _NOMINAL.friction,
    pusher_friction: PusherFrictionOption = _NOMINAL.pusher_friction,
) -> None:
    """Show what recorded pushes can tell: known objects and effects are put into simulated twins of them, and looked for."""
    if page is not None:
        need("report")
    settings = DiagnosisSettings(
        prior=prior_of_options(total_mass, nominal_mass, friction, pusher_friction), outline_from_camera=from_camera
    )
    left_out = parse_numbers(without, "--without") if without else []
    options, in_table = read_options(map_, depth_unit, pose_std), read_camera(camera)
    with progress() as report:
        loaded = load_pushes(bags, object_id=object_id, camera_in_table=in_table, options=options, on_progress=report)
        loaded, kept = leave_out(loaded, left_out, no_forces=no_forces)
        amount = SelfTestOptions(seconds, maps, seed)
        test = selftest([loaded[i] for i in kept], settings, nuisances=loaded.nuisances, options=amount, on_progress=report)
    for note in loaded.notes:
        warn(f"note: {note}")
    _show(test)
    write_json(json, selftest_json(test))
    if page is not None:
        write_selftest_page(page, test, title=f"the pushes of {loaded.object_id}")
        say(f"written: {page}")


def _show(test: SelfTest) -> None:
    content = selftest_json(test)
    headings = ("before", "after", "error", "in 90 %"), ("smallest detectable", "usual size")
    of_objects, of_effects = ([Column(heading, justify="right") for heading in group] for group in headings)
    objects = Table(
        "quantity", *of_objects, "known", title=f"{content['n_objects']} known objects: deviation before and after, median error"
    )
    effects = Table("effect", *of_effects, title="known effects")
    for table, rows in ((objects, quantity_rows(test)), (effects, effect_rows(test))):
        for row in rows:
            table.add_row(*row)
        if rows:
            console.print(table)
    if test.quantities:
        ends = (millimetres(content[name]) for name in ("end_error_m", "end_error_before_m"))
        say("ends of the pushes: {} with the identified maps, noise included; {} with equal cells".format(*ends))
    for proof in test.proofs:
        say(f"put in: {proof_text(proof)}")
    for heading, sentences in (("told", can_tell(test)), ("not told", cannot_tell(test)), ("would help", would_help(test))):
        for sentence in sentences:
            say(f"{heading}: {sentence}")
    for text in (*content["failures"], *test.left_out):
        warn(f"not tried: {text}")
    say(f"{test.n_pushes} pushes, seed {test.options.seed}, {test.seconds:.0f} s")
