"""Programs that ask the node: arrays in and out."""
