"""Where the simulation parts from what was seen, which effect that it leaves out is the cause, and how much of the gap goes with it.

`fits` (the maps with some effects), `scores` (tests of every absent effect from one fit), `selection` (which effects), `held_out` (how far,
on pushes that the fit did not see), `residuals` (where), `next_push` (what would settle what is open), `diagnose` (all of it).
"""
