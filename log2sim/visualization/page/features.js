// Lanes, markings, borders of roads and traffic lights.

const AREAS = ["crosswalk", "other"], MARKING_DASHES = [10, 8], SIGNAL_PX = 5, MIN_MARKING_PX = 1;

const pathOf = (columns, scales, closed) => {
  const x = sums(columns.x_m, scales.x_m), y = sums(columns.y_m, scales.y_m), path = new Path2D();
  for (let k = 0; k < x.length; k++) k ? path.lineTo(x[k], y[k]) : path.moveTo(x[k], y[k]);
  if (closed) path.closePath();
  return path;
};

// Paths are in m of the map and are drawn through the transformation of the view.
const loadFeatures = (document_) => {
  const { lanes, borders, markings, signals, sensors, notes } = document_.features, scales = document_.scales;
  return {
    lanes: lanes.map((lane) => pathOf(lane.outline, scales, true)),
    arrows: lanes.flatMap((lane) => lane.arrows.map((arrow) => pathOf(arrow, scales, true))),
    borders: borders.map((border) => pathOf(border, scales, false)),
    markings: markings.map((marking) => ({ ...marking, area: AREAS.includes(marking.kind), path: pathOf(marking, scales, AREAS.includes(marking.kind)) })),
    signals, sensors, notes, some: lanes.length + borders.length + markings.length > 0,
  };
};

// Lanes are pale above a picture of the ground, which shows more.
const drawFeatures = (painter, features, overGround) => {
  const { ctx, view } = painter, ratio = painter.canvas.width / Math.max(painter.canvas.clientWidth, 1), scale = view.scale;
  ctx.save();
  ctx.setTransform(ratio * scale, 0, 0, -ratio * scale, ratio * view.sx(0), ratio * view.sy(0));
  ctx.fillStyle = theme.lane;
  ctx.globalAlpha = overGround ? 0.3 : 1;
  for (const path of features.lanes) ctx.fill(path);
  ctx.fillStyle = theme.lane_arrow;
  if (scale > 3) for (const path of features.arrows) ctx.fill(path);
  ctx.globalAlpha = 1;
  ctx.strokeStyle = theme.border;
  ctx.lineWidth = 1.2 / scale;
  for (const path of features.borders) ctx.stroke(path);
  for (const marking of features.markings) {
    ctx.strokeStyle = ctx.fillStyle = marking.yellow ? theme.yellow_marking : theme.marking;
    ctx.globalAlpha = marking.doubtful ? 0.4 : 1;
    ctx.lineWidth = marking.area ? 0.8 / scale : Math.max(marking.width_m, MIN_MARKING_PX / scale);
    ctx.setLineDash(marking.kind === "dashed" ? MARKING_DASHES.map((px) => px / scale) : SOLID);
    ctx.stroke(marking.path);
    if (marking.area) {
      ctx.globalAlpha *= 0.25;
      ctx.fill(marking.path);
    }
  }
  ctx.restore();
};

// The state from the last time that is not after t.
const stateOf = (signal, t) => {
  const k = lastUntil(signal.t_s, t + 1e-4);
  return k < 0 ? "unknown" : signal.state[k];
};

// Sensors that are fixed in the map, with their fields of view; of those that look all around only the range.
const drawSensors = (painter, sensors) => {
  const { ctx, view } = painter;
  ctx.fillStyle = ctx.strokeStyle = theme.road;
  for (const { x_m, y_m, yaw_rad, fov_rad, range_m } of sensors) {
    const x = view.sx(x_m), y = view.sy(y_m);
    ctx.beginPath();
    const around = fov_rad > 6.28;
    if (!around) ctx.moveTo(x, y);
    ctx.arc(x, y, range_m * view.scale, -yaw_rad - fov_rad / 2, -yaw_rad + fov_rad / 2);
    ctx.closePath();
    ctx.globalAlpha = 0.06;
    if (!around) ctx.fill();
    ctx.globalAlpha = 0.5;
    ctx.stroke();
    ctx.globalAlpha = 1;
    ctx.beginPath();
    ctx.moveTo(x, y - 5), ctx.lineTo(x + 5, y + 4), ctx.lineTo(x - 5, y + 4);
    ctx.fill();
  }
};

const drawSignals = (painter, signals, t) => {
  const { ctx, view } = painter;
  for (let i = 0; i < signals.length; i++) {
    ctx.beginPath();
    ctx.arc(view.sx(signals[i].at_m[0]), view.sy(signals[i].at_m[1]), SIGNAL_PX, 0, 2 * Math.PI);
    ctx.fillStyle = theme[`signal_${stateOf(signals[i], t)}`];
    ctx.fill();
    ctx.lineWidth = 1.4;
    ctx.strokeStyle = theme.paper;
    ctx.stroke();
  }
};
