"""Write the poses of a bag as tables (CSV), as a tracker exports them. The numbers here come from the example bag."""

import sys
from pathlib import Path

from push_ident.offline.loading import load_pushes

source, folder = Path(sys.argv[1]), Path(sys.argv[2])
folder.mkdir(parents=True, exist_ok=True)
records = load_pushes([source]).records

poses, pusher = ["time,x,y,yaw"], ["time,x,y,push"]
for number, record in enumerate(records):
    start = 10.0 * number - min(record.poses.time[0], record.pusher.time[0])
    poses += [f"{start + t:.4f},{x:.6f},{y:.6f},{yaw:.6f}" for t, (x, y, yaw) in zip(record.poses.time, record.poses.pose, strict=True)]
    path = zip(record.pusher.time, record.pusher.position, strict=True)
    pusher += [f"{start + t:.4f},{x:.6f},{y:.6f},{number}" for t, (x, y) in path]
outline = ["x,y", *(f"{x:.6f},{y:.6f}" for x, y in records[0].shape.outline)]
for name, lines in (("poses", poses), ("pusher", pusher), ("outline", outline)):
    (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
print(f"{len(records)} pushes, pusher of radius {records[0].pusher.radius:g} m: poses.csv, pusher.csv, outline.csv in {folder}")
