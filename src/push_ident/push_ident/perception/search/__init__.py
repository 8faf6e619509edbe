"""From a frame to new and lost objects: hollows, segments, registration."""
