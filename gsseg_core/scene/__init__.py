"""A trained scene: its Gaussians, the cameras that look at it, and the files that they come from."""
