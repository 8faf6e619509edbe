"""What the pushes of a recording can tell: known maps and known effects are put into simulated twins of them, and looked for."""
