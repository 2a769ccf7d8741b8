// The panel of the chosen agent: present values and plots over time.

const DISTANCE_SAMPLES = 241;

// Distance of the centers of two agents while both are present.
const distances = (a, b, data) => {
  const first = Math.max(a.permanent ? data.begin : a.first, b.permanent ? data.begin : b.first);
  const last = Math.min(a.permanent ? data.end : a.last, b.permanent ? data.end : b.last);
  const count = last < first ? 0 : DISTANCE_SAMPLES, t = new Float64Array(count), v = new Float64Array(count);
  for (let k = 0; k < count; k++) {
    t[k] = first + ((last - first) * k) / (count - 1);
    a.moveTo(t[k]);
    b.moveTo(t[k]);
    v[k] = distanceOf(a, b);
  }
  return { t, v };
};

const distanceOf = (a, b) => Math.hypot(a.px - b.px, a.py - b.py);

const fixed = (value, digits) => value.toFixed(digits).replace("-", "−");

const seconds = (t, otherwise) => (t ?? otherwise).toFixed(1);

// Set the text of a row of the panel, or hide the row where there is none.
const fill = (value, text) => {
  value.textContent = text;
  value.hidden = value.previousElementSibling.hidden = text === "";
};

class Details {
  // seek: called with a time when a plot is clicked.
  constructor(data, seek) {
    this.data = data;
    this.track = this.truth = this.replay = null;
    this.ego = data.layers.scenario.find((track) => track.ego) ?? null;
    const others = ["truth", "replay"].filter((layer) => data.layers[layer]).join(" and ");
    const charts = [["Speed (m/s)", 1], ["Distance to ego (m)", 1], [`From ${others} (m)`, 0.1]];
    [this.speed, this.distance, this.error] = charts.map(([title, minSpan]) => new Chart(byId("charts"), title, minSpan, data, seek));
    const rows = ["Confidence", "Sigma", "Heading", "Position", "Observed", "Observed by", "Color", "LiDAR", "Source"].map((name) => {
      const value = element("dd");
      byId("agent-now").append(element("dt", {}, name), value);
      return value;
    });
    [this.confidence, this.sigma, this.heading, this.position, this.observed, this.observers, this.paint, this.points, this.source] = rows;
  }

  choose(track) {
    this.track = track;
    byId("details").hidden = track === null;
    document.body.classList.toggle("chosen", track !== null);
    if (track) this.show();
  }

  show() {
    const track = this.track, { truth, replay } = this.data.layers;
    if (!track) return;
    this.truth = (truth && counterpart(track, truth)) ?? null;
    this.replay = replay?.find((other) => other.id === track.id) ?? null;
    byId("agent-mark").replaceChildren(mark(track));
    byId("agent-id").textContent = track.id;
    const size = `${track.length.toFixed(1)} × ${track.width.toFixed(1)} m`;
    const span = track.permanent ? "the whole scenario" : `${track.first.toFixed(1)} to ${track.last.toFixed(1)} s`;
    byId("agent-kind").textContent = `${track.category} · ${size} · ${span}`;
    this.showTrust(track);
    const color = track.stationary ? theme.parked_edge : track.line;
    const own = { color, dashes: SOLID, width: 1.8 };
    const others = [[this.replay, { color, dashes: DOTTED, width: 1.6 }], [this.truth, { color: theme.truth, dashes: TRUTH_DASHES, width: 1.1 }]]
      .filter(([other]) => other !== null);
    const speeds = [[track, { ...own, filled: track.filled }], ...others].map(([{ t, v }, style]) => ({ t, v, ...style }));
    this.speed.show(track.stationary ? [] : speeds);
    this.distance.show(this.ego && track !== this.ego ? [{ ...distances(track, this.ego, this.data), ...own }] : []);
    this.error.show(others.map(([other, style]) => ({ ...distances(track, other, this.data), ...style })));
  }

  // What does not change over time; rows of which nothing is known are hidden.
  showTrust(track) {
    fill(this.confidence, track.confidence === null ? "" : track.confidence.toFixed(2));
    fill(this.points, track.points === null ? "" : `${track.points.toFixed(0)} points in a sweep (median)`);
    fill(this.source, track.source ?? "");
    fill(this.paint, track.paintName);
    this.paint.style.setProperty("--paint", track.paint ?? "none");
    fill(this.observers, observers(track, 0));
    const warning = this.data.warnings.find((other) => other.agent === track.id);
    byId("agent-warning").hidden = warning === undefined;
    byId("agent-warning").textContent = warning?.text ?? "";
    fill(this.sigma, track.sigmas.some((values) => values !== null) ? "–" : "");
    byId("agent-doubts").replaceChildren(...track.doubts.map(([reason, start, end, flag]) => {
      const span = start === null && end === null ? "" : ` (${seconds(start, this.data.begin)} to ${seconds(end, this.data.end)} s)`;
      const item = element("li", {}, `${reason}${span}`);
      item.append(" ", element("code", { title: "flag of the doubt" }, flag));
      return item;
    }));
  }

  // The values at time t; all agents of the scenario have that state already.
  tick(t) {
    const track = this.track;
    if (!track) return;
    const absent = t < track.first ? "not present yet" : "no longer present", present = track.present;
    this.speed.mark(t, present ? `${fixed(track.pv, 2)} m/s · ${fixed(track.pv * 3.6, 0)} km/h` : absent);
    this.distance.mark(t, present && this.ego?.present ? `${fixed(distanceOf(track, this.ego), 1)} m` : "");
    this.error.mark(t, present ? [this.truth, this.replay].map((other) => this.off(other, t)).filter(Boolean).join(" · ") : "");
    const degrees = (((track.pyaw * 180) / Math.PI + 180) % 360 + 360) % 360 - 180;
    this.heading.textContent = present ? `${fixed(degrees, 0)}° from ${this.data.north ? "east" : "x"}, counter-clockwise` : absent;
    this.position.textContent = present ? this.place(track) : absent;
    const units = [[1, 2, "m"], [180 / Math.PI, 1, "°"], [1, 2, "m/s"]];
    const sigmas = units.map(([scale, digits, unit], which) => {
      const value = track.sigma(which);
      return value === null ? "" : `${(value * scale).toFixed(digits)}${unit === "°" ? "" : " "}${unit}`;
    });
    this.sigma.textContent = present ? sigmas.filter(Boolean).join(" · ") : absent;
    byId("agent-doubts").classList.toggle("holds", present && track.doubted);
    if (track.observedBy !== null) this.observers.textContent = present ? observers(track, t) : absent;
    this.observed.textContent = !present ? absent : track.interpolated ? "no, interpolated" : "yes";
  }

  // Where it is, in words that the map can answer for.
  place({ px, py }) {
    const [x, y] = [fixed(px, 2), fixed(py, 2)];
    return this.data.north ? `${x} m east, ${y} m north` : `x ${x} m, y ${y} m`;
  }

  off(other, t) {
    other?.moveTo(t);
    return other?.present ? `${fixed(distanceOf(this.track, other), 2)} m` : "";
  }
}
