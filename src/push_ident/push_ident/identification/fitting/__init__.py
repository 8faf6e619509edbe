"""A fit of unknowns to pushes: the cost, its minimum, the evidence of priors, and the interface of a solver."""
