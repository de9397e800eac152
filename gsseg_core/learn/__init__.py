"""From views to class probabilities: what all learners share, and each of them."""
