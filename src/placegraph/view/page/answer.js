// An answer on map and panel: which place is chosen, what is lit.

import { button, clamp, el, Plane } from "./base.js";
import { beside, ellipse, Heat, located, paintEllipse, paintEvidence, witnesses } from "./marks.js";
import { MapView } from "./map.js";

/** A map with its furniture, and an answer on it; `changed()` is told when another place is chosen. */
export class AnswerMap {
  constructor(root, { changed = () => {}, tapped = () => {}, viewed = () => {} } = {}) {
    this.root = root;
    this.changed = changed;
    this.heat = new Heat();
    this.places = [];
    this.selected = 0;
    this.lit = new Set();
    const find = (name) => root.querySelector(name);
    this.parts = { tip: find(".tip"), pins: find(".pins"), scale: find(".scale span") };
    this.map = new MapView(find("canvas"), {
      view: () => { root.dataset.state = "moving"; this.follow(); viewed(); },
      still: () => { root.dataset.state = "still"; }, made: () => this.locate(), hover: (shape, at) => this.tell(shape, at),
      tap: (point, shape, at) => { this.tell(shape, at); this.touch(shape); tapped(point, shape); },
    });
    this.map.under.push((ctx, map) => this.heat.paint(ctx, map));
    this.map.over.push((ctx, map) => this.paint(ctx, map));
    this.map.reserved = (scale) => this.places.map(({ at }) => ({ discs: [[at[0] * scale, -at[1] * scale, 14]] })).concat(this.texts());
    this.map.lettered = () => new Set(this.texts().map(({ osm }) => osm));
    this.tools(find(".tools"));
  }

  tools(bar) {
    const { moves } = this.map;
    const heat = button("Heat", { title: "Heat (h)", "aria-pressed": "true", class: "heat", onclick: () => {
      this.heat.shown = !this.heat.shown;
      heat.setAttribute("aria-pressed", String(this.heat.shown));
      this.map.draw();
    } }, "◉");
    bar.append(
      button("Zoom in", { title: "Zoom in (+)", onclick: moves["+"] }, "+"),
      button("Zoom out", { title: "Zoom out (−)", onclick: moves["-"] }, "−"),
      button("Show the whole city", { title: "Whole city (0)", onclick: moves[0] }, "⤢"), heat);
  }

  city(index, load) {
    this.plane = new Plane(index);
    this.map.show(index, load);
  }

  /** Show an answer; null shows none. `move` says whether the map goes there. */
  show(answer, { move = true } = {}) {
    this.answer = answer;
    this.lit.clear();
    const modes = (answer?.estimate.modes ?? []).filter((mode) => Number.isFinite(mode.longitude));
    this.heat.set((answer?.support ?? []).map(([lon, lat, p]) => [...this.plane.to(lon, lat), p]));
    this.places = modes.map((mode) => {
      const at = this.plane.to(mode.longitude, mode.latitude);
      return { mode, at, ring: ellipse(at, mode.covariance), found: witnesses(mode, this.plane) };
    });
    this.selected = clamp(this.selected, 0, Math.max(0, modes.length - 1));
    if (move) this.selected = 0;
    this.parts.pins.replaceChildren(...this.places.map(({ mode }, k) => {
      const share = answer.ranked ? "" : `, ${(100 * mode.probability).toFixed(0)} %`;
      return button(`Place ${k + 1}${share}`, { "data-mode": k, class: "pin", onclick: () => this.select(k) }, String(k + 1));
    }).reverse());
    this.locate();
    this.mark();
    if (move) this.home();
    this.map.redo();
  }

  /** Go to what the answer is about: the best place, all rivals, or the city where all is lost. */
  home() {
    const { map, answer } = this;
    if (!answer || !this.places.length || answer.estimate.status === "LOST") {
      if (map.index) map.fly(map.fitting(map.index.bounds));
      return;
    }
    const least = 0.1 * this.places[0].mode.probability;
    const shown = answer.estimate.status === "AMBIGUOUS" ? this.places.filter((p) => p.mode.probability >= least) : [this.places[0]];
    const boxes = shown.map((place) => this.around(place));
    map.fly(map.fitting([0, 1].map((k) => Math.min(...boxes.map((b) => b[k])))
      .concat([2, 3].map((k) => Math.max(...boxes.map((b) => b[k]))))));
  }

  around({ at, ring, found }) {
    const points = [...ring, ...found.map((witness) => witness.at)];
    const half = [0, 1].map((k) => clamp(1.25 * Math.max(0, ...points
      .map((p) => Math.abs(p[k] - at[k])).filter((far) => far < 160)), 90, 160));
    return [at[0] - half[0], at[1] - half[1], at[0] + half[0], at[1] + half[1]];
  }

  select(k, move = true) {
    this.selected = k;
    this.lit.clear();
    this.mark();
    if (move && this.places[k]) this.map.fly(this.map.fitting(this.around(this.places[k])));
    this.map.redo();
    this.changed();
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

  go(object) {
    const [x, y] = this.plane.to(object.longitude, object.latitude);
    this.map.fly({ x, y, scale: Math.max(this.map.view.scale, 1.2) });
  }

  /** An object of the map was touched: light up what it says, here and in the panel. */
  touch(shape) {
    const place = this.places[this.selected], known = shape && place?.found.some(({ id }) => id === shape.osm);
    this.light(known ? [shape.osm] : []);
    this.on?.touched?.(known ? shape.osm : null);
  }

  locate() {
    const { map } = this;
    for (const place of this.places) located(place.found, place.at, map);
    const key = JSON.stringify(this.texts().map(({ x, y, text }) => [Math.round(x), Math.round(y), text]));
    if (key !== this.placed) { this.placed = key; map.redo(); } // names make room for them
  }

  texts() {
    const place = this.places[this.selected];
    if (!place || this.map.view.scale < 0.4) return [];
    return place.found.slice(0, 12).map((witness) => beside(witness, place.at));
  }

  paint(ctx, map) {
    const { places, selected } = this, place = places[selected];
    for (const { ring } of places) if (map.view.scale > 0.08) paintEllipse(ctx, map, ring, map.colour("mode"));
    if (!place || map.view.scale < 0.08) return;
    paintEvidence(ctx, map, place.found, place.at, this.lit);
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
    tip.replaceChildren(el("b", {}, el("bdi", {}, shape.name)), el("span", {}, shape.label), el("small", {}, shape.osm));
    const left = clamp(at.x + 14, 4, Math.max(4, this.map.width - tip.offsetWidth - 4));
    const below = at.y + 18 + tip.offsetHeight < this.map.height;
    tip.style.translate = `${left}px ${below ? at.y + 18 : Math.max(4, at.y - 10 - tip.offsetHeight)}px`;
  }
}
