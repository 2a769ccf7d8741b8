// Collisions of the replay: ringed and labeled on the map, labeled below the slider, and listed.

const isColliding = (event, t) => t >= event.t_s - 0.05 && t <= event.until_s + 0.3;  // shown longer than the contact

const collisionColor = (event) => (event.belongs_to === "replay" ? theme.alert : theme.muted);

const ringCollisions = (painter, events, t) => {
  for (const event of events) {
    if (!isColliding(event, t)) continue;
    for (const track of event.tracks) if (track.present) painter.ring(track, collisionColor(event), 2);
  }
};

// Who collides, below the lower of the two boxes.
const nameCollisions = (painter, events, t) => {
  const { ctx, view } = painter;
  ctx.font = theme.names;
  ctx.textAlign = "center";
  ctx.textBaseline = "alphabetic";
  for (const event of events) {
    const present = event.tracks.filter((track) => track.present);
    if (!isColliding(event, t) || !present.length) continue;
    const text = `${event.agents.join(" × ")} collide`, half = ctx.measureText(text).width / 2 + 2;
    const reach = (track) => (track.length * Math.abs(Math.sin(track.pyaw)) + track.width * Math.abs(Math.cos(track.pyaw))) / 2;
    const bottom = Math.max(...present.map((track) => view.sy(track.py - reach(track))));
    const sx = present.reduce((sum, track) => sum + view.sx(track.px), 0) / present.length;
    painter.write(text, sx, bottom + 18, half, collisionColor(event), true);
  }
};

// Hide labels below the slider that would cover an earlier one, and keep the rest inside.
const placeEventLabels = () => {
  const whole = byId("events").clientWidth;
  let end = -Infinity;
  for (const label of byId("events").querySelectorAll(".label")) {
    label.style.visibility = "hidden";
    label.style.marginLeft = "0";
    const half = label.offsetWidth / 2, at = label.offsetLeft + half;
    const from = Math.min(Math.max(at - half, 0), Math.max(whole - 2 * half, 0));
    label.style.marginLeft = `${from - at}px`;
    if (from < end) continue;
    label.style.visibility = "visible";
    end = from + 2 * half + 6;
  }
};

// The collisions with when and whose they are; a click shows the moment of one.
const listCollisions = (events, tracks, show) => {
  byId("collided").hidden = events.length === 0;
  byId("collided-count").textContent = `${events.length} collision${events.length === 1 ? "" : "s"}`;
  byId("collided-agents").replaceChildren(...events.map((event) => {
    const button = element("button", { type: "button" }), item = element("li");
    const track = tracks.find((other) => event.agents.includes(other.id));
    if (track) button.append(mark(track));
    button.append(element("span", { class: "why" }, describe(event)));
    button.addEventListener("click", () => show(event));
    item.append(button);
    return item;
  }));
};
