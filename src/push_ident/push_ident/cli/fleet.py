"""`push-ident fleet`: identify many bags, here or on a Ray cluster."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from push_ident.cli.checks import above_zero, writable_folder
from push_ident.cli.identify import DepthUnitOption, MapOption, ObjectOption, PoseStdOption, read_options
from push_ident.cli.output import Description, JsonOption, console, millimetres, say, warn, write_json
from push_ident.extras import need
from push_ident.fleet import FleetOptions, find_jobs, run_fleet, write_index, write_table
from push_ident.fleet.job import Outcome
from push_ident.identification.solvers import DEFAULT_SOLVER, SOLVERS, solver_of
from push_ident.identification.unknowns.prior import Prior

_NOMINAL = Prior()
_OutOption = Annotated[
    Path,
    typer.Option("--out", metavar="DIR", callback=writable_folder, help="Folder of results; an interrupted run continues from them."),
]
_AddressOption = Annotated[
    str, typer.Option(help="Address of a Ray cluster, such as `auto` or ray://host:10001. Default: this machine.", show_default=False)
]


def fleet_command(
    bags: Annotated[list[Path], typer.Argument(metavar="BAG...", help="Bags, or folders that hold bags at any depth.", show_default=False)],
    out: _OutOption = Path("out/fleet"),
    address: _AddressOption = "",
    workers: Annotated[int, typer.Option(min=0, help="Processes on this machine; 0: one per core.")] = 0,
    again: Annotated[bool, typer.Option("--again", help="Retry bags that failed in an earlier run.")] = False,
    object_id: ObjectOption = "",
    method: Annotated[str, typer.Option(help=f"One of {', '.join(SOLVERS)}.")] = DEFAULT_SOLVER,
    hold_out: Annotated[int, typer.Option(min=0, metavar="N", help="Hold out every Nth push as a test; 0: none.")] = 4,
    nominal_mass: Annotated[float, typer.Option(callback=above_zero, help="Nominal total mass [kg].")] = _NOMINAL.total_mass,
    friction: Annotated[float, typer.Option(callback=above_zero, help="Nominal support friction.")] = _NOMINAL.friction,
    pusher_friction: Annotated[float, typer.Option(callback=above_zero, help="Nominal pusher friction.")] = _NOMINAL.pusher_friction,
    max_seconds: Annotated[float, typer.Option(callback=above_zero, help="Time limit of one solve [s].")] = 30.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of methods that draw random numbers.")] = 0,
    pages: Annotated[bool, typer.Option("--pages/--no-pages", help="Write a page for each bag; about a second of each.")] = True,
    json: JsonOption = None,
    map_: MapOption = None,
    depth_unit: DepthUnitOption = None,
    pose_std: PoseStdOption = "",
) -> None:
    """Identify many bags in parallel; a failed bag does not stop the others. Writes results.parquet, index.html and the models."""
    solver_of(method)
    need("fleet")
    need("report")
    options = FleetOptions(
        prior=Prior(total_mass=nominal_mass, friction=friction, pusher_friction=pusher_friction),
        method=method,
        object_id=object_id,
        held_out=hold_out,
        max_seconds=max_seconds,
        seed=seed,
        pages=pages,
        reading=read_options(map_, depth_unit, pose_std),
    )
    jobs = find_jobs(bags, options)
    columns = (Description(), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    n_failed = 0
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("bags", total=len(jobs))

        def show(outcome: Outcome) -> None:
            nonlocal n_failed
            n_failed += outcome["state"] == "failed"
            progress.update(task, advance=1, description=f"{Path(outcome['bag']).name}; {n_failed} failed")

        outcomes = run_fleet(jobs, options, out, address=address, workers=workers, again=again, on_outcome=show)
    write_table(out / "results.parquet", outcomes)
    write_index(out / "index.html", outcomes)
    done = [outcome for outcome in outcomes if outcome["state"] == "done"]
    errors = [o["result"]["test"]["identified_m"] for o in done if o["result"]["test"]["pushes"]]
    say(
        f"{len(done)} of {len(outcomes)} bags identified; median error on held-out pushes "
        f"{millimetres(float(np.median(errors)) if errors else float('nan'))}"
    )
    for outcome in (one for one in outcomes if one["state"] == "failed"):
        warn(f"failed: {outcome['bag']}: {outcome['error']}")
    say(f"written: {out / 'index.html'}, {out / 'results.parquet'}")
    write_json(json, {"bags": outcomes})
    if not done:
        raise typer.Exit(1)
