"""Write arrays as a bag of the contract. The arrays here come from the example bag; put your own in their place."""

import sys
from pathlib import Path

from push_ident.bags.writer import BagWriter
from push_ident.offline.loading import load_pushes

source, target = Path(sys.argv[1]), Path(sys.argv[2])
records = load_pushes([source]).records

with BagWriter(target) as bag:
    shape = records[0].shape
    # shape.cells.centres [m], (n_cells, 2), and shape.outline [m], (n_vertices, 2), counter-clockwise: both in the object frame.
    bag.write_shape("o1", shape, stamp=1.0)
    bag.write_pusher_shape(1.0, radius=records[0].pusher.radius)
    start = 1.0
    for number, record in enumerate(records):
        poses, pusher = record.poses, record.pusher
        first, last = min(poses.time[0], pusher.time[0]), max(poses.time[-1], pusher.time[-1])
        for time, pose, covariance in zip(poses.time, poses.pose, poses.covariance, strict=True):
            bag.write_pose("o1", start + time - first, pose, covariance)  # (x, y, yaw) in `table` and its 3 x 3 covariance
        for time, position in zip(pusher.time, pusher.position, strict=True):
            bag.write_pusher(start + time - first, position)  # axis of the pusher in `table`, while the push lasts
        bag.write_push_record(number, "o1", start, start + last - first)
        start += last - first + 1.0
print(f"{len(records)} pushes written to {target}")
