"""Settings of the refinement, in a module of their own so that parsing options does not load the kernels."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

from gsseg_core.errors import SettingsError

MAX_K = 1 << 20  # largest number of neighbours: sums over more would overflow


@dataclass(frozen=True)
class RefineSettings:
    """Settings of the refinement; the defaults measured best, and `PAPER` does what the paper does.

    Attributes
    ----------
    k : int
        Number of nearest Gaussians that both steps use, 1 to 2^20.
    beta : float
        A Gaussian whose largest probability is below this threshold (0 to 1) takes the mean code of its neighbours.
    filter_sigmas : float
        A Gaussian is removed if its mean neighbour distance exceeds the mean of its class by more than this many
        standard deviations, 0 or more.
    weigh : bool
        Whether to weight neighbours by how well they were seen, if that is known; not in the paper.
    cluster, filter : bool
        Whether to do the paper's KNN clustering and its statistical filter.
    carve : bool
        Whether to cut objects to their silhouettes (`gsseg_core.refine.silhouette_carving`) instead of the filter;
        without views, nothing is cut.
    carve_views : int
        Number of views to carve with, 1 or more, spread evenly over the train views.

    Raises
    ------
    SettingsError
        A value outside its range, or both `filter` and `carve`.
    """

    k: int = 50
    beta: float = 0.65
    filter_sigmas: float = 1.0
    weigh: bool = True
    cluster: bool = True
    filter: bool = False
    carve: bool = True
    carve_views: int = 24

    def __post_init__(self) -> None:
        """Validate."""
        if not isinstance(self.k, Integral) or not 1 <= self.k <= MAX_K:  # Kernels do not accept 50.0.
            raise SettingsError(f"refinement: found k = {self.k}; expected a whole number from 1 to {MAX_K}")
        if not 0 <= self.beta <= 1:
            raise SettingsError(f"refinement: found beta = {self.beta}; expected a probability from 0 to 1")
        if not 0 <= self.filter_sigmas < float("inf"):
            raise SettingsError(f"refinement: found filter_sigmas = {self.filter_sigmas}; expected 0 or more, finite")
        if not isinstance(self.carve_views, Integral) or self.carve_views < 1:
            raise SettingsError(f"refinement: found carve_views = {self.carve_views}; expected a whole number above 0")
        if self.carve and self.filter:
            raise SettingsError("refinement: found both carve and filter; expected one of them")


PAPER = RefineSettings(weigh=False, filter=True, carve=False)  # KNN clustering and the statistical filter
UNREFINED = RefineSettings(cluster=False, carve=False)  # keeps codes as they were learnt
