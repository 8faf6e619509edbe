"""Faults of disks and folders."""

from __future__ import annotations

import stat
import time
from pathlib import Path
from typing import Final

from push_ident.bags.reader import read_bag
from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.errors import PushIdentError
from push_ident.pushing.push import PushCode
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.cell import ARM_CELL, Cell
from push_ident_sim.faults.harness.monitor import until
from push_ident_sim.faults.harness.mounts import fill, read_only, small_disk

__all__ = ["FAULTS"]

_IDENTIFICATION: Final = "identification_node"
_DISK: Final = 24
"""Size of the small disk [MiB]."""
_LEAST: Final = 8
"""`min_free_mib` of the recorder."""
_CHECKED: Final = 0.5
"""The recorder looks at the free disk this often [s]."""


def _recorder(cell: Cell, bag: Path) -> None:
    parameters = {"bag_recorder_node": {"depth": False, "min_free_mib": _LEAST}}
    command = next(c for c in node_commands("sim", record=bag, parameters=parameters) if c.name == "bag_recorder_node")
    cell.add(NodeCommand("bag_recorder_node", command.argv))


def _disk_full(trial: Trial) -> None:
    cell = trial.cell
    with small_disk(trial.folder / "disk", _DISK) as disk:
        bag = disk / "bag"
        try:
            _recorder(cell, bag)
            until(lambda: cell.monitor.report_of("bag_recorder_node"), 20.0, "the recorder reports nothing")
            trial.wait(1.5)
            sent = cell.begin(after=0.0)
            since = time.monotonic()
            fill(disk, _LEAST - 2)
            result = cell.end(sent)
            trial.expect_hold(since)
            trial.expect(result.error_code == PushCode.RECORDING, f"the push ended with {result.error_code} {result.error_text}")
            refused = cell.push()
            trial.expect(refused.error_code == PushCode.RECORDING, f"the next push gave {refused.error_code} {refused.error_text}")
            try:
                contents = read_bag(bag)
                trial.note = f"{len(contents.pusher.time)} poses of the pusher in the bag"
            except PushIdentError as error:
                trial.expect(False, f"the bag cannot be read: {error}")
        finally:
            cell.remove("bag_recorder_node")
    trial.lost = "the push under way"


def _no_disk_at_start(trial: Trial) -> None:
    cell = trial.cell
    with small_disk(trial.folder / "disk", _DISK) as disk:
        fill(disk, _LEAST - 2)
        try:
            _recorder(cell, disk / "bag")
            process = cell.processes["bag_recorder_node"]
            code = process.wait(15.0)
            trial.expect(code == 1, f"the recorder ended with {code}, expected 1")
            trial.expect("MiB free" in process.output, "it does not say how much is free")
            trial.note = process.output.strip().splitlines()[-1][-100:] if process.output.strip() else ""
        finally:
            cell.remove("bag_recorder_node")


def _state_read_only(trial: Trial) -> None:
    """The folder of the checkpoints cannot be written to while a push is learned."""
    cell = trial.cell
    since = time.monotonic()
    with read_only(cell.state_folder):
        cell.whole_push()
        trial.expect_report(_IDENTIFICATION, "cannot write", since=since, patience=10.0)
    cell.whole_push(cell.goal(-1))
    trial.wait(2.0)
    report = cell.monitor.report_of(_IDENTIFICATION)
    trial.note = "" if report is None else report.values.get("last refusal", "")[:120]


def _model_on_full_disk(trial: Trial) -> None:
    cell = trial.cell
    with small_disk(trial.folder / "disk", 1) as disk:
        fill(disk)
        target = disk / "model.json"
        refusal = cell.save_model(target)
        trial.expect(refusal, "save_model reports success on a full disk")
        trial.expect(not target.exists(), "half a model was left behind")
        trial.note = refusal[-100:]


def _private_files(trial: Trial) -> None:
    """State and models belong to one user; a link in their place is not followed."""
    cell = trial.cell
    model, secret, link = trial.folder / "model.json", trial.folder / "secret", trial.folder / "link.json"
    secret.write_text("precious")
    link.symlink_to(secret)
    trial.expect(cell.save_model(model) == "", "save_model failed")
    cell.save_model(link)
    trial.expect(secret.read_text() == "precious", "a link was followed: the file behind it was overwritten")
    files = [model, *(path for path in cell.state_folder.rglob("*") if path.is_file())]
    for path in files:
        mode = stat.S_IMODE(path.stat().st_mode)
        trial.expect(mode == 0o600, f"{path.name} has mode {mode:o}, expected 600")
    if cell.state_folder.exists():
        mode = stat.S_IMODE(cell.state_folder.stat().st_mode)
        trial.expect(mode == 0o700, f"the folder of the states has mode {mode:o}, expected 700")
    trial.note = f"{len(files)} files of mode 600"


FAULTS: Final = (
    Fault(
        number=22,
        name="disk-full",
        what="the disk fills up while a push is recorded",
        holds="the recorder looks at the free disk; the executor listens to it",
        expected="RECORDING; held; the bag is closed readable; the next push is refused",
        run=_disk_full,
        cell=ARM_CELL,
        within=_CHECKED,
    ),
    Fault(
        number=52,
        name="disk-full-before",
        what="a recorder starts on a disk with too little space",
        holds="the recorder looks before it writes",
        expected="one line; nothing recorded",
        run=_no_disk_at_start,
        cell=ARM_CELL,
    ),
    Fault(
        number=53,
        name="state-read-only",
        what="the folder of the checkpoints is mounted read-only during a push",
        holds="the guard around the worker of identification",
        expected="refused and named; the model in memory is kept",
        run=_state_read_only,
        cell=ARM_CELL,
    ),
    Fault(
        number=54,
        name="model-on-full-disk",
        what="save_model on a full disk",
        holds="files are replaced as a whole",
        expected="no success, no half file",
        run=_model_on_full_disk,
        cell=ARM_CELL,
    ),
    Fault(
        number=55,
        name="private-files",
        what="save_model where a link lies; modes of state and models",
        holds="the one writer of files",
        expected="no link followed; files 600, folders 700",
        run=_private_files,
        cell=ARM_CELL,
    ),
)
