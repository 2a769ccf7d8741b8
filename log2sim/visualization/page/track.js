// Agents over time. Columns are decoded once; the present state is kept in fields, so that no frame allocates memory.

const STANDING_IN_PICTURES = "#DDE3EA";

const sums = (differences, scale) => {
  const out = new Float64Array(differences.length);
  let step = 0, value = 0;
  for (let k = 0; k < out.length; k++) {
    step += differences[k];
    value += step;
    out[k] = value / scale;
  }
  return out;
};

// Index of the last of times in order that is not after t; -1 when all are.
const lastUntil = (times, t) => {
  let low = -1, high = times.length;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle; else high = middle;
  }
  return low;
};

// Value between waypoints k and k + 1 by their slopes, straight on over a jump, linear without slopes.
const between = (values, slopes, k, share, span, jump) => {
  const rise = values[k + 1] - values[k];
  if (slopes === null) return values[k] + share * rise;
  const first = span * slopes[k], last = span * slopes[k + 1];
  if (jump) return values[k] + share * first;
  return values[k] + share * (first + share * (3 * rise - 2 * first - last + share * (first + last - 2 * rise)));
};

class Track {
  constructor(entry, scales) {
    Object.assign(this, {
      id: entry.id, category: entry.category, group: entry.group, stationary: entry.stationary, permanent: entry.permanent,
      ego: entry.ego === true, leading: entry.leading === true || entry.ego === true, base: entry.color ?? null,
      length: entry.size_m[0], width: entry.size_m[1], height: entry.size_m[2],
      t: sums(entry.t_s, scales.t_s), x: sums(entry.x_m, scales.x_m), y: sums(entry.y_m, scales.y_m),
      yaw: sums(entry.yaw_rad, scales.yaw_rad), v: sums(entry.speed_mps, scales.speed_mps),
    });
    this.vx = entry.vx_mps ? sums(entry.vx_mps, scales.vx_mps) : null;  // only agents of scenarios follow a spline
    this.vy = entry.vy_mps ? sums(entry.vy_mps, scales.vy_mps) : null;
    this.z = entry.z_m ? sums(entry.z_m, scales.x_m) : null;  // of the middle of the box
    this.jumps = new Uint8Array(this.t.length);
    for (const k of entry.jumps ?? []) this.jumps[k] = 1;
    this.filled = new Uint8Array(Math.max(this.t.length - 1, 0));
    const edges = entry.filled ?? [];
    for (let k = 0; k < edges.length; k += 2) this.filled.fill(1, edges[k], edges[k + 1]);
    this.predicted = entry.predicted ? new Predicted(entry.predicted, scales) : null;
    this.inPicture = entry.color ?? STANDING_IN_PICTURES;
    this.confidence = entry.confidence ?? null;
    this.points = entry.points ?? null;
    this.source = entry.source ?? null;
    this.paint = entry.paint ? `rgb(${entry.paint.rgb})` : null;  // its own color, where it is known
    this.paintName = entry.paint?.text ?? "";
    this.sigmas = ["sigma_xy_m", "sigma_yaw_rad", "sigma_speed_mps"].map((key) => (entry[key] ? sums(entry[key], scales[key]) : null));
    this.observedBy = entry.observed_by ?? null;  // end: spans in s; null where the scenario does not say
    this.doubts = entry.doubts ?? [];  // reason, start and end in s or null, flag
    this.doubtSpans = (entry.doubted ?? []).map(([start, end]) => [start ?? -Infinity, end ?? Infinity]);
    this.doubted = false;
    this.first = this.t[0];
    this.last = this.t[this.t.length - 1];
    this.present = this.interpolated = false;
    this.k = 0;
    this.share = 0;  // of the way from waypoint k to the next
    this.px = this.py = this.pyaw = this.pv = 0;
    this.fill = this.edge = this.pale = this.line = "";  // set by the theme
  }

  // Index of the last waypoint not after t, starting at the previous result.
  find(t) {
    const times = this.t, n = times.length;
    const k = this.k;
    if (times[k] <= t && (k + 1 === n || t < times[k + 1])) return k;
    if (k + 2 < n && times[k + 1] <= t && t < times[k + 2]) return (this.k = k + 1);
    return (this.k = Math.max(lastUntil(times, t), 0));
  }

  // Set the state at time t: position by the cubic Hermite spline of log2sim's trajectories, yaw and speed linearly.
  moveTo(t) {
    const slack = 1e-4;
    this.present = this.permanent || (t >= this.first - slack && t <= this.last + slack);
    if (!this.present) return;
    this.doubted = false;
    for (let i = 0; i < this.doubtSpans.length; i++) this.doubted ||= t >= this.doubtSpans[i][0] && t <= this.doubtSpans[i][1];
    const k = this.find(t), n = this.t.length;
    this.share = 0;
    if (k + 1 === n || t <= this.t[k]) {
      this.set(this.x[k], this.y[k], this.yaw[k], this.v[k], n > 1 && this.filled[Math.min(k, n - 2)] === 1);
      return;
    }
    const span = this.t[k + 1] - this.t[k], share = (t - this.t[k]) / span, jump = this.jumps[k] === 1;
    this.share = share;
    this.set(
      between(this.x, this.vx, k, share, span, jump),
      between(this.y, this.vy, k, share, span, jump),
      jump ? this.yaw[k] : this.yaw[k] + share * (this.yaw[k + 1] - this.yaw[k]),
      this.v[k] + share * (this.v[k + 1] - this.v[k]),
      this.filled[k] === 1,
    );
  }

  set(x, y, yaw, v, interpolated) {
    this.px = x;
    this.py = y;
    this.pyaw = yaw;
    this.pv = v;
    this.interpolated = interpolated;
  }

  get pz() { return this.z === null ? this.height / 2 : this.z[this.k] + (this.share > 0 ? this.share * (this.z[this.k + 1] - this.z[this.k]) : 0); }

  // The present standard deviation of position (0), yaw (1) or speed (2); null where it is not known.
  sigma(which) {
    const values = this.sigmas[which], k = this.k;
    return values === null ? null : values[k] + (this.share > 0 ? this.share * (values[k + 1] - values[k]) : 0);
  }

  // Whether a position in the map is inside the box or within a margin of it.
  contains(x, y, margin) {
    const dx = x - this.px, dy = y - this.py, c = Math.cos(this.pyaw), s = Math.sin(this.pyaw);
    return Math.abs(dx * c + dy * s) <= this.length / 2 + margin && Math.abs(dy * c - dx * s) <= this.width / 2 + margin;
  }
}

// The same agent in another layer: by id, else the nearest on average while both are present.
const counterpart = (track, layer) => {
  const named = layer.find((other) => other.id === track.id);
  if (named) return named;
  let best = null, closest = 2.0;
  for (const other of layer) {
    const first = Math.max(track.first, other.first), last = Math.min(track.last, other.last);
    if (other.group !== track.group || last - first < 0.3 * (track.last - track.first)) continue;
    let sum = 0;
    const samples = 16;
    for (let k = 0; k < samples; k++) {
      const t = first + ((last - first) * k) / (samples - 1);
      track.moveTo(t);
      other.moveTo(t);
      sum += Math.hypot(track.px - other.px, track.py - other.py);
    }
    if (sum / samples < closest) [best, closest] = [other, sum / samples];
  }
  return best;
};

const load = (text) => {
  const document_ = JSON.parse(text);
  const layers = {};
  for (const [name, entries] of Object.entries(document_.layers)) {
    layers[name] = entries.map((entry) => new Track(entry, document_.scales));
  }
  const events = document_.events.map((event) => ({
    ...event, tracks: (layers.replay ?? []).filter((track) => event.agents.includes(track.id)),
  }));
  const named = (name, id) => (layers[name] ?? []).find((track) => track.id === id) ?? null;
  const warnings = document_.warnings.events.map((warning) => ({
    ...warning, agents: [warning.agent], driver: named("replay", warning.driver),
    track: named("replay", warning.agent), shown: named("scenario", warning.agent),
  }));
  const { name, origin, north, metrics, recording, begin_s: begin, end_s: end } = document_;
  return {
    name, origin, begin, end, layers, events, warnings, warned: document_.warnings.title, features: loadFeatures(document_),
    background: loadBackground(document_.background), north, metrics, recording, studio: { before: document_.layers.scenario, ...document_.studio, scales: document_.scales },
    points: recording?.points ? new Points(recording.points, () => requestDraw()) : null,
  };
};
