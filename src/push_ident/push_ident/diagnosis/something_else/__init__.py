"""What no effect of the catalogue explains: a force in each push, by patterns, and the evidence for it."""
