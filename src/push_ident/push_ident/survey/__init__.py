"""What a depth camera sees of a table: its noise, objects and refusals, as JSON, picture, page and parameter file."""
