"""`push-ident predict`: predictions of recorded pushes, compared with what happened."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from push_ident.cli.identify import CameraOption, DepthUnitOption, MapOption, ObjectOption, read_camera, read_options
from push_ident.cli.output import BagsArgument, JsonOption, OutOption, console, millimetres, number_table, say, warn, write_json
from push_ident.identification.predicting.scoring import PredictedPush, compare_pushes
from push_ident.identification.results.model_file import failure_of_model, load_model
from push_ident.offline.loading import load_pushes


def predict_command(
    model: Annotated[
        Path, typer.Argument(metavar="MODEL", help="Model file, as `identify --out DIR` writes it (DIR/model.json).", show_default=False)
    ],
    bags: BagsArgument,
    json: JsonOption = None,
    out: OutOption = None,
    object_id: ObjectOption = "",
    camera: CameraOption = None,
    map_: MapOption = None,
    depth_unit: DepthUnitOption = None,
) -> None:
    """Predict recorded pushes with a model and compare with what was observed."""
    in_file, posterior = load_model(model)
    options = read_options(map_, depth_unit)
    loaded = load_pushes(bags, object_id=object_id, camera_in_table=read_camera(camera), options=options)
    compared = compare_pushes(posterior, loaded.records)
    rows = [_row(push) for push in compared]
    for note in loaded.notes:
        warn(f"note: {note}")
    if failure := failure_of_model(model):
        warn(f"! the model is only the prior: {failure}")
    table = number_table(
        f"object {in_file}: predicted against observed, at the end of each push", "push", "cell error", "expected", "within 90%", "status"
    )
    for number, row in enumerate(rows, 1):
        inside = "yes" if row["within_90"] else "no"
        table.add_row(str(number), millimetres(row["cell_error_m"]), millimetres(row["cell_error_std_m"]), inside, row["status"])
    console.print(table)
    say(f"mean {millimetres(compared.mean_cell_error)} over {len(rows)} pushes")
    content = {"object_id": in_file, "cell_error_m": compared.mean_cell_error, "pushes": rows, "notes": loaded.notes}
    write_json(json, content)
    if out is not None:
        write_json(out / "prediction.json", content)


def _row(push: PredictedPush) -> dict[str, Any]:
    return {
        "source": push.record.source,
        "predicted": push.prediction.pose[-1].tolist(),
        "observed": push.observed.tolist(),
        "cell_error_m": push.cell_error,
        "cell_error_std_m": push.prediction.cell_error_std,
        "within_90": push.within_90,
        "status": push.prediction.status.name.lower(),
    }
