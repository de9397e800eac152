"""What segmenters publish, made into masks of the core: one file for each kind of message."""
