"""From depth frames to the objects on the table: shapes, poses and a top-down occupancy grid.

Rooms, each of which imports only from those before it: `frame` (points, labels, table plane of a depth frame), `tracking` (pose per frame),
`outline` (shape of an object at rest), `search` (new and lost objects). `known_object` has the values that they hand to each other, and
`pipeline` the way of a frame through all of them; `recording` runs it over a recording. `calibration` gives the camera pose from a mark.
"""
