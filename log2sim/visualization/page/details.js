// What is known of the chosen agent: its figures of the moment and its plots over time.

const GAP_SAMPLES = 241;

// Distance of the centers of two agents while both are there.
const gaps = (a, b, data) => {
  const first = Math.max(a.always ? data.begin : a.first, b.always ? data.begin : b.first);
  const last = Math.min(a.always ? data.end : a.last, b.always ? data.end : b.last);
  const count = last < first ? 0 : GAP_SAMPLES, t = new Float64Array(count), v = new Float64Array(count);
  for (let k = 0; k < count; k++) {
    t[k] = first + ((last - first) * k) / (count - 1);
    a.moveTo(t[k]);
    b.moveTo(t[k]);
    v[k] = apart(a, b);
  }
  return { t, v };
};

const apart = (a, b) => Math.hypot(a.px - b.px, a.py - b.py);

const figure = (value, digits) => value.toFixed(digits).replace("-", "−");

class Details {
  // seek: called with a time when a plot is clicked.
  constructor(data, seek) {
    this.data = data;
    this.track = this.truth = this.replay = null;
    this.ego = data.layers.log.find((track) => track.ego) ?? null;
    const others = ["truth", "replay"].filter((layer) => data.layers[layer]).join(" and ");
    const charts = [["Speed (m/s)", 1], ["Distance to ego (m)", 1], [`From ${others} (m)`, 0.1]];
    [this.speed, this.distance, this.error] = charts.map(([title, least]) => new Chart(byId("charts"), title, least, data, seek));
    [this.heading, this.place, this.seen] = ["Heading", "Place", "Seen"].map((name) => {
      const value = element("dd");
      byId("agent-now").append(element("dt", {}, name), value);
      return value;
    });
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
    const life = track.always ? "all the time" : `${track.first.toFixed(1)} to ${track.last.toFixed(1)} s`;
    byId("agent-kind").textContent = `${track.category} · ${size} · ${life}`;
    const color = track.standing ? theme.parked_edge : track.line;
    const own = { color, dashes: SOLID, width: 1.8 };
    const others = [[this.replay, { color, dashes: DOTTED, width: 1.6 }], [this.truth, { color: theme.truth, dashes: TRUTH_DASHES, width: 1.1 }]]
      .filter(([other]) => other !== null);
    const speeds = [[track, { ...own, filled: track.filled }], ...others].map(([{ t, v }, style]) => ({ t, v, ...style }));
    this.speed.show(track.standing ? [] : speeds);
    this.distance.show(this.ego && track !== this.ego ? [{ ...gaps(track, this.ego, this.data), ...own }] : []);
    this.error.show(others.map(([other, style]) => ({ ...gaps(track, other, this.data), ...style })));
  }

  // The figures of the moment; all agents of the log are where they are now.
  tick(t) {
    const track = this.track;
    if (!track) return;
    const gone = t < track.first ? "not there yet" : "gone", there = track.there;
    this.speed.mark(t, there ? `${figure(track.pv, 2)} m/s · ${figure(track.pv * 3.6, 0)} km/h` : gone);
    this.distance.mark(t, there && this.ego?.there ? `${figure(apart(track, this.ego), 1)} m` : "");
    this.error.mark(t, there ? [this.truth, this.replay].map((other) => this.off(other, t)).filter(Boolean).join(" · ") : "");
    const degrees = (((track.pyaw * 180) / Math.PI + 180) % 360 + 360) % 360 - 180;
    this.heading.textContent = there ? `${figure(degrees, 0)}° from east, counter-clockwise` : gone;
    this.place.textContent = there ? `${figure(track.px, 2)} m east, ${figure(track.py, 2)} m north` : gone;
    this.seen.textContent = !there ? gone : track.guessed ? "no, filled in between" : "yes";
  }

  off(other, t) {
    other?.moveTo(t);
    return other?.there ? `${figure(apart(this.track, other), 2)} m` : "";
  }
}
