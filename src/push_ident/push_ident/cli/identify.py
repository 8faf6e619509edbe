"""`push-ident identify`: from bags to maps, without ROS."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Column, Table

from push_ident.bags.read_options import ROLE_WORDS, ReadOptions, parse_maps
from push_ident.cli.checks import above_zero, parse_numbers
from push_ident.cli.output import (
    BagsArgument,
    JsonOption,
    OutOption,
    console,
    millimetres,
    number_table,
    progress,
    say,
    warn,
    write_json,
)
from push_ident.cli.units import parse_floats
from push_ident.errors import InputError
from push_ident.extras import need
from push_ident.identification.fitting.budget import Budget
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import PushErrors, push_errors
from push_ident.identification.report.result_json import result_json
from push_ident.identification.results.identifiability import before_text, identifiability, value_text
from push_ident.identification.results.result import Identification
from push_ident.identification.solvers import DEFAULT_SOLVER, SOLVERS, solver_of
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import LoadedPushes, load_pushes
from push_ident.physics.simulation import compile_kernels
from push_ident.types import Float64Array

_NOMINAL = Prior()
ObjectOption = Annotated[
    str, typer.Option("--object", metavar="ID", help="Object to identify; default: the one with the most pushes.", show_default=False)
]
CameraOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Pose of the depth camera in `table` (4x4 numbers, text), for depth bags without tf_static.",
        show_default=False,
    ),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        metavar="TOPIC=ROLE",
        help=f"Use this topic of a bag as {', '.join(ROLE_WORDS)}; roles of an object with its id, as pose:hammer. May be repeated.",
        show_default=False,
    ),
]
DepthUnitOption = Annotated[
    float | None,
    typer.Option(
        metavar="METRES",
        callback=above_zero,
        help="Metres per unit of a depth image. Default: 0.001 for integers, 1 for reals.",
        show_default=False,
    ),
]
PoseStdOption = Annotated[
    str,
    typer.Option(
        metavar="METRES,RADIANS",
        help="Standard deviations of poses without a covariance, such as 1mm,0.5deg. Default: from the frames at rest.",
        show_default=False,
    ),
]
TotalMassOption = Annotated[
    float | None, typer.Option(callback=above_zero, help="Total mass of the object, if it was weighed [kg].", show_default=False)
]
NominalMassOption = Annotated[float, typer.Option(callback=above_zero, help="Nominal total mass [kg].")]
FrictionOption = Annotated[float, typer.Option(callback=above_zero, help="Nominal support friction.")]
PusherFrictionOption = Annotated[float, typer.Option(callback=above_zero, help="Nominal friction between pusher and object.")]
TrainOption = Annotated[
    str,
    typer.Option(metavar="0,2,5-7", help="Pushes of the fit, counted from 0 over all bags; the others are held out. Default: all."),
]
WithoutOption = Annotated[str, typer.Option(metavar="7,2-5", help="Pushes to leave out, counted from 0 over all bags.", show_default=False)]
NoForcesOption = Annotated[bool, typer.Option("--no-forces", help="Leave measured forces out.")]
_RecordOption = Annotated[
    bool, typer.Option("--record", help="In the report: each push predicted from those before it; about a second a push.")
]


def identify_command(
    bags: BagsArgument,
    method: Annotated[str, typer.Option(help=f"One of {', '.join(SOLVERS)}.")] = DEFAULT_SOLVER,
    train: TrainOption = "",
    without: WithoutOption = "",
    no_forces: NoForcesOption = False,
    out: OutOption = None,
    json: JsonOption = None,
    object_id: ObjectOption = "",
    camera: CameraOption = None,
    map_: MapOption = None,
    depth_unit: DepthUnitOption = None,
    pose_std: PoseStdOption = "",
    total_mass: TotalMassOption = None,
    nominal_mass: NominalMassOption = _NOMINAL.total_mass,
    friction: FrictionOption = _NOMINAL.friction,
    pusher_friction: PusherFrictionOption = _NOMINAL.pusher_friction,
    max_seconds: Annotated[float, typer.Option(callback=above_zero, help="Longest time of the solve [s].")] = 30.0,
    max_simulations: Annotated[int | None, typer.Option(min=1, help="Largest number of simulated pushes.", show_default=False)] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of methods that draw at random.")] = 0,
    record: _RecordOption = False,
) -> None:
    """Identify the mass and friction maps of one object from recorded pushes."""
    if out is not None:
        need("report")
    takes_effects = solver_of(method).capabilities.takes_effects
    numbers, left_out = (parse_numbers(text, name) if text else [] for text, name in ((train, "--train"), (without, "--without")))
    if both := set(numbers).intersection(left_out):
        raise InputError(f"--train and --without both name push {min(both)}; a push that is left out cannot train.")
    prior = prior_of_options(total_mass, nominal_mass, friction, pusher_friction)
    options = read_options(map_, depth_unit, pose_std)
    with progress() as report:
        loaded, kept = leave_out(_load(bags, object_id, camera, options, prior, report), left_out, no_forces=no_forces)
        chosen = _existing(numbers, "--train", len(loaded)) or kept
        report(f"identifying from {len(chosen)} pushes")
        result = identify(
            [loaded.records[i] for i in chosen],
            prior,
            method=method,
            effects=loaded.nuisances if takes_effects else (),
            budget=Budget(max_simulations=max_simulations, max_seconds=max_seconds),
            options=FitOptions(seed=seed, threads=len(os.sched_getaffinity(0))),
            on_progress=lambda best: report(f"{best.n_simulations} simulations, cost {best.cost:.1f}"),
        )
        report("predicting the pushes")
        others = [i for i in kept if i not in chosen]
        fitted, held_out = (push_errors(result, loaded.records, pushes) for pushes in (chosen, others))
    found = result.explanation.notes([loaded.records[i].source for i in chosen])
    _show_errors([*loaded.notes, *result.notes], loaded, fitted, held_out)
    _show_identifiability(result)
    content = result_json(result, loaded.object_id, fitted, held_out, [*loaded.notes, *found])
    for file in (json, None if out is None else out / "result.json"):
        write_json(file, content)
    if out is not None:
        _write_files(out, result, loaded, fitted, held_out, record=record)
    _end(result, found)


def prior_of_options(weighed: float | None, nominal_mass: float, friction: float, pusher_friction: float) -> Prior:
    """Nominal values of the command line; `weighed` is a known total mass [kg]."""
    if weighed is None:
        return Prior(total_mass=nominal_mass, friction=friction, pusher_friction=pusher_friction)
    return Prior(total_mass=weighed, total_mass_std=0.0, friction=friction, pusher_friction=pusher_friction)


def _load(
    bags: Sequence[Path], object_id: str, camera: Path | None, options: ReadOptions, prior: Prior, report: Callable[[str], None]
) -> LoadedPushes:
    """The pushes. Kernels are loaded meanwhile, most of which needs no interpreter; the first time they are compiled, in a minute."""
    in_table = read_camera(camera)
    with ThreadPoolExecutor(1) as pool:
        kernels = pool.submit(compile_kernels, gradients=False)
        loaded = load_pushes(bags, object_id=object_id, camera_in_table=in_table, options=options, possible_with=prior, on_progress=report)
        report("loading the kernels")
        kernels.result()
    return loaded


def read_options(maps: Sequence[str] | None, depth_unit: float | None, pose_std: str = "") -> ReadOptions:
    """How bags are read, from `--map`, `--depth-unit` and `--pose-std`. Raises InputError for another form, or two roles of one topic."""
    std = None
    if pose_std:
        position, yaw = parse_floats(pose_std, ("m", "rad"), "--pose-std", "METRES,RADIANS, such as 1mm,0.5deg").tolist()
        std = (position, yaw)
    return ReadOptions(parse_maps(maps or (), "--map"), depth_unit, std)


def read_camera(path: Path | None) -> Float64Array | None:
    """Homogeneous matrix of 16 numbers in a text file; None where no file is given. Raises InputError for another content."""
    if path is None:
        return None
    try:
        matrix = np.loadtxt(path, dtype=np.float64)
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the camera pose {path}: {error}; expected 4 lines of 4 numbers.") from None
    if matrix.shape != (4, 4) or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-3):
        raise InputError(f"{path} holds an array of shape {matrix.shape}, expected a 4 x 4 matrix with a rotation in it.")
    return matrix


def leave_out(loaded: LoadedPushes, numbers: list[int], *, no_forces: bool) -> tuple[LoadedPushes, list[int]]:
    """All pushes, with notes of what is left out and without forces where they shall be, and the numbers of those that stay.

    Raises InputError for numbers that no push has, or where none stays.
    """
    kept = sorted(set(range(len(loaded))).difference(_existing(numbers, "--without", len(loaded))))
    if not kept:
        raise InputError(f"--without names all {len(loaded)} pushes; leave at least one.")
    notes = [f"push {i} is left out by --without: {loaded[i].source}" for i in sorted(numbers)]
    records = loaded.records
    if no_forces:
        notes.append(f"forces of {sum(record.wrench is not None for record in records)} pushes are left out by --no-forces")
        records = [replace(record, wrench=None) for record in records]
    return replace(loaded, records=records, notes=[*loaded.notes, *notes]), kept


def _existing(numbers: list[int], option: str, n_pushes: int) -> list[int]:
    if wrong := [i for i in numbers if i >= n_pushes]:
        raise InputError(f"{option} names push {wrong[0]}, but there are {n_pushes} pushes, 0 to {n_pushes - 1}.")
    return numbers


def _show_errors(notes: Sequence[str], loaded: LoadedPushes, fitted: PushErrors, held_out: PushErrors) -> None:
    for note in notes:
        warn(f"note: {note}")
    n_cells = len(loaded.records[0].shape.cells)
    table = number_table(
        f"object {loaded.object_id}: {n_cells} cells, mean cell error at the end of a push",
        "pushes",
        "equal cells, nominal",
        "equal cells, fitted",
        "identified",
    )
    for name, errors in (("train", fitted), ("test", held_out)):
        if errors.pushes:
            row = [millimetres(float(np.mean(own))) for own in (errors.uniform, errors.scalar, errors.identified)]
            table.add_row(f"{name} ({len(errors.pushes)})", *row)
    console.print(table)


def _end(result: Identification, found: Sequence[str]) -> None:
    """Say what is wrong; raises typer.Exit with status 1 where the pushes contradict themselves, or nothing was learned."""
    for line in (*(f"warning: {text}" for text in result.warnings), *(f"! {text}" for text in found)):
        warn(line)
    if result.status.is_failure:
        warn(f"push-ident: {result.status.value}; the maps that are written are the prior")
    if result.status.is_failure or result.warnings:
        raise typer.Exit(1)


def _show_identifiability(result: Identification) -> None:
    known = identifiability(result.posterior)
    numbers = (Column(heading, justify="right") for heading in ("value", "before"))
    table = Table("quantity", *numbers, "identifiability", title="identifiability from these pushes")
    for q in known.quantities:
        table.add_row(q.name, value_text(q), before_text(q), q.knowledge.value.partition(":")[0])
    console.print(table)
    say(f"maps: {known.n_pinned} of {len(known.combinations)} combinations of the cells pinned down, {known.n_open} hardly constrained")
    if result.candidates:
        likely = [c for c in sorted(result.candidates, key=lambda c: -c.probability) if c.probability >= 0.01]
        odds = ", ".join(f"{c.name} {c.probability:.0%}" for c in likely)
        say(f"priors: {odds}")
    for label, value, std in zip(
        result.posterior.effects.labels, result.posterior.effects.values, result.posterior.effects_std, strict=True
    ):
        say(f"{label}: {value:.3g} ± {std:.2g}")
    say(f"{result.method}: {result.status.value}; {result.n_simulations} simulations in {result.time_s:.2f} s")


def _write_files(
    out: Path,
    result: Identification,
    loaded: LoadedPushes,
    train: PushErrors,
    test: PushErrors,
    *,
    record: bool = False,
) -> None:
    """Write model and report, and name the files, `result.json` included; `record`: the report has each push predicted from those before
    it.
    """
    # Models and pages take a quarter of a second to import.
    from push_ident.identification.report import Provenance, write_report
    from push_ident.identification.results.model_file import save_model

    sources = [loaded.records[i].source for i in train.pushes]
    save_model(out / "model.json", result.posterior, object_id=loaded.object_id, sources=sources, status=result.status)
    scores = []
    if record and not loaded.nuisances:  # the model of these predictions would lack the nuisances
        from push_ident.identification.online.identifier import running_record

        scores = running_record(loaded.records, result.posterior.prior)
    write_report(
        out / "report.html",
        result,
        train,
        test,
        Provenance(loaded.object_id, tuple(sources), (*loaded.notes, *result.notes, *result.explanation.notes(sources))),
        loaded.records[0].pusher.radius,
        scores,
    )
    names = ("report.html", "model.json", "result.json")
    say(f"written: {', '.join(str(out / name) for name in names)}")
