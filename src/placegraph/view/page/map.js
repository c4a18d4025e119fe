// The map: a view of the plane, drawn from tiles into a picture that moves with the hand, and drawn
// anew beside it, a few milliseconds a frame, so that nothing ever waits for it.

import { calm, clamp, colours } from "./base.js";
import { covering, lettered, Taken, write } from "./letters.js";
import { gestures } from "./gestures.js";
import { painted, Tiles } from "./tiles.js";

const PAD = 0.25, SLICE = 7, NARROW = 600, BUILDINGS = ["building", "landmark"];

export class MapView {
  /** `canvas` fills its parent; `on` has `view()`, `hover(shape, event)`, `tap(point, shape, event)`. */
  constructor(canvas, on = {}) {
    Object.assign(this, { canvas, on, ctx: canvas.getContext("2d") });
    this.view = { x: 0, y: 0, scale: 1 };
    this.largest = 12; // scale [px/m]
    this.byHand = false; // whether somebody moved it
    this.under = []; // painters below the names, and above: (ctx, map) => void
    this.over = [];
    this.names = [];
    this.tiles = null;
    this.front = null; // the last whole picture: canvas, x, y, scale, width, height
    this.job = null;
    this.stale = true;
    this.colour = colours();
    this.moves = gestures(this);
    new ResizeObserver(() => this.resize()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.recolour());
    this.resize();
  }

  get size() { return [this.width, this.height]; }

  resize() {
    this.width = Math.max(1, this.canvas.clientWidth);
    this.height = Math.max(1, this.canvas.clientHeight);
    this.ratio = Math.min(2, devicePixelRatio || 1);
    this.canvas.width = Math.round(this.width * this.ratio);
    this.canvas.height = Math.round(this.height * this.ratio);
    if (this.waiting) this.fit();
    this.draw();
  }

  recolour() {
    this.colour = colours();
    this.front = null;
    this.redo();
  }

  /** Show a city: what `CityTiles.index` says, and a function that gets its tiles; null: it has none. */
  show(index, load) {
    this.index = index;
    this.tiles = load && new Tiles(index, load, () => this.redo());
    this.job = this.front = null;
    this.names = [];
    this.used = [];
    this.fit();
    this.tiles?.want(this.topmost(), 0, 0);
  }

  topmost() {
    const { bounds, top, side } = this.index, wide = side * 2 ** top, found = [];
    for (let y = Math.floor(bounds[1] / wide); y <= Math.floor(bounds[3] / wide); y++) {
      for (let x = Math.floor(bounds[0] / wide); x <= Math.floor(bounds[2] / wide); x++) found.push([top, x, y]);
    }
    return found;
  }

  /** The tiles have changed, or what lies among the names: make the picture anew. */
  redo() { this.stale = true; this.draw(); }

  px = (x, y) => [
    (x - this.view.x) * this.view.scale + this.width / 2,
    (this.view.y - y) * this.view.scale + this.height / 2,
  ];

  plane = (px, py) => [
    this.view.x + (px - this.width / 2) / this.view.scale,
    this.view.y - (py - this.height / 2) / this.view.scale,
  ];

  /** West, south, east, north [m] of what is shown, and so much more [share of it]. */
  bounds(more = 0) {
    const w = (this.width / this.view.scale) * (0.5 + more), h = (this.height / this.view.scale) * (0.5 + more);
    const { x, y } = this.view;
    return [x - w, y - h, x + w, y + h];
  }

  smallest() {
    if (!this.index) return 0.01;
    const [w, s, e, n] = this.index.bounds;
    const all = 0.75 * Math.min(this.width / (e - w), this.height / (n - s));
    return this.tiles ? Math.min(1, all) : all;
  }

  limited({ x, y, scale }) {
    scale = clamp(scale, this.smallest(), this.largest);
    if (!this.index) return { x, y, scale };
    const [w, s, e, n] = this.index.bounds;
    return { x: clamp(x, w, e), y: clamp(y, s, n), scale };
  }

  move(to) { this.view = this.limited({ ...this.view, ...to }); this.draw(); }

  /** The view that shows a rectangle [m], beside what stands on the map. */
  fitting([w, s, e, n], largest = 2.4) {
    const tools = this.width < NARROW ? 46 : 0, legend = tools ? 18 : 44, height = Math.max(80, this.height - tools - legend);
    const scale = Math.min(this.width / Math.max(e - w, 1), height / Math.max(n - s, 1), largest);
    return this.limited({ x: (w + e) / 2, y: (s + n) / 2 + (0.5 * (tools - legend)) / scale, scale });
  }

  /** The view that shows all there is. */
  whole() { return this.fitting(this.index.bounds, this.tiles ? undefined : this.largest); }

  fit() {
    this.waiting = this.width <= 1; // until there is a canvas to fit it to
    this.stop();
    this.view = this.whole();
    this.redo();
  }

  stop() { this.flight = null; }

  fly(to) {
    if (calm()) { this.stop(); this.move(to); return; }
    this.flight = { from: { ...this.view }, to: this.limited({ ...this.view, ...to }), start: performance.now() };
    this.draw();
  }

  step(now) {
    const { from, to, start } = this.flight, t = clamp((now - start) / 550, 0, 1), s = t * t * (3 - 2 * t);
    const far = Math.hypot(to.x - from.x, to.y - from.y) * Math.min(from.scale, to.scale) / this.width;
    const arc = clamp(far - 0.5, 0, 6);
    this.view = {
      x: from.x + (to.x - from.x) * s, y: from.y + (to.y - from.y) * s,
      scale: (from.scale * (to.scale / from.scale) ** s) / (1 + arc * Math.sin(Math.PI * t)),
    };
    if (t >= 1) this.stop();
  }

  draw() {
    if (!this.asked) this.asked = requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.asked = 0;
    if (this.flight) this.step(now);
    const key = `${this.view.x}/${this.view.y}/${this.view.scale}`;
    if (key !== this.key) { this.key = key; this.moved = now; this.on.view?.(); }
    this.work(now);
    const { ctx, ratio } = this;
    ctx.setTransform(1, 0, 0, 1, 0, 0);
    ctx.fillStyle = this.colour("land");
    ctx.fillRect(0, 0, this.canvas.width, this.canvas.height);
    if (this.front) this.paste(this.front);
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    for (const paint of this.under) paint(ctx, this);
    this.lettering(ctx, this.names);
    for (const paint of this.over) paint(ctx, this);
    if (this.job || this.flight || this.wants(now)) this.draw();
    else this.on.still?.();
  }

  paste({ canvas, x, y, scale, width, height }) {
    const k = this.view.scale / scale, { ctx, ratio } = this;
    let left = ((x - this.view.x) * this.view.scale + this.width / 2 - (width * k) / 2) * ratio;
    let top = ((this.view.y - y) * this.view.scale + this.height / 2 - (height * k) / 2) * ratio;
    if (k === 1) { left = Math.round(left); top = Math.round(top); }
    ctx.imageSmoothingEnabled = k !== 1;
    ctx.drawImage(canvas, left, top, width * k * ratio, height * k * ratio);
  }

  /** Whether the picture is not what is shown: made of other tiles, at another scale, or too small. */
  wants(now) {
    if (!this.tiles) return false;
    const { front, view } = this;
    if (this.stale || !front) return true;
    const k = view.scale / front.scale;
    const still = now - this.moved > 90;
    if (k !== 1 && (still || k > 1.5 || k < 0.7)) return true;
    const spareX = front.width * k - this.width, spareY = front.height * k - this.height;
    const dx = Math.abs(view.x - front.x) * view.scale, dy = Math.abs(view.y - front.y) * view.scale;
    if (dx > spareX / 2 || dy > spareY / 2) return true;
    if (still && k === 1 && (dx > spareX / 4 || dy > spareY / 4)) return true;
    return k !== 1; // not yet, but soon
  }

  work(now) {
    if (!this.job) {
      const { front, view } = this;
      const soon = front && !this.stale && view.scale !== front.scale && now - this.moved <= 90
        && view.scale / front.scale < 1.5 && view.scale / front.scale > 0.7;
      if (!this.wants(now) || soon) return;
      this.stale = false;
      this.job = this.make();
    }
    const end = performance.now() + SLICE;
    while (performance.now() < end) {
      const { done, value } = this.job.next();
      if (!done) continue;
      this.job = null;
      this.spare = this.front?.canvas;
      this.front = value.front;
      this.names = value.names;
      this.on.made?.();
      return;
    }
  }

  *make() {
    const { view, ratio } = this;
    const width = Math.ceil(this.width * (1 + 2 * PAD)), height = Math.ceil(this.height * (1 + 2 * PAD));
    const canvas = this.spare ?? document.createElement("canvas");
    this.spare = null;
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const ctx = canvas.getContext("2d", { alpha: false, willReadFrequently: true });
    ctx.fillStyle = this.colour("land");
    ctx.fillRect(0, 0, canvas.width, canvas.height);
    const k = view.scale * ratio, frame = { scale: view.scale, ratio, x0: canvas.width / 2 - view.x * k, y0: canvas.height / 2 + view.y * k };
    const bounds = this.bounds(PAD), tiles = this.tiles.within(bounds, view.scale);
    for (const tile of tiles) yield* painted(ctx, tile, frame, this.colour, this.index);
    const taken = new Taken();
    for (const text of this.reserved?.(view.scale) ?? []) taken.claim(text.discs ?? covering(text, view.scale), true);
    const names = yield* lettered(tiles, bounds, view.scale, taken, this.lettered?.() ?? new Set());
    this.used = tiles.map(({ tile }) => tile);
    return { front: { canvas, x: view.x, y: view.y, scale: view.scale, width: canvas.width / ratio, height: canvas.height / ratio }, names };
  }

  lettering(ctx, texts) { write(ctx, texts, this.px, this.colour, this.size); }

  /** What lies at a place of the canvas [px]; null where nothing is known of it. */
  shapeAt(px, py) {
    const [x, y] = this.plane(px, py), { scale } = this.view, above = this.above?.(x, y);
    if (above !== undefined || !this.tiles) return above ?? null;
    const side = this.index.side * 2 ** this.tiles.level(scale);
    const tile = this.tiles.best(this.tiles.level(scale), Math.floor(x / side), Math.floor(y / side));
    return tile?.at(x, y, 7 / scale, scale, this.tiles.probe) ?? null;
  }

  /** Pieces of an object in the tiles that are shown, and of what lies upon them. */
  pieces(osm) {
    return [...new Set(this.used ?? [])].flatMap((tile) => tile.pieces(osm)).concat(this.more?.(osm) ?? []);
  }

  /** Pieces of the building at a point [m], in the tiles that are shown. */
  buildingAt(x, y) {
    for (const tile of this.used ?? []) {
      const found = tile.at(x, y, 0, Infinity, this.tiles.probe, BUILDINGS);
      if (found) return this.pieces(found.osm);
    }
    return [];
  }
}
