// Corrections by hand. A program that serves this page applies them and answers with the corrected scenario; from a file of its own the page shows
// what they do to each agent alone, and downloads them.

const HANDLE_M = 2.5, NUDGE_M = 0.05, TURN_RAD = Math.PI / 180, SIZE_M = [0.05, 100], CIRCLE_95 = 2.448;
// What can be pulled: places on the box in half lengths, half widths and heights, and in m ahead.
const HANDLES = [
  { name: "turn", along: 1, across: 0, up: 0, ahead: HANDLE_M }, { name: "length", along: 1, across: 0, up: 0 }, { name: "length", along: -1, across: 0, up: 0 },
  { name: "width", along: 0, across: 1, up: 0 }, { name: "width", along: 0, across: -1, up: 0 }, { name: "height", along: 0, across: 0, up: 1 },
];

class Editor {
  // entry: t0_ns, map_offset_m, log, categories, paints, corrections, before, scales; from a program: address, corrected
  constructor(entry) {
    this.entry = entry;
    this.made = [...entry.corrections];
    this.undone = [];
    this.visited = new Set();
    this.mode = null;  // null, "move", "merge", "add", "line" or "erase"
    this.pose = null;  // of the box that is moved: x, y, z of the ground below it, yaw, size, and what of it was changed
    this.line = [];  // points of the line that is drawn
    this.cameras = new Map((pictures?.tiles ?? []).map((tile) => [tile.name, new Calibrated(tile.calibration)]));
    this.ghost = null;  // the chosen agent before its corrections
    this.corrected = entry.corrected;  // since the boxes in the pictures were projected
    this.changes = 0;  // so that pictures know when to draw again
    this.sent = Promise.resolve();  // one after the other
    byId("studio").open = "address" in entry;
    byId("studio").addEventListener("toggle", () => this.mode && this.toggle(null));
    byId("studio-author").value = this.made.at(-1)?.author ?? "";
    if (!("address" in entry)) {
      byId("studio-download").addEventListener("click", () => { this.downloaded = this.made; });
      window.addEventListener("beforeunload", (event) => this.made.length && this.downloaded !== this.made && event.preventDefault());
    }
    byId("studio-category").append(...entry.categories.map((name) => element("option", {}, name)));
    byId("studio-color").append(element("option", { value: "" }, "color"), ...Object.keys(entry.paints).map((name) => element("option", {}, name)));
    const actions = {
      "studio-next": () => this.next(), "studio-undo": () => this.undo(), "studio-redo": () => this.redo(), "studio-download": () => this.download(),
      "studio-add": () => this.toggle("add"), "studio-confirm": () => this.put("confirm"), "studio-delete": () => this.put("delete"),
      "studio-flip": () => this.put("flip"), "studio-split": () => this.put("split", { t_ns: this.stamp() }), "studio-merge": () => this.toggle("merge"),
      "studio-move": () => (this.mode === "move" ? this.place() : this.toggle("move")), "studio-size": () => this.resize(),
      "studio-line": () => (this.mode === "line" ? this.finish() : this.toggle("line")), "studio-erase": () => this.toggle("erase"),
    };
    for (const [id, run] of Object.entries(actions)) byId(id).addEventListener("click", run);
    byId("studio-category").addEventListener("change", ({ target }) => this.mode !== "add" && this.put("category", { category: target.value }));
    byId("studio-color").addEventListener("change", ({ target }) => target.value && this.put("color", { name: target.value, rgb: entry.paints[target.value] }));
    this.keys = {
      J: () => this.next(), K: actions["studio-confirm"], B: actions["studio-flip"], M: actions["studio-merge"], S: actions["studio-split"],
      E: actions["studio-move"], Z: () => this.undo(), Y: () => this.redo(), Delete: actions["studio-delete"],
    };
    window.addEventListener("keydown", (event) => this.key(event), { capture: true });
    for (const tile of pictures?.tiles ?? []) this.listenTo(tile);
    this.show();
  }

  // In a picture a mode takes presses and clicks, as it does in the map.
  listenTo(tile) {
    const camera = this.cameras.get(tile.name);
    if (!camera) return;
    let pulled = false;
    tile.canvas.addEventListener("pointerdown", (event) => {
      const surface = camera.surface(tile);
      pulled = surface !== null && event.button <= 0 && this.grab(event.offsetX, event.offsetY, surface);
      if (pulled) tile.canvas.setPointerCapture(event.pointerId);
    });
    tile.canvas.addEventListener("pointermove", (event) => {
      const surface = pulled && event.buttons ? camera.surface(tile) : null;
      if (surface) this.drag(event.offsetX, event.offsetY, surface);
    });
    tile.canvas.addEventListener("click", (event) => {
      const surface = camera.surface(tile), margin = event.pointerType === "touch" ? 10 : 2;
      if (!pulled && !(surface && this.click(event.offsetX, event.offsetY, margin, surface, tile.trackAt(event.offsetX, event.offsetY, margin)))) return;
      event.stopImmediatePropagation();
      pulled = false;
    }, { capture: true });
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches?.("input:not([type=range]), select")) return;
    if (document.querySelector("dialog[open]") || !byId("studio").open) return;
    const nudge = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (this.mode === "move" && (nudge || "[]".includes(event.key) || event.key === "Enter")) {
      if (nudge) this.pull(nudge[0] * NUDGE_M, nudge[1] * NUDGE_M);
      else if (event.key === "Enter") this.place();
      else this.turn(this.pose.yaw + (event.key === "[" ? TURN_RAD : -TURN_RAD));
    } else if (this.mode === "line" && event.key === "Enter") this.finish();
    else if (event.key === "Escape" && this.mode) this.toggle(null);
    else if (this.keys[event.key]) this.keys[event.key]();
    else return;
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  stamp() { return Math.round(this.entry.t0_ns + state.t * 1e9); }

  // Where an agent is now, or at its nearest time, which is how a correction names it.
  reference(track) {
    const t = track.permanent ? state.t : Math.min(Math.max(state.t, track.first), track.last);
    track.moveTo(t);
    return { t_ns: Math.round(this.entry.t0_ns + t * 1e9), x_m: track.px, y_m: track.py };
  }

  // Corrections but those of a kind of an agent, which has one category, size and color: the last.
  without(made, kind, track) {
    const same = ({ agent }) => {
      track.moveTo((agent.t_ns - this.entry.t0_ns) / 1e9);
      return track.present && track.contains(agent.x_m, agent.y_m, 0);
    };
    const kept = made.filter((entry) => entry.kind !== kind || !same(entry));
    track.moveTo(state.t);
    return kept;
  }

  // Make a correction of the chosen agent.
  put(kind, more = {}) {
    const track = state.chosen;
    if (!track || track.ego) return this.say("Choose an agent first; the ego is that of the log.");
    const entry = this.signed({ kind, agent: this.reference(track), ...more });
    this.send((made) => [...(["category", "size", "color"].includes(kind) ? this.without(made, kind, track) : made), entry]);
  }

  // With when, by whom and why it was made.
  signed(entry) {
    const [author, reason] = ["author", "reason"].map((name) => byId(`studio-${name}`).value.trim());
    return { ...entry, time: new Date().toISOString(), ...(author && { author }), ...(reason && { reason }) };
  }

  toggle(mode) {
    const track = state.chosen, ofAgent = mode === "move" || mode === "merge";
    if (ofAgent && (!track || track.ego)) return this.say("Choose an agent first; the ego is that of the log.");
    this.mode = this.mode === mode ? null : mode;
    this.line = [];
    if (this.mode === "move") {
      // The picture that shows it is of its own time: it is moved at that.
      const shows = (tile) => !tile.element.hidden && tile.shown >= 0 && this.cameras.has(tile.name) && tile.read(tile.shown).some((outline) => outline.track === track);
      const tile = pictures?.tiles.find(shows);
      if (tile) seek(tile.t[tile.shown]);
      chooseVisible(track);
      this.reference(track);  // where it is absent, it goes on from its nearest end
      this.pose = { ...this.boxOf(track), moved: false, turned: false, sized: false };
    }
    const words = {
      move: "Drag the box, or its handles to turn and size it, in the map or a picture; arrows, [ and ] by steps; Enter when it is right.",
      merge: "Click the agent that is the same object, in the map, a picture or the list.", add: "Choose its category, and click where it stands.",
      line: "Click along the line; Enter when it is done.", erase: "Click a line or border.",
    };
    this.say(words[this.mode] ?? "");
    this.show();
    this.redraw();
  }

  redraw() {
    this.changes++;
    requestDraw();
  }

  // A track as it is at the present time, with the ground below it.
  boxOf(track) {
    return { x: track.px, y: track.py, z: track.pz - track.height / 2, yaw: track.pyaw, length: track.length, width: track.width, height: track.height };
  }

  // The ground at a place: that below the nearest waypoint.
  groundAt(x, y) {
    let best = 0, closest = Infinity;
    for (const track of tracks) {
      for (let k = 0; track.z !== null && k < track.t.length; k++) {
        const far = Math.hypot(track.x[k] - x, track.y[k] - y);
        if (far < closest) [best, closest] = [track.z[k] - track.height / 2, far];
      }
    }
    return best;
  }

  // The place of the ground under a pixel; null above the horizon.
  under(sx, sy, surface) {
    let place = surface.from(sx, sy, state.chosen?.present ? this.boxOf(state.chosen).z : this.groundAt(view.x, view.y));
    if (place && !surface.flat) place = surface.from(sx, sy, this.groundAt(...place));
    return place && [...place, this.groundAt(...place)];
  }

  // A click in a mode; returns whether it was taken.
  click(sx, sy, margin, surface = mapSurface, other = agentAt(sx, sy, margin)) {
    if (this.mode === null) return false;
    if (this.mode === "move") return true;
    if (this.mode === "merge") return this.mergeWith(other) || true;
    const place = this.under(sx, sy, surface);
    if (!place) return true;
    if (this.mode === "line") {
      this.line.push(place);
      this.redraw();
      return true;
    }
    const kind = this.mode, pose = { t_ns: this.stamp(), x_m: place[0], y_m: place[1], yaw_rad: 0 };
    const entry = this.signed({ kind, ...(kind === "erase" ? { at: place } : { category: byId("studio-category").value || "car", poses: [pose] }) });
    this.toggle(null);
    this.send((made) => [...made, entry]);
    return true;
  }

  // The other track of a merge; returns whether one was wanted.
  mergeWith(other) {
    if (this.mode !== "merge") return false;
    const track = state.chosen;
    this.toggle(null);
    if (other && other !== track && !other.ego) this.put("merge", { other: this.reference(other) });
    return true;
  }

  // The line is whole.
  finish() {
    const points_m = this.line, feature = byId("studio-feature").value;
    if (points_m.length < 2) return this.say("A line has two points or more.");
    this.toggle(null);
    const entry = this.signed({ kind: "draw", feature, points_m });
    this.send((made) => [...made, entry]);
  }

  // Pixel of a handle of the box that is moved.
  handle({ along, across, up, ahead = 0 }, surface) {
    const { x, y, z, yaw, length, width, height } = this.pose, a = (along * length) / 2 + ahead, b = (across * width) / 2;
    return surface.to(x + a * Math.cos(yaw) - b * Math.sin(yaw), y + a * Math.sin(yaw) + b * Math.cos(yaw), z + up * height);
  }

  // Whether a drag that begins here moves, turns or sizes the box.
  grab(sx, sy, surface = mapSurface) {
    if (this.mode !== "move") return false;
    const slack = matchMedia("(pointer: coarse)").matches ? 22 : 10, body = { name: "body", along: 0, across: 0, up: 0 };
    const far = (handle) => { const at = this.handle(handle, surface); return at ? Math.hypot(at[0] - sx, at[1] - sy) : Infinity; };
    const usable = HANDLES.filter(({ name }) => name !== "height" || !surface.flat);
    const best = usable.reduce((found, handle) => (far(handle) < far(found) ? handle : found), usable[0]);
    const pixels = cornersOf(this.pose).map((corner) => surface.to(...corner)).filter(Boolean);
    const inside = pixels.length > 0 && [0, 1].every((axis) => {
      const values = pixels.map((pixel) => pixel[axis]), at = [sx, sy][axis];
      return at >= Math.min(...values) - slack && at <= Math.max(...values) + slack;
    });
    // Small boxes are all handles: then the box itself is held unless the pointer is outside it.
    const small = pixels.length > 0 && Math.max(...[0, 1].map((axis) => Math.max(...pixels.map((p) => p[axis])) - Math.min(...pixels.map((p) => p[axis])))) < 4 * slack;
    const handled = far(best) < slack && far(best) < far(body) && (!small || best.name === "turn");
    this.held = handled ? best : inside ? body : null;
    if (!this.held) return false;
    const at = this.handle(this.held, surface);
    this.offset = at ? [sx - at[0], sy - at[1]] : [0, 0];
    return true;
  }

  drag(sx, sy, surface = mapSurface) {
    const pose = this.pose, { name, along, across } = this.held, target = [sx - this.offset[0], sy - this.offset[1]];
    const limited = (value) => Math.min(Math.max(value, SIZE_M[0]), SIZE_M[1]);
    if (name === "height") {
      const low = this.handle(this.held, surface), high = this.handle({ ...this.held, up: 1.1 }, surface);
      if (!low || !high || Math.abs(high[1] - low[1]) < 1e-3) return;
      pose.height = limited(pose.height * (1 + (0.1 * (target[1] - low[1])) / (high[1] - low[1])));
      pose.sized = true;
      return this.redraw();
    }
    const place = surface.from(...target, pose.z);
    if (!place) return;
    const dx = place[0] - pose.x, dy = place[1] - pose.y, c = Math.cos(pose.yaw), s = Math.sin(pose.yaw);
    if (name === "body") return this.pull(dx, dy);
    if (name === "turn") return this.turn(Math.atan2(dy, dx));
    // The other end stays where it is.
    const sign = along + across, out = sign * (name === "length" ? dx * c + dy * s : dy * c - dx * s);
    const size = limited(out + pose[name] / 2), shift = (sign * (size - pose[name])) / 2;
    pose[name] = size;
    pose.sized = true;
    this.pull(...(name === "length" ? [shift * c, shift * s] : [-shift * s, shift * c]));
  }

  pull(dx, dy) {
    this.pose.x += dx;
    this.pose.y += dy;
    this.pose.moved = true;
    this.redraw();
  }

  turn(yaw) {
    this.pose.yaw = yaw;
    this.pose.turned = true;
    this.redraw();
  }

  // The box is right: its size, and a key pose at this time.
  place() {
    const { x, y, yaw, length, width, height, moved, turned, sized } = this.pose, track = state.chosen;
    const pose = { t_ns: this.stamp(), x_m: x, y_m: y, ...(turned ? { yaw_rad: yaw } : {}) }, agent = this.reference(track);
    this.toggle(null);
    const entries = [];
    if (sized) entries.push({ kind: "size", agent, size_m: [length, width, height].map((value) => Math.round(value * 100) / 100) });
    if (moved || turned || !sized) entries.push({ kind: "move", agent, poses: [pose] });
    const signed = entries.map((entry) => this.signed(entry));
    this.send((made) => [...(sized ? this.without(made, "size", track) : made), ...signed]);
  }

  resize() {
    const size = ["length", "width", "height"].map((name) => byId(`studio-${name}`).valueAsNumber);
    if (size.every((value) => value >= SIZE_M[0] && value <= SIZE_M[1])) this.put("size", { size_m: size });
    else this.say("Sizes are from 0.05 to 100 m.");
  }

  // The next doubtful agent that was not visited yet, at the time of its first doubt.
  next() {
    const track = doubtful.find((other) => !this.visited.has(other.id) && !other.ego);
    if (!track) return this.say(doubtful.length ? "All doubtful agents were visited." : "No agent is doubtful.");
    this.visited.add(track.id);
    const starts = track.doubts.map(([, start]) => start).filter((start) => start !== null);
    if (starts.length) seek(Math.min(...starts));
    else if (!track.permanent) seek((track.first + track.last) / 2);
    chooseVisible(track);
  }

  undo() { this.send((made) => (made.length ? made.slice(0, -1) : null), () => this.undone.push(this.made.at(-1))); }

  redo() { this.send((made) => (this.undone.length ? [...made, this.undone.at(-1)] : null), () => this.undone.pop()); }

  document(made) {
    return { format: "log2sim-corrections", version: 1, log: this.entry.log, map_offset_m: this.entry.map_offset_m, corrections: made };
  }

  download() {
    const link = element("a", { download: "corrections.json", href: URL.createObjectURL(new Blob([JSON.stringify(this.document(this.made), null, 1)], { type: "application/json" })) });
    link.click();
    URL.revokeObjectURL(link.href);
  }

  // Have corrections, which `build` makes of those so far, applied and kept, once those sent before are; what it makes of the scenario is shown.
  send(build, done = () => { this.undone = []; }) { this.sent = this.sent.then(() => this.exchange(build, done)); }

  async exchange(build, done) {
    try {
      const made = build(this.made);
      if (made === null) return;
      this.say("…");
      const reply = this.entry.address ? await this.ask(made) : null, count = counted(made.length, "correction");
      done();
      this.made = made;
      byId("studio-reason").value = "";
      this.say(reply === null ? `${count}: download them for log2sim correct.` : reply.unmatched.join("; ") || `${count} kept.`);
      this.corrected = true;
      this.changes++;
      if (reply) data.features = loadFeatures({ ...reply, scales: this.entry.scales });
      replaceTracks(reply?.agents ?? this.entry.before, this.entry.scales, reply ? [] : made);
    } catch (error) {
      this.say(error instanceof TypeError ? "The program that serves this page does not answer; download the corrections." : error.message);
    }
    this.show();
  }

  async ask(made) {
    const headers = { "Content-Type": "application/json", "If-Match": String(this.entry.version) };
    const answer = await fetch(this.entry.address, { method: "PUT", headers, body: JSON.stringify(this.document(made)) });
    const reply = await answer.json();
    if (!answer.ok) throw new Error(reply.error);
    this.entry.version = reply.version;
    return reply;
  }

  say(text) { byId("studio-status").textContent = text; }

  // What can be done with the chosen agent.
  show() {
    const track = state.chosen, none = !track || track.ego;
    for (const name of ["confirm", "delete", "flip", "split", "merge", "move", "size"]) byId(`studio-${name}`).disabled = none;
    for (const name of ["move", "merge", "add", "line", "erase"]) byId(`studio-${name}`).setAttribute("aria-pressed", this.mode === name);
    byId("studio-move").textContent = this.mode === "move" ? "Place" : "Move";
    byId("studio-line").textContent = this.mode === "line" ? "Finish" : "Draw";
    document.body.classList.toggle("editing", this.mode !== null);
    byId("studio-undo").disabled = this.made.length === 0;
    byId("studio-redo").disabled = this.undone.length === 0;
    if (none) return;
    byId("studio-category").value = track.category;
    byId("studio-color").value = Object.keys(this.entry.paints).find((name) => track.paintName.startsWith(name)) ?? "";
    for (const name of ["length", "width", "height"]) byId(`studio-${name}`).value = track[name].toFixed(2);
  }

  // What is edited, in the picture of a tile.
  paintPicture(tile, ctx) {
    const surface = this.cameras.get(tile.name)?.surface(tile);
    if (surface) this.draw(ctx, surface);
  }

  // The same on any surface.
  draw(ctx, surface) {
    if (state.chosen?.present && (this.mode === "move" || this.made.length)) this.drawGhost(ctx, surface, state.chosen.id);
    ctx.setLineDash(TRUTH_DASHES);
    ctx.strokeStyle = ctx.fillStyle = theme.alert;
    ctx.lineWidth = 2;
    if (this.mode === "line") this.stroke(ctx, this.line.map((point) => surface.to(...point)), true);
    // What no program has drawn yet.
    for (const { points_m, kind, poses, at } of this.entry.address ? [] : this.made) {
      if (points_m) this.stroke(ctx, points_m.map((point) => surface.to(...point)), true);
      if (kind === "add") this.dot(ctx, surface.to(poses[0].x_m, poses[0].y_m, this.groundAt(poses[0].x_m, poses[0].y_m)), 6);
      if (at) this.dot(ctx, surface.to(...at), 3);
    }
    if (this.mode === "move") {
      this.drawBox(ctx, surface, this.pose);
      const [front, tip] = [HANDLES[1], HANDLES[0]].map((handle) => this.handle(handle, surface));
      if (front && tip) this.stroke(ctx, [front, tip], false);
      ctx.setLineDash(SOLID);
      for (const handle of HANDLES) if (handle.name !== "height" || !surface.flat) this.dot(ctx, this.handle(handle, surface), handle.name === "turn" ? 6 : 4);
    }
    ctx.setLineDash(SOLID);
  }

  // Where the agent was before the corrections, with the circle that the measurements put it into with 95 %.
  drawGhost(ctx, surface, id) {
    const entry = this.entry.before.find((agent) => agent.id === id);
    if (entry && this.ghost?.id !== id) this.ghost = new Track(entry, this.entry.scales);
    const ghost = entry ? this.ghost : null;
    ghost?.moveTo(state.t);
    if (!ghost?.present) return;
    const box = this.boxOf(ghost), radius = CIRCLE_95 * (ghost.sigma(0) ?? 0);
    ctx.setLineDash(DOTTED);
    ctx.strokeStyle = surface.flat ? theme.ink : "#FFFFFF";
    ctx.lineWidth = 1.6;
    this.drawBox(ctx, surface, box);
    const circle = Array.from({ length: 33 }, (_, k) => surface.to(box.x + radius * Math.cos((k * Math.PI) / 16), box.y + radius * Math.sin((k * Math.PI) / 16), box.z));
    if (radius > 0) this.stroke(ctx, circle, false);
  }

  drawBox(ctx, surface, box) {
    const pixels = cornersOf(box).map((corner) => surface.to(...corner));
    for (const [a, b] of surface.flat ? BOX_EDGES.slice(0, 4) : BOX_EDGES) if (pixels[a] && pixels[b]) this.stroke(ctx, [pixels[a], pixels[b]], false);
  }

  stroke(ctx, pixels, dots) {
    ctx.beginPath();
    pixels.filter(Boolean).forEach((pixel, k) => ctx[k ? "lineTo" : "moveTo"](...pixel));
    ctx.stroke();
    if (dots) for (const pixel of pixels) this.dot(ctx, pixel, 3);
  }

  dot(ctx, pixel, radius) {
    if (!pixel) return;
    ctx.beginPath();
    ctx.arc(...pixel, radius, 0, 2 * Math.PI);
    ctx.fill();
  }

  // Boxes in a picture by the present tracks, the farthest first; null where the page's own still hold.
  outlines(tile, k) {
    const camera = this.cameras.get(tile.name);
    if (!camera || !this.corrected) return null;
    const out = [];
    tracks.forEach((track, i) => {
      track.moveTo(tile.t[k]);
      if (!track.present || track.ego) return;
      const box = this.boxOf(track), segments = camera.segments(tile.t[k], cornersOf(box), tile.width, tile.height);
      if (segments.length) out.push({ far: camera.toCamera(camera.poseAt(tile.t[k]), box.x, box.y, box.z)[2], outline: new Outline([i, 0, ...segments], tracks) });
    });
    for (const track of tracks) track.moveTo(state.t);
    return out.sort((a, b) => b.far - a.far).map(({ outline }) => outline);
  }
}

// What a correction does to an agent alone, without the smoother of log2sim; places are moved at and near their time.
const correctAlone = ({ kind, agent, other, category, size_m, poses, rgb, name }) => {
  const find = ({ t_ns, x_m, y_m }) => tracks.find((track) => {
    track.moveTo((t_ns - editor.entry.t0_ns) / 1e9);
    return !track.ego && track.present && track.contains(x_m, y_m, 0.1);
  });
  const track = agent && find(agent), gone = kind === "merge" ? find(other) : kind === "delete" ? track : null;
  if (gone) tracks.splice(tracks.indexOf(gone), 1);
  if (!track) return;
  if (kind === "confirm") [track.doubts, track.doubtSpans] = [[], []];
  if (kind === "category") track.category = category;
  if (kind === "size") [track.length, track.width, track.height] = size_m;
  if (kind === "flip") track.yaw = track.yaw.map((yaw) => yaw + Math.PI);
  if (kind === "color") [track.paint, track.paintName] = [`rgb(${rgb})`, name];
  for (const { t_ns, x_m, y_m, yaw_rad } of kind === "move" ? poses : []) {
    const t = (t_ns - editor.entry.t0_ns) / 1e9;
    track.moveTo(t);
    if (!track.present) continue;
    const shift = [x_m - track.px, y_m - track.py, yaw_rad === undefined ? 0 : yaw_rad - track.pyaw];
    const near = (k) => Math.exp(track.stationary ? 0 : -((track.t[k] - t) ** 2) / 2);
    ["x", "y", "yaw"].forEach((column, i) => { track[column] = track[column].map((value, k) => value + shift[i] * near(k)); });
    track.vx = track.vy = null;
  }
};

// Show other tracks of the scenario; the ego stays the same object, as much refers to it.
const replaceTracks = (entries, scales, corrections) => {
  tracks.splice(0, tracks.length, ...entries.map((entry) => (entry.ego && ego ? ego : new Track(entry, scales))));
  for (const correction of corrections) correctAlone(correction);
  for (const warning of data.warnings) warning.shown = tracks.find((track) => track.id === warning.agent) ?? null;
  prepareTracks();
  applyTheme(data.layers);
  const chosen = tracks.find((track) => track.id === state.chosen?.id) ?? null;
  list.show();
  listDoubtful();
  byId("doubts-toggle").hidden = doubtful.length === 0;
  state.hovered = null;
  choose(chosen);
};

editor = new Editor(data.studio);
