"""Studies: the experiments of Song & Boularias (2020) and beyond, and the benchmarks; one folder each.

A folder with a module `study.py` that has `STUDY` is a study; nothing else has to be touched to add one.
"""
