// The visible part of the map, in CSS pixels: x to the right, y up in the map and down on the screen.

const SCALES_PX_PER_M = [0.02, 400];

class View {
  constructor() {
    this.x = this.y = 0;
    this.scale = 10;
    this.width = this.height = 1;
  }

  sx(x) { return (x - this.x) * this.scale + this.width / 2; }
  sy(y) { return this.height / 2 - (y - this.y) * this.scale; }
  mx(sx) { return (sx - this.width / 2) / this.scale + this.x; }
  my(sy) { return (this.height / 2 - sy) / this.scale + this.y; }

  drag(dx, dy) {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
  }

  // Zoom so that the position under a point of the screen stays fixed.
  zoom(factor, sx, sy) {
    const x = this.mx(sx), y = this.my(sy);
    this.scale = Math.min(Math.max(this.scale * factor, SCALES_PX_PER_M[0]), SCALES_PX_PER_M[1]);
    this.x += x - this.mx(sx);
    this.y += y - this.my(sy);
  }

  // Show the tracks of movers without far outliers, as the pictures do, inside the controls at the edges.
  fit(tracks, inset) {
    const box = extent(tracks);
    const width = Math.max(this.width - inset.left - inset.right, 40);
    const height = Math.max(this.height - inset.top - inset.bottom, 40);
    this.scale = Math.min(width / Math.max(box[1] - box[0], 20), height / Math.max(box[3] - box[2], 20));
    this.x = (box[0] + box[1]) / 2 + (inset.right - inset.left) / 2 / this.scale;
    this.y = (box[2] + box[3]) / 2 + (inset.top - inset.bottom) / 2 / this.scale;
  }
}

// Positions of tracks, at most 25 of each.
const positions = (tracks) =>
  tracks.flatMap((track) => {
    const step = Math.max(1, Math.ceil(track.t.length / 24)), out = [];
    for (let k = 0; k < track.t.length; k += step) out.push([track.x[k], track.y[k]]);
    out.push([track.x[track.t.length - 1], track.y[track.t.length - 1]]);
    return out;
  });

const middle = (values) => values.sort((a, b) => a - b)[values.length >> 1];

// West, east, south, north of what to show: the ego's track, movers within 60 m or three quartiles, stationary agents nearby.
const extent = (tracks) => {
  const ego = tracks.find((track) => track.ego), movers = tracks.filter((track) => !track.stationary);
  const points = positions(movers.length ? movers : tracks);
  if (!points.length) return [-10, 10, -10, 10];
  const core = ego ? positions([ego]) : [[middle(points.map((p) => p[0])), middle(points.map((p) => p[1]))]];
  const far = (p) => Math.min(...core.map((c) => Math.hypot(p[0] - c[0], p[1] - c[1])));
  const distances = points.map(far).sort((a, b) => a - b);
  const limit = Math.max(60, movers.length > 12 ? 2 * distances[distances.length >> 1] : 3 * distances[(distances.length * 3) >> 2]);
  let kept = points.filter((p) => far(p) <= limit);
  if (ego) kept = kept.concat(positions(tracks.filter((track) => track.stationary)).filter((p) => far(p) <= 25));
  const box = [Infinity, -Infinity, Infinity, -Infinity];
  for (const [x, y] of kept) {
    box[0] = Math.min(box[0], x - 5);
    box[1] = Math.max(box[1], x + 5);
    box[2] = Math.min(box[2], y - 5);
    box[3] = Math.max(box[3], y + 5);
  }
  return box;
};

// The largest of 1, 2, 5 times a power of ten that is not above a target.
const niceStep = (target) => {
  const power = 10 ** Math.floor(Math.log10(target));
  return [5, 2, 1].map((s) => s * power).find((s) => s <= target * (1 + 1e-9)) ?? power;
};
