// The road on the map: the cameras' pictures laid onto the ground plane, averaged over time so that traffic fades out.

import { projectPoint } from "./viewer-geometry.js";

const CELL_M = 0.25;
const MAX_CELLS = 900; // A side; a wide site gets larger cells.
const REACH_M = 48;
const PICTURE_SCALE = 0.5;
const REFRESH_MS = 1000;
const SLOWEST_MEAN = 20; // Averages over the last 20 pictures or so, so that the light may change.

export class GroundPicture {
  constructor(site, cameras) {
    const xs = cameras.flatMap((c) => [c.position[0] - REACH_M, c.position[0] + REACH_M]);
    const ys = cameras.flatMap((c) => [c.position[1] - REACH_M, c.position[1] + REACH_M]);
    this.west = Math.min(...xs);
    this.north = Math.max(...ys);
    const width = Math.max(...xs) - this.west, height = this.north - Math.min(...ys);
    this.cell = Math.max(CELL_M, Math.max(width, height) / MAX_CELLS);
    this.columns = Math.ceil(width / this.cell);
    this.rows = Math.ceil(height / this.cell);
    this.canvas = new OffscreenCanvas(this.columns, this.rows);
    this.image = new ImageData(this.columns, this.rows);
    this.mean = new Float32Array(3 * this.columns * this.rows);
    this.count = 0;
    this.nextAt = 0;
    const { normal = [0, 0, 1], offset = 0 } = site.ground ?? {};
    this.views = this.lookUp(cameras, (x, y) => (offset - x * normal[0] - y * normal[1]) / normal[2]);
  }

  /** Per camera: which cells it shows, at which pixel, and with what share (near cameras show more). */
  lookUp(cameras, heightAt) {
    const total = new Float32Array(this.columns * this.rows);
    const views = cameras.map((camera) => {
      const width = Math.floor(camera.width * PICTURE_SCALE), height = Math.floor(camera.height * PICTURE_SCALE);
      const cells = [], pixels = [], shares = [];
      for (let row = 0; row < this.rows; row++) {
        for (let column = 0; column < this.columns; column++) {
          const x = this.west + (column + 0.5) * this.cell, y = this.north - (row + 0.5) * this.cell;
          const far = Math.hypot(x - camera.position[0], y - camera.position[1]) / REACH_M;
          if (far > 1) continue;
          const seen = projectPoint(camera, [x, y, heightAt(x, y)]);
          if (!seen) continue;
          const u = Math.floor((seen[0] + 0.5) * PICTURE_SCALE), v = Math.floor((seen[1] + 0.5) * PICTURE_SCALE);
          if (u < 0 || v < 0 || u >= width || v >= height) continue;
          const share = (1 - far) ** 2 + 1e-4;
          const cell = row * this.columns + column;
          cells.push(cell);
          pixels.push(v * width + u);
          shares.push(share);
          total[cell] += share;
        }
      }
      const canvas = new OffscreenCanvas(width, height);
      const context = canvas.getContext("2d", { willReadFrequently: true });
      return { id: camera.id, width, height, context, cells: Uint32Array.from(cells), pixels: Uint32Array.from(pixels), shares: Float32Array.from(shares) };
    });
    for (const { cells, shares } of views) cells.forEach((cell, i) => { shares[i] /= total[cell]; });
    // What only one far camera shows fades out.
    for (let cell = 0; cell < total.length; cell++) this.image.data[4 * cell + 3] = 255 * Math.min(1, total[cell] * 2.5);
    return views;
  }

  /** Take in the pictures (by camera id) of a frame set in which every camera delivered. */
  update(pictures) {
    const now = performance.now();
    if (now < this.nextAt || this.views.some((view) => !pictures.get(view.id))) return;
    this.nextAt = now + REFRESH_MS;
    this.count = Math.min(this.count + 1, SLOWEST_MEAN);
    const fresh = new Float32Array(this.mean.length);
    for (const { id, width, height, context, cells, pixels, shares } of this.views) {
      context.drawImage(pictures.get(id), 0, 0, width, height);
      const { data } = context.getImageData(0, 0, width, height);
      for (let i = 0; i < cells.length; i++) {
        for (let k = 0; k < 3; k++) fresh[3 * cells[i] + k] += shares[i] * data[4 * pixels[i] + k];
      }
    }
    for (let i = 0; i < fresh.length; i++) this.mean[i] += (fresh[i] - this.mean[i]) / this.count;
    for (let cell = 0; cell < fresh.length / 3; cell++) {
      for (let k = 0; k < 3; k++) this.image.data[4 * cell + k] = this.mean[3 * cell + k];
    }
    this.canvas.getContext("2d").putImageData(this.image, 0, 0);
  }

  /** Draw it where ``toScreen`` puts the world. */
  draw(context, toScreen, scale) {
    if (!this.count) return;
    const [x, y] = toScreen(this.west, this.north);
    context.globalAlpha = 0.55;
    context.drawImage(this.canvas, x, y, this.columns * this.cell * scale, this.rows * this.cell * scale);
    context.globalAlpha = 1;
  }
}
