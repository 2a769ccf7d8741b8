// What was expected of agents: dotted ways, and at their ends an ellipse of one standard deviation.

const PREDICTED_DOTS = [2, 3], MAX_PREDICTION_AGE_S = 0.3;

class Predicted {
  constructor(entry, scales) {
    this.t = sums(entry.t_s, scales.t_s);
    this.dx = entry.dx_m.map((column) => sums(column, scales.dx_m));
    this.dy = entry.dy_m.map((column) => sums(column, scales.dy_m));
    this.course = sums(entry.course_rad, scales.course_rad);
    this.along = sums(entry.along_m, scales.along_m);
    this.across = sums(entry.across_m, scales.across_m);
  }

  // Index of the last prediction up to t; -1 when there is none, or only one made long before.
  find(t) {
    const k = lastUntil(this.t, t + 1e-4);
    return k >= 0 && t - this.t[k] < MAX_PREDICTION_AGE_S ? k : -1;
  }
}

// Draw where a track, which is present, is expected to go; ways start at the box, so that they move smoothly with it.
const drawPredicted = (ctx, view, track, t) => {
  const way = track.predicted, k = way === null ? -1 : way.find(t);
  if (k < 0) return;
  ctx.beginPath();
  ctx.moveTo(view.sx(track.px), view.sy(track.py));
  for (let h = 0; h < way.dx.length; h++) ctx.lineTo(view.sx(track.px + way.dx[h][k]), view.sy(track.py + way.dy[h][k]));
  ctx.setLineDash(PREDICTED_DOTS);
  ctx.lineWidth = 1.6;
  ctx.strokeStyle = track.line;
  ctx.stroke();
  const last = way.dx.length - 1;
  ctx.beginPath();
  ctx.ellipse(
    view.sx(track.px + way.dx[last][k]), view.sy(track.py + way.dy[last][k]),
    way.along[k] * view.scale, way.across[k] * view.scale, -way.course[k], 0, 2 * Math.PI,
  );
  ctx.fillStyle = track.pale;
  ctx.fill();
  ctx.setLineDash([]);
  ctx.lineWidth = 0.8;
  ctx.strokeStyle = track.trail;
  ctx.stroke();
};
