// An answer on map and panel: which place is chosen, what is lit.

import { button, clamp, commonName, el, Plane } from "./base.js";
import { beside, Heat, located, looking, paintEvidence, paintLine, posed, standing, witnesses } from "./marks.js";
import { MapView } from "./map.js";

const LEAST = 0.01; // modes below this probability have no pin, unless they are chosen
const INDOORS = 12; // from this scale on one is seen to be inside [px/m]

/**
 * A map with its furniture, and an answer on it; `changed()` is told when another place is chosen.
 * A `stage`, where there is one, brings the map to where a mode is, and knows what lies inside.
 */
export class AnswerMap {
  constructor(root, { changed = () => {} } = {}) {
    this.root = root;
    furnish(root);
    this.changed = changed;
    this.heat = new Heat();
    this.places = [];
    this.way = [];
    this.selected = 0;
    this.lit = new Set();
    const find = (name) => root.querySelector(name);
    this.parts = { tip: find(".tip"), pins: find(".pins"), scale: find(".scale span") };
    this.map = new MapView(find("canvas"), {
      view: () => { root.dataset.state = "moving"; this.follow(); },
      still: () => { root.dataset.state = "still"; }, made: () => this.locate(), hover: (shape, at) => this.tell(shape, at),
      tap: (point, shape, at) => { this.tell(shape, at); this.touch(shape); this.stage?.tapped(point); },
    });
    this.map.under.push((ctx, map) => this.heat.paint(ctx, map));
    this.map.over.push((ctx, map) => this.paint(ctx, map));
    this.map.reserved = (scale) => this.pinned().map(({ at }) => ({ discs: [[at[0] * scale, -at[1] * scale, 14]] })).concat(this.texts());
    this.map.lettered = () => new Set(this.texts().map(({ osm }) => osm));
    this.tools(find(".tools"));
  }

  tools(bar) {
    const { moves } = this.map;
    moves.h = () => {
      this.heat.shown = !this.heat.shown;
      heat.setAttribute("aria-pressed", String(this.heat.shown));
      this.map.draw();
    };
    const heat = button("Heat", { title: "Heat (h)", "aria-pressed": "true", class: "heat", onclick: moves.h }, "◉");
    bar.append(
      button("Zoom in", { title: "Zoom in (+)", onclick: moves["+"] }, "+"),
      button("Zoom out", { title: "Zoom out (−)", onclick: moves["-"] }, "−"),
      button("Show the whole city", { title: "Whole city (0)", onclick: moves[0] }, "⤢"), heat);
  }

  /** Show a city, or, where nothing loads tiles, a plane that has no place on Earth. */
  city(index, load) {
    this.plane = load && new Plane(index);
    this.map.show(index, load);
    this.place();
  }

  /** Show an answer; null shows none. `move`: the map goes there; `stay`: the place that was chosen stays so. */
  show(answer, { move = true, stay = false } = {}) {
    this.answer = answer;
    this.lit.clear();
    const modes = answer?.estimate.modes ?? [];
    for (const mode of modes) mode.town ??= this.stage?.town(mode);
    this.selected = stay ? clamp(this.selected, 0, Math.max(0, modes.length - 1)) : 0;
    const before = this.stage?.name, found = answer?.estimate.status === "OK" && modes[0]?.scene; // a room that is found opens
    this.on(this.selected, Boolean(found || posed(modes[this.selected])), () => {
      if (move || before !== this.stage?.name) this.home(); // another city comes late
    });
  }

  select(k) {
    this.map.byHand = true;
    this.selected = k;
    this.lit.clear();
    this.on(k, true, () => this.enter(k));
    this.changed();
  }

  /** Bring mode k on the map, with what is inside if that is wanted, and then do something. */
  on(k, inside, then) {
    const { answer, stage } = this, mode = answer?.estimate.modes[k];
    const done = () => { if (answer === this.answer && k === this.selected) { this.place(); then(); } };
    if (!mode || !stage || stage.ready(mode, this.mapOf(k), inside)) done();
    else stage.bring(mode, this.mapOf(k), inside).then(done, done);
  }

  /** Name of the map of rooms that a mode is in. */
  mapOf(k) {
    const mode = this.answer?.estimate.modes[k];
    return mode?.map_from_camera ? this.answer.map : mode?.scene || null;
  }

  /** Whether a mode may be on what the map shows now, and not in another city. */
  reaches(mode) {
    const city = this.stage?.cityOf(mode);
    return !city || city.name === this.stage.name;
  }

  /** Find where the modes are on what the map shows now. */
  place() {
    const { answer, plane, stage } = this, modes = answer?.estimate.modes ?? [];
    this.way = plane ? (answer?.estimate.way ?? []).map(([lon, lat]) => plane.to(lon, lat)) : [];
    this.heat.set(plane ? (answer?.support ?? []).map(([lon, lat, p]) => [...plane.to(lon, lat), p]) : []);
    this.places = modes.map((mode, k) => {
      const map = this.mapOf(k), within = stage?.indoors(map, mode.room), where = this.reaches(mode) ? standing(mode, plane, within) : null;
      return { mode, at: null, found: [], ...where, within,
        ...(where && { found: witnesses(mode, plane, (id) => stage?.thing(map, id)) }) };
    });
    this.parts.pins.replaceChildren(...this.places.map(({ mode, at }, k) => {
      if (!at || (mode.probability < LEAST && k !== this.selected)) return null;
      const share = answer.ranked ? "" : `, ${(100 * mode.probability).toFixed(0)} %`;
      return button(`Place ${k + 1}${share}`, { "data-mode": k, class: "pin", onclick: () => this.select(k) }, String(k + 1));
    }).filter(Boolean).reverse());
    this.locate();
    this.mark();
    this.map.redo();
  }

  pinned() { return this.places.filter(({ mode, at }, k) => at && (mode.probability >= LEAST || k === this.selected)); }

  /** Go to what the answer is about: the best place, all rivals, or the city where all is lost. */
  home() {
    const { map, answer } = this, standing = this.places.filter(({ at }) => at);
    if (!answer) return;
    if (!standing.length || (answer.estimate.status === "LOST" && !this.places[0].within)) {
      if (map.index) map.fly(map.whole());
      return;
    }
    const least = 0.1 * standing[0].mode.probability;
    const shown = answer.estimate.status === "AMBIGUOUS" ? standing.filter((p) => p.mode.probability >= least) : [standing[0]];
    const sure = answer.estimate.status === "OK", [{ within: first }] = shown;
    const seen = shown.every(({ within, heading }) => (heading !== undefined || (sure && within)) && within?.house === first?.house);
    const boxes = shown.map((place) => this.around(place, seen));
    for (const [x, y] of this.way) boxes.push([x - 40, y - 40, x + 40, y + 40]);
    map.fly(map.fitting([0, 1].map((k) => Math.min(...boxes.map((b) => b[k])))
      .concat([2, 3].map((k) => Math.max(...boxes.map((b) => b[k])))), seen ? map.largest : undefined));
  }

  /** Go to a mode: into its building where it is in one. */
  enter(k) {
    const place = this.places[k], { map } = this;
    if (place?.at) map.fly(map.fitting(this.around(place, true), place.within ? map.largest : undefined));
  }

  around({ at, ring, found, within }, inside) {
    if (inside && within) return within.around;
    const points = [...ring, ...found.map((witness) => witness.at)];
    const half = [0, 1].map((k) => clamp(1.25 * Math.max(0, ...points
      .map((p) => Math.abs(p[k] - at[k])).filter((far) => far < 160)), 90, 160));
    return [at[0] - half[0], at[1] - half[1], at[0] + half[0], at[1] + half[1]];
  }

  mark() {
    for (const pin of this.parts.pins.children) {
      const on = Number(pin.dataset.mode) === this.selected;
      pin.classList.toggle("on", on);
      pin.setAttribute("aria-pressed", String(on));
    }
    this.follow();
  }

  /** Light up objects, or none. */
  light(ids) {
    this.lit = new Set(ids);
    this.root.dataset.lit = ids.join(" ");
    this.map.draw();
  }

  /** Go to an object of the evidence. */
  go({ id }) {
    const witness = this.places[this.selected]?.found.find((found) => found.id === id);
    if (!witness) return;
    const [x, y] = witness.middle;
    this.map.fly({ x, y, scale: Math.max(this.map.view.scale, 1.2) });
  }

  /** An object of the map was touched: light up what it says, here and in the panel. */
  touch(shape) {
    const place = this.places[this.selected], known = shape && place?.found.some(({ id }) => id === shape.osm);
    this.light(known ? [shape.osm] : []);
    this.touched?.(known ? shape.osm : null);
  }

  locate() {
    const { map } = this;
    for (const place of this.places) if (place.at) located(place.found, place.at, map);
    const key = JSON.stringify(this.texts().map(({ x, y, text }) => [Math.round(x), Math.round(y), text]));
    if (key !== this.placed) { this.placed = key; map.redo(); } // names make room for them
  }

  texts() {
    const place = this.places[this.selected];
    if (!place?.at || this.map.view.scale < 0.4) return [];
    return beside(this.speaking(place).slice(0, 12), place.at, this.map.view.scale);
  }

  /** Witnesses of a place: what is inside where that is seen from near by, else what is outside. */
  speaking({ found, within }) {
    const near = Boolean(within) && this.map.view.scale > INDOORS;
    return found.filter(({ id, inside, quiet }) => inside === near && (!quiet || this.lit.has(id)));
  }

  paint(ctx, map) {
    const place = this.places[this.selected];
    if (map.view.scale < 0.08) return;
    for (const { ring, at, heading } of this.pinned()) {
      paintLine(ctx, map, ring, map.colour("mode"));
      if (heading !== undefined) looking(ctx, map, at, heading, map.colour("mode"));
    }
    if (!place?.at) return;
    const way = this.selected ? [] : this.way;
    paintLine(ctx, map, way, map.colour("mode"), [], 4);
    paintEvidence(ctx, map, this.speaking(place), place.at, this.lit, way);
    this.write(ctx, this.texts());
  }

  write(ctx, texts) {
    const { map, lit } = this;
    const shown = texts.filter(({ osm }) => !lit.size || lit.has(osm));
    map.lettering(ctx, shown);
  }

  /** Pins, scale bar and tip stand where they belong. */
  follow() {
    const { map, parts } = this;
    for (const pin of parts.pins.children) {
      const [x, y] = map.px(...this.places[Number(pin.dataset.mode)].at);
      pin.style.translate = `${x.toFixed(1)}px ${y.toFixed(1)}px`;
      pin.hidden = x < -20 || y < -20 || x > map.width + 20 || y > map.height + 20;
    }
    this.stage?.follow();
    const { scale } = map.view;
    let metres = 10 ** Math.floor(Math.log10(140 / scale));
    metres *= [5, 2, 1].find((step) => metres * step * scale <= 140);
    parts.scale.style.width = `${metres * scale}px`;
    parts.scale.textContent = metres >= 1000 ? `${metres / 1000} km` : `${metres} m`;
  }

  tell(shape, at) {
    const { tip } = this.parts;
    tip.hidden = !shape?.osm;
    if (tip.hidden) return;
    tip.replaceChildren(el("b", {}, el("bdi", {}, shape.name)), el("span", {}, [...new Set((shape.label ?? "").split(" · ").map(commonName))].join(", ")));
    const left = clamp(at.x + 14, 4, Math.max(4, this.map.width - tip.offsetWidth - 4));
    const below = at.y + 18 + tip.offsetHeight < this.map.height;
    tip.style.translate = `${left}px ${below ? at.y + 18 : Math.max(4, at.y - 10 - tip.offsetHeight)}px`;
  }
}

/** What stands on a map, besides it. */
function furnish(root) {
  const sign = (name, ...words) => [el("span", { class: name }), ...words];
  root.append(
    el("canvas", { tabindex: "0", role: "application", "aria-label": "Map. Arrow keys move it, plus and minus zoom, 0 shows all of it." }),
    el("div", { class: "pins", role: "group", "aria-label": "Places on the map" }),
    el("div", { class: "tools", role: "group", "aria-label": "Map tools" }),
    el("div", { class: "scale", "aria-hidden": "true" }, el("span")),
    el("div", { class: "legend", "aria-hidden": "true" }, sign("dot", "place and its uncertainty"),
      sign("ramp", "how probable"), sign("line", "for"), sign("line against", "against")),
    el("div", { class: "credit" }, "© ", el("a", { href: "https://www.openstreetmap.org/copyright", target: "_blank", rel: "noopener noreferrer" }, "OpenStreetMap contributors")),
    el("div", { class: "tip", role: "status", hidden: true }));
}
