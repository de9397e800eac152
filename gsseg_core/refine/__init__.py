"""Refines learnt class probabilities with those of nearby Gaussians."""
