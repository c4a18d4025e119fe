// One place, told in one go and by answers to questions: the posterior while one types.

import { Live } from "./api.js";
import { chipRow } from "./you.js";
import { button, el } from "./parts/base.js";
import { evidence, places, question, said, STATUS, understanding, verdict } from "./parts/panel.js";

const REST = 700;

export class Here {
  constructor(app) {
    this.app = app;
    this.answers = [];
    this.text = "";
    this.live = new Live((result) => this.answered(result), (error) => this.failed(error));
  }

  read(hash) {
    this.text = hash.get("q") ?? (this.app.tab ? "" : this.app.text); // typed while the page was being made
    this.answers = [];
    try {
      const told = JSON.parse(hash.get("answers") ?? "[]");
      this.answers = told.filter(({ question: asked, option }) => asked?.text && option);
    } catch { /* a link cut short has no answers */ }
    this.result = this.error = null;
  }

  write(hash) {
    if (this.text.trim()) hash.set("q", this.text.trim());
    if (this.answers.length) hash.set("answers", JSON.stringify(this.answers));
  }

  enter() {
    document.getElementById("text-label").textContent = "What is around you?";
    document.getElementById("text").placeholder = "What do you see around you?";
    document.getElementById("go").hidden = true;
    this.app.text = this.text;
    if (this.result) this.app.view.show(this.result);
    else if (this.text.trim()) this.ask(true);
  }

  leave() {
    this.live.forget();
    this.app.wait(false);
    this.app.view.show(null, { move: false });
  }

  typed() {
    const { text } = this.app;
    document.getElementById("clear").hidden = !text;
    if (!text.trim()) { this.clear(); return; }
    if (text.trim() !== this.text.trim()) this.answers = []; // they were given to another text
    this.text = text;
    this.ask(false);
  }

  tell() { if (this.text.trim()) this.ask(true); }

  sensed() {
    if (this.text.trim()) this.ask(false);
    else this.render();
    this.app.write();
  }

  clear() {
    this.live.forget();
    this.text = this.app.text = "";
    this.answers = [];
    this.result = this.error = null;
    this.app.wait(false);
    this.app.view.show(null, { move: false });
    this.app.write();
    this.render();
  }

  ask(now) {
    this.going = now;
    this.app.wait(true);
    this.live.ask({
      text: this.text, ...(this.app.scope ? { map: this.app.scope } : {}), ...this.app.you.known,
      ...(this.answers.length ? { answers: this.answers } : {}),
    });
    clearTimeout(this.rest);
    this.app.view.map.byHand = this.rested = false;
    this.rest = setTimeout(() => {
      this.rested = true;
      if (this.result && this.app.tab === this && !this.app.view.map.byHand) this.app.view.home();
      this.app.write();
    }, REST);
  }

  answered(result) {
    if (this.app.tab !== this) return;
    const told = JSON.stringify([this.text, this.answers]);
    const move = this.going || (this.rested && !this.app.view.map.byHand); // it comes late
    this.app.view.show(result, { move, stay: Boolean(this.result) && told === this.told });
    Object.assign(this, { result, told, error: null });
    this.going = false;
    this.render();
    this.app.wait(false);
    const { status, modes, reason } = result.estimate, n = modes.length;
    this.app.announce(`${STATUS[status]}. ${reason} ${n} place${n === 1 ? "" : "s"}.`
      + (result.question ? ` ${result.question.text}` : ""));
  }

  failed(error) {
    this.app.wait(false);
    if (error.status === 401) { this.app.trouble(error); return; }
    this.error = error;
    this.result = null; // it was the answer to something else
    this.app.view.show(null, { move: false });
    this.render();
  }

  reply(option) {
    const { text, options, things } = this.result.question;
    this.answers = [...this.answers, { question: { text, options, things }, option }];
    this.ask(true);
    document.getElementById("panel").focus({ preventScroll: true });
  }

  take(k) {
    this.answers = this.answers.filter((_, i) => i !== k);
    this.ask(true);
  }

  render() {
    const { app, result, answers } = this;
    const chips = [...app.you.chips(), ...answers.map(({ question: asked, option }, k) =>
      button(null, { class: "chip", title: `${asked.text} Take the answer back.`, onclick: () => this.take(k) },
        el("bdi", {}, short(asked.text)), " ", el("b", {}, el("bdi", {}, option))))];
    if (this.error) { app.show(chipRow(chips), app.problem(this.error)); return; }
    if (!result) { app.show(chipRow(chips), this.examples()); return; }
    const { estimate } = result, mode = estimate.modes[app.view.selected];
    const struck = estimate.understood?.ignored?.length ? said(estimate.understood) : null;
    app.show(chipRow(chips), struck, verdict(estimate), question(result.question, (option) => this.reply(option)),
      places(result, app.view.selected, (k) => app.view.select(k)),
      mode ? evidence(mode, app.view.selected, app.hands) : null, understanding(estimate.understood));
  }

  examples() {
    const texts = this.app.stage.index?.examples ?? [];
    if (!texts.length) return null;
    return el("section", { class: "examples", "aria-label": "Examples" }, el("h2", {}, "For example"),
      texts.map((text) => button(null, { onclick: () => { this.app.text = this.text = text; this.answers = []; this.ask(true); } },
        el("bdi", {}, text))));
  }
}

const short = (text) => (text.length > 48 ? `${text.slice(0, 48).replace(/\s\S*$/, "")} …` : text);
