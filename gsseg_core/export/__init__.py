"""A segmentation as files for others: scene files, meshes and pictures."""
