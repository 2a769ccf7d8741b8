// Mouse, touch and keys.

const CLICK_PX = 5;

// Drag, pinch, wheel and click on the map. act: drag(dx, dy), zoom(factor, sx, sy), click(sx, sy, margin), hover(sx, sy),
// grab(sx, sy): whether what is pressed there is pulled instead of the map, by pull(sx, sy)
const listenToPointers = (canvas, act) => {
  const down = new Map();
  let travelled = 0, grabbed = false;
  const spread = () => {
    const [a, b] = [...down.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, distance: Math.max(Math.hypot(a.x - b.x, a.y - b.y), 1) };
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button > 0) return;
    canvas.setPointerCapture(event.pointerId);
    if (down.size === 0) [travelled, grabbed] = [0, act.grab(event.offsetX, event.offsetY)];
    down.set(event.pointerId, { x: event.offsetX, y: event.offsetY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const pointer = down.get(event.pointerId);
    if (!pointer) return event.pointerType === "mouse" && act.hover(event.offsetX, event.offsetY);
    const before = down.size === 2 ? spread() : null;
    const dx = event.offsetX - pointer.x, dy = event.offsetY - pointer.y;
    travelled += Math.hypot(dx, dy);
    [pointer.x, pointer.y] = [event.offsetX, event.offsetY];
    if (before) {
      const after = spread();
      act.drag(after.x - before.x, after.y - before.y);
      act.zoom(after.distance / before.distance, after.x, after.y);
      travelled = Infinity;
    } else if (grabbed) act.pull(pointer.x, pointer.y);
    else if (travelled > CLICK_PX) act.drag(dx, dy);
  });
  const release = (event) => {
    if (down.delete(event.pointerId) && event.type === "pointerup" && down.size === 0 && travelled <= CLICK_PX) {
      act.click(event.offsetX, event.offsetY, event.pointerType === "touch" ? 14 : 5);
    }
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", () => act.hover(null));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 16 : 1);
    act.zoom(Math.exp(-pixels * (event.ctrlKey ? 0.01 : 0.0015)), event.offsetX, event.offsetY);
  }, { passive: false });
  canvas.addEventListener("dblclick", (event) => act.zoom(2, event.offsetX, event.offsetY));
};

// keys: [displayed names, description, keys of the event, action(event)]; silent: [keys of the event, action(event)]
const listenToKeys = (keys, silent) => {
  const actions = new Map();
  for (const [names, run] of [...keys.map(([, , names, run]) => [names, run]), ...silent]) {
    for (const name of names) actions.set(name, run);
  }
  window.addEventListener("keydown", (event) => {
    const typing = event.target.matches?.("input:not([type=range])");
    if (event.ctrlKey || event.metaKey || event.altKey || (typing && event.key !== "Escape")) return;
    if (event.key === "Enter" || document.querySelector("dialog[open]")) return;
    const run = actions.get(event.key);
    if (!run) return;
    event.preventDefault();
    if (typing) event.target.blur();
    run(event);
  });
  window.addEventListener("keyup", (event) => {
    if (event.key === " " && event.target instanceof HTMLButtonElement) event.preventDefault();  // the key would also press the button
  });
  for (const [names, what] of keys) byId("keys").append(element("dt", {}, names), element("dd", {}, what));
};
