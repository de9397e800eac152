"""A small scene with known truth, and its segmentation from wrong masks."""
