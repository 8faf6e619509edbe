"""Real pushes of which only the end poses are known."""
