// Inside: images of a room, and the pose they were taken from on the plan of its scene.

import { call, mapPath, picture } from "./api.js";
import { button, el } from "./parts/base.js";
import { share, verdict } from "./parts/panel.js";

const CAPTIONS = {
  plan: "The pose on the plan, with every place that fits", overlay: "The map laid over your image",
  animation: "How the particles gathered",
};

export class Inside {
  constructor(app) {
    this.app = app;
    this.scenes = [];
    this.images = [];
  }

  enter() {
    this.chosen ??= this.scenes[0];
    this.plan();
  }

  leave() { this.request?.abort(); }

  choose(scene) {
    this.chosen = scene;
    this.result = this.error = null;
    this.plan();
    this.render();
  }

  async plan() {
    const scene = this.chosen;
    if (!scene || scene.kind !== "scene" || scene.plan) return;
    scene.plan = "asked";
    try { scene.plan = await picture(mapPath(scene.name, "plan.png")); } catch { scene.plan = null; }
    if (this.app.tab === this && this.chosen === scene) this.render();
  }

  take(files) {
    this.images.forEach(({ url }) => URL.revokeObjectURL(url));
    this.images = [...files].slice(0, 12).map((file) => ({ file, url: URL.createObjectURL(file) }));
    this.result = this.error = null;
    if (this.images.length) this.localize();
    else this.render();
  }

  async localize() {
    this.request?.abort();
    this.request = new AbortController();
    const form = new FormData(), { app } = this, { near, radius } = app.you.known;
    for (const { file } of this.images) form.append(/\.zip$/i.test(file.name) ? "capture" : "images", file);
    form.append("request", JSON.stringify({
      map: this.chosen.name, pictures: ["plan", "overlay", "animation"],
      ...(this.words?.trim() ? { description: this.words.trim() } : {}),
      ...(near && this.chosen.anchored ? { near, radius } : {}),
    }));
    this.busy = true;
    this.error = this.result = null;
    this.render();
    try {
      this.result = await call("v1/localize", { form, signal: this.request.signal });
      app.announce(this.result.estimate.reason);
    } catch (error) {
      if (error.name === "AbortError") return;
      this.error = error;
    }
    this.busy = false;
    if (app.tab === this) this.render();
  }

  render() {
    const { app, scenes, chosen, result } = this;
    if (!chosen) { app.show(el("p", { class: "reason" }, "This server has no map of rooms.")); return; }
    const list = el("section", { "aria-label": "Rooms" }, el("h2", {}, "Where"), el("div", { class: "scenes" },
      scenes.map((scene) => button(null, { "aria-pressed": String(scene === chosen), onclick: () => this.choose(scene) },
        el("bdi", {}, scene.name), el("small", {}, `${scene.objects.toLocaleString("en")} ${scene.kind === "library" ? "scenes" : "objects"}${scene.anchored ? " · on the map" : ""}`)))));
    app.show(this.drop(), this.error ? app.problem(this.error) : null,
      this.busy ? el("p", { class: "busy", role: "status" }, "Looking for where this was taken …") : null,
      result ? this.told(result) : null, scenes.length > 1 ? list : null, this.planned(chosen));
  }

  planned(scene) {
    if (this.result?.pictures?.plan || !scene.plan || scene.plan === "asked") return null;
    return el("section", { class: "pictures", "aria-label": "Plan" }, el("h2", {}, scene.name),
      figure(scene.plan, `The plan of ${scene.name}`));
  }

  drop() {
    const files = (label, more) => el("label", { class: `act${more.capture ? " first" : ""}` }, label,
      el("input", { type: "file", accept: more.capture ? "image/*" : "image/*,.zip", multiple: true, ...more, onchange: ({ target }) => this.take(target.files) }));
    const words = el("input", { type: "text", class: "words", dir: "auto", placeholder: "and what you see, in words", "aria-label": "What you see, in words",
      value: this.words ?? "", oninput: ({ target }) => { this.words = target.value; } });
    const box = el("div", { class: "drop",
      ondragover: (event) => { event.preventDefault(); box.classList.add("over"); },
      ondragleave: () => box.classList.remove("over"),
      ondrop: (event) => { event.preventDefault(); this.take(event.dataTransfer.files); } },
    files("Take a picture", { capture: "environment" }), files("Choose images", {}),
    el("p", { class: "note" }, "One picture of the room will do; several as you walk are better. The camera's focal length is read from the image."),
    el("div", { class: "key" }, words),
    this.images.length ? el("div", { class: "thumbs" }, this.images.map(({ url, file }) => el("img", { src: url, alt: file.name }))) : null,
    this.images.length && !this.busy ? button(null, { class: "act", onclick: () => this.localize() }, "Look again") : null);
    return box;
  }

  told({ estimate, pictures = {}, geopose }) {
    const modes = estimate.modes.map((mode, k) => el("li", {}, el("div", { class: "mode" },
      el("span", { class: "number", "aria-hidden": "true" }, String(k + 1)), share(mode.probability),
      el("span", { class: "where" }, where(mode)))));
    const drawn = Object.entries(CAPTIONS).filter(([name]) => pictures[name]);
    return [verdict(estimate), el("section", { "aria-label": "Poses" }, el("h2", {}, "Poses"), el("ol", { class: "modes" }, modes)),
      drawn.length ? el("section", { class: "pictures", "aria-label": "Pictures" },
        drawn.map(([name, caption]) => figure(pictures[name], caption))) : null,
      geopose ? el("details", {}, el("summary", {}, "GeoPose"), el("pre", {}, JSON.stringify(geopose, null, 1))) : null];
  }
}

function where(mode) {
  const spot = mode.earth?.[0], metres = Math.sqrt(Math.max(mode.covariance?.[0]?.[0] ?? 0, mode.covariance?.[1]?.[1] ?? 0));
  const size = metres < 1 ? `± ${(100 * metres).toFixed(0)} cm` : `± ${metres.toFixed(1)} m`;
  const at = mode.x === undefined ? mode.scene
    : `${mode.scene}: x ${mode.x.toFixed(2)}, y ${mode.y.toFixed(2)}, z ${mode.z.toFixed(2)} m · ${mode.yaw_deg.toFixed(0)}° · ${size}`;
  return [at, spot && [spot.building, spot.level && `floor ${spot.level}`, spot.room].filter(Boolean).join(", ")].filter(Boolean).join(" · ");
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
