// Lettering: which names stand on the map and where, none on top of another (view/draw/lettering.py).

const SIZES = { 2: 13, 3: 12, 4: 12 };
const NAMED_SINCE = { 3: 0.16, 5: 0.8, 6: 1.0, 7: 1.0, 8: 1.5 };
const STRAIGHT = 0.97, REPEAT = 420, SQUARE = 32;
export const FACE = 'system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif';

const widths = new Map();
const ruler = document.createElement("canvas").getContext("2d");

export function widthOf(text, size) {
  const key = `${size}${text}`;
  if (!widths.has(key)) {
    if (widths.size > 20000) widths.clear();
    ruler.font = `${size}px ${FACE}`;
    widths.set(key, ruler.measureText(text).width);
  }
  return widths.get(key);
}

/** Where something stands already: discs [px]. */
export class Taken {
  constructor() { this.discs = new Map(); }

  claim(discs, force = false) {
    if (!force && discs.some((disc) => this.hit(disc))) return false;
    for (const disc of discs) {
      const key = square(disc[0], disc[1], 0, 0);
      if (!this.discs.has(key)) this.discs.set(key, []);
      this.discs.get(key).push(disc);
    }
    return true;
  }

  hit([x, y, r]) {
    for (let i = -1; i <= 1; i++) {
      for (let j = -1; j <= 1; j++) {
        for (const [a, b, q] of this.discs.get(square(x, y, i, j)) ?? []) {
          if ((x - a) ** 2 + (y - b) ** 2 < (r + q) ** 2) return true;
        }
      }
    }
    return false;
  }
}

const square = (x, y, i, j) => (Math.floor(x / SQUARE) + i) * 65536 + Math.floor(y / SQUARE) + j;

/** Discs that cover a text; x grows to the right, y downwards [px]. */
export function covering(text, scale) {
  const x = text.x * scale + text.dx, y = -text.y * scale + text.dy;
  const width = (text.bold ? 1.1 : 1) * widthOf(text.text, text.size) + 4, n = Math.max(1, Math.ceil(width / text.size));
  const start = { left: 0, center: -0.5, right: -1 }[text.anchor], discs = [];
  for (let i = 0; i < n; i++) {
    const along = (start + (i + 0.5) / n) * width;
    discs.push([x + along * Math.cos(text.angle), y - along * Math.sin(text.angle), 0.62 * text.size]);
  }
  return discs;
}

/** Names for the tiles of a map at a scale [px/m], around what is taken; yields now and then. */
export function* lettered(tiles, [west, south, east, north], scale, taken, skip) {
  const wanted = [], seen = new Map();
  let steps = 0;
  for (const { tile, rect } of tiles) {
    for (const item of tile.named()) {
      if (++steps % 200 === 0) yield;
      const { paint } = item;
      if (skip.has(item.osm) || paint.since > scale || (NAMED_SINCE[paint.rank] ?? 0) > scale) continue;
      item.size ??= SIZES[paint.rank] ?? 11;
      measure(item);
      const [w, s, e, n] = item.box;
      if (w > east || e < west || s > north || n < south) continue;
      if (paint.form !== "line") {
        if (paint.form !== "area" && !within(item.box, rect)) continue; // its own tile letters it
        const before = seen.get(item.osm);
        if (before && before.extent >= item.extent) continue;
        seen.set(item.osm, item);
        if (paint.form !== "area" && paint.form !== "square") { // stops give way
          taken.claim([[w * scale, -s * scale, 4]], true);
        }
      }
      wanted.push(item);
    }
  }
  wanted.sort((a, b) => a.paint.rank - b.paint.rank || b.extent - a.extent || (a.name < b.name ? -1 : 1));
  const placed = [], streets = new Map();
  for (const item of wanted) {
    if (++steps % 40 === 0) yield;
    if (item.paint.form !== "line" && seen.get(item.osm) !== item) continue;
    const width = widthOf(item.name, item.size), line = item.paint.form === "line";
    if (line && item.extent * scale < width) continue;
    const others = streets.get(item.name) ?? [];
    for (const place of spots(item, width, scale)) {
      const text = { text: item.name, size: item.size, ink: item.paint.ink, angle: 0, anchor: "center",
        dx: 0, dy: 0, osm: item.osm, ...place };
      if (line && others.some((o) => Math.hypot(o.x - text.x, o.y - text.y) * scale < REPEAT)) continue;
      if (!taken.claim(covering(text, scale))) continue;
      placed.push(text);
      if (!line) break;
      others.push(text);
      streets.set(item.name, others);
    }
  }
  return placed;
}

const within = ([x, y], [west, south, side]) =>
  x >= west && x < west + side && y >= south && y < south + side;

function measure(item) {
  if (item.box) return;
  item.parts = item.shape.map((part) => item.tile.points(part));
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  item.extent = 0;
  for (const part of item.paint.form === "area" ? item.parts.slice(0, 1) : item.parts) {
    for (let i = 0; i < part.length; i += 2) {
      box[0] = Math.min(box[0], part[i]); box[2] = Math.max(box[2], part[i]);
      box[1] = Math.min(box[1], part[i + 1]); box[3] = Math.max(box[3], part[i + 1]);
      if (i && item.paint.form === "line") {
        item.extent += Math.hypot(part[i] - part[i - 2], part[i + 1] - part[i - 1]);
      }
    }
  }
  item.box = box;
  if (item.paint.form === "area") item.extent = box[2] - box[0] + box[3] - box[1];
}

function* spots({ paint, size, box, parts }, width, scale) {
  const [w, s, e, n] = box;
  if (paint.form === "area") {
    const x = (w + e) / 2, y = (s + n) / 2;
    if (width > 1.1 * (e - w) * scale || size > 0.8 * (n - s) * scale) return;
    yield { x, y };
    yield { x, y, dy: 1.6 * size };
  } else if (paint.form === "line") {
    for (const part of parts) yield* stretches(part, (width + 8) / scale);
  } else {
    const beside = paint.width / 2 + 4;
    yield { x: w, y: s, anchor: "left", dx: beside };
    yield { x: w, y: s, anchor: "right", dx: -beside };
    yield { x: w, y: s, dy: -beside - size / 2 };
    yield { x: w, y: s, dy: beside + size / 2 };
  }
}

/** Middles and angles of the stretches of a line that are straight enough to carry a name. */
function* stretches(line, length) {
  const along = [0];
  for (let i = 2; i < line.length; i += 2) {
    along.push(along.at(-1) + Math.hypot(line[i] - line[i - 2], line[i + 1] - line[i - 1]));
  }
  const slack = along.at(-1) - length;
  if (slack < 0) return;
  const count = 1 + Math.floor((slack / length) * 4);
  const starts = Array.from({ length: count }, (_, i) => (count > 1 ? (slack * i) / (count - 1) : slack / 2));
  starts.sort((a, b) => Math.abs(a - slack / 2) - Math.abs(b - slack / 2));
  for (const start of starts) {
    const [[ax, ay], [bx, by], [cx, cy]] = [0, 0.5, 1].map((t) => point(line, along, start + t * length));
    const chord = Math.hypot(cx - ax, cy - ay), sag = Math.hypot(bx - (ax + cx) / 2, by - (ay + cy) / 2);
    if (chord < STRAIGHT * length || sag > 0.06 * length) continue;
    let angle = Math.atan2(cy - ay, cx - ax);
    if (angle > Math.PI / 2) angle -= Math.PI;
    if (angle <= -Math.PI / 2) angle += Math.PI;
    yield { x: bx, y: by, angle };
  }
}

function point(line, along, at) {
  let i = 1;
  while (i < along.length - 1 && along[i] < at) i += 1;
  const t = (at - along[i - 1]) / Math.max(along[i] - along[i - 1], 1e-9);
  return [0, 1].map((k) => line[2 * i - 2 + k] + t * (line[2 * i + k] - line[2 * i - 2 + k]));
}

/** Write texts with a halo; `at` turns metres into pixels. */
export function write(ctx, texts, at, colour, [width, height]) {
  ctx.textBaseline = "middle";
  ctx.lineJoin = "round";
  ctx.strokeStyle = colour("land");
  for (const text of texts) {
    let [x, y] = at(text.x, text.y);
    if (x < -200 || y < -200 || x > width + 200 || y > height + 200) continue;
    x += text.dx; y += text.dy + 0.5;
    ctx.font = `${text.bold ? "600 " : ""}${text.size}px ${FACE}`;
    ctx.textAlign = text.anchor;
    ctx.fillStyle = colour(text.ink);
    ctx.lineWidth = 3.2;
    if (text.angle) {
      ctx.save();
      ctx.translate(x, y);
      ctx.rotate(-text.angle);
      x = 0; y = 0;
    }
    ctx.strokeText(text.text, x, y);
    ctx.fillText(text.text, x, y);
    if (text.angle) ctx.restore();
  }
}
