// The page: which map, which way of telling, and what stands in the link.

import { call, mapPath, Problem, useKey } from "./api.js";
import { Here } from "./here.js";
import { Inside } from "./inside.js";
import { You } from "./you.js";
import { Walk } from "./walk.js";
import { AnswerMap } from "./parts/answer.js";
import { button, el } from "./parts/base.js";

const $ = (id) => document.getElementById(id);

class App {
  constructor() {
    this.panel = $("answer");
    this.view = new AnswerMap(document.querySelector(".map"), {
      changed: () => this.tab?.render(), tapped: (...touched) => this.tab?.tapped?.(...touched),
      viewed: () => this.tab?.viewed?.(),
    });
    this.view.on = { touched: (id) => this.reveal(id) };
    this.hands = { light: (ids) => this.view.light(ids), go: (object) => this.view.go(object) };
    this.you = new You(this);
    this.tabs = { here: new Here(this), walk: new Walk(this), inside: new Inside(this) };
    for (const tab of document.querySelectorAll("[data-tab]")) {
      tab.addEventListener("click", () => { this.open(tab.dataset.tab); this.write(); });
      tab.addEventListener("keydown", (event) => this.arrow(event, tab));
    }
    $("city").addEventListener("change", (event) => this.choose(event.target.value, { afresh: true }).catch((e) => this.trouble(e)));
    $("theme").addEventListener("click", () => this.theme());
    $("share").addEventListener("click", () => this.shared());
    $("say").addEventListener("submit", (event) => { event.preventDefault(); this.tab.tell?.(); });
    $("text").addEventListener("input", () => this.tab.typed?.());
    $("text").addEventListener("keydown", (event) => {
      if (event.key === "Enter" && !event.shiftKey && !event.isComposing) { event.preventDefault(); this.tab.tell?.(); }
    });
    $("clear").addEventListener("click", () => { this.tab.clear?.(); $("text").focus(); });
    addEventListener("hashchange", () => { if (location.hash.slice(1) !== this.written) this.read(); });
    this.dress(sessionStorage.getItem("theme"));
  }

  get text() { return $("text").value; }

  set text(value) { $("text").value = value; $("clear").hidden = !value; }

  async start() {
    try {
      this.maps = (await call("v1/maps")).maps.filter((map) => !map.problem);
      await this.read();
    } catch (error) { this.trouble(error); }
  }

  /** State in the link: #map=…&tab=…&q=…&near=lon,lat&radius=…&heading=…&answers=… */
  async read() {
    const hash = new URLSearchParams(location.hash.slice(1));
    const cities = this.maps.filter(({ kind }) => kind === "city");
    const select = $("city");
    select.replaceChildren(...cities.map(({ name }) => el("option", { value: name }, name)));
    select.closest("label").hidden = cities.length < 2;
    this.tabs.inside.scenes = this.maps.filter(({ kind }) => kind !== "city");
    $("tab-inside").hidden = !this.tabs.inside.scenes.length;
    $("tab-here").hidden = $("tab-walk").hidden = !cities.length;
    const city = cities.find(({ name }) => name === hash.get("map")) ?? cities[0];
    if (city) await this.choose(city.name, { told: hash });
    const wanted = hash.get("tab") in this.tabs ? hash.get("tab") : "here";
    this.open(cities.length ? wanted : "inside");
  }

  async choose(name, { told = new URLSearchParams(), afresh = false } = {}) {
    $("city").value = name;
    if (this.city !== name) {
      const index = await call(mapPath(name, "drawing"));
      this.city = name;
      this.index = index;
      this.view.show(null, { move: false });
      this.view.city(index, (level, x, y) => call(mapPath(name, `drawing/${level}/${x}/${y}`)));
      $("source").textContent = `${index.source}: ${index.objects.toLocaleString("en")} objects`;
    }
    if (afresh) this.tab?.leave?.();
    this.you.read(told);
    this.tabs.here.read(told);
    if (afresh) this.open(this.name);
    this.write();
  }

  open(name) {
    if (this.name !== name) this.tab?.leave?.();
    this.name = name;
    this.tab = this.tabs[name];
    for (const tab of document.querySelectorAll("[data-tab]")) {
      const on = tab.dataset.tab === name;
      tab.setAttribute("aria-selected", String(on));
      tab.tabIndex = on ? 0 : -1;
      if (on) $("panel").setAttribute("aria-label", tab.textContent);
    }
    document.body.dataset.tab = name;
    this.tab.enter();
    this.tab.render();
  }

  arrow(event, tab) {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const all = [...document.querySelectorAll("[data-tab]:not([hidden])")];
    const next = all[(all.indexOf(tab) + step + all.length) % all.length];
    next.focus();
    next.click();
  }

  write() {
    const hash = new URLSearchParams();
    if (this.city) hash.set("map", this.city);
    if (this.name && this.name !== "here") hash.set("tab", this.name);
    this.you.write(hash);
    this.tabs.here.write(hash);
    this.written = hash.toString();
    history.replaceState(null, "", `#${this.written}`);
  }

  async shared() {
    this.write();
    try {
      if (navigator.share && navigator.maxTouchPoints) await navigator.share({ title: document.title, url: location.href });
      else { await navigator.clipboard.writeText(location.href); this.note("The link is copied."); }
    } catch (error) {
      if (error.name !== "AbortError") this.note("Copy the link from the address bar.");
    }
  }

  theme() {
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const now = document.documentElement.dataset.theme ?? (dark ? "dark" : "light");
    this.dress(now === "dark" ? "light" : "dark");
  }

  dress(theme) {
    if (!theme) return;
    document.documentElement.dataset.theme = theme;
    sessionStorage.setItem("theme", theme);
    this.view.map.recolour();
  }

  note(text) { $("note").textContent = text; }

  /** Tell a screen reader, when the answer has come to rest. */
  announce(text) {
    clearTimeout(this.later);
    this.later = setTimeout(() => { $("live").textContent = text; }, 500);
  }

  show(...parts) { this.panel.replaceChildren(...parts.flat().filter(Boolean)); }

  /** An object of the map was touched: its statement in the panel is shown. */
  reveal(id) {
    for (const row of this.panel.querySelectorAll("[data-ids]")) {
      const on = Boolean(id) && row.dataset.ids.split(" ").includes(id);
      row.classList.toggle("on", on);
      if (on) row.scrollIntoView({ block: "nearest" });
    }
  }

  trouble(error) {
    if (error instanceof Problem && error.status === 401) { this.show(this.keyhole()); return; }
    this.show(this.problem(error));
    this.announce(error.message);
  }

  problem(error) {
    if (!(error instanceof Problem)) console.error(error);
    return el("div", { class: "problem", role: "alert" }, el("b", {}, error.message), error.mend ?? "");
  }

  keyhole() {
    const field = el("input", { type: "password", "aria-label": "Key", autocomplete: "off" });
    const use = () => { useKey(field.value.trim()); this.start(); };
    field.addEventListener("keydown", (event) => { if (event.key === "Enter") use(); });
    return el("div", { class: "problem" }, el("b", {}, "This server wants a key."),
      el("div", { class: "key" }, field, button(null, { class: "act", onclick: use }, "Use it")));
  }
}

const app = new App();
app.start();
