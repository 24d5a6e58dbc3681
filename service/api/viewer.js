// The live page: follows a site's stream, fetches the frames of the newest message, shows both together.

import { BirdsEye, drawCamera } from "./viewer-draw.js";
import { prepareCameras } from "./viewer-geometry.js";
import { GroundPicture } from "./viewer-ground.js";

const STAGES = { decode: "#6ea8fe", detect: "#46d6b4", orient: "#b18cff", depth: "#f58fb6", lift: "#f5b84b", fuse: "#8fd14f", track: "#ff8a5c" };
const BUDGET_MS = 1000 / 30;
const SMOOTHING = 0.15;
const RATE_WINDOW_MS = 3000;
const SILENT_MS = 2500;
const RETRY_MS = [500, 4000];
const MAX_LATENCY_MS = 600000; // Beyond this the capture times are not of now (a replay), so a latency would say nothing.

const $ = (id) => document.getElementById(id);
const map = new BirdsEye($("map"));
const state = {
  site: null, cameras: [], tiles: new Map(), socket: null, retryMs: RETRY_MS[0],
  pending: null, busy: false, last: null, arrivals: [], smoothed: {},
};

function show(tone, text, notice = "") {
  $("state").className = `pill ${tone}`;
  $("state").textContent = text;
  $("notice").textContent = notice;
  $("notice").hidden = !notice;
}

async function getJson(path) {
  const response = await fetch(path, { cache: "no-store" }).catch(() => null);
  if (!response) throw new Error("The service does not answer.");
  if (!response.ok) throw new Error(`The service answered ${response.status} to /${path}.`);
  return response.json();
}

// ---- cameras ----

function makeTile(camera) {
  const tile = document.createElement("figure");
  tile.className = "camera";
  const canvas = document.createElement("canvas");
  const badge = document.createElement("figcaption");
  badge.className = "badge";
  const [dot, name, detail] = ["i", "b", "span"].map((kind) => badge.appendChild(document.createElement(kind)));
  name.textContent = camera.id;
  dot.setAttribute("role", "img");
  tile.append(canvas, badge);
  $("cameras").append(tile);
  return { tile, canvas, dot, detail, picture: null };
}

/** The number of columns that gives the largest frames, and their width. */
function layOut() {
  const count = state.cameras.length;
  if (!count) return;
  const aspect = Math.max(...state.cameras.map((c) => c.width / c.height));
  const narrow = window.innerWidth <= 900;
  const gap = 12;
  const main = document.querySelector("main");
  const width = narrow ? main.clientWidth - 2 * gap : main.clientWidth * 0.56;
  const height = main.clientHeight - 2 * gap;
  let best = { columns: 1, tile: 0 };
  for (let columns = 1; columns <= count; columns++) {
    const rows = Math.ceil(count / columns);
    const byWidth = (width - (columns - 1) * gap) / columns;
    const byHeight = narrow ? Infinity : ((height - (rows - 1) * gap) / rows) * aspect;
    const tile = Math.floor(Math.min(byWidth, byHeight));
    if (tile > best.tile) best = { columns, tile };
  }
  $("cameras").style.setProperty("--columns", best.columns);
  $("cameras").style.setProperty("--tile-width", `${best.tile}px`);
  for (const camera of state.cameras) {
    state.tiles.get(camera.id).tile.style.aspectRatio = `${camera.width} / ${camera.height}`;
  }
  redraw();
}

function redraw() {
  for (const camera of state.cameras) {
    const { canvas, picture } = state.tiles.get(camera.id);
    drawCamera(canvas, camera, picture, picture ? state.last?.boxes ?? [] : []);
  }
}

function describe({ status, detections, skew_ms: skew, message }) {
  if (status !== "ok") return message ? `${status}: ${message}` : status;
  const parts = [detections === 1 ? "1 vehicle" : `${detections ?? 0} vehicles`];
  if (skew != null && Math.abs(skew) >= 1) parts.push(`${skew > 0 ? "+" : "−"}${Math.abs(skew).toFixed(0)} ms`);
  return parts.join(" · ");
}

// ---- messages ----

async function fetchPicture(message, camera) {
  if (!["ok", "stale"].includes(message.cameras[camera.id]?.status)) return null;
  const path = `sites/${encodeURIComponent(message.site)}/frames/${encodeURIComponent(camera.id)}?sequence=${message.sequence}`;
  const response = await fetch(path, { cache: "no-store" });
  if (response.status === 404) return undefined; // Already replaced by newer frames.
  if (!response.ok) throw new Error(`${path}: ${response.status}`);
  return createImageBitmap(await response.blob());
}

async function present(message) {
  const pictures = await Promise.all(state.cameras.map((camera) => fetchPicture(message, camera)));
  if (message.site !== state.site || pictures.includes(undefined)) {
    pictures.forEach((picture) => picture?.close());
    return;
  }
  state.last = message;
  state.cameras.forEach((camera, i) => {
    const tile = state.tiles.get(camera.id);
    const status = message.cameras[camera.id] ?? { status: "missing" };
    tile.tile.className = `camera ${status.status}`;
    tile.dot.setAttribute("aria-label", status.status);
    tile.detail.textContent = describe(status);
    if (pictures[i]) {
      tile.picture?.close();
      tile.picture = pictures[i];
    }
    drawCamera(tile.canvas, camera, tile.picture, pictures[i] ? message.boxes : []);
  });
  map.ground.update(new Map(state.cameras.map((camera, i) => [camera.id, pictures[i]])));
  map.update(message);
  showFigures(message);
}

/** Newest wins: while one message's frames load, only the latest message waits. */
async function pump() {
  if (state.busy) return;
  state.busy = true;
  try {
    while (state.pending) {
      const message = state.pending;
      state.pending = null;
      const known = state.cameras.map((c) => c.id).sort().join();
      if (known !== Object.keys(message.cameras).sort().join()) useSite(await getJson(`sites/${encodeURIComponent(message.site)}`));
      await present(message);
    }
  } catch (error) {
    console.warn("a frame set could not be shown:", error.message);
  } finally {
    state.busy = false;
  }
}

function receive(message) {
  const now = performance.now();
  state.arrivals.push(now);
  while (now - state.arrivals[0] > RATE_WINDOW_MS) state.arrivals.shift();
  state.pending = message;
  state.retryMs = RETRY_MS[0];
  if (message.degraded) {
    const out = Object.entries(message.cameras).filter(([, c]) => c.status !== "ok");
    show("degraded", `degraded: ${out.map(([id, c]) => `${id} ${c.status}`).join(", ")}`);
  } else {
    show("live", "live");
  }
  pump();
}

function smooth(key, value) {
  const before = state.smoothed[key];
  return (state.smoothed[key] = before === undefined ? value : before + SMOOTHING * (value - before));
}

function showFigures(message) {
  const { arrivals } = state;
  const span = arrivals[arrivals.length - 1] - arrivals[0];
  const fps = span > 0 ? ((arrivals.length - 1) * 1000) / span : null;
  $("fps").textContent = fps === null ? "–" : fps.toFixed(1);
  const latency = Date.now() - Date.parse(message.captured_at);
  $("latency").textContent = latency >= 0 && latency < MAX_LATENCY_MS ? smooth("latency", latency).toFixed(0) : "–";
  $("total").textContent = smooth("total", message.timing_ms.total).toFixed(1);
  $("vehicles").textContent = message.boxes.length;
  $("sequence").textContent = `frame set ${message.sequence}`;
  document.title = `${fps === null ? "–" : fps.toFixed(0)} fps · ${message.site} · Quadlift`;
  showStages(message.timing_ms);
}

function makeStages() {
  for (const [stage, color] of Object.entries(STAGES)) {
    const bar = $("stack").appendChild(document.createElement("span"));
    const item = $("legend").appendChild(document.createElement("li"));
    item.append(document.createElement("i"), stage, document.createElement("b"));
    bar.title = stage;
    bar.style.background = item.firstChild.style.background = color;
    bar.dataset.stage = item.lastChild.dataset.stage = stage;
  }
  const item = $("legend").appendChild(document.createElement("li"));
  item.className = "budget";
  item.append(document.createElement("i"), `${BUDGET_MS.toFixed(0)} ms budget at 30 / s`);
}

function showStages(timing) {
  const values = Object.fromEntries(Object.keys(STAGES).map((stage) => [stage, smooth(`stage ${stage}`, timing[stage] ?? 0)]));
  const sum = Object.values(values).reduce((a, b) => a + b, 0);
  const full = Math.max(BUDGET_MS * 1.08, sum * 1.08);
  $("stack").style.setProperty("--budget", `${(100 * BUDGET_MS) / full}%`);
  for (const bar of $("stack").children) bar.style.width = `${(100 * values[bar.dataset.stage]) / full}%`;
  for (const figure of $("legend").querySelectorAll("b")) figure.textContent = `${values[figure.dataset.stage].toFixed(1)} ms`;
}

// ---- site and connection ----

function useSite(site) {
  $("cameras").replaceChildren();
  state.tiles.forEach((tile) => tile.picture?.close());
  Object.assign(state, { site: site.id, cameras: prepareCameras(site), last: null });
  state.tiles = new Map(state.cameras.map((camera) => [camera.id, makeTile(camera)]));
  layOut();
  map.setSite(state.cameras, new GroundPicture(site, state.cameras));
}

/** The site of the address bar, else the first; null while there is none. */
async function chooseSite() {
  const sites = await getJson("sites");
  if (!sites.length) return null;
  const ids = sites.map((site) => site.id);
  $("site").replaceChildren(...ids.map((id) => new Option(id, id)));
  const asked = new URLSearchParams(location.search).get("site") ?? ids[0];
  $("site").value = asked;
  if (!ids.includes(asked)) throw new Error(`This service has no site '${asked}', but: ${ids.join(", ")}.`);
  return sites[ids.indexOf(asked)];
}

function retry(tone, text, notice) {
  show(tone, text, notice);
  setTimeout(connect, state.retryMs);
  state.retryMs = Math.min(2 * state.retryMs, RETRY_MS[1]);
}

async function connect() {
  let site;
  try {
    site = await chooseSite();
  } catch (error) {
    return retry("lost", "not connected", `${error.message} Trying again…`);
  }
  if (!site) return retry("waiting", "no site", "No site yet. PUT one to /sites/{id}; this page finds it by itself.");
  useSite(site);
  show("waiting", "waiting for frames", "Connected. Waiting for the first frame set…");
  const url = new URL(`stream/${encodeURIComponent(site.id)}`, location.href);
  url.protocol = url.protocol.replace("http", "ws");
  url.search = "";
  const socket = (state.socket = new WebSocket(url));
  Object.assign(state, { arrivals: [], smoothed: {} });
  socket.onmessage = ({ data }) => receive(JSON.parse(data));
  socket.onclose = () => { if (socket === state.socket) retry("lost", "reconnecting", "The connection was lost. Trying again…"); };
}

setInterval(() => {
  const { arrivals, socket } = state;
  if (socket?.readyState !== WebSocket.OPEN || !arrivals.length) return;
  const silent = performance.now() - arrivals[arrivals.length - 1];
  if (silent > SILENT_MS) {
    show("waiting", `no frames for ${(silent / 1000).toFixed(0)} s`);
    $("fps").textContent = "0.0";
  }
}, 500);

$("site").addEventListener("change", () => {
  location.search = new URLSearchParams({ site: $("site").value });
});
window.addEventListener("resize", layOut);
makeStages();
connect();
