// What all parts of a page stand on: elements, numbers, and the plane of a city.

export const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

/** Text as it may be shown: without control characters and changes of direction. */
export const tidy = (text) => String(text ?? "").replace(/(?![\u200c\u200d])\p{C}/gu, " ");

/** Make an element; strings become text and never markup. */
export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "style") Object.assign(node.style, value);
    else node.setAttribute(name, value === true ? "" : value);
  }
  for (const child of children.flat()) {
    if (child !== null && child !== undefined && child !== "" && child !== false) {
      node.append(child.nodeType ? child : tidy(child));
    }
  }
  return node;
}

export const button = (label, attributes, ...children) =>
  el("button", { type: "button", ...attributes, ...(label ? { "aria-label": label } : {}) }, ...children);

/** Colours of the palette as the page shows them now. */
export function colours() {
  const style = getComputedStyle(document.documentElement), known = new Map();
  return (name) => {
    if (!known.has(name)) known.set(name, style.getPropertyValue(`--${name}`).trim() || "#888");
    return known.get(name);
  };
}

/** East-north plane of a city (geometry.LocalPlane), in metres from its origin. */
export class Plane {
  constructor(index) {
    [this.longitude, this.latitude] = index.origin;
    [this.perLongitude, this.perLatitude] = index.metres_per_degree;
  }

  to(longitude, latitude) {
    const turn = ((longitude - this.longitude + 540) % 360) - 180;
    return [turn * this.perLongitude, (latitude - this.latitude) * this.perLatitude];
  }

  from(east, north) {
    return [this.longitude + east / this.perLongitude, this.latitude + north / this.perLatitude];
  }
}

/** Standard deviation along the direction in which a place is least sure [m]. */
export function spread([[a, b], [, d]]) {
  return Math.sqrt((a + d) / 2 + Math.hypot((a - d) / 2, b));
}

const ROADS = /^(trunk|primary|secondary|tertiary|unclassified|residential)(_link)?$/;

/** Words for a label of a map: amenity=post_box is a post box, building=yes a building. */
export function commonName(label) {
  const [key, value = ""] = label.split("=");
  if (key === "highway" && ROADS.test(value)) return "street";
  return (["yes", "*", ""].includes(value) ? key : value).replaceAll("_", " ");
}

/** Name of a map: hafen_stadt.city is of Hafen stadt. */
export const title = (name) => tidy(name).replaceAll("_", " ").replace(/^./u, (first) => first.toUpperCase());

/** A thing's place on OpenStreetMap, or null where it has no id of theirs. */
export function osmLink(id) {
  return /^(node|way|relation)\/\d+$/.test(id) ? `https://www.openstreetmap.org/${id}` : null;
}

export const osmPlace = (latitude, longitude) => {
  const [lat, lon] = [latitude.toFixed(5), longitude.toFixed(5)];
  return `https://www.openstreetmap.org/?mlat=${lat}&mlon=${lon}#map=18/${lat}/${lon}`;
};

export const calm = () => matchMedia("(prefers-reduced-motion: reduce)").matches;
