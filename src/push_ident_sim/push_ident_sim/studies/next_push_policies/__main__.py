"""Does choosing the next push pay? Random pushes against pushes ranked first, on objects simulated by this package.

    .venv/bin/python -m push_ident_sim.studies.next_push_policies
        [--objects 20] [--pushes 5] [--candidates 100] [--seed 0] [--json FILE]

Every object is a random shape with random maps. All policies start from the same random push and are measured on the same random pushes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from push_ident.files import write_whole
from push_ident.identification.predicting.next_push import Criterion, candidate_pushes, rank_pushes, reference_pushes
from push_ident.identification.push_study import CurveOptions, SimulatedObject, choose_at_random, choose_by, learning_curve, random_pushes
from push_ident.identification.results.posterior import prior_posterior
from push_ident.pushing.push import PushSettings
from push_ident.types import Float64Array
from push_ident_sim.studies.common.random_objects import random_object, random_shape

SETTINGS = PushSettings(
    workspace=(-0.4, 0.4, -0.4, 0.4),
    pusher_radius=0.008,
    clearance=0.02,
    distance_range=(0.06, 0.10),
    cone=float(np.radians(40.0)),
)
"""Pushes as in the paper, on a table without edges."""
POLICIES = {
    "random": choose_at_random,
    "least error": choose_by(Criterion.ERROR, SETTINGS),
    "most information": choose_by(Criterion.INFORMATION, SETTINGS),
}


def seconds_per_ranking(seed: int, n: int = 200) -> float:
    """To rank `n` candidates for an object that was never pushed; the first call has compiled the kernels."""
    rng = np.random.default_rng(seed)
    shape = random_shape(rng)
    candidates = candidate_pushes(shape, np.zeros(3), rng, n, SETTINGS)
    reference = reference_pushes(shape, rng, 40, SETTINGS)
    rank_pushes(prior_posterior(shape), candidates[:1], reference=reference[:1], rng=rng)
    started = time.perf_counter()
    rank_pushes(prior_posterior(shape), candidates, reference=reference, rng=rng)
    return time.perf_counter() - started


def mean_and_error(values: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Mean and standard error over the objects, the first axis."""
    return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=20)
    parser.add_argument("--pushes", type=int, default=5)
    parser.add_argument("--candidates", type=int, default=100)
    parser.add_argument("--held-out", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if arguments.objects < 2:
        sys.exit("--objects is below 2; a standard error needs at least two")
    errors = np.empty((len(POLICIES), arguments.objects, arguments.pushes))
    for i in range(arguments.objects):
        truth = random_object(np.random.default_rng([arguments.seed, i, 0]))
        held_out = random_pushes(
            SimulatedObject(truth, np.random.default_rng([arguments.seed, i, 1])),
            arguments.held_out,
            SETTINGS,
            np.random.default_rng([arguments.seed, i, 2]),
        )
        for j, policy in enumerate(POLICIES.values()):
            errors[j, i] = learning_curve(
                SimulatedObject(truth, np.random.default_rng([arguments.seed, i, 3])),
                policy,
                held_out,
                np.random.default_rng([arguments.seed, i, 4]),
                push_settings=SETTINGS,
                options=CurveOptions(n_pushes=arguments.pushes, n_candidates=arguments.candidates),
            )
        print(f"\robject {i + 1}/{arguments.objects}", end="", file=sys.stderr, flush=True)
    print("\r", end="", file=sys.stderr)
    ranking = seconds_per_ranking(arguments.seed)

    rows: dict[str, dict[str, list[float]]] = {}
    print(f"mean cell error on {arguments.held_out} held-out pushes [mm], {arguments.objects} objects, seed {arguments.seed}")
    print(f"{'pushes':>18} " + " ".join(f"{n + 1:>12}" for n in range(arguments.pushes)))
    for name, own in zip(POLICIES, errors, strict=True):
        mean, error = mean_and_error(own)
        gain, gain_error = mean_and_error(errors[0] - own)
        print(f"{name:>18} " + " ".join(f"{1e3 * m:6.2f} ± {1e3 * e:.2f}" for m, e in zip(mean, error, strict=True)))
        if name != "random":
            print(f"{'gain over random':>18} " + " ".join(f"{1e3 * m:6.2f} ± {1e3 * e:.2f}" for m, e in zip(gain, gain_error, strict=True)))
        rows[name] = {
            "mean_m": mean.tolist(),
            "standard_error_m": error.tolist(),
            "gain_m": gain.tolist(),
            "gain_standard_error_m": gain_error.tolist(),
        }
    print(f"ranking 200 candidates: {ranking:.2f} s")
    if arguments.json:
        settings = {k: v for k, v in vars(arguments).items() if k != "json"}
        write_whole(
            arguments.json, json.dumps({"settings": settings, "errors": rows, "ranking_s": ranking}, indent=1) + "\n", "the results"
        )


if __name__ == "__main__":
    main()
