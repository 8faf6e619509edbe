"""From depth frames to what lies on the table: shapes, poses and a top-down occupancy.

`depth` (bytes to metres to points), `table` (the plane), `labels` (table, object, robot, unknown per pixel), `topdown` (grid),
`segments` (candidate objects), `shape` (outline and cells of an object at rest), `tracking` (pose per frame), `pipeline` (all of it).
"""
