// What an estimate says, in words and bars.

import { button, commonName, el, osmLink, osmPlace, spread, tidy, title } from "./base.js";
import { posed } from "./marks.js";

const FULL_BAR = 5, FAINTEST = 0.01;
const WINDS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];
const VERDICTS = { for: ["✓", "speaks for it"], against: ["✕", "speaks against it"] };
const STRENGTHS = [[3, "strongly"], [1, "clearly"], [0, "slightly"]];
const RELATIONS = { visible: "in sight of", same: "at", inside: "in", along: "on", across: "across from", direction: "in some direction from" };
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
      el("bdi", { class: "named" }, named(mode)),
      el("span", { class: "where" }, precision(mode))),
    k === selected ? coordinates(mode, k) : null) : null));
  const left = rows.filter((row) => !row).length, shown = modes.reduce((sum, mode, k) => sum + (rows[k] ? mode.probability : 0), 0);
  const rest = 100 * (1 - shown), more = [left && `${left} more`, left ? "and elsewhere" : "elsewhere"].filter(Boolean).join(", ");
  return el("section", { "aria-label": "Places" }, el("h2", {}, "Places"), el("ol", { class: "modes" }, rows),
    ranked || rest < 0.5 ? null : el("p", { class: "note rest" }, `${more}: ${rest.toFixed(0)} %`));
}

/** Room, building and floor, or street and what is near; and the town, as far as they are known. */
export function named(mode) {
  const on = (mode.pose ?? mode).earth?.[0] ?? {}, level = mode.level || on.level, house = mode.building || on.building;
  const outdoors = mode.address?.includes(house) ? mode.address : house || mode.address;
  const parts = mode.scene ? [mode.room || on.room, house || title(mode.scene), level && `floor ${level}`] : [outdoors];
  const known = [...parts, mode.town].filter(Boolean).join(", ");
  return known || (Number.isFinite(mode.latitude) ? `${mode.latitude.toFixed(5)}, ${mode.longitude.toFixed(5)}` : "");
}

function precision(mode) {
  const metres = spread((posed(mode) ?? mode).covariance ?? [[NaN], [, NaN]]);
  if (!Number.isFinite(metres)) return "";
  return metres < 1 ? `± ${(100 * metres).toFixed(0)} cm` : `± ${metres.toFixed(metres < 10 ? 1 : 0)} m`;
}

/** Coordinates of a mode, on Earth and in its room, behind a tap. */
function coordinates(mode, k) {
  const pose = posed(mode), { longitude, latitude } = (mode.pose ?? mode).earth?.[0] ?? mode, known = Number.isFinite(longitude);
  const inside = pose && `x ${pose.x.toFixed(2)}, y ${pose.y.toFixed(2)}, z ${pose.z.toFixed(2)} m, ${pose.yaw_deg.toFixed(0)}°`.replaceAll("-", "−");
  if (!known && !pose) return null;
  return el("details", { class: "coordinates" }, el("summary", {}, "Coordinates"),
    known ? el("p", {}, `${latitude.toFixed(5)}, ${longitude.toFixed(5)} `, onMap(osmPlace(latitude, longitude), `Place ${k + 1}`)) : null,
    pose ? el("p", {}, inside) : null);
}

const onMap = (href, name) => link(href, el("span", { "aria-hidden": "true" }, "OSM ↗"), el("span", { class: "hidden" }, `${name} on OpenStreetMap`));

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
    const [, strength] = STRENGTHS.find(([least]) => Math.abs(e.weight) >= least);
    const hint = agrees && VERDICTS[e.verdict] ? words.replace(" ", ` ${strength} `) : words, ids = e.objects.map((object) => object.id);
    const touch = ids.length ? { onpointerenter: () => light(ids), onpointerleave: () => light([]) } : {};
    return el("li", { class: VERDICTS[e.verdict] ? e.verdict : "silent", "data-ids": ids.join(" "), ...touch },
      el("span", { class: "verdict", role: "img", "aria-label": words }, mark),
      el("span", { class: "statement" }, e.statement),
      el("span", { class: "weight", role: "img", "aria-label": hint, title: hint },
        el("i", { style: { [e.weight >= 0 ? "left" : "right"]: "50%", width: `${agrees ? 50 * Math.min(1, Math.abs(e.weight) / FULL_BAR) : 0}%` } })),
      e.note ? el("p", { class: "note" }, e.note) : null,
      ids.length ? el("ul", {}, e.objects.map((object) => thing(object, { light, go, linked }))) : null);
  });
  return el("section", { class: "evidence", "aria-label": `Why place ${k + 1}` },
    el("h2", {}, `Why place ${k + 1}`),
    rows.length ? el("ul", {}, rows) : el("p", { class: "note" }, "The description contains nothing that can be compared with the map."));
}

function thing(object, { light, go, linked }) {
  const kind = commonName(object.label ?? ""), name = object.name || kind;
  return el("li", {},
    button(null, { class: "object", onclick: () => { light([object.id]); go(object); }, onfocus: () => light([object.id]), onblur: () => light([]) },
      el("bdi", {}, name), " ", el("small", {}, name.includes(kind) ? "" : kind)),
    linked ? onMap(osmLink(object.id), name) : null);
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
    commonName(sense.label), sense.weight < 0.995 ? ` ${(100 * sense.weight).toFixed(0)} %` : ""));
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
  const options = answer ? asked.options : [];
  return el("section", { class: "ask", "aria-label": "Question" },
    el("h2", {}, answer ? "To be sure" : "To be more certain, please answer"), el("p", {}, asked.text),
    options.length ? el("div", { class: "options" }, options.map((option) =>
      button(null, { onclick: () => answer(option) }, el("bdi", {}, option)))) : null);
}
