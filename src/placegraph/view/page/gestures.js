// Hands, wheels and keys that move a map.

import { clamp } from "./base.js";

export function gestures(map) {
  const { canvas } = map, held = new Map();
  let moved = false, speed = { x: 0, y: 0, at: 0 };
  const here = (event) => {
    const box = canvas.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  };
  const middle = () => {
    const all = [...held.values()], n = all.length;
    return { x: all.reduce((sum, p) => sum + p.x, 0) / n, y: all.reduce((sum, p) => sum + p.y, 0) / n };
  };
  const apart = () => {
    const [a, b] = [...held.values()];
    return b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  };
  const zoom = (factor, at = { x: map.width / 2, y: map.height / 2 }) => {
    map.byHand = true;
    const [x, y] = map.plane(at.x, at.y), { scale } = map.limited({ ...map.view, scale: map.view.scale * factor });
    map.move({ scale, x: x - (at.x - map.width / 2) / scale, y: y + (at.y - map.height / 2) / scale });
  };
  const shift = (x, y) => {
    map.stop();
    map.byHand = true;
    map.move({ x: map.view.x + (90 * x) / map.view.scale, y: map.view.y + (90 * y) / map.view.scale });
  };

  canvas.addEventListener("pointerdown", (event) => {
    map.stop();
    if (!held.size) moved = false;
    held.set(event.pointerId, here(event));
    speed = { x: 0, y: 0, at: event.timeStamp };
  });
  canvas.addEventListener("pointermove", (event) => {
    const at = here(event);
    if (!held.has(event.pointerId)) {
      if (event.pointerType === "mouse") map.on.hover?.(map.shapeAt(at.x, at.y), at);
      return;
    }
    const last = held.get(event.pointerId);
    if (!moved && Math.hypot(at.x - last.x, at.y - last.y) < 5) return;
    if (!moved) { moved = true; canvas.classList.add("held"); map.on.hover?.(null); }
    map.byHand = true;
    if (!canvas.hasPointerCapture(event.pointerId)) canvas.setPointerCapture(event.pointerId);
    const before = middle(), far = apart();
    held.set(event.pointerId, at);
    const after = middle(), dt = Math.max(1, event.timeStamp - speed.at);
    speed = {
      x: 0.6 * speed.x + 0.4 * ((before.x - after.x) / dt), y: 0.6 * speed.y + 0.4 * ((after.y - before.y) / dt),
      at: event.timeStamp,
    };
    const { scale } = map.view;
    map.move({ x: map.view.x - (after.x - before.x) / scale, y: map.view.y + (after.y - before.y) / scale });
    if (far && apart()) zoom(apart() / far, after);
  });
  const release = (event) => {
    if (!held.delete(event.pointerId) || held.size) return;
    canvas.classList.remove("held");
    const fast = Math.hypot(speed.x, speed.y);
    if (moved && fast > 0.3 && event.timeStamp - speed.at < 60) { // it glides on
      const way = (200 * Math.min(1, 3 / fast)) / map.view.scale;
      map.fly({ x: map.view.x + speed.x * way, y: map.view.y + speed.y * way });
    }
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", () => map.on.hover?.(null));
  canvas.addEventListener("click", (event) => {
    if (moved) return;
    const at = here(event);
    map.on.tap?.(map.plane(at.x, at.y), map.shapeAt(at.x, at.y), at);
  });
  canvas.addEventListener("dblclick", (event) => zoom(2, here(event)));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    map.stop();
    const lines = event.deltaMode === 1 ? 18 : 1, pinch = event.ctrlKey ? 4 : 1;
    zoom(Math.exp(-clamp(event.deltaY * lines * pinch, -120, 120) * 0.0022), here(event));
  }, { passive: false });

  const moves = {
    ArrowLeft: () => shift(-1, 0), ArrowRight: () => shift(1, 0),
    ArrowUp: () => shift(0, 1), ArrowDown: () => shift(0, -1),
    "+": () => zoom(1.5), "=": () => zoom(1.5), "-": () => zoom(1 / 1.5),
    0: () => map.index && map.fly(map.whole()), Escape: () => map.on.hover?.(null),
  };
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in moves)) return;
    moves[event.key]();
    event.preventDefault();
  });
  return moves;
}
