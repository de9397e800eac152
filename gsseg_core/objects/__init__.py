"""Objects: found over views, picked, boxed, cut out and taken away."""
