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

// The four bytes of colors as pixels hold them.
const pixelsOf = (colors) => {
  const pen = new OffscreenCanvas(colors.length, 1).getContext("2d", { willReadFrequently: true });
  colors.forEach((color, k) => {
    pen.fillStyle = color;
    pen.fillRect(k, 0, 1, 1);
  });
  return new Uint32Array(pen.getImageData(0, 0, colors.length, 1).data.buffer);
};

class Points {
  constructor(entry, ready) {
    this.t = entry.t_s;
    this.reach = reachOf(this.t);
    this.entry = entry;
    this.byIntensity = false;
    this.layer = new OffscreenCanvas(1, 1);
    this.decoded = new Decoded(async (k) => this.unpack(await inflate(entry.points[k]), entry.origin_m[k]), () => {}, ready);
  }

  // The columns of `pack_recording`: steps in x and y as planes of bytes, heights, intensities.
  unpack(bytes, [east, north]) {
    const n = bytes.length / 6, x = new Float32Array(n), y = new Float32Array(n), unit = this.entry.unit_m;
    for (let k = 0, a = 0, b = 0; k < n; k++) {
      a += ((bytes[k] | (bytes[n + k] << 8)) << 16) >> 16;  // whole numbers of 16 bits with their sign
      b += ((bytes[2 * n + k] | (bytes[3 * n + k] << 8)) << 16) >> 16;
      x[k] = a * unit;
      y[k] = b * unit;
    }
    return { east, north, x, y, height: bytes.subarray(4 * n, 5 * n), intensity: bytes.subarray(5 * n) };
  }

  // Show the points of the nearest moment, or those before while they are decoded.
  draw({ ctx, view, canvas }, t) {
    const k = nearest(this.t, t, this.reach);
    if (k < 0) return;
    this.decoded.ask([k, k + 1, k + 2].filter((i) => i < this.t.length));
    const points = this.decoded.get(k) ?? this.last;
    if (!points) return;
    this.last = points;
    const key = [points, view.x, view.y, view.scale, canvas.width, canvas.height, this.pixels];
    if (!this.key?.every((value, i) => value === key[i])) {
      this.key = key;
      this.fill(points, view, canvas.width, canvas.height);
    }
    ctx.save();
    ctx.resetTransform();
    ctx.drawImage(this.layer, 0, 0);
    ctx.restore();
  }

  // Write the pixels of all points: many times faster than to fill as many rectangles.
  fill(points, view, width, height) {
    const image = new ImageData(width, height), out = new Uint32Array(image.data.buffer), ratio = width / view.width;
    const scale = view.scale * ratio, x0 = view.sx(points.east) * ratio, y0 = view.sy(points.north) * ratio;
    const size = Math.round(Math.min(Math.max(this.entry.cell_m * view.scale * 0.6, 1.5), 4) * ratio), half = size / 2;
    const values = this.byIntensity ? points.intensity : points.height, shift = 8 - Math.log2(POINT_COLORS);
    for (let k = 0; k < values.length; k++) {
      const left = Math.round(x0 + points.x[k] * scale - half), top = Math.round(y0 - points.y[k] * scale - half);
      if (left < 0 || top < 0 || left + size > width || top + size > height) continue;
      const color = this.pixels[values[k] >> shift];
      for (let row = top; row < top + size; row++) out.fill(color, row * width + left, row * width + left + size);
    }
    [this.layer.width, this.layer.height] = [width, height];
    this.layer.getContext("2d").putImageData(image, 0, 0);
  }

  applyTheme() {
    this.colors = pointColors(matchMedia("(prefers-color-scheme: dark)").matches, this.byIntensity, this.entry.height_m);
    this.pixels = pixelsOf(this.colors);
  }
}
