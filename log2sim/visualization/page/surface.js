// What is edited is the same in the map and in the pictures: surfaces take places of the map to their pixels and back.

const NEAR_M = 0.1, UNDISTORT_STEPS = 60;

const mapSurface = {
  flat: true,
  to: (x, y) => [view.sx(x), view.sy(y)],
  from: (sx, sy) => [view.mx(sx), view.my(sy)],
};

// A camera as log2sim's geometry has it: brown or fisheye, z forward, (0, 0) the center of the first pixel.
class Calibrated {
  // entry: K (fx, fy, cx, cy), model, distortion, reach (of x / z, before the lens model folds), t_s, cam_T_map (rows of 12, null where it is not known)
  constructor(entry) { Object.assign(this, entry); }

  poseAt(t) {
    const k = nearest(this.t_s, t, Infinity);
    return k < 0 ? null : this.cam_T_map[k];
  }

  distort(x, y) {
    const [k1 = 0, k2 = 0, k3 = 0, k4 = 0, k5 = 0, k6 = 0, k7 = 0, k8 = 0] = this.distortion, r2 = x * x + y * y;
    if (this.model === "fisheye") {
      const r = Math.sqrt(r2), a = Math.atan(r), a2 = a * a, scale = r > 1e-9 ? (a * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))) / r : 1;
      return [x * scale, y * scale];
    }
    // In the order of OpenCV: k1, k2, p1, p2, k3, and a denominator of three more.
    const scale = (1 + r2 * (k1 + r2 * (k2 + r2 * k5))) / (1 + r2 * (k6 + r2 * (k7 + r2 * k8)));
    return [x * scale + 2 * k3 * x * y + k4 * (r2 + 2 * x * x), y * scale + k3 * (r2 + 2 * y * y) + 2 * k4 * x * y];
  }

  undistort(u, v) {
    let x = u, y = v;
    for (let i = 0; i < UNDISTORT_STEPS; i++) {
      const [a, b] = this.distort(x, y);
      [x, y] = [x + u - a, y + v - b];
    }
    return [x, y];
  }

  toCamera(m, x, y, z) {
    return [0, 4, 8].map((row) => m[row] * x + m[row + 1] * y + m[row + 2] * z + m[row + 3]);
  }

  // Pixel of a point in front of the camera, cam frame; null where the lens model says nothing.
  pixel([x, y, z]) {
    if (z < NEAR_M || Math.hypot(x / z, y / z) > this.reach) return null;
    const [u, v] = this.distort(x / z, y / z), [fx, fy, cx, cy] = this.K;
    return [fx * u + cx, fy * v + cy];
  }

  // Where the ray of a pixel meets the height z; null above the horizon.
  ground(m, u, v, z) {
    const [fx, fy, cx, cy] = this.K, [a, b] = this.undistort((u - cx) / fx, (v - cy) / fy);
    const along = (column) => m[column] * a + m[4 + column] * b + m[8 + column];
    const origin = [0, 1, 2].map((column) => -(m[column] * m[3] + m[4 + column] * m[7] + m[8 + column] * m[11]));
    const far = (z - origin[2]) / along(2);
    return far > 0 && Number.isFinite(far) ? [origin[0] + far * along(0), origin[1] + far * along(1)] : null;
  }

  // The picture of a tile at its time.
  surface(tile) {
    const m = tile.shown < 0 ? null : this.poseAt(tile.t[tile.shown]), scale = tile.canvas.clientWidth / tile.width;
    if (!m) return null;
    return {
      flat: false,
      to: (x, y, z) => this.pixel(this.toCamera(m, x, y, z))?.map((value) => value * scale) ?? null,
      from: (sx, sy, z) => this.ground(m, sx / scale, sy / scale, z),
    };
  }

  // Edges of a box as segments u0, v0, u1, v1, px, cut where they pass the camera; none where it is not in the picture.
  segments(t, corners, width, height) {
    const m = this.poseAt(t), out = [];
    if (!m) return out;
    const cam = corners.map((corner) => this.toCamera(m, ...corner));
    for (const [a, b] of BOX_EDGES) {
      let [p, q] = [cam[a], cam[b]];
      if (p[2] < NEAR_M && q[2] < NEAR_M) continue;
      const cut = (near, far) => near.map((value, k) => value + ((NEAR_M * 1.001 - near[2]) / (far[2] - near[2])) * (far[k] - value));
      if (p[2] < NEAR_M) p = cut(p, q); else if (q[2] < NEAR_M) q = cut(q, p);
      const ends = [this.pixel(p), this.pixel(q)];
      if (ends[0] && ends[1]) out.push(...ends[0], ...ends[1]);
    }
    const seen = out.some((u, k) => k % 2 === 0 && u > 0 && u < width && out[k + 1] > 0 && out[k + 1] < height);
    return seen ? out : [];
  }
}

// Corners (8) of a box on the ground, in the order of log2sim's `box_corners`.
const cornersOf = ({ x, y, z, yaw, length, width, height }) => {
  const c = Math.cos(yaw), s = Math.sin(yaw);
  return [z, z + height].flatMap((up) => [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([a, b]) =>
    [x + (a * length * c - b * width * s) / 2, y + (a * length * s + b * width * c) / 2, up]));
};
