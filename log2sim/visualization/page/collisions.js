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

// Keep labels below the slider inside, and hide those that would cover another; what only the replay has comes first.
const placeEventLabels = () => {
  const whole = byId("events").clientWidth, taken = [];
  for (const label of [...byId("events").querySelectorAll(".label.new"), ...byId("events").querySelectorAll(".label:not(.new)")]) {
    label.style.marginLeft = "0";
    const width = label.offsetWidth, at = label.offsetLeft, from = Math.min(Math.max(at - width / 2, 0), whole - width);
    const free = from >= 0 && taken.every(([left, right]) => from > right + 6 || from + width < left - 6);
    label.style.marginLeft = `${from - at}px`;
    label.style.visibility = free ? "visible" : "hidden";
    if (free) taken.push([from, from + width]);
  }
};

// The collisions with when and whose they are; a click shows the moment of one.
const listCollisions = () => fillLines("collided", counted(data.events.length, "collision"), data.events.map((event) =>
  lineOf(tracks.find((track) => event.agents.includes(track.id)), describe(event), () => showEvent(event))));
