// Tiles of a city: asked for when they are in sight, kept while there is room, painted in layers.

import { tidy } from "./base.js";

const MOST = 240, AT_ONCE = 6, HANDFUL = 400;
const THIN = { motorway: 2.4, "main-road": 1.7, river: 1.4, rail: 0.8, shore: 0.8, street: 0.9 };

/** One tile: its shapes become paths and names when they are first needed. */
class Tile {
  constructor(data, level, x, y, index) {
    this.side = index.side * 2 ** level;
    this.unit = index.unit * 2 ** level;
    [this.west, this.south] = [x * this.side, y * this.side];
    this.data = data;
    this.paints = index.paints;
  }

  /** Points of a part [m]. */
  points(part) {
    const out = new Float64Array(part.length);
    let x = 0, y = 0;
    for (let i = 0; i < part.length; i += 2) {
      out[i] = this.west + (x += part[i]) * this.unit;
      out[i + 1] = this.south + (y += part[i + 1]) * this.unit;
    }
    return out;
  }

  /** A layer as paths in units: simple shapes by the handful, and each shape with holes. */
  paths(layer) {
    const paint = this.paints[layer.paint];
    if (!layer.all) {
      layer.all = [];
      layer.holed = [];
      layer.shapes.forEach((parts, i) => {
        if (i % HANDFUL === 0) layer.all.push(new Path2D());
        const path = parts.length > 1 && paint.form === "area" ? new Path2D() : layer.all.at(-1);
        for (const part of parts) trace(path, part, paint.form);
        if (path !== layer.all.at(-1)) layer.holed.push(path);
      });
    }
    return { name: layer.paint, paint, all: layer.all, holed: layer.holed };
  }

  /** What may be lettered: rank, length, name, geometry [m]. */
  named() {
    if (this.names) return this.names;
    this.names = [];
    for (const layer of this.data.layers) {
      const paint = this.paints[layer.paint];
      if (paint.rank > 8) continue;
      layer.name.forEach((row, i) => {
        const name = row >= 0 ? tidy(this.data.names[row]).slice(0, 60) : "";
        if (name) this.names.push({ paint, name, osm: layer.osm[i], tile: this, shape: layer.shapes[i] });
      });
    }
    return this.names;
  }

  /** Pieces of an object in this tile. */
  pieces(osm) {
    if (!this.rows) {
      this.rows = new Map();
      this.data.layers.forEach((layer, k) => layer.osm.forEach((id, i) => {
        if (id) this.rows.set(id, [...(this.rows.get(id) ?? []), [k, i]]);
      }));
    }
    return (this.rows.get(osm) ?? []).map(([k, i]) => this.shape(k, i));
  }

  shape(k, i) {
    const layer = this.data.layers[k], paint = this.paints[layer.paint];
    const text = (table, row) => (row >= 0 ? tidy(table[row]) : "");
    return {
      tile: this, paint, form: paint.form === "area" || paint.form === "line" ? paint.form : "point",
      osm: layer.osm[i], name: text(this.data.names, layer.name[i]),
      label: text(this.data.labels, layer.label[i]),
      parts: layer.shapes[i].map((part) => this.points(part)),
    };
  }

  /** The uppermost shape at a place [m], within a reach [m], of these paints; null where there is none. */
  at(x, y, reach, scale, ctx, paints = null) {
    const u = (x - this.west) / this.unit, v = (y - this.south) / this.unit, r = reach / this.unit;
    for (let k = this.data.layers.length - 1; k >= 0; k--) {
      const layer = this.data.layers[k], paint = this.paints[layer.paint];
      if (paint.since > scale || (paints && !paints.includes(layer.paint))) continue;
      for (let i = layer.shapes.length - 1; i >= 0; i--) {
        if (layer.osm[i] && hits(layer.shapes[i], paint, u, v, r, this.unit, ctx)) return this.shape(k, i);
      }
    }
    return null;
  }
}

function trace(path, part, form) {
  let x = part[0], y = part[1];
  path.moveTo(x, y);
  if (part.length === 2) path.lineTo(x + 0.01, y);
  if (form === "area" && turned(part) < 0) { // counter-clockwise all, so that none cuts another
    const corners = [];
    for (let i = 2; i < part.length; i += 2) corners.push([x += part[i], y += part[i + 1]]);
    for (let i = corners.length - 2; i >= 0; i--) path.lineTo(...corners[i]);
  } else {
    const last = form === "area" ? part.length - 2 : part.length;
    for (let i = 2; i < last; i += 2) path.lineTo(x += part[i], y += part[i + 1]);
  }
  if (form === "area") path.closePath();
}

function turned(part) {
  let x = 0, y = 0, twice = 0;
  for (let i = 2; i < part.length; i += 2) {
    twice += x * part[i + 1] - y * part[i];
    x += part[i]; y += part[i + 1];
  }
  return twice;
}

function hits(parts, paint, u, v, r, unit, ctx) {
  const wide = r + (paint.form === "line" ? paint.width / unit / 2 : 0);
  let low = Infinity, left = Infinity, high = -Infinity, right = -Infinity;
  for (const part of parts) {
    let x = 0, y = 0;
    for (let i = 0; i < part.length; i += 2) {
      x += part[i]; y += part[i + 1];
      left = Math.min(left, x); right = Math.max(right, x);
      low = Math.min(low, y); high = Math.max(high, y);
    }
  }
  if (u < left - wide || u > right + wide || v < low - wide || v > high + wide) return false;
  if (paint.form !== "area" && paint.form !== "line") return true;
  const path = new Path2D();
  for (const part of parts) trace(path, part, paint.form);
  if (paint.form === "area") return ctx.isPointInPath(path, u, v, "evenodd");
  ctx.lineWidth = 2 * wide;
  return ctx.isPointInStroke(path, u, v);
}

/** The tiles of a city. `load(level, x, y)` promises a tile's data. */
export class Tiles {
  constructor(index, load, changed) {
    this.index = index;
    this.load = load;
    this.changed = changed;
    this.known = new Map(); // oldest first; null while it is on its way
    this.waiting = [];
    this.busy = 0;
    this.probe = document.createElement("canvas").getContext("2d");
  }

  level(scale) {
    return Math.min(this.index.top, Math.max(0, Math.ceil(Math.log2(this.index.finest / scale))));
  }

  /** Tiles that a rectangle [m] needs, each as it is known or a coarser one; asks for the rest. */
  within([west, south, east, north], scale) {
    const level = this.level(scale), side = this.index.side * 2 ** level, found = [];
    const [w, s, e, n] = this.index.bounds, wanted = [];
    const column = [Math.max(west, w), Math.min(east, e)].map((value) => Math.floor(value / side));
    const row = [Math.max(south, s), Math.min(north, n)].map((value) => Math.floor(value / side));
    for (let y = row[0]; y <= row[1]; y++) {
      for (let x = column[0]; x <= column[1]; x++) {
        wanted.push([level, x, y]);
        const rect = [x * side, y * side, side];
        const tile = this.best(level, x, y);
        if (tile) found.push({ tile, rect });
      }
    }
    this.want(wanted, (west + east) / 2 / side, (south + north) / 2 / side);
    return found;
  }

  best(level, x, y) {
    for (let up = 0; level + up <= this.index.top; up++) {
      const key = `${level + up}/${x >> up}/${y >> up}`, tile = this.known.get(key);
      if (tile) {
        this.known.delete(key);
        this.known.set(key, tile); // the youngest
        return tile;
      }
    }
    return null;
  }

  want(wanted, column, row) {
    this.waiting = wanted
      .filter(([l, x, y]) => !this.known.has(`${l}/${x}/${y}`))
      .sort(([, a, b], [, c, d]) =>
        Math.hypot(a + 0.5 - column, b + 0.5 - row) - Math.hypot(c + 0.5 - column, d + 0.5 - row));
    this.next();
  }

  next() {
    while (this.busy < AT_ONCE && this.waiting.length) this.fetch(...this.waiting.shift());
  }

  async fetch(level, x, y) {
    const key = `${level}/${x}/${y}`;
    this.busy += 1;
    this.known.set(key, null);
    try {
      const data = await this.load(level, x, y);
      this.known.set(key, data ? new Tile(data, level, x, y, this.index) : null);
      if (data) this.changed();
    } catch {
      setTimeout(() => { this.known.delete(key); this.changed(); }, 3000); // ask again later
    }
    for (const old of this.known.keys()) {
      if (this.known.size <= MOST) break;
      if (this.known.get(old)) this.known.delete(old);
    }
    this.busy -= 1;
    this.next();
  }
}

/** Paint a tile where it stands, layer by layer; yields after each, so that nobody has to wait. */
export function* painted(ctx, { tile, rect: [west, south, side] }, frame, colour, index) {
  const { x0, y0, scale, ratio } = frame; // device pixels of the plane's origin, px/m, px per CSS px
  const k = scale * ratio, unit = k * tile.unit;
  const left = Math.round(x0 + west * k), top = Math.round(y0 - (south + side) * k);
  const right = Math.round(x0 + (west + side) * k), bottom = Math.round(y0 - south * k);
  const layers = tile.data.layers.filter((layer) => index.paints[layer.paint].since <= scale);
  const enter = () => {
    ctx.save();
    ctx.beginPath();
    ctx.rect(left, top, right - left, bottom - top);
    ctx.clip();
    ctx.setTransform(unit, 0, 0, -unit, x0 + tile.west * k, y0 - tile.south * k);
    ctx.lineJoin = "round";
  };
  const px = ratio / unit; // a CSS pixel, in units
  let cased = layers.filter((layer) => index.cased.includes(layer.paint));
  for (const layer of layers) {
    enter();
    if (index.cased.includes(layer.paint) && cased.length) {
      for (const road of cased) casing(ctx, tile.paths(road), tile, px, colour, index);
      cased = [];
    }
    const { paint, name, holed, all } = tile.paths(layer);
    for (const path of [...all, ...holed]) {
      paintPath(ctx, path, holed.includes(path), name, paint, tile, px, colour);
      ctx.getImageData(0, 0, 1, 1); // painted now, not all at once when the picture is shown
      yield;
    }
    ctx.restore();
  }
}

function casing(ctx, { name, paint, all }, tile, px, colour, index) {
  const width = Math.max(paint.width / tile.unit, (THIN[name] ?? 0) * px);
  if (width < 1.6 * px) return;
  ctx.lineCap = "round";
  ctx.strokeStyle = colour(paint.edge);
  ctx.lineWidth = width + Math.max(index.casing / tile.unit, px);
  for (const path of all) ctx.stroke(path);
}

function paintPath(ctx, path, holed, name, paint, tile, px, colour) {
  const fill = colour(paint.fill);
  if (paint.form === "area") {
    ctx.fillStyle = fill;
    ctx.fill(path, holed ? "evenodd" : "nonzero");
    if (!paint.edge) return;
    ctx.strokeStyle = colour(paint.edge);
    ctx.lineWidth = px;
    ctx.stroke(path);
    return;
  }
  const symbol = paint.form !== "line" && paint.form !== "crown";
  ctx.lineCap = paint.form === "square" ? "square" : paint.dash ? "butt" : "round";
  if (symbol) {
    const width = paint.width * (paint.form === "square" ? 0.8 : 1) * px;
    if (paint.edge) {
      ctx.strokeStyle = colour(paint.edge);
      ctx.lineWidth = width + 2.5 * px;
      ctx.stroke(path);
    }
    ctx.lineWidth = width;
  } else {
    ctx.lineWidth = Math.max(paint.width / tile.unit, (THIN[name] ?? 0.4) * px);
    ctx.setLineDash((paint.dash ?? []).map((length) => length / tile.unit));
  }
  ctx.strokeStyle = fill;
  ctx.stroke(path);
  ctx.setLineDash([]);
}
