import numpy as np

from service.geometry.boxes import Boxes, project_extents
from service.geometry.camera import Camera
from service.geometry.transforms import pole_camera_pose
from service.views import whole_in_view

K = np.array([[642.0, 0.0, 641.5], [0.0, 642.0, 191.5], [0.0, 0.0, 1.0]])


def cars(center):
    n = len(center)
    zero = np.zeros(n)
    dims = np.tile([4.4, 1.8, 1.5], (n, 1))
    return Boxes(np.asarray(center), dims, zero + 0.3, zero, np.zeros(n, np.int64), np.zeros((n, 7, 7)), zero)


def test_it_is_the_projection_that_decides_with_or_without_a_lens():
    rng = np.random.default_rng(0)
    boxes = cars(np.c_[rng.uniform(-60, 60, (300, 2)), np.full(300, 0.75)])
    pose = [pole_camera_pose([20.0, 5.0, 6.0], 2.5, 0.2), pole_camera_pose([-20.0, 5.0, 6.0], 0.0, 0.25)]
    for lens in (np.zeros(0), np.array([-0.2, 0.05, 0.0, 0.0])):
        cameras = [Camera("a", 1284, 384, K, pose[0], lens), Camera("b", 1284, 384, K, pose[1])]
        seen = whole_in_view(boxes, cameras, 50.0)
        assert 20 < seen.sum() < 300
        for column, camera in enumerate(cameras):
            xyxy, in_front = project_extents(camera, boxes.center, boxes.dims_lwh, boxes.yaw)
            inside = (xyxy[:, :2] >= 0).all(1) & (xyxy[:, 2:] <= [1283, 383]).all(1)
            near = np.linalg.norm(boxes.center - camera.position_m, axis=1) <= 50.0
            np.testing.assert_array_equal(seen[:, column], in_front & inside & near)


def test_nothing_is_in_view_of_nobody():
    camera = Camera("a", 1284, 384, K, pole_camera_pose([0.0, 0.0, 6.0], 0.0, 0.2))
    assert whole_in_view(cars([[10.0, 0.0, 0.75]]), [], 50.0).shape == (1, 0)
    assert whole_in_view(Boxes.empty(), [camera], 50.0).shape == (0, 1)
