"""Each stage alone under rising load: perception, identification, recorder."""

from __future__ import annotations

import shutil
import signal
import time
from pathlib import Path
from typing import Any, Final

from geometry_msgs.msg import PoseWithCovarianceStamped

from push_ident.cli.supervisor import node_commands
from push_ident.errors import PushIdentError
from push_ident.files import make_folder
from push_ident_msgs.msg import MassFrictionMap
from push_ident_sim.studies.common.base import Json
from push_ident_sim.studies.load.bench import Bench, bench, delays, slow_disk
from push_ident_sim.studies.load.sources import object_ids

__all__ = ["CAMERA_RATES", "N_OBJECTS", "STREAM_OBJECTS", "STREAM_RATE", "measure_camera", "measure_recorder", "measure_streams"]

CAMERA_RATES: Final = (30.0, 60.0, 90.0)
N_OBJECTS: Final = (1, 4, 10)
STREAM_RATE: Final = 1000.0
STREAM_OBJECTS: Final = (1, 3)
_WARM: Final = 2.0
"""Before a measurement [s]: kernels are loaded, objects are found."""
_MEASURED: Final = 4.0
"""[s]"""
_PUSHES: Final = 9.0
"""Three pushes of the streams [s]."""
_MOST_OBJECTS: Final = 12
"""Objects that perception may see here."""


def measure_camera(folder: Path, domain: int) -> Json:
    """Perception before a camera of each rate with each number of objects in view."""
    rows = []
    for n in N_OBJECTS:
        with bench(folder / f"camera-{n}", domain) as cell:
            poses = cell.listen(PoseWithCovarianceStamped, [f"objects/o{i}/pose" for i in range(1, _MOST_OBJECTS + 1)])
            cell.add_node("perception_node", {"cell_count": 80})
            cell.wait_for_report("perception_node")
            source = cell.add_source("camera", CAMERA_RATES, n)
            for rate in CAMERA_RATES:
                rows.append(_camera_row(cell, poses, rate, n))
                source.signal(signal.SIGUSR1)
    return {"rows": rows}


def _camera_row(cell: Bench, poses: list[tuple[float, float]], rate: float, n: int) -> Json:
    time.sleep(_WARM)
    before = cell.wait_for_report("perception_node")
    del poses[:]
    began = time.monotonic()
    usage = cell.usage(("perception_node", "camera_source"), _MEASURED)
    seen = list(poses)
    after = cell.wait_for_report("perception_node")
    reports = cell.monitor.reports_of("perception_node", began)
    taken, lost = (_difference(before.values, after.values, key) for key in ("images", "images_lost"))
    return {
        "rate_hz": rate,
        "n_objects": n,
        "sent_hz": (taken + lost) / (after.received - before.received),
        "taken": taken,
        "lost": lost,
        "n_poses": len(seen),
        "tracked": len(seen) / max(len({stamp for _, stamp in seen}), 1),
        "delay": delays([received - stamp for received, stamp in seen]),
        "warned": any("left out" in report.message for report in reports),
        "said": after.message,
        **usage,
    }


def measure_streams(folder: Path, domain: int) -> Json:
    """Identification while poses, pusher, wrench and joint states come at 1 kHz."""
    rows = []
    for n in STREAM_OBJECTS:
        with bench(folder / f"streams-{n}", domain) as cell:
            maps = cell.listen(MassFrictionMap, [f"objects/{name}/mass_friction_map" for name in object_ids(n)])
            cell.add_node("identification_node")
            cell.wait_for_report("identification_node")
            time.sleep(_WARM)
            cell.add_source("streams", [STREAM_RATE], n)
            began = time.monotonic()
            usage = cell.usage(("identification_node", "streams_source"), _PUSHES)
            reports = cell.monitor.reports_of("identification_node", began)
            sent = cell.end_source("streams")
            last = cell.wait_for_report("identification_node").values
            rows.append(
                {
                    "n_objects": n,
                    "sent": sum(sent[key] for key in sent if "/" in key and not key.endswith(("cells", "outline", "shape"))),
                    "sent_hz": sent["pusher/pose"] / max(sent["seconds"] * 2.0 / 3.0, 1e-9),
                    "taken": sum(int(last.get(key, 0)) for key in ("poses", "pusher samples", "wrenches")),
                    "lost": int(last.get("messages lost", 0)),
                    "together": int(last.get("frames taken together", 0)),
                    "updates": int(last.get("updates during a push", 0)),
                    "pushes": int(last.get("pushes", 0)),
                    "delay": delays([received - stamp for received, stamp in maps if stamp > 0]),
                    "worst_wait_s": max((float(r.values.get("message delay, worst [s]", 0.0)) for r in reports), default=0.0),
                    "warned": any("were lost" in report.message for report in reports),
                    **usage,
                }
            )
    return {"rows": rows}


def measure_recorder(folder: Path, domain: int) -> Json:
    """The recorder of a camera and of streams at 1 kHz, on the disk as it is, and on a slow one."""
    rows = []
    for disk in ("as it is", "slow"):
        if disk == "slow" and shutil.which("strace") is None:
            rows.append({"disk": disk, "left_out": "strace is not installed; it delays the writes"})
            continue
        own = folder / f"recorder-{disk.split()[0]}"
        shutil.rmtree(own, ignore_errors=True)
        make_folder(own)
        with bench(own, domain) as cell:
            bag = own / "bag"
            rows.append(_recorder_row(cell, bag, disk))
    return {"rows": rows}


def _recorder_row(cell: Bench, bag: Path, disk: str) -> Json:
    cell.add_source("camera", [30.0], 1)
    cell.add_source("streams", [STREAM_RATE], 1)
    if disk == "slow":
        chosen = {c.name: c for c in node_commands("arm", record=bag, log_level="warn")}
        cell.add(slow_disk(chosen["bag_recorder_node"], bag))
    else:
        cell.add_node("bag_recorder_node", record=bag)
    first = cell.wait_for_report("bag_recorder_node")
    time.sleep(1.0)
    usage = cell.usage(("bag_recorder_node",), 2 * _MEASURED)
    last = cell.wait_for_report("bag_recorder_node", 30.0)
    for kind in ("camera", "streams"):
        cell.end_source(kind)
    if not bag.exists():
        raise PushIdentError(f"the recorder wrote no bag: {last.message}")
    written = {key: _difference(first.values, last.values, key) for key in last.values if key.startswith("/") and not key.endswith("lost")}
    lost = {key.removesuffix(" lost"): int(value) for key, value in last.values.items() if key.endswith(" lost")}
    return {"disk": disk, "written": sum(written.values()), "lost": lost, "said": last.message, "warned": last.level != b"\x00", **usage}


def _difference(before: dict[str, str], after: dict[str, str], key: str) -> int:
    def number(values: dict[str, Any]) -> int:
        text = str(values.get(key, "0"))
        return int(text) if text.isdigit() else 0

    return number(after) - number(before)
