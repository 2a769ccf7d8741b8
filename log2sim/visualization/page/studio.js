// Corrections by hand, sent to the program that serves this page, which answers with the corrected scenario.

const HANDLE_M = 2.5, NUDGE_M = 0.05, TURN_RAD = Math.PI / 180;

class Editor {
  // entry: address, t0_ns, map_offset_m, log, categories, corrections
  constructor(entry) {
    this.entry = entry;
    this.made = [...entry.corrections];
    this.undone = [];
    this.visited = new Set();
    this.mode = null;  // null, "move", "merge" or "add"
    this.pose = null;  // of the box that is moved: x, y, yaw, turned
    this.busy = false;
    byId("studio").hidden = false;
    byId("studio-category").append(...entry.categories.map((name) => element("option", {}, name)));
    const actions = {
      "studio-next": () => this.next(), "studio-undo": () => this.undo(), "studio-redo": () => this.redo(), "studio-download": () => this.download(),
      "studio-add": () => this.toggle("add"), "studio-confirm": () => this.put("confirm"), "studio-delete": () => this.put("delete"),
      "studio-flip": () => this.put("flip"), "studio-split": () => this.put("split", { t_ns: this.stamp() }), "studio-merge": () => this.toggle("merge"),
      "studio-move": () => (this.mode === "move" ? this.place() : this.toggle("move")), "studio-size": () => this.resize(),
    };
    for (const [id, run] of Object.entries(actions)) byId(id).addEventListener("click", run);
    byId("studio-category").addEventListener("change", (event) => this.put("category", { category: event.target.value }));
    this.keys = {
      J: () => this.next(), K: actions["studio-confirm"], B: actions["studio-flip"], M: actions["studio-merge"], S: actions["studio-split"],
      E: actions["studio-move"], Z: () => this.undo(), Y: () => this.redo(), Delete: actions["studio-delete"],
    };
    window.addEventListener("keydown", (event) => this.key(event), { capture: true });
    this.show();
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches?.("input[type=search], input[type=number], select")) return;
    if (document.querySelector("dialog[open]")) return;
    const nudge = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (this.mode === "move" && (nudge || "[]".includes(event.key) || event.key === "Enter")) {
      if (nudge) this.pull(nudge[0] * NUDGE_M, nudge[1] * NUDGE_M);
      else if (event.key === "Enter") this.place();
      else this.turn(this.pose.yaw + (event.key === "[" ? TURN_RAD : -TURN_RAD));
    } else if (event.key === "Escape" && this.mode) this.toggle(null);
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

  // Make a correction of the chosen agent.
  put(kind, more = {}) {
    const track = state.chosen;
    if (!track || track.ego) return this.say("Choose an agent first; the ego is that of the log.");
    this.send([...this.made, { kind, agent: this.reference(track), ...more, time: new Date().toISOString() }], track.id);
  }

  toggle(mode) {
    const track = state.chosen;
    if (mode && mode !== "add" && (!track || track.ego)) return this.say("Choose an agent first; the ego is that of the log.");
    this.mode = this.mode === mode ? null : mode;
    if (this.mode === "move") {
      track.moveTo(state.t);
      if (!track.present) [this.mode] = [null];
      else this.pose = { x: track.px, y: track.py, yaw: track.pyaw, turned: false };
    }
    const words = { move: "Drag the box or its handle; arrows, [ and ] by steps; Enter when it is right.", merge: "Click the agent that is the same object.", add: "Click where it stands." };
    this.say(words[this.mode] ?? "");
    this.show();
    requestDraw();
  }

  // A click on the map in a mode; returns whether it was taken.
  click(sx, sy, margin) {
    if (this.mode === "merge") {
      const other = agentAt(sx, sy, margin), track = state.chosen;
      this.toggle(null);
      if (other && other !== track && !other.ego) this.put("merge", { other: this.reference(other) });
      return true;
    }
    if (this.mode !== "add") return this.mode === "move";
    this.toggle(null);
    const pose = { t_ns: this.stamp(), x_m: view.mx(sx), y_m: view.my(sy), yaw_rad: 0 };
    this.send([...this.made, { kind: "add", category: byId("studio-category").value || "car", poses: [pose], time: new Date().toISOString() }], null);
    return true;
  }

  // Whether a drag that begins here moves or turns the box.
  grab(sx, sy) {
    if (this.mode !== "move") return false;
    const x = view.mx(sx) - this.pose.x, y = view.my(sy) - this.pose.y, c = Math.cos(this.pose.yaw), s = Math.sin(this.pose.yaw);
    const track = state.chosen, reach = track.length / 2 + HANDLE_M, slack = 12 / view.scale;
    this.turning = Math.hypot(x - reach * c, y - reach * s) < slack;
    return this.turning || (Math.abs(x * c + y * s) <= track.length / 2 + slack && Math.abs(y * c - x * s) <= track.width / 2 + slack);
  }

  drag(dx, dy, sx, sy) {
    if (this.turning) this.turn(Math.atan2(view.my(sy) - this.pose.y, view.mx(sx) - this.pose.x));
    else this.pull(dx / view.scale, -dy / view.scale);
  }

  pull(dx, dy) {
    this.pose.x += dx;
    this.pose.y += dy;
    requestDraw();
  }

  turn(yaw) {
    this.pose.yaw = yaw;
    this.pose.turned = true;
    requestDraw();
  }

  // The box is right: a key pose at this time.
  place() {
    const { x, y, yaw, turned } = this.pose, pose = { t_ns: this.stamp(), x_m: x, y_m: y, ...(turned ? { yaw_rad: yaw } : {}) };
    this.toggle(null);
    this.put("move", { poses: [pose] });
  }

  resize() {
    const size = ["length", "width", "height"].map((name) => byId(`studio-${name}`).valueAsNumber);
    if (size.every((value) => value >= 0.05 && value <= 100)) this.put("size", { size_m: size });
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

  undo() {
    if (this.made.length) this.send(this.made.slice(0, -1), state.chosen?.id, () => this.undone.push(this.made.at(-1)));
  }

  redo() {
    if (this.undone.length) this.send([...this.made, this.undone.at(-1)], state.chosen?.id, () => this.undone.pop());
  }

  document(made) {
    return { format: "log2sim-corrections", version: 1, log: this.entry.log, map_offset_m: this.entry.map_offset_m, corrections: made };
  }

  download() {
    const link = element("a", { download: "corrections.json", href: URL.createObjectURL(new Blob([JSON.stringify(this.document(this.made), null, 1)], { type: "application/json" })) });
    link.click();
    URL.revokeObjectURL(link.href);
  }

  // Have a list of corrections applied and kept; what it makes of the scenario is shown.
  async send(made, id, done = () => { this.undone = []; }) {
    if (this.busy) return;
    this.busy = true;
    this.say("…");
    try {
      const answer = await fetch(this.entry.address, { method: "PUT", headers: { "Content-Type": "application/json" }, body: JSON.stringify(this.document(made)) });
      const reply = await answer.json();
      if (!answer.ok) throw new Error(reply.error);
      done();
      this.made = made;
      this.say(reply.unmatched.length ? reply.unmatched.join("; ") : `${made.length} correction${made.length === 1 ? "" : "s"} kept.`);
      replaceTracks(reply.agents, reply.scales, id);
    } catch (error) {
      this.say(error instanceof TypeError ? "The program that serves this page does not answer; download the corrections." : error.message);
    }
    this.busy = false;
    this.show();
  }

  say(text) { byId("studio-status").textContent = text; }

  // What can be done with the chosen agent.
  show() {
    const track = state.chosen, none = !track || track.ego;
    for (const name of ["confirm", "delete", "flip", "split", "merge", "move", "size"]) byId(`studio-${name}`).disabled = none;
    for (const name of ["move", "merge", "add"]) byId(`studio-${name}`).setAttribute("aria-pressed", this.mode === name);
    byId("studio-move").textContent = this.mode === "move" ? "Place" : "Move";
    byId("studio-undo").disabled = this.made.length === 0;
    byId("studio-redo").disabled = this.undone.length === 0;
    if (none) return;
    byId("studio-category").value = track.category;
    for (const name of ["length", "width", "height"]) byId(`studio-${name}`).value = track[name].toFixed(2);
  }

  // The box that is moved, with its handle.
  paint({ ctx }) {
    if (this.mode !== "move") return;
    const { x, y, yaw } = this.pose, track = state.chosen, c = Math.cos(yaw), s = Math.sin(yaw);
    const at = (along, across) => [view.sx(x + along * c - across * s), view.sy(y + along * s + across * c)];
    const l = track.length / 2, w = track.width / 2;
    ctx.setLineDash(TRUTH_DASHES);
    ctx.strokeStyle = theme.alert;
    ctx.lineWidth = 2;
    ctx.beginPath();
    [[l, w], [-l, w], [-l, -w], [l, -w], [l, w]].forEach(([a, b], k) => ctx[k ? "lineTo" : "moveTo"](...at(a, b)));
    ctx.moveTo(...at(l, 0));
    ctx.lineTo(...at(l + HANDLE_M, 0));
    ctx.stroke();
    ctx.setLineDash(SOLID);
    ctx.beginPath();
    ctx.arc(...at(l + HANDLE_M, 0), 6, 0, 2 * Math.PI);
    ctx.fillStyle = theme.alert;
    ctx.fill();
  }
}

// Show other tracks of the scenario; the ego stays the same object, as much refers to it.
const replaceTracks = (entries, scales, id) => {
  const made = entries.map((entry) => (entry.ego && ego ? ego : new Track(entry, scales)));
  tracks.splice(0, tracks.length, ...made);
  prepareTracks();
  applyTheme(data.layers);
  const chosen = tracks.find((track) => track.id === id) ?? null;
  list.show();
  listDoubtful();
  byId("doubts-toggle").hidden = doubtful.length === 0;
  state.hovered = null;
  choose(chosen);
};

editor = new Editor(data.studio);
