"""Two independent engines that push an object: Bullet, and a planar one. Both return a `TrueMotion`."""
