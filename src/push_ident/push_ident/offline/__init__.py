"""From bags to the pushes of one object, with poses from the bag or tracked in its depth images."""
