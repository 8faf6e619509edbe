"""What is unknown of an object, its prior, and how the moving body depends on it."""
