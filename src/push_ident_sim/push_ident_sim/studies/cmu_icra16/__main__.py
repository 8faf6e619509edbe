"""Real pushes of which only the end poses are known: uniform, identified and known-support models on held-out pushes.

    .venv/bin/python -m push_ident_sim.studies.cmu_icra16 [FOLDER OF RECORDINGS] [--splits 10] [--seed 0] [--json FILE]

The recording (Zhou, Paolini, Bagnell, Mason, ICRA 2016; Apache-2.0) is not part of this repository: `FOLDER/cmu_icra16/*.txt`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from push_ident.bags.importers import ImportReport, import_cmu_icra16
from push_ident.files import write_whole
from push_ident.geometry.cells import cell_error
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.offline.loading import load_pushes
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import GRAVITY, BodyParameters, body_of_cells, simulate_body
from push_ident.types import CellGrid, ObjectShape, PushRecord

SUPPORT_FRICTION = 4.2 / (1.518 * 9.8)
"""Measured on this hardboard by the authors of the recording."""
PUSHER_FRICTION = 0.3


def known_support_errors(report: ImportReport, records: list[PushRecord]) -> np.ndarray:
    """Cell error of a body that stands on its three known supports, each with the load that statics gives it."""
    if not len(report.supports) or report.mass is None or report.centre_of_mass is None:
        sys.exit(f"{report.bag}: supports or mass are not known; name the recording as published, 30_90_30_30_30_90__….txt")
    shape = records[0].shape
    shares = np.linalg.solve(np.vstack([report.supports.T, np.ones(3)]), np.append(report.centre_of_mass, 1.0))
    plate = body_of_cells(shape, np.full(len(shape.cells), report.mass / len(shape.cells)), np.zeros(len(shape.cells)))
    body = BodyParameters(report.mass, report.centre_of_mass, plate.inertia, SUPPORT_FRICTION * report.mass * GRAVITY * shares)
    standing = ObjectShape(CellGrid(report.supports, shape.cells.size), shape.outline)
    errors = []
    for record in records:
        observed = observe_push(record)
        end = simulate_body(standing, body, PUSHER_FRICTION, PushScenario(record.pusher, observed.pose[0], observed.time[-1:])).pose[-1]
        errors.append(cell_error(shape.cells, end, observed.pose[-1]))
    return np.array(errors)


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("../shared/data"))
    parser.add_argument("--splits", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    recordings = sorted((arguments.folder / "cmu_icra16").glob("*.txt"))
    if not recordings:
        sys.exit(f"no recording cmu_icra16/*.txt in {arguments.folder}; give the folder that holds it")
    with tempfile.TemporaryDirectory() as folder:
        report = import_cmu_icra16(recordings[0], Path(folder) / "bag")
        records = load_pushes([Path(folder) / "bag"]).records
    moved = np.mean([cell_error(r.shape.cells, r.poses.pose[0], r.poses.pose[-1]) for r in records])
    print(
        f"{len(records)} pushes, mean cell motion {1e3 * moved:.1f} mm; means over {arguments.splits} random splits, seed {arguments.seed}"
    )
    print(f"{'trained on':>10} {'uniform':>10} {'scalars':>10} {'identified':>10} {'supports':>10}  [mm, on held-out pushes]")
    rng = np.random.default_rng(arguments.seed)
    rows = {}
    for n in (2, 5, 10):
        errors = []
        for _ in range(arguments.splits):
            train = rng.choice(len(records), n, replace=False)
            test = [records[i] for i in range(len(records)) if i not in train]
            result = identify([records[i] for i in train])
            models = (result.uniform, result.scalar, result.model)
            errors.append([*(held_out_errors(m, test).mean() for m in models), known_support_errors(report, test).mean()])
            print(f"\r{n:>10} split {len(errors)}/{arguments.splits}", end="", file=sys.stderr, flush=True)
        print("\r", end="", file=sys.stderr)
        mean = np.mean(errors, axis=0)
        rows[n] = dict(zip(("uniform_m", "scalar_m", "identified_m", "known_supports_m"), mean.tolist(), strict=True))
        print(f"{n:>10} " + " ".join(f"{1e3 * e:>10.2f}" for e in mean))
    if arguments.json:
        write_whole(
            arguments.json, json.dumps({"seed": arguments.seed, "splits": arguments.splits, "errors": rows}, indent=1) + "\n", "the results"
        )


if __name__ == "__main__":
    main()
