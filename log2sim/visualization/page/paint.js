// Paints a moment onto the one canvas. A loop over columns a layer; nothing is allocated but the strings of the scale bar.

const SOLID = [], DASHED = [5, 4], TRUTH_DASHES = [4, 3], DOTTED = [1.5, 2.5];
const TRAIL_S = 3, SMALL_PX = 6, SLIM_PX = 4, MOST_LABELS = 64;

class Painter {
  constructor(canvas, view) {
    this.canvas = canvas;
    this.view = view;
    this.pen = canvas.getContext("2d", { alpha: false });
    this.corner = new Float64Array(8);
    this.taken = new Float64Array(4 * MOST_LABELS);
    this.labels = 0;
  }

  resize() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), { clientWidth: width, clientHeight: height } = this.canvas;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.view.resize(width, height);
  }

  // shown: which layers and extras; chosen, hovered: tracks of the log or null.
  paint({ layers, events }, t, shown, chosen, hovered) {
    const pen = this.pen;
    pen.setLineDash(SOLID);
    pen.lineJoin = "round";
    pen.fillStyle = theme.ground;
    pen.fillRect(0, 0, this.view.width + 1, this.view.height + 1);  // the last pixel may be half one
    this.grid();
    for (const track of layers.log) track.moveTo(t);
    if (shown.log) this.log(layers.log, t, shown, chosen);
    if (shown.truth && layers.truth) this.outlines(layers.truth, t, TRUTH_DASHES, 1.1);
    if (shown.replay && layers.replay) this.outlines(layers.replay, t, DOTTED, 1.6);
    pen.setLineDash(SOLID);
    if (shown.replay) this.contacts(events, t);
    if (shown.log && chosen && chosen.there) this.ring(chosen, theme.accent, 2);
    if (shown.log && hovered && hovered !== chosen && hovered.there) this.ring(hovered, theme.muted, 1.2);
    if (shown.log) this.names(layers.log, shown, chosen, hovered);
    this.scaleBar();
  }

  grid() {
    const { pen, view } = this, step = niceStep(140 / view.scale);
    pen.strokeStyle = theme.grid;
    pen.lineWidth = 1;
    pen.beginPath();
    for (let k = Math.ceil(view.mx(0) / step); k * step <= view.mx(view.width); k++) {
      const sx = Math.round(view.sx(k * step)) + 0.5;
      pen.moveTo(sx, 0);
      pen.lineTo(sx, view.height);
    }
    for (let k = Math.ceil(view.my(view.height) / step); k * step <= view.my(0); k++) {
      const sy = Math.round(view.sy(k * step)) + 0.5;
      pen.moveTo(0, sy);
      pen.lineTo(view.width, sy);
    }
    pen.stroke();
  }

  log(tracks, t, shown, chosen) {
    if (chosen && !chosen.standing) this.way(chosen, chosen.first, chosen.last, chosen.pale, 2.5);
    if (shown.trails) {
      for (let i = tracks.length - 1; i >= 0; i--) {
        const track = tracks[i];
        if (track.there && !track.standing) this.way(track, t - TRAIL_S, t, track.trail, track.ego ? 2.6 : track.leading ? 2 : 1.4);
      }
    }
    for (let i = tracks.length - 1; i >= 0; i--) if (tracks[i].there) this.box(tracks[i]);
  }

  // The way of a track from one time to another, dashed where nobody saw it.
  way(track, from, to, color, width) {
    const { pen, view } = this, n = track.t.length, end = track.find(Math.min(to, track.last));
    let k = end;
    while (k > 0 && track.t[k] > from) k--;
    pen.strokeStyle = color;
    pen.lineWidth = width;
    pen.lineCap = "butt";
    let dashed = -1;
    for (; k <= end && k + 1 < n; k++) {
      if (track.filled[k] !== dashed) {
        if (dashed >= 0) pen.stroke();
        dashed = track.filled[k];
        pen.setLineDash(dashed ? DASHED : SOLID);
        pen.beginPath();
        const late = Math.max(0, Math.min(1, (from - track.t[k]) / (track.t[k + 1] - track.t[k])));
        pen.moveTo(view.sx(track.x[k] + late * (track.x[k + 1] - track.x[k])), view.sy(track.y[k] + late * (track.y[k + 1] - track.y[k])));
      }
      if (track.t[k + 1] <= to) pen.lineTo(view.sx(track.x[k + 1]), view.sy(track.y[k + 1]));
      else pen.lineTo(view.sx(track.px), view.sy(track.py));
    }
    if (dashed >= 0) pen.stroke();
    pen.setLineDash(SOLID);
  }

  // Fill `corner` with front left, rear left, rear right, front right; whether any of it can be in sight.
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
    const { pen, corner: c } = this;
    pen.beginPath();
    pen.moveTo(c[0], c[1]);
    pen.lineTo(c[2], c[3]);
    pen.lineTo(c[4], c[5]);
    pen.lineTo(c[6], c[7]);
    pen.closePath();
  }

  // A footprint at true size with a nose at its front; a dot where that would be too small to see.
  box(track) {
    const { pen, corner: c } = this;
    if (!this.corners(track, 0)) return;
    if (track.length * this.view.scale < SMALL_PX) return this.dot(track);
    this.trace();
    pen.fillStyle = track.guessed ? track.pale : track.fill;
    pen.fill();
    const slim = track.width * this.view.scale < SLIM_PX;
    if (slim && !track.guessed) return;  // a rim and a nose would leave nothing of it
    pen.lineWidth = track.guessed ? 1.2 : 0.8;
    pen.strokeStyle = track.guessed ? track.line : track.edge;
    pen.setLineDash(track.guessed ? DASHED : SOLID);
    pen.stroke();
    pen.setLineDash(SOLID);
    if (slim) return;
    const depth = 0.42, inset = 0.2;
    const lx = c[0] + depth * (c[2] - c[0]), ly = c[1] + depth * (c[3] - c[1]);
    const rx = c[6] + depth * (c[4] - c[6]), ry = c[7] + depth * (c[5] - c[7]);
    pen.beginPath();
    pen.moveTo(lx + inset * (rx - lx), ly + inset * (ry - ly));
    pen.lineTo(rx + inset * (lx - rx), ry + inset * (ly - ry));
    pen.lineTo((c[0] + c[6]) / 2, (c[1] + c[7]) / 2);
    pen.closePath();
    pen.fillStyle = track.guessed ? track.line : track.nose;
    pen.fill();
  }

  // The marker of the category, as in the legends of the pictures: square, diamond, circle, triangle.
  dot(track) {
    const { pen, view } = this, r = track.standing ? 2 : 3.2, sx = view.sx(track.px), sy = view.sy(track.py);
    pen.beginPath();
    if (track.group === "pedestrian") pen.arc(sx, sy, r, 0, 2 * Math.PI);
    else if (track.group === "vehicle") pen.rect(sx - r, sy - r, 2 * r, 2 * r);
    else {
      const top = track.group === "two_wheeler" ? 1.3 : 1.1;
      pen.moveTo(sx, sy - top * r);
      pen.lineTo(sx + 1.2 * r, track.group === "two_wheeler" ? sy : sy + r);
      if (track.group === "two_wheeler") pen.lineTo(sx, sy + top * r);
      pen.lineTo(sx - 1.2 * r, track.group === "two_wheeler" ? sy : sy + r);
      pen.closePath();
    }
    pen.fillStyle = track.guessed ? track.pale : track.fill;
    pen.fill();
    pen.lineWidth = 0.8;
    pen.strokeStyle = track.guessed ? track.line : track.edge;
    pen.stroke();
  }

  // Boxes of another layer, hollow.
  outlines(tracks, t, dashes, width) {
    const pen = this.pen;
    for (let i = 0; i < tracks.length; i++) {
      const track = tracks[i];
      track.moveTo(t);
      if (!track.there || !this.corners(track, 0)) continue;
      this.trace();
      pen.setLineDash(dashes);
      pen.strokeStyle = track.line;
      pen.lineWidth = width;
      pen.stroke();
    }
  }

  // Rings around agents that collide in the replay, shown a moment longer than that takes.
  contacts(events, t) {
    for (let k = 0; k < events.length; k++) {
      const event = events[k];
      if (t < event.t_s - 0.05 || t > event.until_s + 0.3) continue;
      for (let i = 0; i < event.tracks.length; i++) {
        if (event.tracks[i].there) this.ring(event.tracks[i], event.in_log ? theme.muted : theme.alert, 2);
      }
    }
  }

  ring(track, color, width) {
    if (!this.corners(track, 3.5)) return;
    this.trace();
    this.pen.strokeStyle = color;
    this.pen.lineWidth = width;
    this.pen.stroke();
  }

  // Names of the leading movers, each where it is free; the chosen and the hovered one in any case.
  names(tracks, shown, chosen, hovered) {
    this.labels = 0;
    this.pen.font = theme.names;
    this.pen.textAlign = "center";
    this.pen.textBaseline = "alphabetic";
    if (chosen) this.label(chosen, true);
    if (hovered && hovered !== chosen) this.label(hovered, true);
    if (!shown.names) return;
    for (let i = 0; i < tracks.length; i++) {
      if (tracks[i].leading && tracks[i] !== chosen && tracks[i] !== hovered) this.label(tracks[i], false);
    }
  }

  label(track, forced) {
    if (!track.there || !this.corners(track, 0) || this.labels === MOST_LABELS) return;
    const { pen, corner: c, taken } = this, half = track.halfWidth ?? (track.halfWidth = pen.measureText(track.label).width / 2 + 2);
    const sx = (c[0] + c[4]) / 2, bottom = Math.min(c[1], c[3], c[5], c[7]) - 4;
    for (let k = 0; k < 4 * this.labels && !forced; k += 4) {
      if (sx - half < taken[k + 2] && sx + half > taken[k] && bottom - 12 < taken[k + 3] && bottom + 2 > taken[k + 1]) return;
    }
    const k = 4 * this.labels++;
    taken[k] = sx - half;
    taken[k + 1] = bottom - 12;
    taken[k + 2] = sx + half;
    taken[k + 3] = bottom + 2;
    pen.lineWidth = 3;
    pen.strokeStyle = theme.halo;
    pen.strokeText(track.label, sx, bottom);
    pen.fillStyle = track.standing ? theme.muted : track.line;
    pen.fillText(track.label, sx, bottom);
  }

  scaleBar() {
    const { pen, view } = this, meters = niceStep(110 / view.scale), width = meters * view.scale;
    const x = 16, y = view.height - 16;
    pen.fillStyle = theme.paper;
    pen.strokeStyle = theme.ink;
    pen.lineWidth = 1;
    pen.fillRect(x + width / 2, y - 5, width / 2, 5);
    pen.strokeRect(x, y - 5, width, 5);
    pen.fillStyle = theme.ink;
    pen.fillRect(x, y - 5, width / 2, 5);
    pen.font = theme.figures;
    pen.textAlign = "left";
    pen.fillText("0", x, y - 10);
    pen.textAlign = "right";
    pen.fillText(meters >= 1000 ? `${meters / 1000} km` : `${meters} m`, x + width, y - 10);
  }
}
