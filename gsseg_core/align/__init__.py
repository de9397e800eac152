"""Whether the cameras of a dataset fit a scene, and which frame makes them fit."""
