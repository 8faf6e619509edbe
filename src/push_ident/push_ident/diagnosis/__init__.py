"""Where a simulation differs from observed pushes, which missing effect causes it, and how far the gap shrinks once it is added.

`diagnose` is the pipeline. Its stages are functions from one state (`state`) to the next: `gates`, `base_fit`, `select`, `validate`,
`decide`, `explain`; `camera` adapts them to poses from a camera. They use `fits` (maps with effects), `scores` (score tests of absent
effects), `selection` (effects found and their rivals), `residuals`, `held_out`, `patterns` and `something_else` (structure that no
effect explains), `odds` (from evidence to probabilities) and `next_push`. `policy` has every number that decides.
"""
