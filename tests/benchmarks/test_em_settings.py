"""The program that tries other values of the settings of `em`: each once, each put back, and the ends named."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from em_settings import AS_IS, BOUNDARIES, LEARNING, learnt, named, setting, table, values
from regret import Bench
from small_scenes import NAMES, NUM_CLASSES, balls_on_a_table, clean_views

from gsseg_core.learn.em import boundary_alignment, rejected_regions
from gsseg_core.learn.em.em_learner import EMSettings


def test_every_value_is_learnt_with_once_and_none_that_is_known() -> None:
    data: Any = SimpleNamespace(num_classes=NUM_CLASSES, class_names=NAMES)
    views = clean_views(3)
    bench = Bench("demo", balls_on_a_table()[0], data, views, views, views)
    names = [name for name, _ in learnt(bench, views, (LEARNING, BOUNDARIES), set())]
    assert names == [AS_IS, *(named(*other) for other in values((LEARNING, BOUNDARIES)))]
    assert [name for name, _ in learnt(bench, views, (LEARNING,), set(names) - {AS_IS})] == [AS_IS]


def test_a_setting_has_its_value_for_as_long_as_it_is_tried() -> None:
    with setting("majority", 2.0) as settings:
        assert settings == EMSettings(majority=2.0)
    for module, name in ((rejected_regions, "CLAIMED"), (boundary_alignment, "TELLING")):
        before = getattr(module, name)
        with setting(name, 9.0) as settings:
            assert getattr(module, name) == 9.0 and settings == EMSettings()
        assert getattr(module, name) == before


def test_the_table_has_the_mean_and_names_the_worst_and_the_best() -> None:
    measured = {"demo": {"true": {AS_IS: 90.0, "majority 2": 90.5}, "clutter": {AS_IS: 80.0, "majority 2": 79.75}}}
    assert "| majority 2 | +0.125 | -0.25 (demo, clutter) | +0.50 (demo, true) | 2 |" in table(measured)
