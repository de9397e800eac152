"""Which points are near each other."""
