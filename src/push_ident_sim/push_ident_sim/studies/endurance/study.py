"""Whether the whole live cell works for an hour while its nodes are killed at random, and learns what it learns undisturbed."""

from __future__ import annotations

import os
import shutil
import sys
import time
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import chdtri

from push_ident.cli.restart import RestartPolicy
from push_ident.cli.supervisor import Supervisor, node_commands
from push_ident.errors import PushIdentError
from push_ident.identification.online.state_file import load_state
from push_ident.nodes.client.cell_client import CellClient, CellTimeout
from push_ident.pushing.push import PushCode
from push_ident_msgs.action import DiagnoseGap, ExecutePush
from push_ident_sim.recordings.truth import CameraNoise, load_truth
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.common.drawing import COLOURS, markdown_table, millimetres, new_figure, save
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment
from push_ident_sim.studies.endurance.chaos import PERIOD, Chaos
from push_ident_sim.studies.endurance.comparison import compare_maps, errors_on
from push_ident_sim.studies.endurance.meters import QUANTITIES, Meters, growth
from push_ident_sim.studies.endurance.witness import Witness, tracebacks

__all__ = ["STUDY"]

_CALM, _AGAIN, _DISTURBED = "undisturbed", "again", "disturbed"
_NODES: Final = ("sim_cell_node", "perception_node", "push_executor_node", "identification_node", "gap_diagnosis_node")
_CALM_SHARE: Final = 0.25
"""Duration of an undisturbed run, relative to the disturbed one."""
_DOMAIN: Final = 30
"""First ROS domain, that of the first variant: they may run beside each other."""
_SETTLING: Final = 60.0
"""Without faults at the end [s]."""
_SILENCE: Final = 20.0
"""Without feedback for so long a push is given up: its executor may have been killed [s]."""
_PAUSE: Final = 0.5
"""After a push that was refused [s]."""
_POLL: Final = 0.02
_SETTLED: Final = 15.0
"""At the end, for the last push to be learned [s]."""
_DIAGNOSIS: Final = 600.0
"""Between two diagnoses [s]."""
_LINE: Final = 60.0
"""Between two lines of progress [s]."""
_EXACT: Final = CameraNoise(position_std=1e-6, yaw_std=1e-6)
"""Of held-out pushes: their true poses."""
_COLOURS: Final = ("gauss_newton", "fast_gradient", "autograd", "finite_differences", "truth")
_UNANSWERED: Final = "no answer"
_RARE: Final = 1e-3
"""Of the ends of pushes that lie further away than their deviation allows, if it is exact [-]."""


class _Run:
    """One live cell and a client that always wants another push."""

    def __init__(self, case: Case, minutes: float, folder: Path) -> None:
        self._case, self._seconds, self._folder = case, 60.0 * minutes, folder
        self._seed = zlib.crc32(case.key.encode())
        self._outcomes: Counter[str] = Counter()
        self._began = time.monotonic()
        self._said = self._began
        self._diagnosed = self._began
        self._diagnoses: Counter[str] = Counter()

    def run(self) -> Json:
        domain = _DOMAIN + STUDY.variants.index(self._case.variant)
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        shutil.rmtree(self._folder, ignore_errors=True)
        state = self._folder / "state"
        case, disturbed = self._case, self._case.variant == _DISTURBED
        parameters: dict[str, dict[str, object]] = {
            "sim_cell_node": {"object": case.object_name, "seed": case.model, "noise_seed": case.model},
            "identification_node": {"state_directory": str(state.resolve())},
            "perception_node": {"state_directory": str(state.resolve())},
        }
        commands = node_commands("sim", parameters=parameters)
        with Supervisor(commands, log_dir=self._folder / "log", restart=RestartPolicy()) as nodes:
            self._nodes = nodes
            self._meters = Meters(nodes, _NODES)
            self._chaos = Chaos(nodes, _NODES, self._seed, self._seconds - _SETTLING if disturbed else -1.0)
            with CellClient(check=self._tend) as client:
                object_id = client.wait_for_object(120.0)
                with Witness(domain, object_id) as witness:
                    ended = ""
                    try:
                        self._push_on(client, object_id)
                        self._pause(_SETTLED)
                    except PushIdentError as error:
                        ended = str(error)  # a node that died for good: what was measured until then counts
                    finally:
                        self._chaos.release()
                    return self._account(witness, state / f"{object_id}.state.json") | {"ended_early": ended}

    def _tend(self) -> None:
        """Called while the client waits: restarts, faults, measurements."""
        self._nodes.check()
        self._meters.tend()
        fault = self._chaos.tend()
        if fault is not None:
            self._say(f"{fault['fault']}: {fault['node']}")
        elif time.monotonic() - self._said > _LINE:
            self._say(", ".join(f"{n} {what}" for what, n in self._outcomes.most_common()))

    def _say(self, text: str) -> None:
        self._said = time.monotonic()
        print(f"{self._case.variant}, {(self._said - self._began) / 60:.1f} min: {text}", file=sys.stderr, flush=True)

    def _push_on(self, client: CellClient, object_id: str) -> None:
        number = 0
        while time.monotonic() - self._began < self._seconds:
            number += 1
            goal = ExecutePush.Goal(mode=ExecutePush.Goal.MODE_RANDOM, object_id=object_id, seed=(self._seed + number) % 2**31)
            outcome = self._outcome(client, goal)
            self._outcomes[outcome] += 1
            if outcome != PushCode.SUCCESS.name:
                self._pause()
            if time.monotonic() - self._diagnosed > _DIAGNOSIS:
                self._diagnosed = time.monotonic()
                self._diagnoses[self._verdict(client, object_id)] += 1

    def _pause(self, seconds: float = _PAUSE) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self._tend()
            time.sleep(_POLL)

    def _outcome(self, client: CellClient, goal: ExecutePush.Goal) -> str:
        try:
            return PushCode(client.execute_push(goal, silence=_SILENCE).error_code).name
        except CellTimeout:
            return _UNANSWERED

    def _verdict(self, client: CellClient, object_id: str) -> str:
        try:
            result = client.diagnose_gap(DiagnoseGap.Goal(object_id=object_id), timeout=120.0)
        except CellTimeout:
            return _UNANSWERED
        return str(result.report.verdict) if result.success else "refused"

    def _account(self, witness: Witness, state: Path) -> Json:
        return {
            "minutes": (time.monotonic() - self._began) / 60.0,
            "load": os.getloadavg()[2],
            "learned": len(load_state(state).pushes),
            "outcomes": dict(self._outcomes),
            "diagnoses": dict(self._diagnoses),
            "faults": self._chaos.faults,
            "deaths": [death.how for death in self._nodes.deaths],
            "learned_unfinished": witness.learned_unfinished(state),
            "tracebacks": tracebacks(self._folder / "log"),
            "seen": witness.account(),
            "samples": self._meters.samples,
            "state": str(state.resolve()),
        }


def _run(case: Case, settings: CaseSettings) -> Json:
    minutes = settings.minutes * (1.0 if case.variant == _DISTURBED else _CALM_SHARE)
    folder = settings.truth_folder.parent / "endurance" / case.key
    values = _Run(case, minutes, folder).run()
    posterior = load_state(Path(values["state"])).state.posterior
    _, held_out, _ = load_truth(settings.truth_folder, case.object_name, case.model, settings.truth, _EXACT)
    return values | {"held_out_m": errors_on(posterior, held_out)}


def _summarise(results: Sequence[CaseResult]) -> Json:
    by_variant = {result.case.variant: result.values for result in results}
    kept_states = {variant: load_state(Path(values["state"])) for variant, values in by_variant.items()}
    posteriors = {variant: kept.state.posterior for variant, kept in kept_states.items()}
    runs = {}
    for variant, values in by_variant.items():
        kept = {key: value for key, value in values.items() if key not in ("samples", "state")}
        grows = {node: {q: growth(own, q) for q in QUANTITIES} for node, own in values["samples"].items()}
        scores = kept_states[variant].record.latest
        kept["surprises"] = float(np.mean([score.mahalanobis2 > chdtri(3, _RARE) for score in scores])) if scores else float("nan")
        runs[variant] = {**kept, "growth": grows, "samples": {node: _thinned(own) for node, own in values["samples"].items()}}
    maps = {
        f"{one} – {other}": compare_maps(posteriors[one], posteriors[other])
        for one, other in ((_DISTURBED, _CALM), (_AGAIN, _CALM))
        if one in posteriors and other in posteriors
    }
    return {"runs": runs, "maps": maps}


def _thinned(samples: Sequence[Json], most: int = 240) -> list[list[float]]:
    """Time [s] and quantities of some samples, for the picture."""
    step = max(1, len(samples) // most)
    return [[round(s["time_s"], 1), *(round(s[q], 2) for q in QUANTITIES)] for s in samples[::step]]


def _tables(summary: Json) -> str:
    runs: dict[str, Any] = summary["runs"]
    rows = [
        [name, *(str(of(run)) for run in runs.values())]
        for name, of in (
            ("duration [min]", lambda r: f"{r['minutes']:.0f}"),
            ("mean load of the machine, 2 cores", lambda r: f"{r['load']:.0f}"),
            ("faults", lambda r: len(r["faults"])),
            ("nodes killed", lambda r: sum(f["fault"] == "killed" for f in r["faults"])),
            ("nodes started again", lambda r: len(r["deaths"])),
            ("pushes made", lambda r: r["outcomes"].get(PushCode.SUCCESS.name, 0)),
            ("pushes refused or broken off", lambda r: sum(r["outcomes"].values()) - r["outcomes"].get(PushCode.SUCCESS.name, 0)),
            ("pushes learned", lambda r: r["learned"]),
            ("learned without being whole", lambda r: len(r["learned_unfinished"])),
            ("maps published", lambda r: r["seen"]["n_maps"]),
            ("of them negative or not finite", lambda r: len(r["seen"]["bad_maps"])),
            ("logs with a traceback", lambda r: len(r["tracebacks"])),
            ("longest motion after a command [s]", lambda r: f"{r['seen']['longest_unasked_s']:.2f}"),
            (f"pushes that end where one in {1 / _RARE:.0f} should", lambda r: f"{r['surprises']:.0%}"),
            ("cell error on held-out pushes, mean [mm]", lambda r: millimetres(float(np.mean(r["held_out_m"])))),
        )
    ]
    parts = [markdown_table(["", *runs], rows)]
    heads = ["maps", "cells", "within 2 sd", "rms difference [sd]", "combinations determined", "squared Mahalanobis distance"]
    compared = [
        [name, str(m["n_cells"]), f"{m['within_2_std']:.0%}", f"{m['rms_std']:.2f}", str(m["n_pinned"]), f"{m['mahalanobis2']:.1f}"]
        for name, m in summary["maps"].items()
    ]
    if compared:
        parts.append(markdown_table(heads, compared))
    for variant, run in runs.items():
        rows = [[node, *(_grown(own[q]) for q in QUANTITIES)] for node, own in run["growth"].items()]
        parts.append(f"Growth per hour, {variant}:\n\n" + markdown_table(["node", *QUANTITIES.values()], rows))
    return "\n\n".join(parts)


def _grown(slope: Json | None) -> str:
    return "–" if slope is None else f"{slope['per_hour']:+.1f} ± {slope['std']:.1f} (at {slope['level']:.0f})"


def _draw(summary: Json, folder: Path) -> dict[str, str]:
    run = summary["runs"].get(_DISTURBED) or next(iter(summary["runs"].values()))
    figure, panels = new_figure(1, len(QUANTITIES), width=9.0, height=2.4)
    colours = {node: COLOURS[name] for node, name in zip(_NODES, _COLOURS, strict=True)}
    for column, (axes, name) in enumerate(zip(panels, QUANTITIES.values(), strict=True), start=1):
        for node, samples in run["samples"].items():
            rows = np.array(samples).reshape(-1, 1 + len(QUANTITIES))
            axes.plot(rows[:, 0] / 60, rows[:, column], ".", markersize=2.5, color=colours[node], label=node)
        for fault in run["faults"]:
            axes.axvline(fault["time_s"] / 60, color="#bbbbbb", linewidth=0.6, linestyle="-" if fault["fault"] == "killed" else ":")
        axes.set_ylabel(name)
        axes.set_ylim(bottom=0)
    panels[-1].set_xlabel("time [min]")
    panels[0].legend(fontsize=7, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    save(figure, folder / "endurance.png")
    return {"endurance.png": "Each node over time while nodes are killed (lines) and stopped (dotted). A killed node begins anew."}


STUDY = Experiment(
    name="endurance",
    place=130,
    title="An hour of the live cell with faults",
    question=(
        "Does the cell keep working, and does it learn the same? Camera, perception, executor, identification and diagnosis run "
        "live on the simulated cell under the supervisor of `push-ident up`. A client requests random pushes all the time. Every "
        f"{PERIOD / 60:.0f} minutes, at a random moment, a random node is killed (SIGKILL) or stopped for up to 5 s (one fault in "
        "four); the supervisor starts it again. Identification and perception continue from their state folder. The undisturbed "
        "runs last a quarter of the time; the second one differs in the pushes only, and shows by what two runs without faults "
        "differ. Maps are compared in the standard deviations that both state; a squared Mahalanobis distance equal to the number "
        "of determined combinations is what exact deviations give. Where more pushes than stated end far from their prediction, "
        "deviations are too small, the more so the longer a run is. Held-out pushes are those of the simulator, with their true "
        "poses. Growth: one slope for all lives of a node."
    ),
    variants=(_CALM, _AGAIN, _DISTURBED),
    run=_run,
    summarise=_summarise,
    tables=_tables,
    draw=_draw,
    stages=("geometry", "perception", "pushing", "physics", "identification", "nodes", "cli"),
    once=(_CALM, _AGAIN, _DISTURBED),
    one_at_a_time=True,
    timed=True,
)
