"""`push-ident demo`: the live pipeline: perceive and push an unknown object, identify it, and predict further pushes."""

from __future__ import annotations

import json as jsonlib
import os
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column, Table

from push_ident.bags.pushes import count_pushes
from push_ident.bags.reader import read_bag
from push_ident.cli.checks import writable_folder
from push_ident.cli.demo_pushes import DemoPush, DemoPushes
from push_ident.cli.goal_report import GoalReport, goal_message
from push_ident.cli.live_view import ViewOption, show_view
from push_ident.cli.output import Description, JsonOption, console, millimetres, say, write_json
from push_ident.cli.push_to import finish, parse_goal, push_to_goal
from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.errors import PushIdentError
from push_ident.extras import need_ros
from push_ident.geometry.cut_cells import cell_polygons
from push_ident.geometry.se2 import transform_points
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import push_errors
from push_ident.identification.report import Provenance, write_report
from push_ident.identification.results.model_file import load_model
from push_ident.nodes.base.network import own_domain
from push_ident.offline.loading import load_pushes
from push_ident.pages.chart import CellPanel, cell_panel
from push_ident.pages.outline_chart import Placed, outline_panels
from push_ident.pages.page import FigureSection
from push_ident.planning.goal_page import write_goal_page
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape


def demo_command(
    object_name: Annotated[str, typer.Option("--object", help="hammer, wrench, crimp, toolbox or book.")] = "hammer",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the object's masses and frictions, the pushes and the noise.")] = 0,
    n_train: Annotated[int | None, typer.Option(min=1, help="Number of training pushes.", show_default="4; with --goal 2")] = None,
    n_test: Annotated[int, typer.Option(min=1, help="Number of test pushes, the score; each push is predicted before it is made.")] = 4,
    goal: Annotated[
        str | None, typer.Option(metavar="X,Y,YAW", help="Push it to this pose [m, m, rad, or 90deg], no test pushes.", show_default="none")
    ] = None,
    sensor: Annotated[str, typer.Option(metavar="NAME", help="Model of the simulated depth camera.")] = "plain",
    view: ViewOption = False,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", callback=writable_folder, help="Folder for the bag, the model and the report.")
    ] = Path("out/demo"),
    json: JsonOption = None,
) -> None:
    """Push an unknown object in the simulated cell, identify it during the pushes, and predict further pushes, or push it to a goal."""
    started, target = time.monotonic(), None if goal is None else parse_goal(goal)
    need_ros()
    # With a goal few: the pushes to it are learned as well.
    n_train, n_test = (n_train or 4, n_test) if target is None else (n_train or 2, 0)
    run = out / time.strftime("%Y%m%d-%H%M%S")
    os.environ.setdefault("ROS_DOMAIN_ID", str(own_domain()))
    parameters = {"sim_cell_node": {"object": object_name, "seed": seed, "noise_seed": seed, "sensor": sensor}}
    # On two cores each node that waits for nothing slows down the others.
    unused = {"gap_diagnosis_node"} | ({"goal_pushing_node"} if target is None else set())
    nodes = [node for node in node_commands("sim", record=run / "bag", view=view, parameters=parameters) if node.name not in unused]
    columns = (SpinnerColumn(), Description(), BarColumn(), TextColumn("{task.completed}/{task.total}"), TimeElapsedColumn())
    with Supervisor(nodes, log_dir=run / "log") as supervisor:
        show_view(view)
        from push_ident.nodes.client.cell_client import CellClient

        with CellClient(check=supervisor.check) as client, Progress(*columns, console=console) as progress:
            show = partial(progress.update, progress.add_task("starting the cell", total=n_train + n_test))
            object_id = client.wait_for_object()
            say(f"object {object_id} found by perception")
            pushes = DemoPushes(client, object_id, seed, run / "model.json", show)
            pushes.await_executor()
            training, tested = pushes.make(n_train), pushes.make(n_test)
            report = None if target is None else GoalReport(goal_message(target, object_id=object_id))
            if report is not None:
                push_to_goal(client, report, lambda text: show(description=text))
            client.save_model(object_id, str((run / "model.json").resolve()))
            truth, outline = _true_model(client.latched_text("sim_cell_node/ground_truth/object")), client.shape(object_id).outline
    seconds = time.monotonic() - started
    content = {"object_id": object_id, "training": [push.content() for push in training], "time_s": seconds, "n_train": n_train}
    content = content | _scores(tested, run, seconds) if report is None else report.content() | content
    for file in (run / "result.json", json):
        write_json(file, content)
    sections = [_maps_section({"True": truth, "Identified": load_model(run / "model.json")[1].model})]
    sections.append(_pushes_section(training + tested, outline))
    if report is None:
        _write_report(run, tested, sections)
    else:
        write_goal_page(run / "report.html", content, sections)
    _say_files(run, len(training + tested) + (0 if report is None else len(report.lines)))
    if report is not None:
        finish(report)


def _say_files(run: Path, n_made: int) -> None:
    """Name the files, and how many of the pushes that were made the recording has."""
    n_recorded = count_pushes(read_bag(run / "bag"))
    if n_recorded != n_made:
        say(f"the recording has {n_recorded} pushes without a fault, {n_made} were made; see {run / 'log'}", style="yellow")
    names = ("report", "numbers", "model", f"recording of {n_recorded} pushes", "logs of the nodes")
    for name, file in zip(names, ("report.html", "result.json", "model.json", "bag", "log"), strict=True):
        say(f"{name}: {run / file}")
    say(f"again, offline: push-ident identify {run / 'bag'}")


def _true_model(text: str) -> ObjectModel:
    """What the simulator publishes of its object, for the score only."""
    truth = jsonlib.loads(text)
    shape = ObjectShape(CellGrid(np.array(truth["cells"]), float(truth["cell_size"])), np.array(truth["outline"]))
    return ObjectModel(shape, np.array(truth["mass"]), np.maximum(truth["friction"], 0.0), float(truth["pusher_friction"]))


def _scores(tested: Sequence[DemoPush], run: Path, seconds: float) -> dict[str, Any]:
    """Print and return the errors on the test pushes. Raises PushIdentError where they were not predicted."""
    predicted, uniform = (np.array([getattr(push, name) for push in tested]) for name in ("predicted_m", "uniform_m"))
    if not np.isfinite(predicted).all():
        raise PushIdentError(f"identification learned no push before the test, so that nothing was predicted; see {run / 'log'}")
    numbers = (Column(name, justify="right") for name in ("mean", "median", "worst"))
    table = Table("model", *numbers, title=f"cell error on {len(tested)} test pushes, poses from the camera")
    for name, errors in (("equal cells, nominal", uniform), ("identified", predicted)):
        table.add_row(name, *(millimetres(float(f(errors))) for f in (np.mean, np.median, np.max)))
    console.print(table)
    say(f"{seconds:.0f} s for {tested[-1].number} pushes; ratio identified / equal cells {predicted.mean() / uniform.mean():.2f}")
    per_push = [push.content() for push in tested]
    return {"identified_m": float(predicted.mean()), "uniform_m": float(uniform.mean()), "per_push": per_push}


def _write_report(run: Path, tested: Sequence[DemoPush], sections: Sequence[FigureSection]) -> None:
    """The page of the recording, identified again from all its pushes as the model was; its score is that of the live predictions."""
    loaded = load_pushes([run / "bag"])
    every, sources = range(len(loaded.records)), tuple(record.source for record in loaded.records)
    result = identify(loaded.records, effects=loaded.nuisances)
    fitted, held_out = (push_errors(result, loaded.records, list(numbers)) for numbers in (every, ()))
    source, radius = Provenance(loaded.object_id, sources, tuple(loaded.notes)), loaded.records[0].pusher.radius
    scores = [push.score for push in tested]
    write_report(run / "report.html", result, fitted, held_out, source, radius, scores, sections)


def _pushes_section(pushes: Sequence[DemoPush], outline: Float64Array) -> FigureSection:
    """A drawing of each push; `outline` of the object in its frame [m], shape (n_vertices, 2)."""
    drawings = []
    for push in pushes:
        poses = [("before", "before the push", push.before), ("seen", "observed after the push", push.after)]
        poses += [(style, "predicted", way["end"]) for style, way in zip(("predicted", "other"), push.ways, strict=False)]
        title = f"Push {push.number}: {push.expectation}" + (f"; error {millimetres(push.predicted_m)}" if push.ways else "")
        drawings.append((title, [Placed(transform_points(np.array(pose), outline), style, text) for style, text, pose in poses]))
    note = "From above, in the table frame. Filled: before the push. Dashed: predicted before it, twice where it may end in two ways. "
    return FigureSection("Predicted live, then pushed", outline_panels(drawings), note + "Solid: observed after it.")


def _maps_section(models: dict[str, ObjectModel]) -> FigureSection:
    """The truth beside what was identified; loads per area are comparable between grids of different cells."""
    loads = {name: model.mass * model.friction for name, model in models.items()}
    shares = {name: 1e-2 * load / (load.sum() * models[name].shape.cells.areas) for name, load in loads.items()}
    top = float(np.concatenate(list(shares.values())).max())
    shapes = {name: model.shape for name, model in models.items()}
    panels = [CellPanel(n, s.cells.centres, cell_polygons(s), s.outline, shares[n], "%/cm²", top=top) for n, s in shapes.items()]
    note = "Share of the friction force of the object that each square centimetre bears."
    return FigureSection("The true map beside the identified one", [(panel.title, cell_panel(panel)) for panel in panels], note)
