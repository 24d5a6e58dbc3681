"""KITTI labels of the world boxes that a scene's camera sees, whatever made the scene."""

from __future__ import annotations

import numpy as np

from models_export.data.dataset import SceneTruth
from models_export.data.kitti import KittiObject, box_to_kitti, occlusion_level
from service.geometry.boxes import clip_extents, project_extents
from service.geometry.camera import Camera


def kitti_labels(camera: Camera, index: int, truth: SceneTruth) -> list[KittiObject]:
    """KITTI labels of the vehicles that camera number ``index`` of the scene sees, nearest first.

    The 2D box is the extent of the projected 3D box, clipped to the image: what the lifting's geometry is about.
    """
    seen = np.flatnonzero(truth.visible[:, index] > 0)
    center, dims, yaw = truth.center[seen], truth.dims_lwh[seen], truth.yaw[seen]
    location, rotation_y, alpha = box_to_kitti(camera, center, yaw, dims[:, 2])
    extents, _ = project_extents(camera, center, dims, yaw)
    xyxy = clip_extents(camera, extents)
    objects = []
    for k in np.argsort(location[:, 2], kind="stable"):
        length, width, height = (float(d) for d in dims[k])
        x1, y1, x2, y2 = (float(p) for p in xyxy[k])
        x, y, z = (float(p) for p in location[k])
        objects.append(
            KittiObject(
                truth.classes[seen[k]],
                float(truth.truncated[seen[k], index]),
                occlusion_level(float(truth.visible[seen[k], index])),
                float(alpha[k]),
                (x1, y1, x2, y2),
                (height, width, length),
                (x, y, z),
                float(rotation_y[k]),
            )
        )
    return objects
