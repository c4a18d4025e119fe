// What the device knows of you: where it is and where it points, on the map and in every question.

import { button, el } from "./parts/base.js";
import { dot } from "./parts/marks.js";
import { compass, position, voice } from "./senses.js";

const $ = (id) => document.getElementById(id);
const WINDS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];

export class You {
  constructor(app) {
    this.app = app;
    this.near = this.heading = null;
    this.radius = 1000;
    const said = (text) => app.note(text);
    const here = (found) => {
      this.near = found?.near ?? null;
      this.radius = found?.radius ?? 1000;
      this.accuracy = found?.accuracy ?? null;
      if (found) this.middle(false);
      this.changed();
      if (found && !this.been) { this.been = true; this.look(); }
    };
    this.stops = [position($("gps"), { here, said }),
      compass($("compass"), { towards: (heading) => { this.heading = heading; this.changed(); }, said })];
    voice($("voice"), { said, heard: (text, final) => { app.text = text; app.tab?.typed?.(); if (final) app.tab?.tell?.(); } });
    $("middle").addEventListener("click", () => this.toggle());
    app.view.map.over.unshift((ctx, map) => this.paint(ctx, map));
  }

  read(hash) {
    const near = (hash.get("near") ?? "").split(",").map(Number);
    this.near = near.length === 2 && near.every(Number.isFinite) ? near : null;
    this.radius = Number(hash.get("radius")) || 1000;
    const heading = hash.get("heading");
    this.heading = heading !== null && Number.isFinite(Number(heading)) ? Number(heading) : null;
    this.accuracy = null;
    this.middle(Boolean(this.near));
  }

  write(hash) {
    if (this.near) {
      hash.set("near", this.near.map((n) => n.toFixed(5)).join(","));
      hash.set("radius", String(Math.round(this.radius)));
    }
    if (this.heading !== null) hash.set("heading", String(this.heading));
  }

  /** What a question takes along. */
  get known() {
    return {
      ...(this.near ? { near: this.near, radius: this.radius } : {}),
      ...(this.heading !== null ? { heading_deg: this.heading } : {}),
    };
  }

  changed() {
    this.app.view.map.draw();
    this.app.tab?.sensed?.();
  }

  look() {
    if (!this.app.view.plane) return;
    const [x, y] = this.app.view.plane.to(...this.near);
    this.app.view.map.fly({ x, y, scale: 1 });
  }

  middle(on) { $("middle").setAttribute("aria-pressed", String(on)); }

  toggle() {
    const { map, plane } = this.app.view;
    const on = $("middle").getAttribute("aria-pressed") !== "true";
    if (on && plane) {
      const { x, y, scale } = map.view;
      this.near = plane.from(x, y);
      this.radius = Math.max(100, Math.round(Math.min(map.width, map.height) / scale / 2));
      this.accuracy = null;
    } else this.near = null;
    this.middle(Boolean(this.near));
    this.changed();
  }

  chips() {
    const found = [];
    if (this.near) {
      const far = this.radius >= 1000 ? `${(this.radius / 1000).toFixed(1)} km` : `${Math.round(this.radius)} m`;
      found.push(button(null, { class: "chip", title: "Search everywhere", onclick: () => {
        if (this.accuracy !== null) this.stops[0]?.();
        this.near = null; this.middle(false); this.changed();
      } }, `within about ${far} of ${this.accuracy === null ? "here" : "this device"}`));
    }
    if (this.heading !== null) {
      found.push(button(null, { class: "chip", title: "Forget it", onclick: () => {
        this.stops[1]?.(); this.heading = null; this.changed();
      } }, `looking ${WINDS[Math.round(this.heading / 45) % 8]} (${this.heading}°)`));
    }
    return found;
  }

  paint(ctx, map) {
    const { near, radius, accuracy, heading } = this;
    if (!near || !this.app.view.plane) return;
    const [x, y] = map.px(...this.app.view.plane.to(...near)), blue = map.colour("transit");
    ctx.strokeStyle = ctx.fillStyle = blue;
    ctx.lineWidth = 1.5;
    ctx.setLineDash(accuracy === null ? [3, 5] : []);
    ctx.beginPath();
    ctx.arc(x, y, (accuracy ?? radius) * map.view.scale, 0, 7);
    ctx.globalAlpha = 0.07;
    if (accuracy !== null) ctx.fill();
    ctx.globalAlpha = 0.8;
    ctx.stroke();
    ctx.setLineDash([]);
    if (heading !== null) {
      const turn = ((heading - 90) * Math.PI) / 180;
      ctx.beginPath();
      ctx.moveTo(x, y);
      ctx.arc(x, y, 60, turn - 0.45, turn + 0.45);
      ctx.globalAlpha = 0.25;
      ctx.fill();
    }
    ctx.globalAlpha = 1;
    if (accuracy !== null || heading !== null) dot(ctx, x, y, 7, blue, map.colour("paper"));
  }
}

export const chipRow = (chips) => (chips.length ? el("div", { class: "chips" }, chips) : null);
