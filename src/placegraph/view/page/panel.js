// What an estimate says, in words and bars.

import { button, commonName, el, factor, osmLink, osmPlace, spread, tidy } from "./base.js";

const FULL_BAR = 5, FAINTEST = 0.01;
const WINDS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];
const VERDICTS = { for: ["✓", "speaks for it"], against: ["✕", "speaks against it"] };
const RELATIONS = { visible: "in sight of", same: "at", across: "across from", direction: "in some direction from" };
export const STATUS = { OK: "Found", AMBIGUOUS: "Not sure yet", LOST: "Lost" };

const link = (href, ...children) =>
  href && el("a", { href, target: "_blank", rel: "noopener noreferrer", class: "osm" }, ...children);

/** The text as it was said; what was ignored is struck out. */
export function said(understood) {
  if (!understood?.text?.trim()) return null;
  const quote = el("blockquote");
  let rest = 0;
  for (const { text } of understood.ignored) {
    const start = text ? understood.text.indexOf(text, rest) : -1;
    if (start < 0) continue;
    quote.append(tidy(understood.text.slice(rest, start)), el("s", {}, text));
    rest = start + text.length;
  }
  quote.append(tidy(understood.text.slice(rest)));
  return quote;
}

export function verdict({ status, reason }) {
  return el("p", { class: "reason" }, el("span", { class: `status ${status}`, title: status }, STATUS[status] ?? status),
    " ", reason);
}

/** The modes, each with what is known of it; those that hardly count are only counted. */
export function places({ estimate, ranked }, selected, select) {
  const { modes } = estimate;
  if (!modes.length) return null;
  const counts = (mode, k) => ranked || k === 0 || k === selected || mode.probability >= FAINTEST;
  const rows = modes.map((mode, k) => (counts(mode, k) ? el("li", {},
    button(null, { class: "mode", "data-mode": k, "aria-pressed": String(k === selected), onclick: () => select(k) },
      el("span", { class: "number", "aria-hidden": "true" }, String(k + 1)),
      ranked ? null : share(mode.probability),
      named(mode) ? el("bdi", { class: "named" }, named(mode)) : null,
      el("span", { class: "where" }, measured(mode))),
    linked(mode, k)) : null));
  const left = rows.filter((row) => !row).length;
  return el("section", { "aria-label": "Places" }, el("h2", {}, "Places"), el("ol", { class: "modes" }, rows),
    left ? el("p", { class: "note" }, `and ${left} more below ${100 * FAINTEST} % each`) : null);
}

/** Room, building and floor of a mode, as far as they are known. */
export function named(mode) {
  const on = (mode.pose ?? mode).earth?.[0] ?? {}, level = mode.level || on.level;
  const rooms = mode.room || on.room, house = mode.building || on.building;
  return [rooms, house, level && `floor ${level}`, house && rooms ? "" : mode.scene].filter(Boolean).join(", ");
}

function measured(mode) {
  const pose = mode.pose ?? (mode.map_from_camera ? mode : null);
  const size = (metres) => (metres < 1 ? `± ${(100 * metres).toFixed(0)} cm` : `± ${metres.toFixed(metres < 10 ? 1 : 0)} m`);
  if (pose) {
    const yaw = `${pose.yaw_deg.toFixed(0)}°`.replace("-", "−");
    return `x ${pose.x.toFixed(2)}, y ${pose.y.toFixed(2)}, z ${pose.z.toFixed(2)} m · ${yaw} · ${size(spread(pose.covariance)).replaceAll(" ", "\u00a0")}`;
  }
  if (!Number.isFinite(mode.longitude)) return "";
  return `${mode.latitude.toFixed(5)}, ${mode.longitude.toFixed(5)} · ± ${spread(mode.covariance).toFixed(0)} m`;
}

function linked(mode, k) {
  const spot = (mode.pose ?? mode).earth?.[0] ?? mode;
  if (!Number.isFinite(spot.longitude)) return null;
  return link(osmPlace(spot.latitude, spot.longitude), el("span", { "aria-hidden": "true" }, "OSM ↗"),
    el("span", { class: "hidden" }, `Place ${k + 1} on OpenStreetMap`));
}

export function share(probability) {
  const percent = probability >= 0.01 ? (100 * probability).toFixed(0) : "<1";
  return el("span", { class: "share" }, el("b", {}, `${percent} %`), bar(probability));
}

function bar(probability) {
  return el("span", { class: "bar" }, el("i", { style: { width: `${100 * Math.min(1, probability)}%` } }));
}

/** Why a mode: each statement with its verdict, weight and objects. `light(ids)` shows them on the map. */
export function evidence(mode, k, { light, go, linked = true }) {
  const rows = mode.evidence.map((e) => {
    const [mark, words] = VERDICTS[e.verdict] ?? ["–", "says nothing about it"];
    const agrees = e.verdict !== "against" || e.weight <= 0; // a rare object may speak for a place and lie the other way
    const title = agrees ? `${words}: ${factor(e.weight)} than anywhere` : words, ids = e.objects.map((object) => object.id);
    const touch = ids.length ? { onpointerenter: () => light(ids), onpointerleave: () => light([]) } : {};
    return el("li", { class: VERDICTS[e.verdict] ? e.verdict : "silent", "data-ids": ids.join(" "), ...touch },
      el("span", { class: "verdict", role: "img", "aria-label": words }, mark),
      el("span", { class: "statement" }, e.statement),
      el("span", { class: "weight", role: "img", "aria-label": title, title },
        el("i", { style: { [e.weight >= 0 ? "left" : "right"]: "50%", width: `${agrees ? 50 * Math.min(1, Math.abs(e.weight) / FULL_BAR) : 0}%` } })),
      e.note ? el("p", { class: "note" }, e.note) : null,
      ids.length ? el("ul", {}, e.objects.map((object) => thing(object, { light, go, linked }))) : null);
  });
  return el("section", { class: "evidence", "aria-label": `Why place ${k + 1}` },
    el("h2", {}, `Why place ${k + 1}`),
    rows.length ? el("ul", {}, rows) : el("p", { class: "note" }, "The description contains nothing that can be compared with the map."));
}

function thing(object, { light, go, linked }) {
  const name = object.name || commonName(object.label ?? "");
  return el("li", {},
    button(null, { class: "object", onclick: () => { light([object.id]); go(object); }, onfocus: () => light([object.id]), onblur: () => light([]) },
      el("bdi", {}, name), " ", el("small", {}, object.label)),
    linked ? link(osmLink(object.id), el("span", { class: "hidden" }, "OpenStreetMap: "), object.id) : null);
}

/** How the text was read, and what was left. */
export function understanding(understood, open = false) {
  if (!understood) return null;
  const { mentions = [], statements = [], conflicts = [], outside = [], inside = [], ignored } = understood;
  const known = new Map(mentions.map((mention) => [mention.id, mention])), quoted = (text) => el("li", {}, el("q", {}, text));
  const blocks = [
    ["Contradictions", conflicts.map((sentence) => el("li", {}, sentence))],
    ["Statements", statements.map((s) => el("li", {}, reading(s, known)))],
    ["Things", mentions.filter(({ id }) => id > 1).map(mention)],
    ["About the surroundings", outside.map(quoted)],
    ["About rooms", inside.map(quoted)],
    ["Ignored", ignored.map((i) => el("li", {}, el("q", {}, i.text), " ", el("small", {}, i.reason)))],
  ].filter(([, rows]) => rows.length);
  return el("details", { class: "understood", open }, el("summary", {}, "What was understood"),
    blocks.length ? blocks.flatMap(([head, rows]) => [el("h3", {}, head), el("ul", {}, rows)]) : el("p", {}, "Nothing."));
}

function mention({ words, name, senses }) {
  const shown = senses.slice(0, 6).map((sense) => el("span", { class: "sense" },
    sense.label, sense.weight < 0.995 ? ` ${(100 * sense.weight).toFixed(0)} %` : ""));
  return el("li", {}, el("q", {}, words), " ", name ? el("span", { class: "sense name" }, name) : null, shown,
    senses.length > 6 ? el("small", {}, `and ${senses.length - 6} more`) : null,
    name || senses.length ? null : el("small", {}, "unknown"));
}

/** Words for a statement as it was read: "a bakery: north of me, about 30 m". */
export function reading(statement, mentions) {
  const words = (node) => {
    if (node === 0) return "me";
    if (node === 1) return "you";
    const known = mentions.get(node);
    return known ? known.name || known.words : "something";
  };
  let target = words(statement.target);
  if (statement.target2 !== null) target += ` and ${words(statement.target2)}`;
  let relation = RELATIONS[statement.relation] ?? statement.relation;
  if (statement.bearing !== null) relation = `${WINDS[(Math.round(statement.bearing / (Math.PI / 4)) + 8) % 8]} of`;
  const about = statement.distance !== null ? `, about ${statement.distance.toFixed(0)} m` : "";
  return `${words(statement.source)}: ${statement.negated ? "not " : ""}${relation} ${target}${about}`;
}

/** The question that would help most, with its answers as buttons where one can answer. */
export function question(asked, answer) {
  if (!asked) return null;
  const options = answer ? [...asked.options, "don't know"] : [];
  return el("section", { class: "ask", "aria-label": "Question" },
    el("h2", {}, answer ? "To be sure" : "To be more certain, please answer"), el("p", {}, asked.text),
    options.length ? el("div", { class: "options" }, options.map((option) =>
      button(null, { onclick: () => answer(option) }, el("bdi", {}, option)))) : null);
}
