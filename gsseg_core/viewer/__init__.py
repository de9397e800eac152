"""A segmentation in the browser."""
