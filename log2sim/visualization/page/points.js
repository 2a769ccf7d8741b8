// LiDAR points from above at the time, colored by height above the ground or by intensity.

const POINT_COLORS = 16, GROUND_BELOW_M = 0.25;

// Colors of equal steps of height or intensity; the ground is pale, so that what stands on it is seen.
const pointColors = (dark, byIntensity, [lowest, step]) =>
  Array.from({ length: POINT_COLORS }, (_, k) => {
    const share = k / (POINT_COLORS - 1), height = lowest + (k + 0.5) * (256 / POINT_COLORS) * step;
    if (byIntensity) return `hsl(${275 - 230 * share} 75% ${dark ? 42 + 24 * share : 62 - 24 * share}%)`;
    if (height < GROUND_BELOW_M) return dark ? "hsl(215 12% 50% / .45)" : "hsl(215 12% 45% / .4)";
    return `hsl(${215 - 205 * share} 75% ${dark ? 62 : 42}%)`;
  });

class Points {
  constructor(entry, ready) {
    this.t = entry.t_s;
    this.reach = reachOf(this.t);
    this.entry = entry;
    this.byIntensity = false;
    this.decoded = new Decoded(async (k) => this.unpack(await inflate(entry.points[k]), entry.origin_m[k]), () => {}, ready);
  }

  // The columns of `pack`: steps in x and y as planes of bytes, heights, intensities.
  unpack(bytes, [east, north]) {
    const n = bytes.length / 6, x = new Float32Array(n), y = new Float32Array(n), unit = this.entry.unit_m;
    for (let k = 0, a = 0, b = 0; k < n; k++) {
      a += ((bytes[k] | (bytes[n + k] << 8)) << 16) >> 16;  // whole numbers of 16 bits with their sign
      b += ((bytes[2 * n + k] | (bytes[3 * n + k] << 8)) << 16) >> 16;
      x[k] = a * unit;
      y[k] = b * unit;
    }
    return { east, north, x, y, height: bytes.subarray(4 * n, 5 * n), intensity: bytes.subarray(5 * n), sorted: {} };
  }

  // Indices of the points by color, and where each color begins.
  sort(points) {
    const key = this.byIntensity ? "intensity" : "height";
    if (points.sorted[key]) return points.sorted[key];
    const values = points[key], begin = new Uint32Array(POINT_COLORS + 1), order = new Uint32Array(values.length);
    const shift = 8 - Math.log2(POINT_COLORS);
    for (let k = 0; k < values.length; k++) begin[(values[k] >> shift) + 1]++;
    for (let c = 0; c < POINT_COLORS; c++) begin[c + 1] += begin[c];
    const next = begin.slice();
    for (let k = 0; k < values.length; k++) order[next[values[k] >> shift]++] = k;
    return (points.sorted[key] = { order, begin });
  }

  draw({ ctx, view }, t) {
    const k = nearest(this.t, t, this.reach);
    if (k < 0) return;
    this.decoded.ask([k, k + 1, k + 2].filter((i) => i < this.t.length));
    const points = this.decoded.get(k) ?? this.last;
    if (!points) return;
    this.last = points;
    const { order, begin } = this.sort(points), size = Math.min(Math.max(this.entry.cell_m * view.scale * 0.6, 1.3), 4), half = size / 2;
    const [x0, y0] = [view.sx(points.east), view.sy(points.north)], { width, height, scale } = view;
    for (let c = 0; c < POINT_COLORS; c++) {
      ctx.fillStyle = this.colors[c];
      for (let i = begin[c]; i < begin[c + 1]; i++) {
        const sx = x0 + points.x[order[i]] * scale, sy = y0 - points.y[order[i]] * scale;
        if (sx > -4 && sy > -4 && sx < width + 4 && sy < height + 4) ctx.fillRect(sx - half, sy - half, size, size);
      }
    }
  }

  applyTheme() {
    this.colors = pointColors(matchMedia("(prefers-color-scheme: dark)").matches, this.byIntensity, this.entry.height_m);
  }
}
