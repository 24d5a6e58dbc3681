"""Fairness and sites of repeated cameras."""

from __future__ import annotations

import math

import pytest

from benchmarks.load.scaling import jain, repeated_site
from clients.clip import open_clip
from service.site import parse_site


def test_known_fairness() -> None:
    assert jain([3, 3, 3]) == pytest.approx(1)
    assert jain([5, 0, 0, 0]) == pytest.approx(1 / 4)
    assert jain([1, 2]) == pytest.approx(9 / 10)
    assert math.isnan(jain([0, 0]))


@pytest.mark.parametrize("count", [1, 4, 16])
def test_a_site_of_as_many_cameras_as_wanted(count: int) -> None:
    clip = open_clip()
    site = repeated_site(clip, "many", count)
    assert len(parse_site(dict(site.document)).cameras) == len(site.cameras) == count
    assert set(site.cameras.values()) == set(clip.camera_ids[:count])
