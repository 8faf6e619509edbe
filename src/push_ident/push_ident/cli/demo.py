"""`push-ident demo`: the live pipeline: perceive and push an unknown object, identify it, and predict further pushes."""

from __future__ import annotations

import json as jsonlib
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from push_ident.cli.checks import writable_folder
from push_ident.cli.live_view import ViewOption, show_view
from push_ident.cli.output import Description, JsonOption, console, millimetres, write_json
from push_ident.cli.push_to import GoalReport, GoalText, finish, goal_message, push_to_goal
from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.errors import PushIdentError
from push_ident.extras import need_ros
from push_ident.types import CellGrid, Float64Array, ObjectModel, ObjectShape

if TYPE_CHECKING:
    from push_ident.nodes.client import CellClient
    from push_ident_msgs.action import ExecutePush

__all__ = ["demo_command"]

_OK = 0
_NO_CONTACT = -5
_MAX_REFUSALS = 10
_STARTUP = 30.0
_N_TRAIN = 6
_N_TRAIN_FOR_GOAL = 2
"""Few: the pushes to the goal are learned as well."""
_TEST_SEEDS = 100_000
"""First seed of the test pushes; the training pushes have smaller ones."""


@dataclass
class _Score:
    """Errors of one test push [m]."""

    predicted_m: float
    uniform_m: float
    moved_m: float
    expected_m: float


@dataclass
class _Outcome:
    object_id: str = ""
    training: list[dict[str, Any]] = field(default_factory=list)
    test: list[_Score] = field(default_factory=list)
    truth: ObjectModel | None = None
    report: GoalReport | None = None
    """Of the pushes to a goal."""


def demo_command(
    object_name: Annotated[str, typer.Option("--object", help="hammer, wrench, crimp, toolbox or book.")] = "hammer",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the object's masses and frictions, the pushes and the noise.")] = 0,
    n_train: Annotated[int | None, typer.Option(min=1, help="Number of random training pushes.", show_default="6; with --goal 2")] = None,
    n_test: Annotated[int, typer.Option(min=1, help="Number of test pushes, predicted before they are executed.")] = 6,
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
    os.environ.setdefault("ROS_DOMAIN_ID", str(os.getpid() % 100 + 1))
    own = {"sim_cell_node": {"object": object_name, "seed": seed, "noise_seed": seed, "sensor": sensor}}
    commands = node_commands("sim", record=run / "bag", view=view, parameters=own)
    columns = (
        SpinnerColumn(),
        Description(),
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(),
    )
    with Supervisor(commands, log_dir=run / "log") as supervisor:
        show_view(view)
        from push_ident.nodes.client import CellClient

        with CellClient(check=supervisor.check) as client, Progress(*columns, console=console) as progress:
            task = progress.add_task("starting the cell", total=n_train + (n_test if where is None else 0))
            outcome = _Outcome(object_id=client.wait_for_object())
            progress.console.print(f"object {outcome.object_id} found by perception", highlight=False)

            def show(text: str, step: int) -> None:
                progress.update(task, description=text, advance=step)

            _train(client, outcome, n_train, seed, show)
            if where is None:
                _test(client, outcome, n_test, seed, show)
            else:
                outcome.report = push_to_goal(client, goal_message(where, object_id=outcome.object_id), lambda text: show(text, 0))
            client.save_model(outcome.object_id, str((run / "model.json").resolve()))
            outcome.truth = _ground_truth(client)
    if where is None:
        _finish(outcome, run, time.monotonic() - started, json)
    else:
        _finish_goal(outcome, where, run, time.monotonic() - started, json)


def _train(client: CellClient, outcome: _Outcome, n: int, seed: int, show: Any) -> None:
    from push_ident_msgs.action import ExecutePush

    _await_executor(client, outcome.object_id)
    done, tries = 0, 0
    while done < n:
        goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=outcome.object_id, seed=_push_seed(seed, tries))
        tries += 1
        show(f"training push {done + 1}: {_PHASES[0]}", 0)

        def progress(feedback: ExecutePush.Feedback, number: int = done + 1) -> None:
            show(f"training push {number}: {_PHASES[feedback.phase]}", 0)

        result = client.execute_push(goal, on_feedback=progress)
        if result.error_code != _OK:
            _refused(result, tries - done)
            continue
        latest = client.wait_for_map(outcome.object_id, done + 1)
        done += 1
        outcome.training.append({"direction": result.direction, "distance": result.distance, "speed": result.speed})
        spread = float(np.median(np.asarray(latest.mass_friction_std) / np.asarray(latest.mass_friction)))
        show(f"training push {done}: identified, maps known to {100 * spread:.0f}%", 1)
        console.print(
            f"push {done}: {1e3 * result.distance:.0f} mm at {result.speed:.2f} m/s; pusher friction "
            f"{latest.pusher_friction:.2f} ± {latest.pusher_friction_std:.2f}; cells known to {100 * spread:.0f}% (median)",
            highlight=False,
        )


def _test(client: CellClient, outcome: _Outcome, n: int, seed: int, show: Any) -> None:
    """Predict a test push from its plan, execute it, and compare with the pose that the camera measures."""
    from push_ident.identification.identify import uniform_model
    from push_ident.identification.prediction import cell_error
    from push_ident.nodes.convert_model import pusher_path_from_msg
    from push_ident.physics.scenario import PushScenario
    from push_ident.physics.simulation import simulate
    from push_ident_msgs.action import ExecutePush

    done, tries = 0, 0
    while done < n:
        object_id = outcome.object_id
        plan = ExecutePush.Goal(
            mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, seed=_push_seed(seed, _TEST_SEEDS + tries), dry_run=True
        )
        tries += 1
        planned = client.execute_push(plan)
        if planned.error_code != _OK:
            _refused(planned, tries - done)
            continue
        latest = client.latest_map(object_id)
        assert latest is not None
        shape = client.shape(object_id)
        before = client.pose_at_rest(object_id, after=-np.inf)
        prediction = client.predict(object_id, planned.tool_path)
        path = pusher_path_from_msg(planned.tool_path, client.pusher_radius)
        uniform = simulate(uniform_model(shape), PushScenario(path, before, path.time[-1:])).pose[-1]
        show(f"test push {done + 1}: predicted, now executed", 0)
        goal = ExecutePush.Goal(
            mode=ExecutePush.Goal.MODE_CONTACT,
            object_id=object_id,
            contact_point=planned.contact_point,
            direction=planned.direction,
            distance=planned.distance,
            speed=planned.speed,
        )
        result = client.execute_push(goal)
        if result.error_code not in (_OK, _NO_CONTACT):
            _refused(result, tries - done)
            continue
        after = client.pose_at_rest(object_id, after=client.poses(object_id)[-1][0])
        end = prediction.poses[-1].pose
        predicted = np.array([end.position.x, end.position.y, 2 * np.arctan2(end.orientation.z, end.orientation.w)])
        score = _Score(
            predicted_m=cell_error(shape.cells, predicted, after),
            uniform_m=cell_error(shape.cells, uniform, after),
            moved_m=cell_error(shape.cells, before, after),
            expected_m=float(prediction.cell_error_std),
        )
        outcome.test.append(score)
        done += 1
        show(f"test push {done}: error {millimetres(score.predicted_m)}", 1)
        console.print(
            f"test push {done}: travel {millimetres(score.moved_m)}; error of the prediction {millimetres(score.predicted_m)} "
            f"(expected {millimetres(score.expected_m)}), equal cells {millimetres(score.uniform_m)}",
            highlight=False,
        )


_PHASES = ("planning", "approach", "pushing, identifying", "rest", "retreat", "re-centring")


def _await_executor(client: CellClient, object_id: str) -> None:
    """Wait until the executor knows the object and its arm answers."""
    from push_ident_msgs.action import ExecutePush

    plan = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, dry_run=True)
    deadline = time.monotonic() + _STARTUP
    while (result := client.execute_push(plan)).error_code != _OK:
        if time.monotonic() > deadline:
            raise PushIdentError(f"no push can be planned {_STARTUP:.0f} s after the start: {result.error_text}")
        time.sleep(0.5)


def _push_seed(seed: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _refused(result: ExecutePush.Result, refusals: int) -> None:
    console.print(f"push not executed: {result.error_text}", style="yellow", highlight=False, soft_wrap=True)
    if refusals > _MAX_REFUSALS:
        raise PushIdentError(f"{refusals} pushes could not be executed; the last error: {result.error_text}")


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
    table = Table(title=f"cell error on {len(outcome.test)} test pushes, poses from the camera")
    for heading in ("model", "mean", "median", "worst"):
        table.add_column(heading, justify="right" if heading != "model" else "left")
    for name, errors in (("equal cells, nominal", uniform), ("identified", predicted)):
        table.add_row(name, *(millimetres(float(f(errors))) for f in (np.mean, np.median, np.max)))
    console.print(table)
    model, truth = posterior.model, outcome.truth
    name = "friction force per area [% / cm2]"
    panels = [(name, m.shape, _share(m)) for m in (truth, model)]
    relative = 100 * posterior.mass_friction_std / (model.mass * model.friction)
    draw_panels(
        run / "map.png",
        [*panels, ("deviation [%]", model.shape, relative)],
        title=f"true (left) and identified (middle) after {len(outcome.training)} pushes",
    )
    content = {
        "object_id": outcome.object_id,
        "n_train": len(outcome.training),
        "identified_m": float(predicted.mean()),
        "uniform_m": float(uniform.mean()),
        "per_push": [vars(score) for score in outcome.test],
        "training": outcome.training,
        "time_s": seconds,
    }
    write_json(run / "result.json", content)
    if json is not None:
        write_json(json, content)
    console.print(f"{seconds:.0f} s; ratio identified / equal cells {predicted.mean() / uniform.mean():.2f}", highlight=False)
    _say_files(run, "maps: map.png")


def _finish_goal(outcome: _Outcome, where: Float64Array, run: Path, seconds: float, json: Path | None) -> None:
    """Draw and write the way to the goal. Raises typer.Exit with status 1 where it was not reached."""
    from push_ident.identification.model_file import load_model
    from push_ident.planning.goal import Goal
    from push_ident.planning.goal_picture import draw_goal_pushes

    report = outcome.report
    assert report is not None
    if pushes := [(line.expected, line.seen) for line in report.lines]:
        outline = load_model(run / "model.json")[1].unknowns.shape.outline
        title = f"{len(pushes)} pushes to the goal, after {len(outcome.training)} exploring ones"
        draw_goal_pushes(run / "goal.png", outline, report.start, pushes, Goal(where), title=title)
    content = {"object_id": outcome.object_id, "training": outcome.training, **report.content(), "time_s": seconds}
    write_json(run / "result.json", content)
    if json is not None:
        write_json(json, content)
    _say_files(run, "way to the goal: goal.png")
    finish(report, None)


def _say_files(run: Path, first: str) -> None:
    what, file = first.split(": ")
    rest = (("numbers", "result.json"), ("model", "model.json"), ("recording", "bag"), ("logs of the nodes", "log"))
    for name, path in ((what, file), *rest):
        console.print(f"{name}: {run / path}", highlight=False, soft_wrap=True)
    console.print(f"again, offline: push-ident identify {run / 'bag'}", highlight=False, soft_wrap=True)


def _share(model: ObjectModel) -> Float64Array:
    """Friction force of each cell per area, relative to the total: comparable between grids of different cells."""
    product = model.mass * model.friction
    density = product / model.shape.cells.size**2
    return np.asarray(100 * density / product.sum() * 1e-4)
