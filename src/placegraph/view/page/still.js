// A page that is one file: an estimate on its map, with the tiles that it needs beside it.

import { AnswerMap } from "./answer.js";
import { el } from "./base.js";
import { evidence, places, question, said, understanding, verdict } from "./panel.js";

const { index, tiles, answer } = JSON.parse(document.getElementById("data").textContent);
const panel = document.getElementById("answer");
const view = new AnswerMap(document.querySelector(".map"), { changed: () => tell() });
const hands = { light: (ids) => view.light(ids), go: (object) => view.go(object) };

function tell() {
  const { estimate } = answer, mode = estimate.modes[view.selected];
  panel.replaceChildren(...[
    said(estimate.understood), verdict(estimate), question(answer.question),
    places(answer, view.selected, (k) => view.select(k)),
    mode ? evidence(mode, view.selected, hands) : null, understanding(estimate.understood, true),
  ].filter(Boolean));
}

view.city(index, (level, x, y) => Promise.resolve(tiles[`${level}/${x}/${y}`]));
view.touched = (id) => lightRow(panel, id);
view.show(answer);
tell();

function lightRow(within, id) {
  for (const row of within.querySelectorAll("[data-ids]")) {
    const on = Boolean(id) && row.dataset.ids.split(" ").includes(id);
    row.classList.toggle("on", on);
    if (on) row.scrollIntoView({ block: "nearest" });
  }
}
