// Cameras and boxes: the conventions of the wire contract (world East, North, up; camera x right, y down, z forward).

const NEAR_M = 0.2;
const MAX_NORMALISED = 3; // Beyond this a lens polynomial folds back on itself.
const SIGNS = [-1, 1].flatMap((z) => [[1, 1, z], [-1, 1, z], [-1, -1, z], [1, -1, z]]);
const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];
const FRONT_FACE = [0, 3, 7, 4];

/** World corners (8 points) of a box, bottom four first, counter-clockwise from the front left. */
export function boxCorners({ center, size, yaw }) {
  const c = Math.cos(yaw), s = Math.sin(yaw);
  return SIGNS.map(([sx, sy, sz]) => {
    const x = (sx * size[0]) / 2, y = (sy * size[1]) / 2;
    return [center[0] + c * x - s * y, center[1] + s * x + c * y, center[2] + (sz * size[2]) / 2];
  });
}

function toCamera(T, p) {
  return [0, 1, 2].map((r) => T[r][0] * p[0] + T[r][1] * p[1] + T[r][2] * p[2] + T[r][3]);
}

/** OpenCV's radial and tangential terms: k1 k2 p1 p2 k3 k4 k5 k6. */
function distort(d, x, y) {
  const [k1 = 0, k2 = 0, p1 = 0, p2 = 0, k3 = 0, k4 = 0, k5 = 0, k6 = 0] = d;
  const r2 = x * x + y * y;
  const radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
  return [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y];
}

function pixel(camera, [X, Y, Z]) {
  let x = X / Z, y = Y / Z;
  if (camera.bent) {
    if (Math.hypot(x, y) > MAX_NORMALISED) return null;
    [x, y] = distort(camera.distortion, x, y);
  }
  const K = camera.K;
  return [K[0][0] * x + K[0][1] * y + K[0][2], K[1][1] * y + K[1][2]];
}

/** Pixel of a world point, or null when it lies behind the camera. */
export function projectPoint(camera, point) {
  const inCamera = toCamera(camera.T_cam_world, point);
  return inCamera[2] < NEAR_M ? null : pixel(camera, inCamera);
}

/** A polyline in px of the part of segment a-b (camera frame) that lies before the camera. */
function projectSegment(camera, a, b) {
  if (a[2] < NEAR_M && b[2] < NEAR_M) return [];
  if (a[2] < NEAR_M || b[2] < NEAR_M) {
    const t = (NEAR_M - a[2]) / (b[2] - a[2]);
    const cut = a.map((v, i) => v + t * (b[i] - v));
    if (a[2] < NEAR_M) a = cut; else b = cut;
  }
  const steps = camera.bent ? 8 : 1;
  const points = [];
  for (let i = 0; i <= steps; i++) points.push(pixel(camera, a.map((v, k) => v + (i / steps) * (b[k] - v))));
  return points.filter(Boolean);
}

/**
 * What a camera sees of a box: edges (12 polylines), front face (polygon, empty when cut by the image plane), extent
 * [x0, y0, x1, y1], all px; or null when it lies behind the camera or outside its image.
 */
export function projectBox(camera, box) {
  const corners = boxCorners(box).map((p) => toCamera(camera.T_cam_world, p));
  const edges = EDGES.map(([i, j]) => projectSegment(camera, corners[i], corners[j]));
  const points = edges.flat();
  if (!points.length) return null;
  const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
  const extent = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  if (extent[2] < 0 || extent[3] < 0 || extent[0] > camera.width || extent[1] > camera.height) return null;
  const whole = FRONT_FACE.every((i) => corners[i][2] >= NEAR_M);
  const front = whole ? FRONT_FACE.map((i) => pixel(camera, corners[i])).filter(Boolean) : [];
  return { edges, front, extent, depth: toCamera(camera.T_cam_world, box.center)[2] };
}

/** A camera as the map needs it: position, heading (counter-clockwise from East) and half angle of view, metres and radians. */
export function footprint(camera) {
  const T = camera.T_cam_world;
  const position = [0, 1, 2].map((i) => -(T[0][i] * T[0][3] + T[1][i] * T[1][3] + T[2][i] * T[2][3]));
  return {
    position,
    heading: Math.atan2(T[2][1], T[2][0]),
    halfAngle: Math.atan(camera.width / 2 / camera.K[0][0]),
  };
}

/** Cameras of a site document, each with what drawing needs precomputed. */
export function prepareCameras(site) {
  return site.cameras.map((camera) => ({
    ...camera,
    bent: (camera.distortion ?? []).some((k) => k !== 0),
    ...footprint(camera),
  }));
}
