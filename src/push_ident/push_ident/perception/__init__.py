"""From depth frames to what lies on the table: shapes, poses and a top-down occupancy.

`depth` (bytes to metres to points), `calibration` (camera pose from a mark), `table` (the plane), `labels` (table, object, robot,
unknown per pixel), `topdown` (grid), `surfaces` and `segments` (candidate objects), `shape` (outline and cells of an object at rest),
`tracking` (pose per frame), `fusion` (the outline from several views), `pipeline` (all of it).
"""
