"""`push-ident demo`: the live pipeline: perceive and push an unknown object, identify it, and predict further pushes."""

from __future__ import annotations

import json as jsonlib
import os
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from push_ident.cli.checks import writable_folder
from push_ident.cli.demo_pushes import DemoPush, DemoPushes
from push_ident.cli.goal_messages import goal_message
from push_ident.cli.goal_report import GoalReport
from push_ident.cli.live_view import ViewOption, show_view
from push_ident.cli.output import Description, JsonOption, console, millimetres, write_json
from push_ident.cli.push_to import GoalText, finish, push_to_goal
from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.errors import PushIdentError
from push_ident.extras import need_ros
from push_ident.nodes.base.network import own_domain
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape

if TYPE_CHECKING:
    from push_ident.nodes.client.cell_client import CellClient

__all__ = ["demo_command"]

_OK = 0
_STARTUP = 30.0
_N_TRAIN = 4
_N_TRAIN_FOR_GOAL = 2
"""Few: the pushes to the goal are learned as well."""


@dataclass
class _Outcome:
    object_id: str = ""
    training: list[DemoPush] = field(default_factory=list)
    test: list[DemoPush] = field(default_factory=list)
    truth: ObjectModel | None = None
    report: GoalReport | None = None
    """Of the pushes to a goal."""


def demo_command(
    object_name: Annotated[str, typer.Option("--object", help="hammer, wrench, crimp, toolbox or book.")] = "hammer",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the object's masses and frictions, the pushes and the noise.")] = 0,
    n_train: Annotated[int | None, typer.Option(min=1, help="Number of random training pushes.", show_default="4; with --goal 2")] = None,
    n_test: Annotated[int, typer.Option(min=1, help="Number of test pushes, the score; each push is predicted before it is made.")] = 4,
    goal: Annotated[
        str | None, typer.Option(metavar="X,Y,YAW", help="Push it to this pose [m, m, rad] instead of test pushes.", show_default="none")
    ] = None,
    sensor: Annotated[str, typer.Option(metavar="NAME", help="Model of the simulated depth camera.")] = "plain",
    view: ViewOption = False,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", callback=writable_folder, help="Folder for the bag, the model and the pictures.")
    ] = Path("out/demo"),
    json: JsonOption = None,
) -> None:
    """Push an unknown object in the simulated cell, identify it during the pushes, and predict further pushes, or push it to a goal."""
    started = time.monotonic()
    where = None if goal is None else GoalText(goal).pose
    need_ros()
    n_train = n_train or (_N_TRAIN if where is None else _N_TRAIN_FOR_GOAL)
    run = out / time.strftime("%Y%m%d-%H%M%S")
    os.environ.setdefault("ROS_DOMAIN_ID", str(own_domain()))
    own = {"sim_cell_node": {"object": object_name, "seed": seed, "noise_seed": seed, "sensor": sensor}}
    # On two cores each node that waits for nothing slows down the others.
    unused = {"gap_diagnosis_node"} | ({"goal_pushing_node"} if where is None else set())
    commands = [command for command in node_commands("sim", record=run / "bag", view=view, parameters=own) if command.name not in unused]
    columns = (SpinnerColumn(), Description(), BarColumn(), TextColumn("{task.completed}/{task.total}"), TimeElapsedColumn())
    with Supervisor(commands, log_dir=run / "log") as supervisor:
        show_view(view)
        from push_ident.nodes.client.cell_client import CellClient

        with CellClient(check=supervisor.check) as client, Progress(*columns, console=console) as progress:
            task = progress.add_task("starting the cell", total=n_train + (n_test if where is None else 0))
            outcome = _Outcome(object_id=client.wait_for_object())
            progress.console.print(f"object {outcome.object_id} found by perception", highlight=False)

            def show(text: str, step: int) -> None:
                progress.update(task, description=text, advance=step)

            _await_executor(client, outcome.object_id)
            pushes = DemoPushes(client, outcome.object_id, seed, run, show)
            pushes.make(n_train)
            outcome.training = pushes.made[:]
            if where is None:
                pushes.make(n_test)
                outcome.test = pushes.made[n_train:]
            else:
                outcome.report = GoalReport(goal_message(where, object_id=outcome.object_id))
                push_to_goal(client, outcome.report, lambda text: show(text, 0))
            client.save_model(outcome.object_id, str((run / "model.json").resolve()))
            outcome.truth = _ground_truth(client)
    if where is None:
        _finish(outcome, run, time.monotonic() - started, json)
    else:
        _finish_goal(outcome, where, run, time.monotonic() - started, json)


def _await_executor(client: CellClient, object_id: str) -> None:
    """Wait until the executor knows the object and its arm answers."""
    from push_ident_msgs.action import ExecutePush

    plan = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, dry_run=True)
    deadline = time.monotonic() + _STARTUP
    while (result := client.execute_push(plan)).error_code != _OK:
        if time.monotonic() > deadline:
            raise PushIdentError(f"no push can be planned {_STARTUP:.0f} s after the start: {result.error_text}")
        time.sleep(0.5)


def _ground_truth(client: CellClient) -> ObjectModel:
    """Ground truth of the simulator: read at the end, for the score only."""
    truth = jsonlib.loads(client.latched_text("sim_cell_node/ground_truth/object"))
    cells = CellGrid(np.array(truth["cells"]), float(truth["cell_size"]))
    shape = ObjectShape(cells, np.array(truth["outline"]))
    return ObjectModel(shape, np.array(truth["mass"]), np.maximum(truth["friction"], 0.0), float(truth["pusher_friction"]))


def _finish(outcome: _Outcome, run: Path, seconds: float, json: Path | None) -> None:
    from push_ident.identification.model_file import load_model
    from push_ident.identification.picture import draw_panels

    _, posterior = load_model(run / "model.json")
    assert outcome.truth is not None
    predicted, uniform = (np.array([getattr(s, name) for s in outcome.test]) for name in ("predicted_m", "uniform_m"))
    if not np.isfinite(predicted).all():
        raise PushIdentError(f"identification learned no push before the test, so that nothing was predicted; see {run / 'log'}")
    table = Table(title=f"cell error on {len(outcome.test)} test pushes, poses from the camera")
    for heading in ("model", "mean", "median", "worst"):
        table.add_column(heading, justify="right" if heading != "model" else "left")
    for name, errors in (("equal cells, nominal", uniform), ("identified", predicted)):
        table.add_row(name, *(millimetres(float(f(errors))) for f in (np.mean, np.median, np.max)))
    console.print(table)
    model, truth = posterior.model, outcome.truth
    name = "share of the friction force [%/cm²]"
    panels = [(name, m.shape, _share(m)) for m in (truth, model)]
    relative = 100 * posterior.mass_friction_std / (model.mass * model.friction)
    draw_panels(
        run / "map.png",
        [*panels, ("standard deviation of a cell [%]", model.shape, relative)],
        title="true (left) and identified (middle) after all pushes",
    )
    content = {
        "object_id": outcome.object_id,
        "n_train": len(outcome.training),
        "identified_m": float(predicted.mean()),
        "uniform_m": float(uniform.mean()),
        "per_push": [asdict(push) for push in outcome.test],
        "training": [_known(push) for push in outcome.training],
        "time_s": seconds,
    }
    write_json(run / "result.json", content)
    if json is not None:
        write_json(json, content)
    console.print(f"{seconds:.0f} s; ratio identified / equal cells {predicted.mean() / uniform.mean():.2f}", highlight=False)
    _write_report(run, len(outcome.test))
    _say_files(run, "pushes as predicted and as seen: pushes.png", "maps: map.png", "report: report.html")


def _write_report(run: Path, n_test: int) -> None:
    """The page of the recording, identified again from all pushes but the last."""
    from push_ident.identification.identify import identify
    from push_ident.identification.push_errors import push_errors
    from push_ident.identification.report import Provenance, write_report
    from push_ident.offline.loading import load_pushes

    loaded = load_pushes([run / "bag"])
    n = len(loaded.records)
    chosen = range(max(n - n_test, 1))
    result = identify([loaded.records[i] for i in chosen], effects=loaded.nuisances)
    fitted, held_out = (push_errors(result, loaded.records, list(pushes)) for pushes in (chosen, range(len(chosen), n)))
    source = Provenance(loaded.object_id, tuple(loaded.records[i].source for i in chosen), tuple(loaded.notes))
    write_report(run / "report.html", result, fitted, held_out, source, loaded.records[0].pusher.radius)


def _finish_goal(outcome: _Outcome, where: Float64Array, run: Path, seconds: float, json: Path | None) -> None:
    """Draw and write the way to the goal. Raises typer.Exit with status 1 where it was not reached."""
    from push_ident.planning.goal import Goal
    from push_ident.planning.goal_page import write_goal_page
    from push_ident.planning.goal_picture import draw_goal_pushes

    report = outcome.report
    assert report is not None
    if (pushes := [(line.expected, line.seen) for line in report.lines]) and report.outline is not None:
        title = f"{len(pushes)} pushes to the goal, after {len(outcome.training)} exploring ones"
        draw_goal_pushes(run / "goal.png", report.outline, report.start, pushes, Goal(where), title=title)
    training = [_known(push) for push in outcome.training]
    content = {**report.content(), "object_id": outcome.object_id, "training": training, "time_s": seconds}
    write_json(run / "result.json", content)
    write_goal_page(run / "report.html", content)
    if json is not None:
        write_json(json, content)
    _say_files(run, "exploring pushes: pushes.png", "way to the goal: report.html")
    finish(report)


def _known(push: DemoPush) -> dict[str, Any]:
    """Of a push, without what was not predicted."""
    return {key: value for key, value in asdict(push).items() if not isinstance(value, float) or np.isfinite(value)}


def _say_files(run: Path, *first: str) -> None:
    rest = (("numbers", "result.json"), ("model", "model.json"), ("recording", "bag"), ("logs of the nodes", "log"))
    for name, path in (*(tuple(text.split(": ")) for text in first), *rest):
        console.print(f"{name}: {run / path}", highlight=False, soft_wrap=True)
    console.print(f"again, offline: push-ident identify {run / 'bag'}", highlight=False, soft_wrap=True)


def _share(model: ObjectModel) -> Float64Array:
    """Friction force of each cell per area, relative to the total: comparable between grids of different cells."""
    product = model.mass * model.friction
    density = product / model.shape.cells.size**2
    return np.asarray(100 * density / product.sum() * 1e-4)
