"""The least value of a function of one number between two bounds, by Brent's method.

What SciPy's `minimize_scalar` finds with `method="bounded"`, to the last bit, without loading half of SciPy.
"""

from __future__ import annotations

import math
from collections.abc import Callable

GOLDEN = 0.5 * (3 - math.sqrt(5))  # what a golden section leaves of an interval on its smaller side
_PRECISION = math.sqrt(2.2e-16)  # of a place, as a share of it: closer together, values do not differ
_MOST = 500  # calls of the function


def minimum(f: Callable[[float], float], low: float, high: float, precision: float) -> float:
    """Find where `f` is least between two bounds, to an absolute precision.

    Each step goes to the vertex of the parabola through the three best places, where that is trusted, and else to a
    golden section of the larger side (Brent, Algorithms for Minimization without Derivatives, 1973, section 5.8).
    """
    best = second = third = low + GOLDEN * (high - low)
    f_best = f_second = f_third = f(best)
    step = before = 0.0  # the last step, and the one before it
    for _ in range(_MOST - 1):
        middle, least = 0.5 * (low + high), _PRECISION * abs(best) + precision / 3
        if abs(best - middle) <= 2 * least - 0.5 * (high - low):
            break
        vertex = None
        if abs(before) > least:
            vertex = _vertex(best - second, f_best - f_second, best - third, f_best - f_third)
            trusted = abs(vertex[0]) < abs(0.5 * vertex[1] * before)
            before, (p, q) = step, vertex
            if not (trusted and q * (low - best) < p < q * (high - best)):
                vertex = None
        if vertex is None:
            before = (low if best >= middle else high) - best
            step = GOLDEN * before
        else:
            step = p / q
            if best + step - low < 2 * least or high - (best + step) < 2 * least:
                step = least if middle >= best else -least
        x = best + (1 if step >= 0 else -1) * max(abs(step), least)
        value = f(x)
        if value <= f_best:
            low, high = (best, high) if x >= best else (low, best)
            third, f_third, second, f_second, best, f_best = second, f_second, best, f_best, x, value
            continue
        low, high = (x, high) if x < best else (low, x)
        if value <= f_second or second == best:
            third, f_third, second, f_second = second, f_second, x, value
        elif value <= f_third or third in (best, second):
            third, f_third = x, value
    return best


def _vertex(to_second: float, rise_second: float, to_third: float, rise_third: float) -> tuple[float, float]:
    """Step from the best place to the vertex of a parabola, as numerator and denominator of at least 0."""
    r, q = to_second * rise_third, to_third * rise_second
    p = to_third * q - to_second * r
    q = 2 * (q - r)
    return (-p if q > 0 else p), abs(q)
