// The page: which map, which way of telling, and what stands in the link.

import { call, Problem, useKey } from "./api.js";
import { Here } from "./here.js";
import { Inside } from "./inside.js";
import { Stage } from "./stage.js";
import { You } from "./you.js";
import { Walk } from "./walk.js";
import { AnswerMap } from "./parts/answer.js";
import { button, el, title } from "./parts/base.js";

const $ = (id) => document.getElementById(id);

class App {
  constructor() {
    this.panel = $("answer");
    this.view = new AnswerMap(document.querySelector(".map"), { changed: () => this.tab?.render() });
    this.view.touched = (id) => this.reveal(id);
    this.stage = new Stage(this);
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
    $("say").addEventListener("submit", (event) => { event.preventDefault(); this.tell(); });
    $("text").addEventListener("input", () => {
      this.wait(this.name !== "walk" && Boolean(this.text.trim()));
      this.tab?.typed?.();
    });
    $("text").addEventListener("keydown", (event) => {
      if (event.key === "Enter" && !event.shiftKey && !event.isComposing) { event.preventDefault(); this.tell(); }
    });
    $("clear").addEventListener("click", () => { this.tab?.clear?.(); $("text").focus(); });
    addEventListener("hashchange", () => { if (location.hash.slice(1) !== this.written) this.read(); });
    this.dress(sessionStorage.getItem("theme"));
  }

  get text() { return $("text").value; }

  set text(value) { $("text").value = value; $("clear").hidden = !value; }

  /** Whether the colours are those of the night. */
  get dark() {
    const chosen = document.documentElement.dataset.theme;
    return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  }

  async start() {
    try {
      this.maps = (await call("v1/maps")).maps.filter((map) => !map.problem);
      this.stage.use(this.maps);
      await this.read();
    } catch (error) { this.trouble(error); }
  }

  /** State in the link: #map=…&tab=…&scene=…&q=…&near=lon,lat&radius=…&heading=…&answers=… */
  async read() {
    const hash = new URLSearchParams(location.hash.slice(1)), { cities } = this.stage, select = $("city");
    const everywhere = this.maps.length > 1 ? [el("option", { value: "" }, "Everywhere")] : [];
    select.replaceChildren(...everywhere, ...this.maps.filter(({ kind }) => kind === "city").map(({ name }) => el("option", { value: name }, title(name))));
    select.closest("label").hidden = select.options.length < 2;
    this.tabs.inside.use(this.maps.filter(({ kind }) => kind !== "city"), hash.get("scene"));
    $("tab-inside").hidden = !this.tabs.inside.scenes.length;
    $("tab-walk").hidden = !cities.length;
    const city = cities.find(({ name }) => name === hash.get("map"));
    await this.choose(city?.name ?? (everywhere.length ? "" : this.maps[0]?.name), { told: hash });
    const wanted = new URLSearchParams(location.hash.slice(1)).get("tab"); // it may have been clicked meanwhile
    this.open(Object.hasOwn(this.tabs, wanted) && !$(`tab-${wanted}`).hidden ? wanted : "here");
    this.write();
  }

  /** Ask of a map, or of all where the name is empty. */
  async choose(name = "", { told = new URLSearchParams(), afresh = false } = {}) {
    const { cities, scenes } = this.stage, city = cities.find((map) => map.name === name) ?? cities[0];
    $("city").value = this.scope = name;
    if (afresh) this.tab?.leave?.();
    if (city && (name || !this.stage.name)) await this.stage.city(city.name);
    else if (!city && scenes[0]) await this.stage.open(scenes[0]);
    this.you.read(told);
    this.tabs.here.read(told);
    if (!afresh) return;
    this.open(this.name);
    this.write();
  }

  source() {
    const { index, cityName } = this.stage, all = this.maps.length > 1 ? `, one of ${this.maps.length} maps` : "";
    $("source").textContent = index ? `Map of ${title(cityName)}: ${index.objects.toLocaleString("en")} objects${all}.` : "";
  }

  /** A building was entered: images that are taken now are of it. */
  entered(plan) { this.tabs.inside.stand(plan.map); }

  /** Take what was typed; what was told before the page was ready is taken then. */
  tell() {
    this.told = !this.tab;
    this.tab?.tell?.();
  }

  open(name) {
    const early = this.tab ? "" : this.text;
    if (this.name !== name) this.tab?.leave?.();
    this.name = name;
    this.tab = this.tabs[name];
    for (const tab of document.querySelectorAll("[data-tab]")) {
      const on = tab.dataset.tab === name;
      tab.setAttribute("aria-selected", String(on));
      tab.tabIndex = on ? 0 : -1;
      if (on) $("panel").setAttribute("aria-label", tab.textContent);
    }
    document.body.dataset.way = name;
    this.tab.enter();
    if (early) {
      this.text = early;
      this.tab.typed?.();
      if (this.told) this.tell();
    }
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
    if (this.scope) hash.set("map", this.scope);
    if (this.name && this.name !== "here") hash.set("tab", this.name);
    if (this.name === "inside") this.tabs.inside.write(hash);
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
    this.dress(this.dark ? "light" : "dark");
  }

  dress(theme) {
    matchMedia("(prefers-color-scheme: dark)").onchange ??= () => this.stage.recolour();
    if (!theme) return;
    document.documentElement.dataset.theme = theme;
    sessionStorage.setItem("theme", theme);
    this.view.map.recolour();
    this.stage.recolour();
  }

  /** Show at once that an answer is on its way. */
  wait(on) {
    document.body.toggleAttribute("data-busy", on);
    $("panel").setAttribute("aria-busy", String(on));
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
    return el("div", { class: "problem", role: "alert" }, el("b", {}, error.message), error.mend ? ` ${error.mend}` : "");
  }

  keyhole() {
    const field = el("input", { type: "password", "aria-label": "Key", autocomplete: "off" });
    const use = () => { this.tried = true; useKey(field.value.trim()); this.start(); };
    field.addEventListener("keydown", (event) => { if (event.key === "Enter") use(); });
    return el("div", { class: "problem" }, el("b", {}, this.tried ? "The key is not valid." : "This server needs a key."),
      el("div", { class: "key" }, field, button(null, { class: "act", onclick: use }, "Use it")));
  }
}

const app = new App();
app.start();
