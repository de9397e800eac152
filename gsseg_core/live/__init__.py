"""Sessions that learn while views come in, as a robot does."""
