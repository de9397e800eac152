"""What kernels would take for places beyond their tables: operators and observations refuse it with one clear error."""

from __future__ import annotations

import numpy as np
import pytest
from operator_cases import random_view

from gsseg_core.csr_rows import CSRRows
from gsseg_core.data.label_evidence import LabelEvidence
from gsseg_core.errors import MaskFormatError, MaskSizeError, SceneValueError
from gsseg_core.raster.backends import make_operator


def test_what_kernels_would_take_for_places_beyond_their_tables_is_refused():
    scene, camera = random_view(0)
    operator, labels = make_operator(scene, camera), np.full((21, 37), 2, np.int32)
    few = LabelEvidence(np.arange(2, dtype=np.int32))
    for mask, evidence in [(labels, few), (labels + 1_000_000_000, None), (labels.astype(float), None)]:
        for use in (operator.observe, lambda *given: operator.vote(*given, np.zeros((120, 9), np.int64), 1.0)):
            with pytest.raises(MaskFormatError, match=r"view 'view': labels are (int32|float64) up to .* expected"):
                use(mask, evidence)
    seen = operator.observe(labels.astype(np.uint8))
    for total in [np.zeros((5, 9), np.int64), np.zeros((120, 2), np.int64), np.zeros((120, 9), np.int32)]:
        with pytest.raises(SceneValueError, match=r"view 'view': votes have shape .* or more, int64"):
            seen.vote(total, 1.0)
        assert not total.any()
    with pytest.raises(SceneValueError, match=r"hidden is int64 \(120,\); expected bool \(120,\)"):
        operator.without(np.zeros(120, np.int64))  # It would be taken for indices, and nothing be hidden.
    codes, seen_codes = CSRRows.from_dense(np.ones((120, 3), np.float32)), np.ones((len(operator.ids), 2), np.float32)
    for use in (lambda *given: operator.blend_rows(*given), lambda k, *given: operator.strongest(k, *given, True)):
        with pytest.raises(SceneValueError, match="codes are of class 2; expected below 1"):
            use(codes, 1)
    with pytest.raises(SceneValueError, match="a Gaussian that it shows has no codes; expected all"):
        operator.blend_rows(codes, 3, np.zeros(120, np.int64))
    for use in (operator.blend_seen, lambda a, b: operator.strongest(codes, 3, True, beside=a, wanted=b)):
        with pytest.raises(MaskSizeError, match=r"wanted pixels have shape \(3, 3\); expected \(21, 37\)"):
            use(seen_codes, np.ones((3, 3), bool))
