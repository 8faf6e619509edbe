"""`push-ident push`: push an object of a live cell, at random or as given."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import typer

from push_ident.cli.checks import at_least_zero
from push_ident.cli.output import JsonOption, console, say, warn, write_json
from push_ident.cli.units import in_unit, parse_floats
from push_ident.errors import InputError
from push_ident.extras import need_ros
from push_ident.limits import check_object_id, printable
from push_ident.pushing.push import PushCode
from push_ident.types import Float64Array

if TYPE_CHECKING:
    from push_ident.nodes.client.cell_client import CellClient
    from push_ident_msgs.action import ExecutePush

_GOES_ON: Final = frozenset({PushCode.NONE, PushCode.NO_CONTACT, PushCode.UNREACHABLE, PushCode.LIMIT})
"""After which another random push is made: nothing is wrong with the cell."""
_PHASES: Final = ("planning", "approach", "pushing", "rest", "retreat", "re-centring")
_POINT: Final = "X,Y in metres, such as 0.05,-0.02"


def push_command(
    random: Annotated[int | None, typer.Option("--random", metavar="N", min=1, help="So many random pushes.", show_default=False)] = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="Push at the point of the outline next to this one [m, or 50mm,-20mm].", show_default=False),
    ] = None,
    direction: Annotated[
        float | None,
        typer.Option(metavar="ANGLE", parser=in_unit("rad"), help="Heading, from the x axis [rad, or 90deg].", show_default=False),
    ] = None,
    distance: Annotated[
        float,
        typer.Option(
            metavar="M", parser=in_unit("m"), callback=at_least_zero, help="Travel after contact [m, or 60mm]; 0: that of the executor."
        ),
    ] = 0.0,
    speed: Annotated[
        float,
        typer.Option(metavar="M/S", parser=in_unit("m/s"), callback=at_least_zero, help="Speed [m/s]; 0: that of the executor."),
    ] = 0.0,
    in_object: Annotated[bool, typer.Option("--in-object", help="--at and --direction are in the object frame, not the table's.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of random pushes: the same seed on the same object gives the same pushes.")] = 0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Plan and check only; the arm does not move.")] = False,
    object_id: Annotated[str, typer.Option("--object", metavar="ID", help="The object. Default: the only one.", show_default=False)] = "",
    json: JsonOption = None,
) -> None:
    """Push an object of a live cell; exit status 0 only where every push was made. Ctrl-C holds the arm."""
    if (at is None) != (direction is None):
        raise InputError("--at and --direction belong together: where the object is touched, and which way it is pushed.")
    if (random is not None) == (at is not None):
        raise InputError("say what to push: --random N, or --at X,Y with --direction ANGLE.")
    if object_id:
        check_object_id(object_id)
    need_ros()
    from push_ident_msgs.action import ExecutePush

    if at is not None and direction is not None:
        point = parse_floats(at, ("m", "m"), "--at", _POINT)
        goals = iter([contact_goal(point, direction, object_id=object_id, in_object=in_object, distance=distance, speed=speed)])
    elif distance or speed or in_object:
        raise InputError("--distance, --speed and --in-object are for a push --at a point; random pushes draw their own.")
    else:
        goals = random_goals(random or 1, seed, object_id)
    from push_ident.nodes.client.cell_client import CellClient

    with CellClient() as client, console.status("looking for the cell") as status:
        results = push_one_by_one(client, goals, dry_run, status.update)
    n_done = sum(result.error_code == ExecutePush.Result.NONE for result in results)
    write_json(json, {"pushes": [_content(result) for result in results], "n_done": n_done, "dry_run": dry_run})
    asked = random or 1
    if n_done < asked:
        warn(f"push-ident: {n_done} of {asked} pushes {'could be planned' if dry_run else 'were made'}")
        raise typer.Exit(1)


def contact_goal(
    point: Float64Array, direction: float, *, object_id: str = "", in_object: bool = False, distance: float = 0.0, speed: float = 0.0
) -> ExecutePush.Goal:
    """Goal of a push at the point of the outline that is nearest to `point` [m], shape (2,), towards `direction` [rad].

    Both are in the frame of `object_id` with `in_object`, else in `table`; without an id the only object is meant. `distance`: travel after
    contact [m], 0 for that of the executor, as for `speed` [m/s].

    Raises InputError for numbers that are not finite, or the frame of no named object.
    """
    from geometry_msgs.msg import Point

    from push_ident.geometry.frames import TABLE_FRAME, object_frame
    from push_ident_msgs.action import ExecutePush

    if not np.isfinite([*point, direction, distance, speed]).all():
        raise InputError("a number of the push is not finite; give metres, radians and metres per second.")
    if in_object and not object_id:
        raise InputError("--in-object needs the name of the object: --object ID.")
    return ExecutePush.Goal(
        mode=ExecutePush.Goal.MODE_CONTACT,
        object_id=object_id,
        frame_id=object_frame(object_id) if in_object else TABLE_FRAME,
        contact_point=Point(x=float(point[0]), y=float(point[1]), z=0.0),
        direction=float(direction),
        distance=float(distance),
        speed=float(speed),
    )


def random_goals(n: int, seed: int, object_id: str = "") -> Iterator[ExecutePush.Goal]:
    """Goals of `n` random pushes, reproducible from `seed`."""
    from push_ident_msgs.action import ExecutePush

    for state in np.random.SeedSequence(seed).generate_state(n):
        yield ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, seed=int(state))


def push_one_by_one(
    client: CellClient, goals: Iterator[ExecutePush.Goal], dry_run: bool, show: Callable[[str], None]
) -> list[ExecutePush.Result]:
    """Make the pushes, with a line for each, until one shows that something is wrong with the cell; `show` gets what is under way."""
    results: list[ExecutePush.Result] = []
    for number, goal in enumerate(goals, 1):
        goal.dry_run = dry_run

        def progress(feedback: ExecutePush.Feedback, number: int = number) -> None:
            show(f"push {number}: {_PHASES[feedback.phase] if feedback.phase < len(_PHASES) else 'at work'}")

        show(f"push {number}: planning")
        results.append(client.execute_push(goal, on_feedback=progress))
        result = results[-1]
        if result.error_code == PushCode.NONE:
            say(f"push {number}: {_way(result)}{' (planned only)' if dry_run else ''}")
        else:
            warn(f"push {number}: {_name(result)}: {printable(result.error_text)}")
        if result.error_code not in _GOES_ON:
            break
    return results


def _way(result: ExecutePush.Result) -> str:
    point = result.contact_point
    return (
        f"touched at ({point.x:.3f}, {point.y:.3f}) m, heading {result.direction:.2f} rad, {1e3 * result.distance:.0f} mm "
        f"at {result.speed:.2f} m/s"
    )


def _name(result: ExecutePush.Result) -> str:
    try:
        return PushCode(result.error_code).name
    except ValueError:
        return str(result.error_code)


def _content(result: ExecutePush.Result) -> dict[str, Any]:
    """For JSON: lengths in metres, angles in radians."""
    return {
        "code": _name(result),
        "text": printable(result.error_text),
        "push_id": int(result.push_id),
        "contact_point_m": [float(result.contact_point.x), float(result.contact_point.y)],
        "direction_rad": float(result.direction),
        "distance_m": float(result.distance),
        "speed_m_s": float(result.speed),
    }
