"""Settings of the refinement, apart from its kernels: who only reads options need not load them."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

from gsseg_core.errors import SettingsError

MAX_K = 1 << 20  # most neighbours: sums over more would overflow


@dataclass(frozen=True)
class RefineSettings:
    """How to refine; the defaults are what measured best, `PAPER` is the paper's way.

    Attributes
    ----------
    k : int
        Neighbours looked at by both steps, a number of Gaussians from 1 to 2^20.
    beta : float
        A Gaussian whose largest probability is below this one (0 to 1) takes the mean code of its neighbours.
    filter_sigmas : float
        A Gaussian is removed where its mean neighbour distance is more than this many standard deviations, 0 or more,
        above the mean of its class.
    weigh : bool
        Whether neighbours weigh by how well they were seen, where that is known; not in the paper.
    cluster, filter : bool
        Whether to take each of the paper's two steps, KNN clustering and the statistical filter.
    carve : bool
        Whether to cut objects to their silhouettes (`gsseg_core.refine.silhouette_carving`), in place of the filter;
        where there are no views, nothing is cut.
    carve_views : int
        From how many views, 1 or more, spread evenly over the train views.

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
        if not isinstance(self.k, Integral) or not 1 <= self.k <= MAX_K:  # Kernels take no 50.0.
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
UNREFINED = RefineSettings(cluster=False, carve=False)  # codes as they were learnt
