"""The least value of a function of one number, beside SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from gsseg_core.learn.minimum import minimum


@pytest.mark.parametrize("precision", [0.02, 1e-5, 1e-9])
@pytest.mark.parametrize("seed", range(40))
def test_the_minimum_is_scipys_to_the_last_bit(seed: int, precision: float) -> None:
    rng = np.random.default_rng(seed)
    place, power, waves, steps = rng.uniform(-3, 3), rng.choice([1, 2, 4]), rng.choice([0, 0.3]), rng.choice([0, 8])
    low, high = sorted(rng.uniform(-2, 2, 2).tolist())
    asked: list[float] = []

    def f(x: float) -> float:
        asked.append(float(x))
        value = abs(x - place) ** power + waves * np.sin(9 * x)
        return float(np.round(value * steps) / steps if steps else value)  # with steps, many values are the same

    found = minimum(f, low, high, precision)
    ours, asked[:] = asked.copy(), []
    theirs = minimize_scalar(f, bounds=(low, high), method="bounded", options={"xatol": precision})
    assert (ours, found) == (asked, float(theirs.x))
    assert low <= found <= high
