"""How much a view counts for what it sees of a cluster of segments, or of a region of Gaussians."""

from __future__ import annotations

import numpy as np

FULL_SIGHT = 0.5  # share of a cluster, as far as any view sees it, that a view must see to count in full
PLENTY = 2000.0  # px of a cluster that a view must see to count in full, however large the cluster is
FULL_SIGHT_PX = 10.0  # what a view sees of a cluster counts by x / (x + this), x in px
EVIDENCE = 0.3  # views, in full sight of both clusters, that it takes at least to merge two


def sight(seen: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Say how much views count for what they see of clusters, (C, views) px; the most that any sees is (C, 1)."""
    full = np.minimum(FULL_SIGHT * most, PLENTY)
    return np.minimum(seen / np.maximum(full, 1e-9), 1) * seen / (seen + FULL_SIGHT_PX)
