"""Simulated cell and studies. One purpose a room:

`objects.py`: what is pushed. `injected/`: effects that a simulated world has. `engines/`: Bullet and a planar engine. `cell/`: the
simulated cell behind the ROS interface of the real one. `recordings/`: simulated pushes, as files and bags. `studies/`: experiments
and benchmarks. `code_digest.py`, `workers.py`: which code a result depends on, and processes for work that is timed.
"""
