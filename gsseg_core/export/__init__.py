"""A segmentation as files for others: PLY files and pictures."""
