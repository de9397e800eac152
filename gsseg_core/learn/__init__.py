"""Learns class probabilities from views: the base class of all learners, and each learner."""
