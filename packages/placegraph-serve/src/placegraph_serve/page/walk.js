// On the way: what is said from place to place, as one session of the server.

import { call } from "./api.js";
import { button, el } from "./parts/base.js";
import { chipRow } from "./you.js";
import { evidence, places, question, verdict } from "./parts/panel.js";

export class Walk {
  constructor(app) {
    this.app = app;
    this.forget();
  }

  forget() { this.session = this.result = this.error = null; this.log = []; }

  enter() {
    document.getElementById("text-label").textContent = "What do you see now, or how far did you walk?";
    document.getElementById("text").placeholder = "What do you see now? “I walked 100 metres south.”";
    document.getElementById("go").hidden = false;
    this.app.text = "";
    if (this.result) this.app.view.show(this.result);
  }

  leave() {
    this.app.view.show(null, { move: false });
    if (this.session && this.app.scope !== this.scope) this.end();
  }

  end() {
    if (this.session) call(`v1/sessions/${this.session}`, { method: "DELETE" }).catch(() => {});
    this.forget();
  }

  sensed() { this.render(); }

  typed() { document.getElementById("clear").hidden = !this.app.text; }

  clear() { this.app.text = ""; }

  tell() {
    const text = this.app.text.trim();
    if (text) this.send({ text }, text);
  }

  reply(option) {
    const { text, options, things } = this.result.question;
    this.send({ answers: [{ question: { text, options, things }, option }] }, `${text} ${option}`);
    document.getElementById("panel").focus({ preventScroll: true });
  }

  async send(step, words) {
    if (this.busy) return;
    this.busy = true;
    this.error = null;
    this.render();
    try {
      if (!this.session || this.scope !== this.app.scope) {
        this.forget();
        this.scope = this.app.scope;
        const map = this.scope ? { map: this.scope } : {}; // without one, all are asked
        this.session = (await call("v1/sessions", { json: { ...map, ...this.app.you.known } })).session;
      }
      this.result = await call(`v1/sessions/${this.session}`, { json: step });
      this.log.push(words);
      if (step.text) this.app.text = "";
      if (this.app.tab === this) this.app.view.show(this.result);
      this.app.announce(this.result.estimate.reason);
    } catch (error) {
      if ([404, 410].includes(error.status)) this.session = null; // it has run out: the next begins anew
      this.error = error;
    }
    this.busy = false;
    if (this.app.tab === this) this.render();
  }

  render() {
    const { app, result, log } = this;
    const told = log.length ? el("section", { class: "log", "aria-label": "What was said" }, el("h2", {}, "On the way"),
      el("ol", {}, log.map((text) => el("li", {}, el("bdi", {}, text)))),
      button(null, { class: "act", onclick: () => { this.end(); app.view.show(null, { move: false }); this.render(); } }, "Start again"))
      : el("p", { class: "reason" }, "Describe what you see, walk on, and describe it again: “I am on a square with a fountain.” "
        + "“I walked about 100 metres south.” Each sentence makes the place clearer.");
    const mode = result?.estimate.modes[app.view.selected];
    app.show(chipRow(app.you.chips()), told, this.busy ? el("p", { class: "busy", role: "status" }, "Thinking …") : null,
      this.error ? app.problem(this.error) : null, result ? verdict(result.estimate) : null, result ? question(result.question, (option) => this.reply(option)) : null,
      result ? places(result, app.view.selected, (k) => app.view.select(k)) : null,
      mode ? evidence(mode, app.view.selected, app.hands) : null);
  }
}
