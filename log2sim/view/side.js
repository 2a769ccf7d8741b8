// The list of agents and what is known of the chosen one. Names come from the file: they are only ever set as text.

const MOST_ROWS = 500;
const SHAPES = {
  vehicle: "M2 2h8v8h-8z", two_wheeler: "M6 .8L11.2 6 6 11.2.8 6z",
  pedestrian: "M6 1.5a4.5 4.5 0 1 1 0 9a4.5 4.5 0 1 1 0-9z", other: "M6 1.2L11 10.4H1z",
};

const mark = (track) => {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 12 12");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", SHAPES[track.group]);
  path.style.fill = track.fill;
  path.style.stroke = track.standing ? track.edge : "none";
  svg.append(path);
  return svg;
};

const byId = (id) => document.getElementById(id);

class Side {
  // actions: choose(track or null), seek(t), hover(track or null)
  constructor(data, actions) {
    this.data = data;
    this.actions = actions;
    this.chosen = null;
    this.rows = new Map();
    this.ego = data.layers.log.find((track) => track.ego) ?? null;
    this.speed = new Chart(byId("charts"), "Speed (m/s)", data.begin, data.end, actions.seek);
    this.distance = new Chart(byId("charts"), "Distance to ego (m)", data.begin, data.end, actions.seek);
    this.facts = Object.fromEntries(["Heading", "Place", "Seen"].map((name) => {
      const value = element("dd");
      byId("agent-now").append(element("dt", {}, name), value);
      return [name, value];
    }));
    const search = byId("search");
    search.addEventListener("input", () => this.list());
    search.addEventListener("keydown", (event) => {
      const first = this.rows.keys().next().value;
      if (event.key === "Enter" && first) actions.choose(first);
    });
    byId("deselect").addEventListener("click", () => actions.choose(null));
    this.list();
  }

  list() {
    const words = byId("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = this.data.layers.log.filter((track) => {
      const text = `${track.id} ${track.category} ${track.standing ? "standing" : "moving"}`.toLowerCase();
      return words.every((word) => text.includes(word));
    });
    this.rows.clear();
    byId("agents").replaceChildren(...found.slice(0, MOST_ROWS).map((track) => this.row(track)));
    const rest = found.length - MOST_ROWS;
    byId("more").hidden = rest <= 0 && found.length > 0;
    this.dim();
    byId("more").textContent = found.length ? `${rest} more; search for them` : "No agent is called so.";
  }

  row(track) {
    const button = element("button", { type: "button" });
    const kind = track.standing ? `${track.category}, standing` : track.category;
    button.append(mark(track), element("span", { class: "id" }, track.id), element("span", { class: "kind" }, kind));
    button.setAttribute("aria-pressed", track === this.chosen);
    button.addEventListener("click", () => this.actions.choose(track === this.chosen ? null : track));
    button.addEventListener("pointerenter", () => this.actions.hover(track));
    button.addEventListener("pointerleave", () => this.actions.hover(null));
    const item = element("li");
    item.append(button);
    this.rows.set(track, button);
    return item;
  }

  choose(track) {
    this.rows.get(this.chosen)?.setAttribute("aria-pressed", false);
    this.chosen = track;
    this.rows.get(track)?.setAttribute("aria-pressed", true);
    byId("details").hidden = track === null;
    document.body.classList.toggle("chosen", track !== null);
    if (track) this.describe(track);
  }

  describe(track) {
    byId("agent-mark").replaceChildren(mark(track));
    byId("agent-id").textContent = track.id;
    const size = `${track.length.toFixed(1)} × ${track.width.toFixed(1)} m`;
    const life = track.always ? "all the time" : `${track.first.toFixed(1)} to ${track.last.toFixed(1)} s`;
    byId("agent-kind").textContent = `${track.category} · ${size} · ${life}`;
    const { truth, replay } = this.data.layers;
    this.others = { truth: truth && counterpart(track, truth), replay: replay && replay.find((r) => r.id === track.id) };
    const line = track.standing ? theme.parked_edge : track.line;
    const speeds = [{ t: track.t, v: track.v, filled: track.filled, color: line, dashes: SOLID, width: 1.8 }];
    if (this.others.replay) speeds.push({ ...this.others.replay, t: this.others.replay.t, v: this.others.replay.v, filled: null, color: line, dashes: DOTTED, width: 1.6 });
    if (this.others.truth) speeds.push({ t: this.others.truth.t, v: this.others.truth.v, filled: null, color: theme.truth, dashes: TRUTH_DASHES, width: 1.1 });
    this.speed.show(track.standing ? [] : speeds);
    this.distance.show(this.ego && track !== this.ego ? [{ ...this.gaps(track), color: line, dashes: SOLID, width: 1.8 }] : []);
  }

  // Distance of the centers while both are there.
  gaps(track) {
    const first = Math.max(track.always ? this.data.begin : track.first, this.ego.first);
    const last = Math.min(track.always ? this.data.end : track.last, this.ego.last);
    const count = last < first ? 0 : 241, t = new Float64Array(count), v = new Float64Array(count);
    for (let k = 0; k < count; k++) {
      t[k] = first + ((last - first) * k) / (count - 1);
      track.moveTo(t[k]);
      this.ego.moveTo(t[k]);
      v[k] = Math.hypot(track.px - this.ego.px, track.py - this.ego.py);
    }
    return { t, v, filled: null };
  }

  // The figures of the moment; tracks stand where they are now.
  tick(t) {
    const track = this.chosen;
    if (!track) return;
    const gone = t < track.first ? "not there yet" : "gone";
    const number = (value, digits) => value.toFixed(digits).replace("-", "−");
    this.speed.mark(t, track.there ? `${number(track.pv, 2)} m/s · ${number(track.pv * 3.6, 0)} km/h` : gone);
    const apart = this.ego && this.ego.there && track.there ? Math.hypot(track.px - this.ego.px, track.py - this.ego.py) : null;
    this.distance.mark(t, apart === null ? "" : `${number(apart, 1)} m`);
    const degrees = (((track.pyaw * 180) / Math.PI + 180) % 360 + 360) % 360 - 180;
    this.facts.Heading.textContent = track.there ? `${number(degrees, 0)}° from east, counter-clockwise` : gone;
    this.facts.Place.textContent = track.there ? `${number(track.px, 2)} m east, ${number(track.py, 2)} m north` : gone;
    this.facts.Seen.textContent = !track.there ? gone : track.guessed ? "no, filled in between" : "yes";
  }

  // Dim the rows of those that are not there now.
  dim() {
    for (const [track, row] of this.rows) {
      if (row.dimmed !== !track.there) row.classList.toggle("away", (row.dimmed = !track.there));
    }
  }

  redraw() {
    this.list();
    if (this.chosen) this.describe(this.chosen);
  }
}
