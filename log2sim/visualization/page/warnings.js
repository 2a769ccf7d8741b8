// Warnings of collisions: listed, marked below the slider, and drawn while they last.

const WARNED_DASHES = [6, 4], BESIDE_PX = 11, cornersA = new Float64Array(8), cornersB = new Float64Array(8);

const fillCorners = (track, out) => {
  const cos = Math.cos(track.pyaw), sin = Math.sin(track.pyaw);
  for (let k = 0; k < 4; k++) {
    const ahead = (k === 0 || k === 3 ? 0.5 : -0.5) * track.length, left = (k < 2 ? 0.5 : -0.5) * track.width;
    out[2 * k] = track.px + ahead * cos - left * sin;
    out[2 * k + 1] = track.py + ahead * sin + left * cos;
  }
};

// Least distance of the corners of one box from the sides of another.
const cornerGap = (a, b) => {
  let least = Infinity;
  for (let i = 0; i < 8; i += 2) {
    for (let j = 0; j < 8; j += 2) {
      const n = (j + 2) % 8, dx = b[n] - b[j], dy = b[n + 1] - b[j + 1];
      const share = ((a[i] - b[j]) * dx + (a[i + 1] - b[j + 1]) * dy) / (dx * dx + dy * dy), s = Math.max(0, Math.min(1, share));
      least = Math.min(least, Math.hypot(a[i] - b[j] - s * dx, a[i + 1] - b[j + 1] - s * dy));
    }
  }
  return least;
};

// Distance of the nearest points of two boxes that do not overlap.
const boxGap = (a, b) => {
  fillCorners(a, cornersA);
  fillCorners(b, cornersB);
  return Math.min(cornerGap(cornersA, cornersB), cornerGap(cornersB, cornersA));
};

const isWarned = (warning, t) => {
  for (let k = 0; k < warning.spans.length; k++) if (t >= warning.spans[k][0] - 1e-4 && t <= warning.spans[k][1] + 0.1) return true;
  return false;
};

// A ring around whom the warning is about, and a line from who is warned with the distance.
const drawWarnings = (painter, warnings, t) => {
  const { ctx, view } = painter;
  for (let i = 0; i < warnings.length; i++) {
    const { driver, track } = warnings[i];
    if (!driver || !track || !isWarned(warnings[i], t)) continue;
    driver.moveTo(t);
    track.moveTo(t);
    if (!driver.present || !track.present) continue;
    painter.ring(track, theme.warn, 2.4);
    const x = view.sx(track.px), y = view.sy(track.py), ex = view.sx(driver.px), ey = view.sy(driver.py);
    ctx.beginPath();
    ctx.moveTo(ex, ey);
    ctx.lineTo(x, y);
    ctx.setLineDash(WARNED_DASHES);
    ctx.lineWidth = 1.6;
    ctx.stroke();
    ctx.setLineDash(SOLID);
    ctx.font = theme.names;
    ctx.textAlign = "center";
    ctx.textBaseline = "middle";
    const text = `${boxGap(driver, track).toFixed(1)} m`, length = Math.max(Math.hypot(x - ex, y - ey), 1);
    const side = x < ex ? -1 : 1, tx = (x + ex) / 2 - (side * BESIDE_PX * (y - ey)) / length, ty = (y + ey) / 2 + (side * BESIDE_PX * (x - ex)) / length;
    painter.letters(text, tx, ty, theme.warn);
  }
};

// The warnings with what was predicted; a click shows the moment of one.
const listWarnings = () => fillLines("warned", data.warned, data.warnings.map((warning) =>
  lineOf(warning.shown, warning.brief, () => showEvent(warning))));
