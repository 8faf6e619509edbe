"""Storage files of bags, read with bounded time and memory: MCAP, sqlite3, ROS 1, and folders of them.

The readers of the usual libraries take sizes and offsets from the file at their word. These compare them with `limits.py` and with the size
of the file first.
"""
