"""From depth frames to the objects on the table: shapes, poses and a top-down occupancy grid.

`depth_image` (bytes to metres), `depth` (metres to points), `calibration` (camera pose from a mark), `table` (the plane), `labels` (table,
object, robot, unknown per pixel), `topdown` (grid), `surfaces` and `segments` (candidate objects), `shape` (outline and cells of an object
at rest), `tracking` (pose per frame), `fusion` (the outline from several views), `further_camera` (a second view of an object at rest),
`pipeline` (all of it).
"""
