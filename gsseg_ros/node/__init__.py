"""The lifecycle node: posed masks in, objects out."""
