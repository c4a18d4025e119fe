// What an estimate says, on the map: the posterior as heat, modes with their ellipses, evidence.

import { clamp, commonName, tidy } from "./base.js";
import { covering, Taken } from "./letters.js";

const BANDWIDTH = 9, FAINT = 0.1, SIGMAS = 2, SHOWN = 120, NEAREST = 10, FINEST = 0.0025;
const STOPS = [[0.02, 255, 205, 90, 0], [0.12, 255, 190, 80, 70], [0.4, 246, 138, 52, 125],
  [0.7, 224, 74, 50, 150], [1, 176, 30, 50, 165]];
const RAMP = Array.from({ length: 256 }, (_, i) => {
  const level = (i / 255) ** 0.7; // weak places show, too
  const k = clamp(STOPS.findIndex(([stop]) => level <= stop), 1, 4), [a, b] = [STOPS[k - 1], STOPS[k]];
  const t = clamp((level - a[0]) / (b[0] - a[0]), 0, 1);
  return [1, 2, 3, 4].map((c) => Math.round(a[c] + t * (b[c] - a[c])));
});

/** The posterior: points (east, north [m], probability) as a picture around the view. */
export class Heat {
  constructor() { this.points = []; this.picture = null; this.shown = true; }

  set(points) { this.points = points; this.picture = null; }

  paint(ctx, map) {
    const alpha = clamp((NEAREST - map.view.scale) / 4, 0, 1); // it tells nothing inside a building
    if (!this.shown || !this.points.length || !alpha) return;
    const p = this.picture, { view } = map;
    const [w, s, e, n] = map.bounds();
    if (!p || view.scale / p.scale > 1.25 || view.scale / p.scale < 0.8
      || w < p.bounds[0] || s < p.bounds[1] || e > p.bounds[2] || n > p.bounds[3]) this.make(map);
    const { canvas, bounds } = this.picture, [left, top] = map.px(bounds[0], bounds[3]);
    ctx.imageSmoothingEnabled = true;
    ctx.globalAlpha = alpha;
    ctx.drawImage(canvas, left, top, (bounds[2] - bounds[0]) * view.scale, (bounds[3] - bounds[1]) * view.scale);
    ctx.globalAlpha = 1;
  }

  make(map) {
    const { scale } = map.view, bounds = map.bounds(0.35);
    const sigma = Math.max(BANDWIDTH, 6 / scale), cell = Math.max(3 / scale, sigma / 4);
    const columns = Math.ceil((bounds[2] - bounds[0]) / cell), rows = Math.ceil((bounds[3] - bounds[1]) / cell);
    bounds[2] = bounds[0] + columns * cell;
    bounds[1] = bounds[3] - rows * cell;
    const density = new Float32Array(columns * rows), reach = Math.ceil((3.2 * sigma) / cell);
    for (const [x, y, weight] of this.points) {
      const u = (x - bounds[0]) / cell - 0.5, v = (bounds[3] - y) / cell - 0.5;
      const i0 = Math.max(0, Math.ceil(u - reach)), i1 = Math.min(columns - 1, Math.floor(u + reach));
      const j0 = Math.max(0, Math.ceil(v - reach)), j1 = Math.min(rows - 1, Math.floor(v + reach));
      const k = -0.5 * (cell / sigma) ** 2;
      for (let j = j0; j <= j1; j++) {
        const across = weight * Math.exp(k * (j - v) ** 2);
        for (let i = i0; i <= i1; i++) density[j * columns + i] += across * Math.exp(k * (i - u) ** 2);
      }
    }
    const peak = Math.max(FAINT, this.peak(sigma)), image = new ImageData(columns, rows);
    for (let i = 0; i < density.length; i++) {
      if (density[i] > 0) image.data.set(RAMP[Math.min(255, Math.round((255 * density[i]) / peak))], 4 * i);
    }
    const canvas = this.picture?.canvas ?? document.createElement("canvas");
    [canvas.width, canvas.height] = [columns, rows];
    canvas.getContext("2d").putImageData(image, 0, 0);
    this.picture = { canvas, bounds, scale };
  }

  peak(sigma) {
    const heaviest = [...this.points].sort((a, b) => b[2] - a[2]).slice(0, 64), k = -0.5 / sigma ** 2;
    return Math.max(0, ...heaviest.map(([x, y]) =>
      this.points.reduce((sum, [a, b, p]) => sum + p * Math.exp(k * ((x - a) ** 2 + (y - b) ** 2)), 0)));
  }
}

/** The pose in a map of rooms that a mode has; undefined where it has none. */
export const posed = (mode) => mode?.pose ?? (mode?.map_from_camera && mode);

/**
 * Where a mode stands on the plane: point and ring around it [m], and where it looks, clockwise from
 * north [rad]. `within`: what is known of the map of rooms that it is in. Null where it stands nowhere.
 */
export function standing(mode, plane, within) {
  const pose = posed(mode), earth = pose?.earth?.[0], turned = (degrees) => ((degrees ?? 0) * Math.PI) / 180;
  if (pose && within?.to) {
    const at = [pose.x, pose.y];
    return { at: within.to(at), ring: ellipse(at, pose.covariance, FINEST).map(within.to), heading: within.heading + turned(90 - pose.yaw_deg) };
  }
  if (!pose && within?.at) return { at: within.at, ring: within.ring };
  const known = earth ?? mode;
  if (!plane || !Number.isFinite(known.longitude)) return null;
  const at = plane.to(known.longitude, known.latitude);
  return { at, ring: ellipse(at, known.covariance, earth ? FINEST : 1), ...(earth && { heading: turned(earth.heading_deg) }) };
}

/** Paint what a camera looks at. */
export function looking(ctx, map, at, heading, colour) {
  const [x, y] = map.px(...at), far = Math.min(90, 3 * map.view.scale), turn = heading - Math.PI / 2;
  if (far < 12) return;
  const fade = ctx.createRadialGradient(x, y, 0, x, y, far);
  fade.addColorStop(0, colour);
  fade.addColorStop(1, "transparent");
  ctx.fillStyle = fade;
  ctx.globalAlpha = 0.55;
  ctx.beginPath();
  ctx.moveTo(x, y);
  ctx.arc(x, y, far, turn - 0.5, turn + 0.5);
  ctx.fill();
  ctx.globalAlpha = 1;
}

/** Closed ring [m] around a mode: two standard deviations, or more where they are less than `least` [m2]. */
export function ellipse([x, y], [[a, b], [, d]], least = 1) {
  const mean = (a + d) / 2, half = Math.hypot((a - d) / 2, b), turn = Math.atan2(2 * b, a - d) / 2;
  const [r, q] = [mean + half, mean - half].map((v) => SIGMAS * Math.sqrt(Math.max(v, least)));
  return Array.from({ length: 49 }, (_, i) => {
    const t = (i / 48) * 2 * Math.PI, [u, v] = [r * Math.cos(t), q * Math.sin(t)];
    return [x + u * Math.cos(turn) - v * Math.sin(turn), y + u * Math.sin(turn) + v * Math.cos(turn)];
  });
}

/** Objects that spoke for or against a mode, each once, the weightiest first; `thing(id)`: what is known of it inside. */
export function witnesses(mode, plane, thing = () => null) {
  const found = new Map();
  const spoke = mode.evidence.filter((e) => e.verdict === "for" || e.verdict === "against");
  for (const evidence of spoke.sort((a, b) => Math.abs(b.weight) - Math.abs(a.weight))) {
    for (const object of evidence.objects) {
      if (found.has(object.id)) continue;
      const inside = thing(object.id), outside = plane && Number.isFinite(object.longitude);
      if (!inside && !outside) continue;
      const at = inside?.at ?? plane.to(object.longitude, object.latitude);
      found.set(object.id, { id: object.id, inside: Boolean(inside), quiet: inside?.quiet, verdict: evidence.verdict, at, middle: at,
        words: tidy(object.name ?? "") || commonName(object.label), pieces: [] });
    }
  }
  return [...found.values()];
}

/** Find the witnesses' shapes in the tiles, and the point of each that is nearest to the mode. */
export function located(found, at, map) {
  for (const witness of found) {
    const pieces = map.pieces(witness.id);
    if (!pieces.length) continue;
    witness.pieces = pieces.filter((piece) => piece.form !== "point");
    let nearest = Infinity;
    for (const { form, parts } of pieces) {
      if (form === "area" && inside(parts, at)) { nearest = 0; witness.at = at; }
      for (const part of parts) {
        const [x, y] = closest(part, at), far = Math.hypot(x - at[0], y - at[1]);
        if (far < nearest) { nearest = far; witness.at = [x, y]; }
      }
    }
  }
  return found;
}

function closest(part, [x, y]) {
  let best = [part[0], part[1]], least = Infinity;
  for (let i = 2; i < part.length; i += 2) {
    const [a, b] = [part[i - 2], part[i - 1]], [dx, dy] = [part[i] - a, part[i + 1] - b];
    const t = clamp(((x - a) * dx + (y - b) * dy) / Math.max(dx * dx + dy * dy, 1e-9), 0, 1);
    const far = Math.hypot(a + t * dx - x, b + t * dy - y);
    if (far < least) { least = far; best = [a + t * dx, b + t * dy]; }
  }
  return best;
}

function inside(rings, [x, y]) {
  let odd = false;
  for (const ring of rings) {
    for (let i = 2; i < ring.length; i += 2) {
      const [a, b, c, d] = [ring[i - 2], ring[i - 1], ring[i], ring[i + 1]];
      if ((b > y) !== (d > y) && x < a + ((y - b) / (d - b)) * (c - a)) odd = !odd;
    }
  }
  return odd;
}

/** Paint the witnesses of a mode; where some are lit, the others step back. */
export function paintEvidence(ctx, map, found, at, lit, way = []) {
  for (const witness of [...found].reverse()) {
    const colour = map.colour(witness.verdict), on = lit.has(witness.id);
    ctx.globalAlpha = lit.size && !on ? 0.3 : 1;
    ctx.strokeStyle = ctx.fillStyle = colour;
    ctx.lineJoin = ctx.lineCap = "round";
    ctx.setLineDash([]);
    for (const piece of witness.pieces) outline(ctx, map, piece, at, on);
    const [x, y] = map.px(...witness.at), [mx, my] = map.px(...(way.length ? closest(way.flat(), witness.at) : at));
    ctx.setLineDash(witness.verdict === "against" ? [5, 4] : []);
    ctx.lineWidth = on ? 3 : 1.8;
    ctx.beginPath();
    ctx.moveTo(mx, my);
    ctx.lineTo(x, y);
    ctx.stroke();
    ctx.setLineDash([]);
    dot(ctx, x, y, on ? 7 : 4, colour, map.colour("paper"));
  }
  ctx.globalAlpha = 1;
}

function outline(ctx, map, { form, parts, tile }, at, on) {
  ctx.save();
  ctx.beginPath();
  const far = 2 * SHOWN, [left, top] = map.px(Math.max(tile.west, at[0] - far), Math.min(tile.south + tile.side, at[1] + far));
  const [right, bottom] = map.px(Math.min(tile.west + tile.side, at[0] + far), Math.max(tile.south, at[1] - far));
  ctx.rect(left, top, right - left, bottom - top); // a tile's border is no outline
  ctx.clip();
  ctx.beginPath();
  for (const part of parts) {
    ctx.moveTo(...map.px(part[0], part[1]));
    for (let i = 2; i < part.length; i += 2) ctx.lineTo(...map.px(part[i], part[i + 1]));
    if (form === "area") ctx.closePath();
  }
  if (form === "area") {
    const alpha = ctx.globalAlpha;
    ctx.globalAlpha = alpha * (on ? 0.3 : 0.14);
    ctx.fill("evenodd");
    ctx.globalAlpha = alpha;
  }
  ctx.lineWidth = (form === "area" ? 2 : 3) * (on ? 1.7 : 1);
  ctx.stroke();
  ctx.restore();
}

export function dot(ctx, x, y, radius, fill, rim) {
  ctx.beginPath();
  ctx.arc(x, y, radius, 0, 7);
  ctx.fillStyle = fill;
  ctx.fill();
  ctx.strokeStyle = rim;
  ctx.lineWidth = 1.5;
  ctx.stroke();
}

/**
 * Names of the witnesses at a scale [px/m], none on another: beside them on the side that looks away
 * from the mode, else on another side. One that finds no room stands in the panel alone.
 */
export function beside(found, mode, scale) {
  const taken = new Taken(), texts = [];
  taken.claim([[mode[0] * scale, -mode[1] * scale, 13]], true);
  for (const { at, words, verdict, id } of found) {
    const text = { x: at[0], y: at[1], text: words, size: 14, ink: verdict, bold: true, angle: 0, dx: 0, dy: 0, osm: id };
    const here = Math.hypot(at[0] - mode[0], at[1] - mode[1]) < 1;
    const left = { ...text, anchor: "right", dx: -9 }, right = { ...text, anchor: "left", dx: 9 };
    const upright = (here ? [26, -26] : [16, -16]).map((dy) => ({ ...text, anchor: "center", dy }));
    const sides = at[0] < mode[0] - 1 ? [left, right] : [right, left];
    const free = (here ? upright : [...sides, ...upright]).find((t) => taken.claim(covering(t, scale)));
    if (free) texts.push(free);
  }
  return texts;
}

/** Paint the ring of an ellipse, dashed, or a way. */
export function paintLine(ctx, map, points, colour, dash = [6, 4], width = 1.6) {
  ctx.beginPath();
  for (const [x, y] of points) ctx.lineTo(...map.px(x, y));
  ctx.setLineDash(dash);
  ctx.lineWidth = width;
  ctx.strokeStyle = colour;
  ctx.stroke();
  ctx.setLineDash([]);
}
