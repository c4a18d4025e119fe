// What lies on the map: a city with the plans of its buildings, or a scene that stands nowhere on Earth.

import { call, mapPath, picture } from "./api.js";
import { button, clamp, el, title } from "./parts/base.js";
import { middle, OPEN, Plan } from "./rooms.js";

const CLOSEST = 90, ENTERED = 0.35, DOORS = 0.35, NAMED = 1;

export class Stage {
  constructor(app) {
    this.app = app;
    this.view = app.view;
    const { map, root } = this.view;
    this.indices = new Map();
    this.plans = []; // on this stage
    this.shown = new Map(); // house: the plan of it that is shown
    map.largest = CLOSEST;
    map.under.push((ctx) => this.paint(ctx, map));
    map.more = (id) => this.planOf(this.view.mapOf(this.view.selected))?.pieces(id) ?? [];
    this.view.stage = this;
    map.above = (x, y) => this.thingAt([x, y]);
    const reserved = map.reserved;
    map.reserved = (scale) => reserved(scale).concat(this.visible().flatMap((plan) => plan.reserved(scale)));
    this.doors = el("div", { class: "doors", role: "group", "aria-label": "Buildings to enter" });
    this.bar = el("div", { class: "floor", role: "group", "aria-label": "Floors", hidden: true });
    root.querySelector(".pins").after(this.doors, this.bar);
  }

  use(maps) {
    this.cities = maps.filter(({ kind }) => kind === "city");
    this.scenes = maps.filter(({ kind }) => kind === "scene");
  }

  /** Show a city, with the plans of the scenes that stand in it. */
  async city(name) {
    if (this.name === name) return;
    if (!this.indices.has(name)) this.indices.set(name, call(mapPath(name, "drawing")));
    const index = await this.indices.get(name).catch((error) => { this.indices.delete(name); throw error; });
    if (this.name === name) return;
    this.name = this.cityName = name;
    this.index = index;
    this.view.city(index, (level, x, y) => call(mapPath(name, `drawing/${level}/${x}/${y}`)));
    const [w, s, e, n] = this.cities.find((city) => city.name === name).bounds;
    this.plans = this.scenes.flatMap((scene) => first(scene.anchors ?? []).map((anchor) => new Plan(scene.name, anchor)))
      .filter(({ anchor: { longitude: x, latitude: y } }) => x >= w && x <= e && y >= s && y <= n);
    for (const plan of this.plans) plan.origin = this.view.plane.to(plan.anchor.longitude, plan.anchor.latitude);
    this.furnish();
  }

  /** Show a scene alone, in its own plane. */
  async alone(name) {
    const key = `${name}/alone`;
    if (this.name === key) return;
    const plan = new Plan(name);
    await this.learn(plan);
    this.name = key;
    this.plans = [plan];
    this.index = null;
    this.view.city({ bounds: plan.index.bounds }, null);
    this.furnish();
  }

  furnish() {
    this.shown.clear();
    for (const plan of this.floors(this.plans)) if (!this.shown.has(plan.house)) this.shown.set(plan.house, plan);
    this.doors.replaceChildren(...[...this.shown.values()].filter(({ anchor }) => anchor).map((plan) =>
      button(`Enter ${plan.title}`, { class: "door", title: `Enter ${plan.title}`, "data-house": plan.house, onclick: () => this.enter(this.shown.get(plan.house)) },
        el("bdi", {}, plan.title))));
    this.view.root.dataset.stage = this.index ? "city" : "scene";
    this.app.source();
    this.follow();
  }

  floors(plans) { return [...plans].sort((a, b) => Number(a.level) - Number(b.level) || (a.map < b.map ? -1 : 1)); }

  /** See to it that a mode of an answer can be shown, wherever it is, with its rooms if they are wanted. */
  async bring(mode, map, inside) {
    const city = this.cityOf(mode), scene = this.scenes.find(({ name }) => name === map);
    if (city) await this.city(city.name);
    else if (scene) await this.open(scene);
    const plan = this.planOf(map);
    if (!plan) return;
    this.shown.set(plan.house, plan);
    const learned = this.learn(plan);
    if (inside) await learned;
    else learned.catch(() => {});
  }

  /** Whether a mode can be shown now, so that nobody has to wait. */
  ready(mode, map, inside) {
    const plan = this.planOf(map), city = this.cityOf(mode);
    if (plan) return this.shown.get(plan.house) === plan && Boolean(plan.index || (plan.asked && !inside));
    return city ? city.name === this.name : !this.scenes.some(({ name }) => name === map);
  }

  /** What is known of a map of rooms on this stage, and of a room in it; null where it is not on it. */
  indoors(map, room) {
    const plan = this.planOf(map);
    if (!plan?.index) return plan ? { house: plan.house, around: plan.around } : null;
    const box = plan.room(room)?.box ?? (plan.anchor ? null : plan.index.bounds), ring = box && plan.ring(box);
    return { house: plan.house, around: plan.around, heading: plan.heading, to: (point) => plan.to(point),
      ...(box && { at: plan.to(middle(box)), ring: [...ring, ring[0]] }) };
  }

  /** Where a thing of a map is; walls and floors are everywhere, and quiet. Null where it is not on this stage. */
  thing(map, id) {
    const plan = this.planOf(map), thing = plan?.things?.get(id);
    return thing ? { at: plan.to(middle(thing.box)), quiet: thing.role !== "thing" } : null;
  }

  planOf(map) { return map ? this.plans.find((plan) => plan.map === map) : undefined; }

  /** Show a scene: in its city, or alone where it stands in none. */
  async open({ name, anchors }) {
    const city = anchors?.length && this.cityOf(anchors[0]);
    await (city ? this.city(city.name) : this.alone(name));
    return this.planOf(name);
  }

  /** The town of a mode, where there are several. */
  town(mode) {
    const city = this.cities.length > 1 && this.cityOf((mode.pose ?? mode).earth?.[0] ?? mode);
    return city ? title(city.name) : undefined;
  }

  /** The city that a place lies in. */
  cityOf({ longitude: x, latitude: y }) {
    return this.cities.find(({ bounds: [w, s, e, n] }) => x >= w && x <= e && y >= s && y <= n);
  }

  async learn(plan) {
    plan.asked ??= call(plan.path("drawing")).then((index) => { plan.learn(index); this.draw(plan); });
    try { await plan.asked; } catch (error) { plan.asked = null; throw error; }
    this.view.place();
  }

  /** Get the picture of a plan, in the colours of the page. */
  async draw(plan) {
    const dark = this.app.dark;
    if (plan.dark === dark) return;
    plan.dark = dark;
    const url = await picture(plan.path("drawing.png", dark ? { dark: "1" } : {})).catch(() => null);
    if (!url) { plan.dark = null; return; }
    const image = new Image();
    image.src = url;
    await image.decode().catch(() => {});
    URL.revokeObjectURL(url);
    if (plan.dark !== dark) return;
    plan.image = image;
    this.view.map.redo();
  }

  recolour() { for (const plan of this.plans) if (plan.index) this.draw(plan); }

  /** Go into a building, to the floor of a plan. */
  async enter(plan) {
    this.view.map.byHand = true;
    this.shown.set(plan.house, plan);
    try { await this.learn(plan); } catch (error) { this.app.trouble(error); return; }
    const { map } = this.view;
    map.fly(map.fitting(plan.around, CLOSEST));
  }

  leave() {
    const { map } = this.view, [x, y] = this.inside?.middle ?? [map.view.x, map.view.y];
    map.fly({ x, y, scale: 1.6 });
  }

  visible() { return [...this.shown.values()]; }

  paint(ctx, map) {
    const pins = this.view.pinned().map(({ at }) => at);
    for (const plan of this.visible()) {
      if (plan.anchor) this.outline(ctx, map, plan);
      if (plan.anchor && map.view.scale < OPEN) continue;
      if (plan.anchor && !plan.asked && this.near(plan)) this.learn(plan).catch(() => {});
      plan.paint(ctx, map, pins);
    }
  }

  near({ origin }) {
    const [w, s, e, n] = this.view.map.bounds(0.2);
    return origin[0] > w && origin[0] < e && origin[1] > s && origin[1] < n;
  }

  /** The building that a plan is of, as far as the tiles show one. */
  outline(ctx, map, plan) {
    const [x, y] = plan.middle, shapes = map.buildingAt(x, y);
    ctx.fillStyle = ctx.strokeStyle = map.colour("transit");
    ctx.lineWidth = 2;
    for (const { parts } of shapes) {
      ctx.beginPath();
      for (const part of parts) {
        for (let i = 0; i < part.length; i += 2) ctx[i ? "lineTo" : "moveTo"](...map.px(part[i], part[i + 1]));
        ctx.closePath();
      }
      ctx.globalAlpha = 0.16 * clamp((2 * OPEN - map.view.scale) / OPEN, 0, 1);
      ctx.fill("evenodd");
      ctx.globalAlpha = 0.9;
      ctx.stroke();
    }
    ctx.globalAlpha = 1;
  }

  thingAt(point) {
    const plan = this.view.map.view.scale > 2 * OPEN && this.visible().find((known) => known.holds(point));
    const thing = plan && plan.thingAt(point);
    if (!plan) return undefined;
    return thing ? { osm: thing.id, name: thing.name, label: thing.room ? "room" : thing.label, thing: true } : null;
  }

  /** The map was touched: whoever touches a building enters it. */
  tapped(point) {
    if (this.inside) return;
    const hit = this.visible().find((plan) => plan.anchor && plan.holds(point, 0.5));
    if (hit && this.view.map.view.scale > OPEN) this.enter(hit);
  }

  /** Doors and floors stand where they belong. */
  follow() {
    const { map } = this.view, { scale, x, y } = map.view, taken = [], pins = this.view.pinned().map(({ at }) => map.px(...at));
    for (const door of this.doors.children) {
      const plan = this.shown.get(door.dataset.house), [left, top] = map.px(...plan.middle);
      const off = left < 0 || top < 20 || left > map.width || top > map.height + 20;
      const near = taken.some(([a, b]) => Math.abs(a - left) < 90 && Math.abs(b - top) < 30);
      const pinned = (before, after) => pins.some(([a, b]) => a > left - before && a < left + after && Math.abs(b - top + 22) < 30);
      door.classList.toggle("small", scale < NAMED || near || pinned(34, 178));
      door.hidden = off || scale < DOORS || scale > 2 * OPEN || pinned(28, 28); // a pin stands there
      door.style.translate = `${left.toFixed(1)}px ${top.toFixed(1)}px`;
      if (!door.hidden) taken.push([left, top]);
    }
    const least = ENTERED * Math.min(map.width, map.height);
    this.inside = this.visible().find((plan) => {
      const [w, s, e, n] = plan.around;
      return plan.anchor && plan.index && plan.holds([x, y], 2) && Math.max(e - w, n - s) * scale > least;
    });
    const key = this.inside ? `${this.inside.map}/${this.inside.part}` : "";
    if (key === this.barred) return;
    this.barred = key;
    this.write();
    if (this.inside) this.app.entered(this.inside);
  }

  /** The bar of a building that one is in: its name, its floors, and the way out. */
  write() {
    const { inside, bar } = this;
    bar.hidden = !inside;
    if (!inside) return;
    const floors = this.floors(this.plans.filter(({ house }) => house === inside.house));
    const named = (plan) => (plan.level ? `Floor ${plan.level}` : title(plan.map));
    const twice = (plan) => floors.filter((other) => named(other) === named(plan)).length > 1;
    bar.replaceChildren(button(null, { class: "out", title: "Back to the city", onclick: () => this.leave() }, "← City"),
      el("b", {}, el("bdi", {}, inside.title)), ...floors.map((plan) =>
        button(null, { "aria-pressed": String(plan === inside), onclick: () => this.enter(plan) },
          el("bdi", {}, twice(plan) ? `${named(plan)} (${title(plan.map)})` : named(plan)))));
  }
}

/** The likeliest anchor of each scene of a map. */
function first(anchors) {
  const seen = new Set();
  return anchors.filter(({ scene }) => !seen.has(scene) && seen.add(scene));
}
