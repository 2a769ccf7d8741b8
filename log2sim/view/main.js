// State, time and what keeps the parts together. Frames are drawn while something moves and else not at all.

const RATES = [0.1, 0.2, 0.5, 1, 2, 5, 10];
const PLAY = "M6 3.5v13l11-6.5z", PAUSE = "M5.5 3.5h3.2v13H5.5zM11.3 3.5h3.2v13h-3.2z";
const LAYER_NAMES = { log: "Log", truth: "Truth", replay: "Replay", trails: "Trails", names: "Names" };

const data = load(byId("data").textContent);
const tracks = data.layers.log, ego = tracks.find((track) => track.ego) ?? null;
for (const track of tracks) track.label = track.id.length > 24 ? `${track.id.slice(0, 23)}…` : track.id;
const state = {
  t: data.begin, rate: 1, playing: false, follow: false, chosen: null, hovered: null,
  shown: { log: true, truth: true, replay: true, trails: true, names: true },
};
dress(data.layers);
const view = new View(), painter = new Painter(byId("map"), view);
let queued = false, before = 0, dimmed = 0, fitted = false, labelled = "";

const wake = () => {
  if (!queued) {
    queued = true;
    requestAnimationFrame(frame);
  }
};

const frame = (now) => {
  queued = false;
  if (state.playing) {
    state.t += Math.min((now - before) / 1000, 0.25) * state.rate;
    if (state.t >= data.end) {
      state.t = data.end;
      pause();
    }
  }
  before = now;
  draw(now);
  if (state.playing) wake();
};

const draw = (now) => {
  const leader = state.follow ? (state.chosen ?? ego) : null;
  if (leader) {
    leader.moveTo(state.t);
    if (leader.there) [view.x, view.y] = [leader.px, leader.py];
  }
  painter.paint(data.layers, state.t, state.shown, state.chosen, state.hovered);
  const text = state.t.toFixed(2);
  if (text !== labelled) {
    byId("time").textContent = labelled = text;
    byId("scrub").value = state.t;
  }
  side.tick(state.t);
  if (now - dimmed > 250 || !state.playing) {
    side.dim();
    dimmed = now;
  }
};

const seek = (t) => {
  if (!Number.isFinite(t)) return;
  state.t = Math.min(Math.max(t, data.begin), data.end);
  wake();
  if (!state.playing) remember();
};

const play = () => {
  if (state.t >= data.end) state.t = data.begin;
  state.playing = true;
  before = performance.now();
  showPlay();
  wake();
};

const pause = () => {
  state.playing = false;
  showPlay();
  remember();
};

const showPlay = () => {
  byId("play-shape").setAttribute("d", state.playing ? PAUSE : PLAY);
  byId("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
};

const setRate = (step) => {
  state.rate = RATES[Math.min(Math.max(RATES.indexOf(state.rate) + step, 0), RATES.length - 1)];
  byId("rate").textContent = `${state.rate}×`;
};

const choose = (track) => {
  state.chosen = track;
  side.choose(track);
  drawLife();
  remember();
  wake();
};

const hover = (track) => {
  if (track === state.hovered) return;
  state.hovered = track;
  byId("map").classList.toggle("over", track !== null);
  wake();
};

// The agent under a point of the screen, the nearest center first.
const under = (sx, sy, margin) => {
  const x = view.mx(sx), y = view.my(sy), reach = margin / view.scale;
  let best = null, least = Infinity;
  for (const track of tracks) {
    if (!state.shown.log || !track.there || !track.holds(x, y, reach)) continue;
    const distance = Math.hypot(track.px - x, track.py - y);
    if (distance < least) [best, least] = [track, distance];
  }
  return best;
};

const follow = (on) => {
  state.follow = on && (ego !== null || state.chosen !== null);
  byId("follow").setAttribute("aria-pressed", state.follow);
  wake();
};

const zoom = (factor, sx = view.width / 2, sy = view.height / 2) => {
  view.zoom(factor, sx, sy);
  wake();
};

const fit = () => {
  follow(false);
  view.fit(tracks, { left: 24, right: 56, top: 76, bottom: 44 });
  wake();
};

// Beside the map the list is there until it is put away; on a narrow screen it is away until asked for.
const showList = () => {
  const narrow = matchMedia("(max-width: 720px)").matches && state.chosen !== null;
  if (narrow) choose(null);
  document.body.classList.toggle("flipped", narrow || undefined);
};

const toggle = (layer) => {
  if (!(layer in LAYER_NAMES) || (data.layers[layer] === undefined && layer in { truth: 0, replay: 0 })) return;
  state.shown[layer] = !state.shown[layer];
  byId(`layer-${layer}`).setAttribute("aria-pressed", state.shown[layer]);
  wake();
};

// The life of the chosen agent above the slider, pale where nobody saw it.
const drawLife = () => {
  const canvas = byId("life"), pen = sharpPen(canvas), track = state.chosen;
  if (!track || !canvas.clientWidth) return;
  const sx = (t) => ((t - data.begin) / Math.max(data.end - data.begin, 1e-3)) * canvas.clientWidth;
  const bar = (from, to, color) => {
    pen.fillStyle = color;
    pen.fillRect(sx(from), 0, Math.max(sx(to) - sx(from), 2), canvas.clientHeight);
  };
  if (track.always) bar(data.begin, data.end, theme.parked_edge);
  else if (track.t.length === 1) bar(track.first, track.first, track.line);
  for (let k = 0, from = 0; k + 1 < track.t.length; k++) {
    if (k + 2 < track.t.length && track.filled[k + 1] === track.filled[k]) continue;
    bar(track.t[from], track.t[k + 1], track.filled[k] ? track.pale : track.standing ? theme.parked_edge : track.line);
    from = k + 1;
  }
};

// The address names the moment and the agent, so that it can be passed on.
const remember = () => {
  const parts = new URLSearchParams({ t: state.t.toFixed(2) });
  if (state.chosen) parts.set("agent", state.chosen.id);
  try {
    history.replaceState(null, "", `#${parts}`);
  } catch {
    // Some browsers do not let a page that was opened as a file do so.
  }
};

const recall = () => {
  const parts = new URLSearchParams(location.hash.slice(1));
  const t = parts.get("t"), id = parts.get("agent");
  if (id !== null) choose(tracks.find((track) => track.id === id) ?? null);
  if (t !== null && t.trim() !== "") seek(Number(t));
};

const resize = () => {
  painter.resize();
  if (!fitted && view.width > 1) {
    fit();
    fitted = true;
  }
  if (state.chosen) side.describe(state.chosen);
  drawLife();
  draw(performance.now());
};

const listen = () => {
  const buttons = {
    play: () => (state.playing ? pause() : play()), slower: () => setRate(-1), faster: () => setRate(1), fit,
    "zoom-in": () => zoom(1.5), "zoom-out": () => zoom(1 / 1.5), follow: () => follow(!state.follow),
    "help-toggle": () => byId("help").showModal(), "list-toggle": showList,
  };
  for (const [id, run] of Object.entries(buttons)) byId(id).addEventListener("click", run);
  byId("scrub").addEventListener("input", (event) => seek(event.target.valueAsNumber));
  const jump = (seconds) => (event) => seek(state.t + seconds * (event.shiftKey ? 10 : 1));
  listenToKeys([
    ["Space", "play or pause", [" "], buttons.play],
    ["← →", "0.1 s back or on, 1 s with Shift", ["ArrowLeft"], jump(-0.1)],
    ["Home End", "first or last moment", ["Home"], () => seek(data.begin)],
    ["< >", "slower or faster", ["<", ","], () => setRate(-1)],
    ["+ −", "zoom in or out", ["+", "="], () => zoom(1.25)],
    ["0", "show all", ["0"], fit],
    ["f", "follow the chosen agent, else the ego", ["f"], buttons.follow],
    ["n p", "next or previous agent", ["n"], () => neighbor(1)],
    ["d t r", "log, truth or replay on or off", ["d"], () => toggle("log")],
    ["w l", "trails or names on or off", ["w"], () => toggle("trails")],
    ["a /", "list of agents, search in it", ["a"], buttons["list-toggle"]],
    ["Esc", "choose nobody", ["Escape"], () => choose(null)],
    ["?", "this list", ["?"], buttons["help-toggle"]],
  ], [
    [["ArrowRight"], jump(0.1)], [["End"], () => seek(data.end)], [[">", "."], () => setRate(1)],
    [["-", "_"], () => zoom(1 / 1.25)], [["p"], () => neighbor(-1)], [["t"], () => toggle("truth")],
    [["r"], () => toggle("replay")], [["l"], () => toggle("names")], [["/"], () => byId("search").focus()],
  ]);
  listenToPointers(byId("map"), {
    drag: (dx, dy) => { follow(false); view.drag(dx, dy); wake(); },
    zoom,
    click: (sx, sy, margin) => choose(under(sx, sy, margin)),
    hover: (sx, sy) => hover(sx === null ? null : under(sx, sy, 3)),
  });
  window.addEventListener("hashchange", recall);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    dress(data.layers);
    side.redraw();
    drawLife();
    wake();
  });
  new ResizeObserver(resize).observe(byId("map"));
};

const neighbor = (step) => {
  const here = tracks.indexOf(state.chosen), count = tracks.length;
  if (count) choose(tracks[here < 0 ? (step > 0 ? 0 : count - 1) : (here + step + count) % count]);
};

const side = new Side(data, { choose, seek, hover });

const start = () => {
  const moving = tracks.filter((track) => !track.standing && !track.ego).length, agents = tracks.length - (ego ? 1 : 0);
  const parts = [`${(data.end - data.begin).toFixed(1)} s`, `${agents} agent${agents === 1 ? "" : "s"}, ${moving} moving`];
  if (!ego) parts.push("no ego");
  if (data.origin) parts.push(`origin ${data.origin}`);
  byId("whole").textContent = `/ ${data.end.toFixed(1)} s`;
  byId("name").textContent = data.name || "scenario";
  byId("summary").textContent = parts.join(" · ");
  Object.assign(byId("scrub"), { min: data.begin, max: data.end, value: data.begin });
  byId("follow").disabled = tracks.length === 0;
  for (const [layer, name] of Object.entries(LAYER_NAMES)) {
    if (layer in { truth: 0, replay: 0 } && !data.layers[layer]) continue;
    const button = element("button", { id: `layer-${layer}`, type: "button", "aria-pressed": true, class: layer }, name);
    button.addEventListener("click", () => toggle(layer));
    byId("layers").append(button);
  }
  setRate(0);
  showPlay();
  listen();
  resize();
  recall();
};

// For scripts and tests in the browser's console.
window.log2sim = {
  get time() { return state.t; },
  set time(t) { seek(t); },
  get agents() { return tracks.map((track) => track.id); },
  get chosen() { return state.chosen?.id ?? null; },
  choose: (id) => choose(tracks.find((track) => track.id === id) ?? null),
  play, pause,
  // Where on the canvas the middle of an agent is, in CSS pixels; null when it is not there.
  placeOf: (id) => {
    const track = tracks.find((other) => other.id === id);
    track?.moveTo(state.t);
    return track?.there ? [view.sx(track.px), view.sy(track.py)] : null;
  },
  get pixelsPerMeter() { return view.scale; },
};
start();
