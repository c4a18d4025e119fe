// Inside: images of a room, and the pose they were taken from on the plan of its scene.

import { call } from "./api.js";
import { chipRow } from "./you.js";
import { button, el, title } from "./parts/base.js";
import { evidence, places, verdict } from "./parts/panel.js";

const CAPTIONS = { overlay: "Map drawn over your image", animation: "Particles during the search" };
const ANYWHERE = { name: "", kind: "world" };

export class Inside {
  constructor(app) {
    this.app = app;
    this.scenes = [];
    this.images = [];
  }

  /** Maps of rooms that there are; the one that the link names is chosen. */
  use(scenes, told) {
    this.scenes = scenes.length > 1 ? [ANYWHERE, ...scenes] : scenes;
    this.chosen = scenes.find(({ name }) => name === told) ?? this.scenes[0];
  }

  write(hash) { if (this.chosen?.name) hash.set("scene", this.chosen.name); }

  enter() {
    if (this.result) this.app.view.show(this.result);
    else this.look();
  }

  leave() {
    this.request?.abort();
    this.busy = false;
    this.app.view.show(null, { move: false });
  }

  sensed() { this.render(); }

  choose(scene) {
    this.stand(scene.name);
    this.app.view.show(null, { move: false });
    this.look();
    this.render();
    this.app.write();
  }

  /** Somebody went into a scene: it is meant from now on. */
  stand(name) {
    const scene = this.scenes.find((known) => known.name === name);
    if (!scene || scene === this.chosen || (this.result && this.app.tab === this && name)) return;
    this.chosen = scene;
    this.result = this.error = null;
    if (this.app.tab === this) { this.render(); this.app.write(); }
  }

  /** Show the plan of the scene that was chosen. */
  async look() {
    const { stage } = this.app, { chosen } = this;
    if (chosen?.kind !== "scene") return;
    try {
      const plan = await stage.open(chosen);
      if (this.chosen === chosen && this.app.tab === this && !this.result) await stage.enter(plan);
    } catch (error) { this.app.trouble(error); }
  }

  take(files) {
    this.images.forEach(({ url }) => URL.revokeObjectURL(url));
    this.images = [...files].slice(0, 8).map((file) => ({ file, url: URL.createObjectURL(file), zip: /\.zip$/i.test(file.name) }));
    if (this.images.length) this.localize();
  }

  async localize() {
    this.request?.abort();
    const request = this.request = new AbortController(), form = new FormData(), { app, chosen } = this;
    for (const { file, zip } of this.images) form.append(zip ? "capture" : "images", file);
    form.append("request", JSON.stringify({
      ...(chosen.name ? { map: chosen.name } : {}), pictures: ["overlay", "animation"],
      ...(this.words?.trim() ? { description: this.words.trim() } : {}), ...app.you.known,
    }));
    this.busy = true;
    this.error = this.result = null;
    app.view.show(null, { move: false });
    this.render();
    try {
      const result = await call("v1/localize", { form, signal: request.signal });
      if (request !== this.request) return;
      this.result = result;
      app.announce(result.estimate.reason);
    } catch (error) {
      if (error.name === "AbortError") return;
      this.error = error;
    }
    this.busy = false;
    if (app.tab !== this) return;
    if (this.result) app.view.show(this.result);
    this.render();
  }

  render() {
    const { app, chosen, result } = this;
    if (!chosen) { app.show(el("p", { class: "reason" }, "This server has no map of rooms.")); return; }
    app.show(chipRow(app.you.chips()), this.drop(), this.error ? app.problem(this.error) : null,
      this.busy ? el("p", { class: "busy", role: "status" }, "Localizing the images …") : null,
      result ? this.told(result) : null, this.scenes.length > 1 ? this.list() : null);
  }

  list() {
    const stands = ([anchor]) => [anchor.level && `floor ${anchor.level}`, this.app.stage.town(anchor)].filter(Boolean).join(", ");
    const facts = ({ kind, objects, anchors = [] }) => (anchors.length ? stands(anchors)
      : `${objects.toLocaleString("en")} ${kind === "library" ? "scenes" : "objects"}`);
    return el("section", { "aria-label": "Rooms" }, el("h2", {}, "Where"), el("div", { class: "scenes" },
      this.scenes.map((scene) => button(null, { "aria-pressed": String(scene === this.chosen), onclick: () => this.choose(scene) },
        el("bdi", {}, scene.anchors?.[0]?.building || title(scene.name) || "Anywhere"), el("small", {}, el("bdi", {}, scene === ANYWHERE ? "all maps of rooms" : facts(scene)))))));
  }

  drop() {
    const files = (label, more) => el("label", { class: `act${more.capture ? " first" : ""}` }, label,
      el("input", { type: "file", accept: more.capture ? "image/*" : "image/*,.zip", multiple: true, ...more, onchange: ({ target }) => this.take(target.files) }));
    const words = el("input", { type: "text", class: "words", dir: "auto", placeholder: "and what you see, in words", "aria-label": "What you see, in words",
      value: this.words ?? "", maxlength: 2000, oninput: ({ target }) => { this.words = target.value; } });
    const box = el("div", { class: "drop",
      ondragover: (event) => { event.preventDefault(); box.classList.add("over"); },
      ondragleave: () => box.classList.remove("over"),
      ondrop: (event) => { event.preventDefault(); this.take(event.dataTransfer.files); } },
    files("Take a picture", { capture: "environment" }), files("Choose images", {}),
    this.images.length ? null : el("p", { class: "note" }, "One image of the room is enough; several taken while walking are better. The camera's focal length is read from the image."),
    el("div", { class: "key" }, words),
    this.images.length ? el("div", { class: "thumbs" }, this.images.map(({ url, file, zip }) => (zip ? el("bdi", {}, file.name) : el("img", { src: url, alt: file.name })))) : null,
    this.images.length && !this.busy ? button(null, { class: "act", onclick: () => this.localize() }, "Look again") : null);
    return box;
  }

  told(result) {
    const { estimate, pictures = {}, geopose, notes = [] } = result, { view } = this.app, mode = estimate.modes[view.selected];
    const drawn = Object.entries(CAPTIONS).filter(([name]) => pictures[name]);
    return [verdict(estimate), notes.map((note) => el("p", { class: "note" }, note)),
      places(result, view.selected, (k) => view.select(k)), mode ? evidence(mode, view.selected, this.app.hands) : null,
      drawn.length ? el("section", { class: "pictures", "aria-label": "Pictures" },
        drawn.map(([name, caption]) => figure(pictures[name], caption))) : null,
      geopose ? el("details", {}, el("summary", {}, "GeoPose"), el("pre", {}, JSON.stringify(geopose, null, 1))) : null].flat();
  }
}

function figure(src, caption) {
  const image = el("img", { src, alt: caption, loading: "lazy" });
  const large = () => {
    const dialog = el("dialog", { "aria-label": caption, onclick: () => dialog.close(), onclose: () => dialog.remove() }, el("img", { src, alt: caption }));
    document.body.append(dialog);
    dialog.showModal();
  };
  return el("figure", {}, button(`Enlarge: ${caption}`, { onclick: large, style: { display: "block", width: "100%" } }, image), el("figcaption", {}, caption));
}
