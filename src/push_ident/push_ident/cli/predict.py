"""`push-ident predict`: predictions of recorded pushes, compared with what happened, and of a push that nobody has made."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer

from push_ident.checking.records import check_records
from push_ident.cli.checks import above_zero, at_least_zero
from push_ident.cli.identify import CameraOption, DepthUnitOption, MapOption, ObjectOption, PoseStdOption, read_camera, read_options
from push_ident.cli.output import JsonOption, OutOption, console, millimetres, number_table, say, warn, write_json
from push_ident.cli.units import in_unit, parse_floats
from push_ident.errors import InputError
from push_ident.identification.predicting.planned import PUSHER_RADIUS, PlannedPush, predict_planned
from push_ident.identification.predicting.scoring import PredictedPush, compare_pushes
from push_ident.identification.results.model_file import failure_of_model, load_model, sources_of_model
from push_ident.identification.results.posterior import ModelPosterior
from push_ident.offline.loading import LoadedPushes, load_pushes
from push_ident.offline.pusher_file import read_pusher_path
from push_ident.types import Float64Array, SolveStatus

_FOR_PEOPLE: Final = ((1e3, "mm"), (1e3, "mm"), (180.0 / np.pi, "°"))
"""Factor and unit of x, y and yaw."""


_PoseOption = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,YAW", help="Without bags: pose of the object before the push [m, m, rad, or 5cm,0,90deg].", show_default=False
    ),
]


def predict_command(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="Model file, as `identify --out DIR` writes it (DIR/model.json).", show_default=False)
    ],
    bags: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[BAG...]", help="Recorded pushes: folders, .mcap, .db3 or ROS 1 .bag files.", show_default=False),
    ] = None,
    pose: _PoseOption = None,
    path: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Its push: table time,x,y of the axis of the pusher (CSV), or x,y with --speed.", show_default=False
        ),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            metavar="M/S", parser=in_unit("m/s"), callback=above_zero, help="Along a path without times [m/s].", show_default=False
        ),
    ] = None,
    radius: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            parser=in_unit("m"),
            callback=at_least_zero,
            help="Radius of the pusher along --path [m, or 8mm].",
            show_default=f"{PUSHER_RADIUS}",
        ),
    ] = None,
    json: JsonOption = None,
    out: OutOption = None,
    object_id: ObjectOption = "",
    camera: CameraOption = None,
    map_: MapOption = None,
    depth_unit: DepthUnitOption = None,
    pose_std: PoseStdOption = "",
) -> None:
    """Predict recorded pushes with a model and compare with what was observed; or predict a push that was not made (--pose, --path)."""
    is_made = all(value is None for value in (pose, path, speed, radius))
    if bool(bags) != is_made or (not is_made and (pose is None or path is None)):
        raise InputError("say what to predict: recorded pushes (BAG...), or one that was not made, with --pose X,Y,YAW and --path FILE.")
    first = None if pose is None else parse_floats(pose, ("m", "m", "rad"), "--pose", "X,Y,YAW in metres and radians, such as 0.05,0,1.57")
    in_file, posterior = load_model(model)
    if failure := failure_of_model(model):
        warn(f"! the model is only the prior: {failure}")
    if first is not None and path is not None:
        driven = read_pusher_path(path, PUSHER_RADIUS if radius is None else radius, speed)
        content = _of_planned(predict_planned(posterior, first, driven), in_file)
    else:
        loaded = load_pushes(
            bags or [], object_id=object_id, camera_in_table=read_camera(camera), options=read_options(map_, depth_unit, pose_std)
        )
        content = _of_recorded(posterior, loaded, in_file, sources_of_model(model))
    for file in (json, None if out is None else out / "prediction.json"):
        write_json(file, content)
    if content.get("warnings"):
        raise typer.Exit(1)


def _of_recorded(posterior: ModelPosterior, loaded: LoadedPushes, object_id: str, sources: tuple[str, ...]) -> dict[str, Any]:
    """Show and return predictions of recorded pushes, `sources` of which the model was fitted to."""
    compared = compare_pushes(posterior, loaded.records)
    rows = [_row(push, sources) for push in compared]
    warnings = check_records(loaded.records).warnings
    for note in loaded.notes:
        warn(f"note: {note}")
    for warning in warnings:
        warn(f"warning: {warning}")
    heads = ("push", "cell error", "expected", "within 90%", "trained on", "status")
    table = number_table(f"object {object_id}: predicted against observed, at the end of each push", *heads)
    for number, row in enumerate(rows, 1):
        inside, trained = ("yes" if row[name] else "no" for name in ("within_90", "in_training"))
        table.add_row(str(number), millimetres(row["cell_error_m"]), millimetres(row["cell_error_std_m"]), inside, trained, row["status"])
    console.print(table)
    say(f"mean {millimetres(compared.mean_cell_error)} over {len(rows)} pushes")
    errors = np.array([row["cell_error_m"] for row in rows if not row["in_training"]])
    held_out = float(np.nanmean(errors)) if np.isfinite(errors).any() else None
    if len(errors) == 0:
        warn("! the model was fitted to all of these pushes, so their errors are not those of new ones; predict others")
    elif len(errors) < len(rows):
        say(f"mean {millimetres(np.nan if held_out is None else held_out)} over the {len(errors)} that the model was not fitted to")
    return {
        "object_id": object_id,
        "cell_error_m": compared.mean_cell_error,
        "held_out_cell_error_m": held_out,
        "pushes": rows,
        "notes": loaded.notes,
        "warnings": list(warnings),
    }


def _row(push: PredictedPush, sources: tuple[str, ...]) -> dict[str, Any]:
    return {
        "source": push.record.source,
        "in_training": push.record.source in sources,
        "predicted": push.prediction.pose[-1].tolist(),
        "observed": push.observed.tolist(),
        "cell_error_m": push.cell_error,
        "cell_error_std_m": push.prediction.cell_error_std,
        "within_90": push.within_90,
        "status": push.prediction.status.name.lower(),
    }


def _of_planned(push: PlannedPush, object_id: str) -> dict[str, Any]:
    """Show and return the prediction of a push that was not made."""
    prediction = push.prediction
    time, std = prediction.time - prediction.time[0], np.sqrt(np.einsum("fii->fi", prediction.covariance))
    table = number_table(f"object {object_id}, pusher of radius {millimetres(push.path.radius)}: predicted motion", "time", "x", "y", "yaw")
    for frame in np.unique(np.linspace(0, len(time) - 1, 7).astype(int)):
        table.add_row(f"{time[frame]:.2f} s", *_pose_texts(prediction.pose[frame], std[frame]))
    console.print(table)
    if prediction.status is SolveStatus.SIMULATION_FAILED:
        warn(f"! {prediction.status.value}")
    else:
        say(f"touched with a chance of {prediction.touched:.0%}; expected cell error at the end {millimetres(prediction.cell_error_std)}")
    if len(push.outcomes) > 1:
        for outcome in push.outcomes:
            say(f"with a chance of {outcome.chance:.0%} it ends at {', '.join(_pose_texts(outcome.end))}")
    return {
        "object_id": object_id,
        "start": push.pose.tolist(),
        "pusher_radius_m": push.path.radius,
        "end": prediction.pose[-1].tolist(),
        "covariance": prediction.covariance[-1].tolist(),
        "cell_error_std_m": prediction.cell_error_std,
        "touched": prediction.touched,
        "outcomes": [{"chance": outcome.chance, "end": outcome.end.tolist()} for outcome in push.outcomes],
        "trajectory": {
            "time_s": prediction.time.tolist(),
            "pose": prediction.pose.tolist(),
            "covariance": prediction.covariance.tolist(),
        },
        "status": prediction.status.name.lower(),
    }


def _pose_texts(pose: Float64Array, std: Float64Array | None = None) -> list[str]:
    """Position and yaw for people, with standard deviations where they are given; all of shape (3,)."""
    texts = []
    for value, deviation, (scale, unit) in zip(pose, [None] * 3 if std is None else std, _FOR_PEOPLE, strict=True):
        spread = "" if deviation is None else f" ± {scale * deviation:.1f}"
        texts.append(f"{round(scale * value, 1) + 0.0:.1f}{spread} {unit}")  # + 0.0: no -0.0
    return texts
