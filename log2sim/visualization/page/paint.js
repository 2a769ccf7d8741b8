// Draws the state at a time onto the canvas, without allocating memory except for texts.

const SOLID = [], DASHED = [5, 4], TRUTH_DASHES = [4, 3], DOTTED = [1.5, 2.5];
const TRAIL_S = 3, SMALL_PX = 6, SLIM_PX = 4, STRIPES_PX = 4, MAX_LABELS = 64, MIN_NAMED_STANDING_PX = 16;

class Painter {
  constructor(canvas, view) {
    this.canvas = canvas;
    this.view = view;
    this.ctx = canvas.getContext("2d", { alpha: false });
    this.corner = new Float64Array(8);
    this.taken = new Float64Array(4 * MAX_LABELS);
    this.labels = 0;
  }

  resize() {
    scaledContext(this.canvas);
    [this.view.width, this.view.height] = [this.canvas.clientWidth, this.canvas.clientHeight];
  }

  // shown: which layers and extras; chosen, hovered: tracks of the scenario or null.
  paint({ layers, events, warnings, features, background, points, north }, t, shown, chosen, hovered) {
    const ctx = this.ctx;
    ctx.setLineDash(SOLID);
    ctx.lineJoin = "round";
    ctx.fillStyle = theme.ground;
    ctx.fillRect(0, 0, this.view.width + 1, this.view.height + 1);  // the last pixel may be half one
    if (shown.ground && background) drawBackground(this, background);
    drawSensors(this, features.sensors);
    if (shown.lanes) drawFeatures(this, features, shown.ground && background !== null);
    this.grid();
    if (shown.points && points) points.draw(this, t);
    for (const track of layers.scenario) track.moveTo(t);
    if (shown.scenario) this.scene(layers.scenario, t, shown, chosen);
    if (shown.scenario && shown.predictions) this.predictions(layers.scenario, t);
    if (shown.truth && layers.truth) this.outlines(layers.truth, t, TRUTH_DASHES, 1.1);
    if (shown.replay && layers.replay) this.outlines(layers.replay, t, DOTTED, 1.6);
    ctx.setLineDash(SOLID);
    if (shown.scenario && shown.ends) drawEnds(this, layers.scenario, t);
    if (shown.replay) drawWarnings(this, warnings, t);
    if (shown.replay) ringCollisions(this, events, t);
    if (shown.scenario && chosen && chosen.present) this.ring(chosen, theme.accent, 2);
    if (shown.scenario && hovered && hovered !== chosen && hovered.present) this.ring(hovered, theme.muted, 1.2);
    if (shown.lanes) drawSignals(this, features.signals, t);
    this.labels = 0;
    if (shown.replay) nameCollisions(this, events, t);
    if (shown.scenario) this.names(layers.scenario, shown, chosen, hovered);
    drawScaleBar(this, north);
  }

  grid() {
    const { ctx, view } = this, step = niceStep(140 / view.scale);
    ctx.strokeStyle = theme.grid;
    ctx.lineWidth = 1;
    ctx.beginPath();
    for (let k = Math.ceil(view.mx(0) / step); k * step <= view.mx(view.width); k++) {
      const sx = Math.round(view.sx(k * step)) + 0.5;
      ctx.moveTo(sx, 0);
      ctx.lineTo(sx, view.height);
    }
    for (let k = Math.ceil(view.my(view.height) / step); k * step <= view.my(0); k++) {
      const sy = Math.round(view.sy(k * step)) + 0.5;
      ctx.moveTo(0, sy);
      ctx.lineTo(view.width, sy);
    }
    ctx.stroke();
  }

  scene(tracks, t, shown, chosen) {
    if (chosen && !chosen.stationary) this.path(chosen, chosen.first, chosen.last, chosen.pale, 2.5);
    if (shown.trails) {
      for (let i = tracks.length - 1; i >= 0; i--) {
        const track = tracks[i];
        if (track.present && !track.stationary) this.path(track, t - TRAIL_S, t, track.trail, track.ego ? 2.6 : track.leading ? 2 : 1.4);
      }
    }
    for (let i = tracks.length - 1; i >= 0; i--) if (tracks[i].present) this.box(tracks[i]);
  }

  predictions(tracks, t) {
    for (let i = tracks.length - 1; i >= 0; i--) if (tracks[i].present) drawPredicted(this.ctx, this.view, tracks[i], t);
  }

  // A part of a track, dashed where it was not observed.
  path(track, from, to, color, width) {
    const { ctx, view } = this, n = track.t.length, end = track.find(Math.min(to, track.last));
    let k = end;
    while (k > 0 && track.t[k] > from) k--;
    ctx.strokeStyle = color;
    ctx.lineWidth = width;
    ctx.lineCap = "butt";
    let dashed = -1;
    for (; k <= end && k + 1 < n; k++) {
      if (track.filled[k] !== dashed) {
        if (dashed >= 0) ctx.stroke();
        dashed = track.filled[k];
        ctx.setLineDash(dashed ? DASHED : SOLID);
        ctx.beginPath();
        const late = Math.max(0, Math.min(1, (from - track.t[k]) / (track.t[k + 1] - track.t[k])));
        ctx.moveTo(view.sx(track.x[k] + late * (track.x[k + 1] - track.x[k])), view.sy(track.y[k] + late * (track.y[k + 1] - track.y[k])));
      }
      if (track.t[k + 1] <= to) ctx.lineTo(view.sx(track.x[k + 1]), view.sy(track.y[k + 1]));
      else ctx.lineTo(view.sx(track.px), view.sy(track.py));
    }
    if (dashed >= 0) ctx.stroke();
    ctx.setLineDash(SOLID);
  }

  // Fill `corner` with front left, rear left, rear right, front right; returns whether any of it can be visible.
  corners(track, grow) {
    const view = this.view, c = this.corner, sx = view.sx(track.px), sy = view.sy(track.py);
    const ahead = (track.length / 2) * view.scale + grow, left = (track.width / 2) * view.scale + grow, reach = ahead + left;
    if (sx < -reach || sy < -reach || sx > view.width + reach || sy > view.height + reach) return false;
    const cos = Math.cos(track.pyaw), sin = Math.sin(track.pyaw);
    const ax = ahead * cos, ay = -ahead * sin, lx = -left * sin, ly = -left * cos;
    c[0] = sx + ax + lx; c[1] = sy + ay + ly;
    c[2] = sx - ax + lx; c[3] = sy - ay + ly;
    c[4] = sx - ax - lx; c[5] = sy - ay - ly;
    c[6] = sx + ax - lx; c[7] = sy + ay - ly;
    return true;
  }

  trace() {
    const { ctx, corner: c } = this;
    ctx.beginPath();
    ctx.moveTo(c[0], c[1]);
    ctx.lineTo(c[2], c[3]);
    ctx.lineTo(c[4], c[5]);
    ctx.lineTo(c[6], c[7]);
    ctx.closePath();
  }

  // A footprint at true size with a heading mark; a dot when that would be too small to see.
  box(track) {
    const { ctx, corner: c } = this;
    if (!this.corners(track, 0)) return;
    if (track.length * this.view.scale < SMALL_PX) return this.dot(track);
    this.trace();
    ctx.fillStyle = track.interpolated ? track.pale : track.fill;
    ctx.fill();
    const slim = track.width * this.view.scale < SLIM_PX;
    const outlined = track.interpolated || track.doubted;
    if (slim && !outlined) return;  // an outline and a heading mark would cover it
    if (track.doubted) {
      this.stripes(track.interpolated ? track.outline : track.stripes);
      this.trace();
    }
    ctx.lineWidth = outlined ? 1.2 : 0.8;
    ctx.strokeStyle = track.doubted ? track.outline : track.interpolated ? track.line : track.edge;
    ctx.setLineDash(track.interpolated ? DASHED : SOLID);
    ctx.stroke();
    ctx.setLineDash(SOLID);
    if (slim) return;
    const depth = 0.42, inset = 0.2;
    const lx = c[0] + depth * (c[2] - c[0]), ly = c[1] + depth * (c[3] - c[1]);
    const rx = c[6] + depth * (c[4] - c[6]), ry = c[7] + depth * (c[5] - c[7]);
    ctx.beginPath();
    ctx.moveTo(lx + inset * (rx - lx), ly + inset * (ry - ly));
    ctx.lineTo(rx + inset * (lx - rx), ry + inset * (ly - ry));
    ctx.lineTo((c[0] + c[6]) / 2, (c[1] + c[7]) / 2);
    ctx.closePath();
    ctx.fillStyle = track.interpolated ? track.line : track.headingMark;
    ctx.fill();
    if (!track.paint || track.interpolated) return;
    ctx.lineWidth = 0.8;
    ctx.strokeStyle = track.stationary ? theme.parked_edge : theme.headingMark;
    ctx.stroke();
  }

  // Stripes across the box in `corner`, at 45 degrees to its sides as in the pictures; they move with it.
  stripes(color) {
    const { ctx, corner: c } = this, ax = c[0] - c[2], ay = c[1] - c[3], bx = c[4] - c[2], by = c[5] - c[3];
    const length = Math.hypot(ax, ay), width = Math.hypot(bx, by), reach = length + width;
    const count = Math.max(Math.floor(reach / (STRIPES_PX * Math.SQRT2)), 2);
    ctx.beginPath();
    for (let k = 0; k < count; k++) {
      const offset = ((k + 0.5) / count) * reach - width;
      const a = Math.max(offset, 0) / length, b = Math.max(-offset, 0) / width;
      const along = Math.min(length, offset + width) / length, across = Math.min(width, length - offset) / width;
      ctx.moveTo(c[2] + a * ax + b * bx, c[3] + a * ay + b * by);
      ctx.lineTo(c[2] + along * ax + across * bx, c[3] + along * ay + across * by);
    }
    ctx.strokeStyle = color;
    ctx.lineWidth = 1.2;
    ctx.stroke();
  }

  // The marker of the category, as in the legends of the pictures: square, diamond, circle, triangle.
  dot(track) {
    const { ctx, view } = this, r = track.stationary ? 2 : 3.2, sx = view.sx(track.px), sy = view.sy(track.py);
    ctx.beginPath();
    if (track.group === "pedestrian") ctx.arc(sx, sy, r, 0, 2 * Math.PI);
    else if (track.group === "vehicle") ctx.rect(sx - r, sy - r, 2 * r, 2 * r);
    else {
      const top = track.group === "two_wheeler" ? 1.3 : 1.1;
      ctx.moveTo(sx, sy - top * r);
      ctx.lineTo(sx + 1.2 * r, track.group === "two_wheeler" ? sy : sy + r);
      if (track.group === "two_wheeler") ctx.lineTo(sx, sy + top * r);
      ctx.lineTo(sx - 1.2 * r, track.group === "two_wheeler" ? sy : sy + r);
      ctx.closePath();
    }
    ctx.fillStyle = track.interpolated ? track.pale : track.fill;
    ctx.fill();
    ctx.lineWidth = 0.8;
    ctx.strokeStyle = track.doubted ? theme.alert : track.interpolated ? track.line : track.edge;
    ctx.stroke();
  }

  // Boxes of another layer, hollow.
  outlines(tracks, t, dashes, width) {
    const ctx = this.ctx;
    for (let i = 0; i < tracks.length; i++) {
      const track = tracks[i];
      track.moveTo(t);
      if (!track.present || !this.corners(track, 0)) continue;
      this.trace();
      ctx.setLineDash(dashes);
      ctx.strokeStyle = track.line;
      ctx.lineWidth = width;
      ctx.stroke();
    }
  }

  ring(track, color, width) {
    if (!this.corners(track, 3.5)) return;
    this.trace();
    this.ctx.strokeStyle = color;
    this.ctx.lineWidth = width;
    this.ctx.stroke();
  }

  // Names where there is room, first of leading movers, then of others, of standing ones if their boxes are not tiny; always of the
  // chosen and the hovered agent.
  names(tracks, shown, chosen, hovered) {
    this.ctx.font = theme.names;
    this.ctx.textAlign = "center";
    this.ctx.textBaseline = "alphabetic";
    if (chosen) this.label(chosen, true);
    if (hovered && hovered !== chosen) this.label(hovered, true);
    if (!shown.names) return;
    for (let rank = 0; rank < 3; rank++) {
      for (let i = 0; i < tracks.length; i++) {
        const track = tracks[i];
        if (track === chosen || track === hovered || (track.stationary ? 2 : track.leading ? 0 : 1) !== rank) continue;
        if (!track.stationary || track.length * this.view.scale >= MIN_NAMED_STANDING_PX) this.label(track, false);
      }
    }
  }

  label(track, forced) {
    if (!track.present || !this.corners(track, 0)) return;
    const { ctx, corner: c } = this, half = track.halfWidth ?? (track.halfWidth = ctx.measureText(track.label).width / 2 + 2);
    const bottom = Math.min(c[1], c[3], c[5], c[7]) - 4;
    this.write(track.label, (c[0] + c[4]) / 2, bottom, half, track.stationary ? theme.muted : track.line, forced);
  }

  // Write a text, of which half the width is known, where no other is; a forced one always.
  write(text, sx, bottom, half, color, forced) {
    const taken = this.taken;
    if (this.labels === MAX_LABELS) return;
    for (let k = 0; k < 4 * this.labels && !forced; k += 4) {
      if (sx - half < taken[k + 2] && sx + half > taken[k] && bottom - 12 < taken[k + 3] && bottom + 2 > taken[k + 1]) return;
    }
    const k = 4 * this.labels++;
    taken[k] = sx - half;
    taken[k + 1] = bottom - 12;
    taken[k + 2] = sx + half;
    taken[k + 3] = bottom + 2;
    this.letters(text, sx, bottom, color);
  }

  // A text with a halo that keeps it readable.
  letters(text, sx, sy, color) {
    const ctx = this.ctx;
    ctx.lineWidth = 3;
    ctx.strokeStyle = theme.halo;
    ctx.strokeText(text, sx, sy);
    ctx.fillStyle = color;
    ctx.fillText(text, sx, sy);
  }
}
