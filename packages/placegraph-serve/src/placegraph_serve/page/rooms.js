// Plans of rooms on the map: each laid over its building where it stands on Earth, floor by floor.

import { mapPath } from "./api.js";
import { clamp, tidy, title } from "./parts/base.js";
import { covering, Taken, widthOf, write } from "./parts/letters.js";

export const OPEN = 3; // plans are drawn from this scale on [px/m], and filled with names from the next
const NAMED = 18, RESERVED = 24;

/** Middle of a box. */
export const middle = ([w, s, e, n]) => [(w + e) / 2, (s + n) / 2];

/** A plan of a scene: where it stands, and, once it was asked for, what is in it. */
export class Plan {
  constructor(map, anchor) {
    Object.assign(this, { map, part: anchor?.scene ?? "", anchor, heading: 0, origin: [0, 0], index: null, image: null });
    this.title = tidy(anchor?.building || title(map));
    this.level = tidy(anchor?.level ?? "");
    this.house = anchor ? anchor.osm || anchor.building || map : map;
  }

  path(rest, more = {}) {
    const asked = new URLSearchParams({ ...(this.part ? { scene: this.part } : {}), ...more }).toString();
    return mapPath(this.map, rest) + (asked ? `?${asked}` : "");
  }

  /** Learn what is in it: what the server says of the scene. */
  learn(index) {
    this.index = index;
    this.things = new Map(index.things.map((thing) => [thing.id, thing]));
    if (this.anchor && index.anchors.length) this.heading = index.anchors[0].heading;
  }

  /** From the scene's x and y to the plane [m], and back. */
  to([x, y]) {
    const [c, s] = [Math.cos(this.heading), Math.sin(this.heading)];
    return [this.origin[0] + x * c + y * s, this.origin[1] - x * s + y * c];
  }

  from([east, north]) {
    const [c, s] = [Math.cos(this.heading), Math.sin(this.heading)], [e, n] = [east - this.origin[0], north - this.origin[1]];
    return [e * c - n * s, e * s + n * c];
  }

  get middle() {
    return this.index ? this.to(middle(this.index.bounds)) : this.origin;
  }

  ring([w, s, e, n]) { return [[w, s], [e, s], [e, n], [w, n]].map((corner) => this.to(corner)); }

  /** West, south, east, north of it on the plane [m]. */
  get around() {
    if (!this.index) return [0, 1, 0, 1].map((k, i) => this.origin[k] + (i < 2 ? -8 : 8));
    const ring = this.ring(this.index.bounds), of = (k) => ring.map((corner) => corner[k]);
    const [w, s, e, n] = [Math.min(...of(0)), Math.min(...of(1)), Math.max(...of(0)), Math.max(...of(1))];
    const edge = 0.06 * Math.max(e - w, n - s);
    return [w - edge, s - edge, e + edge, n + edge];
  }

  holds(point, margin = 0) {
    if (!this.index) return false;
    const [x, y] = this.from(point), [w, s, e, n] = this.index.bounds;
    return x > w - margin && x < e + margin && y > s - margin && y < n + margin;
  }

  /** The smallest thing with a name at a point of the plane; null where there is none. */
  thingAt(point) {
    const [x, y] = this.from(point), size = ({ box: [w, s, e, n] }) => (e - w) * (n - s);
    const there = (this.index?.things ?? []).filter(({ name, box: [w, s, e, n] }) => name && x >= w && x <= e && y >= s && y <= n);
    return there.sort((a, b) => size(a) - size(b))[0] ?? null;
  }

  /** A room of a name; undefined where none is called so. */
  room(name) { return name ? this.index?.things.find((thing) => thing.room && thing.name === name) : undefined; }

  /** Outline of a thing as the map's tiles would give it. */
  pieces(id) {
    const thing = this.things?.get(id);
    if (!thing) return [];
    const ring = this.ring(thing.box), [w, s, e, n] = this.around;
    return [{ form: "area", parts: [[...ring, ring[0]].flat()], tile: { west: w - 9, south: s - 9, side: Math.max(e - w, n - s) + 18 } }];
  }

  /** Paint it; names keep clear of pins, points on the plane [m]. */
  paint(ctx, map, pins) {
    if (!this.image) return;
    const [x, y] = map.px(...this.origin), k = map.view.scale, [w, s, e, n] = this.index.bounds;
    ctx.save();
    ctx.translate(x, y);
    ctx.rotate(this.heading);
    ctx.globalAlpha = this.anchor ? clamp((k - OPEN) / 2, 0, 1) : 1;
    ctx.imageSmoothingEnabled = true;
    ctx.imageSmoothingQuality = "high";
    if (this.anchor) { ctx.shadowColor = "#0006"; ctx.shadowBlur = 14; }
    ctx.drawImage(this.image, w * k, -n * k, (e - w) * k, (n - s) * k);
    ctx.restore();
    if (k >= NAMED) write(ctx, this.texts(k, pins), map.px, map.colour, map.size);
  }

  /** Names of rooms and things where there is room for them. */
  texts(scale, pins) {
    const key = [scale, ...pins].join();
    if (this.lettered?.key === key) return this.lettered.texts;
    const taken = new Taken(), texts = [], size = ({ box: [w, s, e, n] }) => (e - w) * (n - s);
    for (const [x, y] of pins) taken.claim([[x * scale, -y * scale, 15]], true);
    const named = this.index.things.filter(({ name }) => name).sort((a, b) => b.room - a.room || size(b) - size(a));
    for (const { name, room, box } of named) {
      const height = room ? 13 : 11, [x, y] = this.to(middle(box)), [w, s, e, n] = box;
      const text = { text: tidy(name).slice(0, 60), x, y, dx: 0, dy: 0, size: height, angle: 0, anchor: "center",
        ink: room ? "ink" : "soft-ink", bold: room };
      if (!room && widthOf(text.text, height) > 1.25 * Math.max(e - w, n - s) * scale) continue;
      const place = [0, 24, -24].map((dy) => ({ ...text, dy })).find((tried) => taken.claim(covering(tried, scale)));
      if (place) texts.push(place);
    }
    this.lettered = { key, texts };
    return texts;
  }

  /** Discs [px] that keep the names of the city out of it. */
  reserved(scale) {
    if (!this.image || !this.anchor || scale < OPEN + 1) return [];
    const [w, s, e, n] = this.index.bounds, step = RESERVED / scale, discs = [];
    for (let x = w; x <= e; x += step) {
      for (let y = s; y <= n; y += step) {
        const [east, north] = this.to([x, y]);
        discs.push([east * scale, -north * scale, 0.75 * RESERVED]);
      }
    }
    return [{ discs }];
  }
}
