// Drawing on canvases: boxes over camera frames, and the bird's-eye map.

import { boxCorners, projectBox } from "./viewer-geometry.js";

const FONT = 'Inter, "Segoe UI", system-ui, -apple-system, Roboto, "DejaVu Sans", sans-serif';
const CONE_M = 32;
const FIT_M = 38; // How far before each camera the map shows at first.
const MIN_TAG_PX = 13; // Smaller boxes get no number: in the distance the numbers would hide the vehicles.
const TRAIL_MS = 4000;
const TRAIL_JUMP_M = 8; // A longer step is another vehicle under the same number, not a movement.
const GOLDEN_ANGLE = 137.508;

/** A colour that stays with a track: neighbouring numbers get hues far apart. */
export function trackColor(trackId, alpha = 1) {
  if (trackId == null) return `oklch(82% 0.13 170 / ${alpha})`;
  let n = Number(trackId);
  if (!Number.isFinite(n)) n = [...String(trackId)].reduce((sum, c) => (sum * 31 + c.charCodeAt(0)) % 9973, 7);
  return `oklch(80% 0.15 ${(n * GOLDEN_ANGLE) % 360} / ${alpha})`;
}

/** Give a canvas as many device pixels as it covers; returns a context in CSS px. */
export function fitCanvas(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return context;
}

function trace(context, points, scale) {
  points.forEach(([x, y], i) => (i ? context.lineTo(x * scale, y * scale) : context.moveTo(x * scale, y * scale)));
}

function tag(context, text, x, y, color) {
  context.font = `600 11px ${FONT}`;
  const width = context.measureText(text).width + 10;
  context.fillStyle = color;
  context.beginPath();
  context.roundRect(x, y - 16, width, 16, 4);
  context.fill();
  context.fillStyle = "#0b0e13";
  context.fillText(text, x + 5, y - 4.5);
}

/** One camera's frame with the boxes in it. Boxes that this camera had no part in are dashed. */
export function drawCamera(canvas, camera, picture, boxes) {
  const context = fitCanvas(canvas);
  const width = canvas.clientWidth, height = canvas.clientHeight, scale = width / camera.width;
  context.clearRect(0, 0, width, height);
  if (picture) context.drawImage(picture, 0, 0, width, height);
  const seen = boxes.map((box) => ({ box, view: projectBox(camera, box) })).filter(({ view }) => view);
  seen.sort((a, b) => b.view.depth - a.view.depth);
  for (const { box, view } of seen) {
    const own = box.cameras.includes(camera.id);
    context.globalAlpha = own ? 1 : 0.55;
    context.setLineDash(own ? [] : [4, 4]);
    context.lineJoin = "round";
    if (view.front.length) {
      context.beginPath();
      trace(context, view.front, scale);
      context.closePath();
      context.fillStyle = trackColor(box.track_id, 0.28);
      context.fill();
    }
    context.beginPath();
    for (const edge of view.edges) trace(context, edge, scale);
    context.strokeStyle = "rgb(5 8 12 / 55%)";
    context.lineWidth = 3.2;
    context.stroke();
    context.strokeStyle = trackColor(box.track_id);
    context.lineWidth = 1.6;
    context.stroke();
    context.setLineDash([]);
    const [x0, y0] = view.extent;
    if (own && (view.extent[2] - x0) * scale >= MIN_TAG_PX) {
      tag(context, box.track_id ?? box.class, Math.max(2, x0 * scale), Math.max(16, y0 * scale - 2), trackColor(box.track_id, 0.92));
    }
  }
  context.globalAlpha = 1;
}

/** The bird's-eye map: keeps the view (centre, zoom) and each track's trail. */
export class BirdsEye {
  constructor(canvas) {
    this.canvas = canvas;
    this.cameras = [];
    this.boxes = [];
    this.statuses = {};
    this.trails = new Map();
    this.view = null;
    this.listen();
    new ResizeObserver(() => { if (!this.moved) this.view = null; this.draw(); }).observe(canvas);
  }

  /** Start anew with a site's cameras and the picture of its ground. */
  setSite(cameras, ground) {
    Object.assign(this, { cameras, ground, boxes: [], view: null, moved: false });
    this.trails.clear();
    this.draw();
  }

  update(message) {
    const now = performance.now();
    this.boxes = message.boxes;
    this.statuses = message.cameras;
    for (const { track_id: id, center } of message.boxes) {
      if (id == null) continue;
      if (!this.trails.has(id)) this.trails.set(id, []);
      this.trails.get(id).push([center[0], center[1], now]);
    }
    for (const [id, trail] of this.trails) {
      while (trail.length && now - trail[0][2] > TRAIL_MS) trail.shift();
      if (!trail.length) this.trails.delete(id);
    }
    this.draw();
  }

  /** Show all cameras and what lies before them. */
  fit() {
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    const points = this.cameras.flatMap(({ position: [x, y], heading, halfAngle }) => [
      [x, y],
      ...[-halfAngle, 0, halfAngle].map((turn) => [x + FIT_M * Math.cos(heading + turn), y + FIT_M * Math.sin(heading + turn)]),
    ]);
    if (!points.length) points.push([-30, -30], [30, 30]);
    const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
    const spanX = Math.max(...xs) - Math.min(...xs) + 8, spanY = Math.max(...ys) - Math.min(...ys) + 8;
    this.view = {
      x: (Math.max(...xs) + Math.min(...xs)) / 2,
      y: (Math.max(...ys) + Math.min(...ys)) / 2,
      scale: Math.min(width / spanX, height / spanY),
    };
  }

  toScreen(x, y) {
    const { view, canvas } = this;
    return [canvas.clientWidth / 2 + (x - view.x) * view.scale, canvas.clientHeight / 2 - (y - view.y) * view.scale];
  }

  draw() {
    const context = fitCanvas(this.canvas);
    if (!this.canvas.clientWidth) return;
    if (!this.view) this.fit();
    context.clearRect(0, 0, this.canvas.clientWidth, this.canvas.clientHeight);
    this.ground?.draw(context, (x, y) => this.toScreen(x, y), this.view.scale);
    this.drawGrid(context);
    for (const camera of this.cameras) this.drawCone(context, camera);
    for (const [id, trail] of this.trails) this.drawTrail(context, id, trail);
    for (const box of this.boxes) this.drawBox(context, box);
    for (const camera of this.cameras) this.drawPole(context, camera);
  }

  drawGrid(context) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const { view } = this;
    const step = [1, 2, 5, 10, 20, 50, 100, 200].find((s) => s * view.scale >= 44) ?? 500;
    context.font = `10.5px ${FONT}`;
    const line = (major, x0, y0, x1, y1) => {
      context.strokeStyle = major ? "rgb(160 185 220 / 22%)" : "rgb(160 185 220 / 9%)";
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(x0, y0);
      context.lineTo(x1, y1);
      context.stroke();
    };
    context.fillStyle = "#6b788f";
    const halfX = width / 2 / view.scale, halfY = height / 2 / view.scale;
    for (let x = Math.ceil((view.x - halfX) / step) * step; x <= view.x + halfX; x += step) {
      const [sx] = this.toScreen(x, 0);
      line(x === 0, Math.round(sx) + 0.5, 0, Math.round(sx) + 0.5, height);
      if (sx > 40) context.fillText(`${x}`, sx + 4, height - 8);
    }
    for (let y = Math.ceil((view.y - halfY) / step) * step; y <= view.y + halfY; y += step) {
      const [, sy] = this.toScreen(0, y);
      line(y === 0, 0, Math.round(sy) + 0.5, width, Math.round(sy) + 0.5);
      if (sy > 40 && sy < height - 24) context.fillText(`${y}`, 8, sy - 4);
    }
    context.fillStyle = "#75829a";
    context.font = `600 11.5px ${FONT}`;
    context.fillText(`N ↑   ${step} m grid`, 12, 20);
  }

  color(camera) {
    const status = this.statuses[camera.id]?.status;
    return { missing: "242 97 122", bad: "245 184 75" }[status] ?? "120 170 255";
  }

  drawCone(context, camera) {
    const [x, y] = this.toScreen(...camera.position);
    const radius = CONE_M * this.view.scale;
    const gradient = context.createRadialGradient(x, y, 0, x, y, radius);
    gradient.addColorStop(0, `rgb(${this.color(camera)} / 13%)`);
    gradient.addColorStop(1, `rgb(${this.color(camera)} / 0%)`);
    context.fillStyle = gradient;
    context.beginPath();
    context.moveTo(x, y);
    context.arc(x, y, radius, -camera.heading - camera.halfAngle, -camera.heading + camera.halfAngle);
    context.fill();
  }

  drawPole(context, camera) {
    const [x, y] = this.toScreen(...camera.position);
    const color = `rgb(${this.color(camera)})`;
    context.save();
    context.translate(x, y);
    context.rotate(-camera.heading);
    context.fillStyle = color;
    context.beginPath();
    context.roundRect(-7, -5, 11, 10, 2);
    context.moveTo(4, 0);
    context.lineTo(9, -4.5);
    context.lineTo(9, 4.5);
    context.fill();
    context.restore();
    context.font = `600 12px ${FONT}`;
    const width = context.measureText(camera.id).width;
    const dx = -Math.cos(camera.heading) * (width / 2 + 12), dy = Math.sin(camera.heading) * 18;
    context.fillText(camera.id, x + dx - width / 2, y + dy + 4);
  }

  drawTrail(context, id, trail) {
    context.lineWidth = 2.5;
    for (let i = 1; i < trail.length; i++) {
      if (Math.hypot(trail[i][0] - trail[i - 1][0], trail[i][1] - trail[i - 1][1]) > TRAIL_JUMP_M) continue;
      context.strokeStyle = trackColor(id, (0.55 * i) / trail.length);
      context.beginPath();
      context.moveTo(...this.toScreen(trail[i - 1][0], trail[i - 1][1]));
      context.lineTo(...this.toScreen(trail[i][0], trail[i][1]));
      context.stroke();
    }
  }

  drawBox(context, box) {
    const corners = boxCorners(box).slice(0, 4).map(([x, y]) => this.toScreen(x, y));
    const [frontLeft, rearLeft, rearRight, frontRight] = corners;
    const along = (a, b, t) => [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
    context.beginPath();
    trace(context, corners, 1);
    context.closePath();
    context.fillStyle = trackColor(box.track_id, 0.3);
    context.fill();
    context.strokeStyle = trackColor(box.track_id);
    context.lineWidth = 1.8;
    context.stroke();
    // The filled front quarter shows the heading.
    context.beginPath();
    trace(context, [frontLeft, frontRight, along(frontRight, rearRight, 0.26), along(frontLeft, rearLeft, 0.26)], 1);
    context.closePath();
    context.fillStyle = trackColor(box.track_id, 0.95);
    context.fill();
    this.drawVelocity(context, box);
    const [x, y] = this.toScreen(box.center[0], box.center[1]);
    const reach = (Math.hypot(box.size[0], box.size[1]) / 2) * this.view.scale;
    context.font = `600 12px ${FONT}`;
    context.fillStyle = "#e6ebf2";
    context.fillText(box.track_id ?? "", x + reach * 0.75 + 3, y - reach * 0.75);
  }

  /** Where the vehicle will be in one second. */
  drawVelocity(context, { center, velocity, track_id: id }) {
    if (!velocity || Math.hypot(velocity[0], velocity[1]) < 0.5) return;
    const [x0, y0] = this.toScreen(center[0], center[1]);
    const [x1, y1] = this.toScreen(center[0] + velocity[0], center[1] + velocity[1]);
    const angle = Math.atan2(y1 - y0, x1 - x0);
    context.strokeStyle = context.fillStyle = trackColor(id);
    context.lineWidth = 1.6;
    context.beginPath();
    context.moveTo(x0, y0);
    context.lineTo(x1, y1);
    context.stroke();
    context.beginPath();
    for (const turn of [0, 2.6, -2.6]) context.lineTo(x1 + 6 * Math.cos(angle + turn), y1 + 6 * Math.sin(angle + turn));
    context.fill();
  }

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons || !this.view) return;
      this.moved = true;
      this.view.x -= event.movementX / this.view.scale;
      this.view.y += event.movementY / this.view.scale;
      this.draw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (!this.view) return;
      this.moved = true;
      const factor = Math.exp(-event.deltaY / 500);
      const dx = (event.offsetX - canvas.clientWidth / 2) / this.view.scale;
      const dy = (canvas.clientHeight / 2 - event.offsetY) / this.view.scale;
      this.view.x += dx * (1 - 1 / factor);
      this.view.y += dy * (1 - 1 / factor);
      this.view.scale *= factor;
      this.draw();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => { this.moved = false; this.view = null; this.draw(); });
  }
}
