"""Recordings of others, converted to contract bags: one module for each format, `report.py` and `shapes.py` for all of them."""

from __future__ import annotations

from push_ident.bags.importers.cmu_fingers import FINGER_SHAPES, FingerOptions, import_cmu_fingers
from push_ident.bags.importers.cmu_icra16 import import_cmu_icra16
from push_ident.bags.importers.cmu_mocap import MocapObject, import_cmu_mocap
from push_ident.bags.importers.mit import MIT_SHAPES, MitOptions, import_mit, mit_sets
from push_ident.bags.importers.report import ImportReport
from push_ident.bags.importers.rosbag import RosbagTopics, import_rosbag
from push_ident.bags.importers.tables import TableFormat
from push_ident.bags.importers.tracked_poses import TrackedPoses, import_tracked_poses

__all__ = [
    "FINGER_SHAPES", "MIT_SHAPES", "FingerOptions", "ImportReport", "MitOptions", "MocapObject", "RosbagTopics", "TableFormat",
    "TrackedPoses", "import_cmu_fingers", "import_cmu_icra16", "import_cmu_mocap", "import_mit", "import_rosbag",
    "import_tracked_poses", "mit_sets",
]  # fmt: skip
