"""What a fit leaves: the posterior, what it determines, how well it explains its pushes, and its file."""
