"""`push-ident predict`: predictions of recorded pushes, compared with what happened."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table
from scipy.special import chdtri

from push_ident.cli.identify import CameraOption, ObjectOption, read_camera
from push_ident.cli.output import BagsArgument, JsonOption, OutOption, console, millimetres, warn, write_json
from push_ident.errors import InputError
from push_ident.geometry.se2 import wrap_angle
from push_ident.identification.model_file import failure_of_model, load_model
from push_ident.identification.observation import observe_push
from push_ident.identification.prediction import cell_error, predict
from push_ident.identification.result import ModelPosterior
from push_ident.offline.loading import load_pushes
from push_ident.physics.scenario import PushScenario
from push_ident.types import PushRecord, SolveStatus

__all__ = ["predict_command"]


def predict_command(
    model: Annotated[Path, typer.Argument(help="Model file, as `identify --out DIR` writes it (DIR/model.json).", show_default=False)],
    bags: BagsArgument,
    json: JsonOption = None,
    out: OutOption = None,
    object_id: ObjectOption = "",
    camera: CameraOption = None,
) -> None:
    """Predict recorded pushes with a model and compare with what was observed."""
    in_file, posterior = load_model(model)
    loaded = load_pushes(bags, object_id=object_id, camera_in_table=read_camera(camera))
    expected = posterior.unknowns.shape.cells
    got = loaded.records[0].shape.cells
    if len(expected) != len(got) or not np.allclose(expected.centres, got.centres, atol=1e-3):
        raise InputError(
            f"The model has {len(expected)} cells, the object in the bag {len(got)} others; predict bags that share the cells of the model."
        )
    rows = [_compare(posterior, record) for record in loaded.records]
    for note in loaded.notes:
        warn(f"note: {note}")
    if failure := failure_of_model(model):
        warn(f"! the model is only the prior: {failure}")
    table = Table(title=f"object {in_file}: predicted against observed, at the end of each push")
    for heading in ("push", "cell error", "expected", "within 90%", "status"):
        table.add_column(heading, justify="right")
    for number, row in enumerate(rows):
        inside = "yes" if row["within_90"] else "no"
        table.add_row(str(number), millimetres(row["cell_error_m"]), millimetres(row["cell_error_std_m"]), inside, row["status"])
    console.print(table)
    errors = np.array([row["cell_error_m"] for row in rows])
    mean = float(np.nanmean(errors)) if np.isfinite(errors).any() else float("nan")
    console.print(f"mean {millimetres(mean)} over {len(rows)} pushes", highlight=False)
    content = {"object_id": in_file, "cell_error_m": mean, "pushes": rows, "notes": loaded.notes}
    if json is not None:
        write_json(json, content)
    if out is not None:
        write_json(out / "prediction.json", content)


def _compare(posterior: ModelPosterior, record: PushRecord) -> dict[str, Any]:
    observed = observe_push(record, posterior.noise())
    scenario = PushScenario(record.pusher, observed.pose[0], observed.time)
    prediction = predict(posterior, scenario, first_covariance=observed.first_covariance)
    difference = observed.pose[-1] - prediction.pose[-1]
    difference[2] = wrap_angle(difference[2])
    covariance = prediction.covariance[-1] + np.linalg.inv(observed.whitening[-1].T @ observed.whitening[-1])
    failed = prediction.status is SolveStatus.SIMULATION_FAILED
    return {
        "source": record.source,
        "predicted": prediction.pose[-1].tolist(),
        "observed": observed.pose[-1].tolist(),
        "cell_error_m": cell_error(record.shape.cells, prediction.pose[-1], observed.pose[-1]),
        "cell_error_std_m": prediction.cell_error_std,
        "within_90": bool(not failed and difference @ np.linalg.solve(covariance, difference) < chdtri(3, 0.1)),
        "status": prediction.status.name.lower(),
    }
