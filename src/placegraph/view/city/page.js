"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const map = document.getElementById("map");
  const tip = document.getElementById("tip");
  const scale = document.querySelector(".scale span");
  const frame = document.getElementById("window");
  const layers = [...map.querySelectorAll("[data-since]")];
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const [left, top, width, height] = data.box;
  const view = { x: 0, y: 0, k: 1 }; // middle, and units of the map in a pixel
  let flight = 0;

  const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
  const widest = () => 1.3 * Math.max(width / map.clientWidth, height / map.clientHeight);

  function draw() {
    const w = map.clientWidth, h = map.clientHeight;
    view.k = clamp(view.k, 0.04, Math.max(0.1, widest()));
    view.x = clamp(view.x, left, left + width);
    view.y = clamp(view.y, top, top + height);
    const box = [view.x - (w * view.k) / 2, view.y - (h * view.k) / 2, w * view.k, h * view.k];
    map.setAttribute("viewBox", box.map((n) => n.toFixed(2)).join(" "));
    map.style.setProperty("--k", view.k.toFixed(5));
    const perMetre = 1 / (view.k * data.unit);
    for (const layer of layers) {
      layer.style.display = perMetre >= Number(layer.dataset.since) ? "" : "none";
    }
    ["x", "y", "width", "height"].forEach((name, i) => frame.setAttribute(name, box[i]));
    frame.closest(".inset").classList.toggle("off", box[2] > 0.9 * width && box[3] > 0.9 * height);
    let metres = 10 ** Math.floor(Math.log10(140 / perMetre));
    for (const step of [5, 2]) if (metres * step * perMetre <= 140) { metres *= step; break; }
    scale.style.width = `${metres * perMetre}px`;
    scale.textContent = metres >= 1000 ? `${metres / 1000} km` : `${metres} m`;
  }

  function fitting([x, y, w, h]) {
    return { x: x + w / 2, y: y + h / 2, k: Math.max(w / map.clientWidth, h / map.clientHeight) };
  }

  function fly(to) {
    cancelAnimationFrame(flight);
    if (calm) { Object.assign(view, to); draw(); return; }
    const from = { ...view }, start = performance.now();
    const far = Math.hypot(to.x - from.x, to.y - from.y);
    const arc = clamp(far / (map.clientWidth * Math.max(from.k, to.k)) - 0.5, 0, 6);
    const step = (now) => {
      const t = clamp((now - start) / 550, 0, 1), s = t * t * (3 - 2 * t);
      view.x = from.x + (to.x - from.x) * s;
      view.y = from.y + (to.y - from.y) * s;
      view.k = from.k * (to.k / from.k) ** s * (1 + arc * Math.sin(Math.PI * t));
      draw();
      if (t < 1) flight = requestAnimationFrame(step);
    };
    flight = requestAnimationFrame(step);
  }

  function zoom(factor, px = map.clientWidth / 2, py = map.clientHeight / 2) {
    const dx = px - map.clientWidth / 2, dy = py - map.clientHeight / 2;
    const k = clamp(view.k * factor, 0.04, Math.max(0.1, widest()));
    view.x += dx * (view.k - k);
    view.y += dy * (view.k - k);
    view.k = k;
    draw();
  }

  function select(mode, move = true) {
    for (const element of document.querySelectorAll("[data-of]")) {
      element.toggleAttribute("hidden", element.dataset.of !== String(mode));
    }
    for (const element of document.querySelectorAll("[data-mode]")) {
      const on = element.dataset.mode === String(mode);
      element.classList.toggle("on", on);
      if (element.hasAttribute("aria-pressed")) element.setAttribute("aria-pressed", String(on));
    }
    if (move && data.modes[mode]) fly(fitting(data.modes[mode]));
  }

  function tell(shape, event) {
    for (const lit of map.querySelectorAll(".lit")) lit.classList.remove("lit");
    if (!shape) { tip.hidden = true; return; }
    shape.classList.add("lit");
    const [name, labels] = data.tips[Number(shape.dataset.t)].split("\n");
    tip.replaceChildren();
    for (const [kind, text] of [["b", name], ["span", labels], ["small", shape.dataset.o]]) {
      if (text) tip.appendChild(document.createElement(kind)).textContent = text;
    }
    tip.hidden = false;
    const box = map.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    tip.style.left = `${clamp(x + 14, 4, box.width - tip.offsetWidth - 4)}px`;
    const below = y + 18 + tip.offsetHeight < box.height;
    tip.style.top = `${below ? y + 18 : y - 10 - tip.offsetHeight}px`;
  }

  const held = new Map();
  let moved = false;
  const spread = () => {
    const [a, b] = [...held.values()];
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  };
  const middle = () => {
    const all = [...held.values()], n = all.length;
    return { x: all.reduce((s, p) => s + p.x, 0) / n, y: all.reduce((s, p) => s + p.y, 0) / n };
  };
  map.addEventListener("pointerdown", (event) => {
    cancelAnimationFrame(flight);
    if (!held.size) moved = false;
    held.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
  });
  map.addEventListener("pointermove", (event) => {
    if (!held.has(event.pointerId)) {
      if (event.pointerType === "mouse") tell(event.target.closest("[data-t]"), event);
      return;
    }
    const box = map.getBoundingClientRect();
    const before = middle(), apart = spread(), last = held.get(event.pointerId);
    const here = { x: event.clientX - box.left, y: event.clientY - box.top };
    if (!moved && Math.hypot(here.x - last.x, here.y - last.y) < 4) return;
    if (!moved) { moved = true; map.classList.add("held"); tell(null); }
    if (!map.hasPointerCapture(event.pointerId)) map.setPointerCapture(event.pointerId);
    held.set(event.pointerId, here);
    const after = middle();
    view.x -= (after.x - before.x) * view.k;
    view.y -= (after.y - before.y) * view.k;
    if (apart && spread()) zoom(apart / spread(), after.x, after.y);
    else draw();
  });
  const release = (event) => {
    held.delete(event.pointerId);
    if (!held.size) map.classList.remove("held");
  };
  map.addEventListener("pointerup", release);
  map.addEventListener("pointercancel", release);
  map.addEventListener("pointerleave", () => tell(null));
  map.addEventListener("click", (event) => {
    if (moved) return;
    const pin = event.target.closest("[data-mode]");
    if (pin) select(Number(pin.dataset.mode));
    else tell(event.target.closest("[data-t]"), event);
  });
  map.addEventListener("dblclick", (event) => {
    const box = map.getBoundingClientRect();
    zoom(0.5, event.clientX - box.left, event.clientY - box.top);
  });
  map.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = map.getBoundingClientRect();
    const lines = event.deltaMode === 1 ? 18 : 1;
    zoom(Math.exp(clamp(event.deltaY * lines, -120, 120) * 0.0022),
      event.clientX - box.left, event.clientY - box.top);
  }, { passive: false });
  map.addEventListener("keydown", (event) => {
    const pin = event.target.closest("[data-mode]");
    if (pin && (event.key === "Enter" || event.key === " ")) select(Number(pin.dataset.mode));
    else if (event.key in moves) moves[event.key]();
    else return;
    event.preventDefault();
  });
  const shift = (x, y) => { view.x += 80 * x * view.k; view.y += 80 * y * view.k; draw(); };
  const whole = () => fly(fitting(data.box));
  const heat = document.getElementById("heat"), heatSwitch = document.getElementById("heat-switch");
  const toggleHeat = () => {
    heatSwitch.setAttribute("aria-pressed", String(!heat.toggleAttribute("hidden")));
  };
  const moves = {
    ArrowLeft: () => shift(-1, 0), ArrowRight: () => shift(1, 0),
    ArrowUp: () => shift(0, -1), ArrowDown: () => shift(0, 1),
    "+": () => zoom(0.7), "=": () => zoom(0.7), "-": () => zoom(1 / 0.7),
    0: whole, h: toggleHeat, Escape: () => tell(null),
  };
  document.getElementById("in").addEventListener("click", moves["+"]);
  document.getElementById("out").addEventListener("click", moves["-"]);
  document.getElementById("all").addEventListener("click", whole);
  heatSwitch.addEventListener("click", toggleHeat);
  document.querySelector(".inset").addEventListener("click", (event) => {
    const svg = event.currentTarget.querySelector("svg");
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    fly({ x: at.x, y: at.y, k: view.k });
  });
  document.querySelector(".panel").addEventListener("click", (event) => {
    const button = event.target.closest("button");
    if (!button) return;
    if (button.dataset.mode) select(Number(button.dataset.mode));
    else if (button.dataset.x) {
      const to = { x: Number(button.dataset.x), y: Number(button.dataset.y), k: Math.min(view.k, 0.5) };
      fly(to);
    }
  });
  document.getElementById("inset-modes").innerHTML = data.modes
    .map(([x, y, w, h]) => `<path d="M${x + w / 2} ${y + h / 2}h0"/>`).join("");
  new ResizeObserver(draw).observe(map);
  Object.assign(view, fitting(data.start));
  select(0, false);
  draw();
})();
