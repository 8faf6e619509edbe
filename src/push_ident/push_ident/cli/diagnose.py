"""`push-ident diagnose`: where the simulation parts from recorded pushes, and why."""

from __future__ import annotations

import math
from typing import Annotated

import typer
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from push_ident.cli.identify import CameraOption, ObjectOption, read_camera
from push_ident.cli.output import BagsArgument, JsonOption, OutOption, console, warn, write_json
from push_ident.diagnosis.diagnose import diagnose
from push_ident.diagnosis.diagnosis_json import to_json
from push_ident.diagnosis.report import write_report
from push_ident.diagnosis.settings import DiagnosisSettings
from push_ident.diagnosis.verdict import Diagnosis
from push_ident.identification.model_file import save_model
from push_ident.identification.prior import Prior
from push_ident.offline.loading import load_pushes
from push_ident.physics.effects import EFFECTS

__all__ = ["diagnose_command"]

_NOMINAL = Prior()
_SHOWN = 8


def diagnose_command(
    bags: BagsArgument,
    base: Annotated[
        list[str] | None,
        typer.Option("--with", metavar="EFFECT", help="Put this effect into the base model; may be repeated.", show_default=False),
    ] = None,
    out: OutOption = None,
    json: JsonOption = None,
    object_id: ObjectOption = "",
    camera: CameraOption = None,
    seen: Annotated[bool, typer.Option("--seen", help="Poses and outline in the bags come from a camera, not from a model.")] = False,
    total_mass: Annotated[float | None, typer.Option(help="Weight of the object, if it was weighed [kg].", show_default=False)] = None,
    nominal_mass: Annotated[float, typer.Option(help="Nominal total mass [kg].")] = _NOMINAL.total_mass,
    friction: Annotated[float, typer.Option(help="Nominal support friction.")] = _NOMINAL.friction,
    pusher_friction: Annotated[
        float, typer.Option(help="Nominal friction of the pusher: another one is an effect.")
    ] = _NOMINAL.pusher_friction,
) -> None:
    """Say where the simulation parts from recorded pushes, which effect it leaves out, and how much of the gap goes with it."""
    prior = Prior(
        total_mass=nominal_mass if total_mass is None else total_mass,
        total_mass_std=_NOMINAL.total_mass_std if total_mass is None else 0.0,
        friction=friction,
        pusher_friction=pusher_friction,
    )
    settings = DiagnosisSettings(prior=prior, base_effects=tuple(base or ()), outline_is_seen=seen)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("reading")

        def report(text: str) -> None:
            progress.update(task, description=text)

        loaded = load_pushes(bags, object_id=object_id, camera_in_table=read_camera(camera), on_progress=report)
        diagnosis = diagnose(loaded.records, settings, on_progress=report)
    _show(diagnosis)
    content = to_json(diagnosis)
    if json is not None:
        write_json(json, content)
    if out is not None:
        write_json(out / "diagnosis.json", content)
        write_report(
            out / "report.html", diagnosis, object_id=loaded.object_id, sources=[r.source for r in loaded.records], notes=loaded.notes
        )
        files = ["report.html", "diagnosis.json"]
        if diagnosis.fit is not None:
            sources = [record.source for record in loaded.records]
            save_model(out / "model.json", diagnosis.fit.posterior, object_id=loaded.object_id, sources=sources)
            files.append("model.json")
        console.print(f"written: {', '.join(str(out / name) for name in files)}", highlight=False, soft_wrap=True)


def _show(diagnosis: Diagnosis) -> None:
    for gate in diagnosis.gates:
        if not gate.passed:
            warn(f"! {gate.found}: {gate.remedy}")
    console.print(f"{diagnosis.verdict.value}: {diagnosis.sentence}", highlight=False, soft_wrap=True)
    if diagnosis.check:
        console.print(f"To settle it without a push: {diagnosis.check}", highlight=False, soft_wrap=True)
    proposal = diagnosis.next_push
    if proposal is not None and proposal.push.plan is not None:
        plan = proposal.push.plan
        console.print(
            f"The push that {proposal.aim}: contact at ({plan.contact_point[0]:.3f}, "
            f"{plan.contact_point[1]:.3f}) m, heading {plan.direction:.2f} rad, {plan.distance:.3f} m at {plan.speed:.2f} m/s, table "
            "frame. " + ("It should be enough." if proposal.settles else "It will hardly be enough by itself."),
            highlight=False,
            soft_wrap=True,
        )
    elif diagnosis.confusable:
        console.print("No push within the limits of a push would tell what is still open.", highlight=False)
    if diagnosis.selection is None:
        return
    first = diagnosis.selection.steps[0]
    refitted = {c.name: c.gain for c in first.candidates}
    table = Table(title="effects beside the base model")
    for heading, justify in (("effect", "left"), ("evidence [nat]", "right"), ("smallest that would have shown", "right"), ("", "left")):
        table.add_column(heading, justify=justify)  # type: ignore[arg-type]
    ranked = sorted(first.scores, key=lambda s: -refitted.get(s.name, s.gain))
    for score in ranked[:_SHOWN]:
        gain = refitted.get(score.name, score.gain)
        found = "found" if score.name in diagnosis.selection.found else ""
        unit = EFFECTS[score.name].parameters[0].unit
        smallest = f"{score.smallest:.2g} {unit}".rstrip() if math.isfinite(score.smallest) else "none"
        table.add_row(score.name, f"{gain:.1f}", smallest, found)
    console.print(table)
