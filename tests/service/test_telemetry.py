"""Telemetry: its own registry, every drop reason there from the start, no series left of a site that went."""

from __future__ import annotations

from service.telemetry import Drop, Telemetry


def test_two_services_do_not_mix() -> None:
    first, second = Telemetry(), Telemetry()
    first.dropped(Drop.DEADLINE, 3)
    assert first.drops()["deadline"] == 3
    assert second.drops()["deadline"] == 0
    assert set(first.drops()) == {reason.value for reason in Drop}


def test_frame_sets_feed_counters_and_histograms() -> None:
    telemetry = Telemetry()
    telemetry.frame_set("demo", ["ok", "ok", "bad"], 4, {"decode": 2.5, "total": 17.0})
    telemetry.request("/detect", 200)
    text = telemetry.exposition().decode()
    assert 'quadlift_frame_sets_total{site="demo"} 1.0' in text
    assert 'quadlift_frames_total{status="ok"} 2.0' in text
    assert 'quadlift_boxes_total{site="demo"} 4.0' in text
    assert 'quadlift_stage_seconds_sum{stage="decode"} 0.0025' in text
    assert 'quadlift_http_requests_total{route="/detect",status="200"} 1.0' in text


def test_a_site_that_went_leaves_no_series() -> None:
    telemetry = Telemetry()
    for site in ("demo", "other"):
        telemetry.frame_set(site, ["ok"], 1, {"total": 1.0})
        telemetry.readers(site, 1)
    telemetry.forget_site("demo")
    telemetry.forget_site("never-seen")
    text = telemetry.exposition().decode()
    assert 'site="demo"' not in text
    assert 'quadlift_stream_readers{site="other"} 1.0' in text
