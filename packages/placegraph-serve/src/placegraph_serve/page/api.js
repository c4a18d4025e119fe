// What the server answers, and how it is asked.

let key = sessionStorage.getItem("key") ?? "";

export function useKey(given) {
  key = given;
  sessionStorage.setItem("key", given);
}

/** A problem (RFC 9457) as an error with its mend. */
export class Problem extends Error {
  constructor(told, status) {
    const mend = told?.mend ?? "", detail = told?.detail || told?.title || `The server answered with ${status}.`;
    const ends = mend && detail.toLowerCase().endsWith(mend.toLowerCase()); // it is said once, on a line of its own
    super(ends ? detail.slice(0, -mend.length).replace(/;? *$/, "").replace(/\w$/, "$&.") || detail : detail);
    this.status = told?.status ?? status;
    this.mend = mend;
  }
}

export async function call(path, { method, json, form, signal } = {}) {
  const headers = key ? { Authorization: `Bearer ${key}` } : {};
  if (json !== undefined) headers["Content-Type"] = "application/json";
  let response;
  try {
    response = await fetch(path, { method: method ?? (json !== undefined || form ? "POST" : "GET"), headers, signal,
      body: form ?? (json === undefined ? undefined : JSON.stringify(json)) });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem({ detail: "The server does not answer.", mend: "Check that it is running." }, 0);
  }
  const told = response.status === 204 ? null : await response.json().catch(() => null);
  if (!response.ok) throw new Problem(told, response.status);
  return told;
}

/** An image of the server as a URL of this page (its key goes along). */
export async function picture(path) {
  const response = await fetch(path, { headers: key ? { Authorization: `Bearer ${key}` } : {} });
  if (!response.ok) throw new Problem(await response.json().catch(() => null), response.status);
  return URL.createObjectURL(await response.blob());
}

export const mapPath = (name, rest) => `v1/maps/${encodeURIComponent(name)}/${rest}`;

/** An answer with the changes (a JSON merge patch) that the server sends; the answer before stays as it was. */
function merge(before, changes) {
  if (changes === null || typeof changes !== "object" || Array.isArray(changes)) return changes;
  const now = before !== null && typeof before === "object" && !Array.isArray(before) ? { ...before } : {};
  for (const [key, value] of Object.entries(changes)) now[key] = merge(now[key], value);
  return now;
}

/** The posterior while one types: the newest question cancels the ones before. */
export class Live {
  constructor(answered, failed) {
    Object.assign(this, { answered, failed, id: 0, socket: null, dead: 0, pause: 0, last: {} });
  }

  ask(question) {
    this.id += 1;
    this.newest = { id: this.id, changes: true, ...question };
    if (this.dead > 2) { this.post(220); return; }
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(this.newest));
    else this.connect();
  }

  forget() { this.id += 1; this.newest = null; this.request?.abort(); }

  connect() {
    if (this.socket?.readyState === WebSocket.CONNECTING) return;
    const url = new URL("v1/live", location.href);
    url.protocol = url.protocol.replace("http", "ws");
    url.hash = "";
    url.search = key ? `?key=${encodeURIComponent(key)}` : "";
    const socket = this.socket = new WebSocket(url);
    this.last = {};
    socket.onopen = () => { this.dead = 0; if (this.newest) socket.send(JSON.stringify(this.newest)); };
    socket.onmessage = ({ data }) => {
      const { id, changes, problem } = JSON.parse(data);
      if (changes) this.last = merge(this.last, changes);
      if (id !== this.id || !this.newest) return;
      this.newest = null;
      if (changes) this.answered(this.last);
      else this.failed(new Problem(problem));
    };
    socket.onclose = () => {
      this.dead += 1;
      if (this.newest) this.post(0); // it was not answered: ask in the plain way
    };
  }

  post(wait) {
    clearTimeout(this.pause);
    this.request?.abort();
    const { id, changes, ...question } = this.newest;
    this.pause = setTimeout(async () => {
      this.request = new AbortController();
      try {
        const result = await call("v1/locate", { json: question, signal: this.request.signal });
        if (id === this.id) { this.newest = null; this.answered(result); }
      } catch (error) {
        if (error.name !== "AbortError" && id === this.id) this.failed(error);
      }
    }, wait);
  }
}
