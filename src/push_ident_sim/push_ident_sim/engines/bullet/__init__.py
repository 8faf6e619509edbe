"""An object of cells in Bullet, and a disc that pushes it without arm and camera."""
