"""Three real roadside cameras posted to a running service."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.recordings import open_roadside_clip
from clients.client import Client, ServiceError
from clients.local_service import HOST, free_port, running_service
from service.errors import NotFoundError
from service.site import save_site


def test_one_real_step_is_answered_with_well_formed_boxes(tmp_path: Path) -> None:
    try:
        clip = open_roadside_clip()
    except NotFoundError as error:
        pytest.skip(str(error))
    site_file = tmp_path / "site.json"
    save_site(clip.site, site_file)
    frames = {camera.id: clip.frame(camera.id, 41) for camera in clip.site.cameras}
    port = free_port(0)
    with running_service(site_file, port), Client(f"http://{HOST}:{port}") as client:
        message = client.detect(clip.site.id, frames, per_camera=True)
        with pytest.raises(ServiceError) as caught:
            client.detect(clip.site.id, {"infra_0": frames["infra_0"][:5000]})
        again = client.detect(clip.site.id, frames)
    assert caught.value.status == 422
    assert caught.value.field == "infra_0"
    assert not message.degraded
    assert {camera.status for camera in message.cameras.values()} == {"ok"}
    assert [box.center for box in again.boxes] == [box.center for box in message.boxes]
    for box in message.boxes:
        assert all(math.isfinite(v) for v in (*box.center, *box.size, box.yaw))
        assert all(side > 0 for side in box.size)
        assert set(box.cameras) <= set(frames)
        # In the site's frame: on the road, within the junction.
        assert abs(box.center[2] - box.size[2] / 2) < 3
        assert math.hypot(*box.center[:2]) < 200
