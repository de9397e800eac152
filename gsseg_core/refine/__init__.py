"""Learnt probabilities made better by what lies near in space."""
