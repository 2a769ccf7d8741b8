// Actions of the user, and the start.

const LAYER_NAMES = { scenario: "Scenario", truth: "Truth", replay: "Replay", trails: "Trails", names: "Names", predictions: "Predictions", ends: "Ends", lanes: "Lanes", ground: "Ground", pictures: "Pictures", points: "Points" };
let fitted = false;

// Whether there is anything to show or hide.
const hasLayer = (layer) => {
  if (layer === "predictions") return tracks.some((track) => track.predicted);
  if (layer === "lanes") return data.features.some || data.features.signals.length > 0;
  if (layer === "ground") return data.background !== null;
  if (layer === "pictures") return pictures !== null;
  if (layer === "points") return data.points !== null;
  if (layer === "ends") return tracks.some((track) => track.observedBy !== null);
  return !(layer in { truth: 0, replay: 0 }) || data.layers[layer] !== undefined;
};

const choose = (track) => {
  state.chosen = track;
  list.choose(track);
  details.choose(track);
  editor?.show();
  drawPresence();
  updateAddress();
  requestDraw();
};

// Choose an agent and move the map so that it is visible, if it is present.
const chooseVisible = (track) => {
  choose(track);
  if (track === null) return;
  track.moveTo(state.t);
  const sx = view.sx(track.px), sy = view.sy(track.py);
  if (track.present && !(sx > 20 && sy > 20 && sx < view.width - 20 && sy < view.height - 20)) [view.x, view.y] = [track.px, track.py];
};

const hover = (track) => {
  if (track === state.hovered) return;
  state.hovered = track;
  byId("map").classList.toggle("over", track !== null);
  requestDraw();
};

// The agent under a point of the screen, the nearest center first.
const agentAt = (sx, sy, margin) => {
  const x = view.mx(sx), y = view.my(sy), reach = margin / view.scale;
  let best = null, closest = Infinity;
  for (const track of tracks) {
    if (!state.shown.scenario || !track.present || !track.contains(x, y, reach)) continue;
    const distance = Math.hypot(track.px - x, track.py - y);
    if (distance < closest) [best, closest] = [track, distance];
  }
  return best;
};

const follow = (on) => {
  state.follow = on && (ego !== null || state.chosen !== null);
  byId("follow").setAttribute("aria-pressed", state.follow);
  requestDraw();
};

const zoom = (factor, sx = view.width / 2, sy = view.height / 2) => {
  view.zoom(factor, sx, sy);
  requestDraw();
};

const fit = () => {
  follow(false);
  view.fit(tracks, { left: 24, right: 56, top: 76, bottom: 44 });
  requestDraw();
};

// The list is shown beside the map until hidden; on a narrow screen it is hidden until shown.
const showList = () => {
  const narrow = matchMedia("(max-width: 720px), (max-height: 480px)").matches && state.chosen !== null;
  if (narrow) choose(null);
  document.body.classList.toggle("flipped", narrow || undefined);
};

const toggle = (layer) => {
  if (!(layer in LAYER_NAMES) || !hasLayer(layer)) return;
  state.shown[layer] = !state.shown[layer];
  byId(`layer-${layer}`).setAttribute("aria-pressed", state.shown[layer]);
  byId("pictures").hidden = pictures === null || !state.shown.pictures;
  requestDraw();
};

// Color LiDAR points by height or by intensity.
const colorPoints = () => {
  if (!data.points?.entry.intensity) return;
  data.points.byIntensity = !data.points.byIntensity;
  showPointColors();
  requestDraw();
};

// The colors of points with what they stand for.
const showPointColors = () => {
  const button = byId("points-color");
  data.points?.applyTheme();
  if (button === null) return;
  const ramp = element("span"), [lowest, step] = data.points.entry.height_m;
  ramp.style.background = `linear-gradient(90deg, ${data.points.colors.join(", ")})`;
  const range = data.points.byIntensity ? "weak to strong" : `${lowest} to ${(lowest + 255 * step).toFixed(0)} m above the ground`;
  button.replaceChildren(ramp, data.points.byIntensity ? "by intensity" : "by height");
  button.title = `Color of the points: ${range} (h)`;
};

// On a narrow screen the layers are behind a button.
const showLayers = () => {
  const open = byId("layers").classList.toggle("open");
  byId("layers-toggle").setAttribute("aria-expanded", open);
};

const resize = () => {
  painter.resize();
  if (!fitted && view.width > 1) {
    fit();
    fitted = true;
  }
  details.show();
  drawPresence();
  placeEventLabels();
  draw(performance.now());
};

const listen = () => {
  const buttons = {
    play: () => (state.playing ? pause() : play()), slower: () => setRate(-1), faster: () => setRate(1), fit,
    "zoom-in": () => zoom(1.5), "zoom-out": () => zoom(1 / 1.5), follow: () => follow(!state.follow),
    "help-toggle": () => byId("help").showModal(), deselect: () => choose(null), "list-toggle": showList,
    "metrics-toggle": () => byId("metrics").showModal(), "doubts-toggle": showDoubtful, "layers-toggle": showLayers,
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
    ["s t r", "scenario, truth or replay on or off", ["s"], () => toggle("scenario")],
    ["w l d o m g", "trails, names, predictions, ends, lanes or ground on or off", ["w"], () => toggle("trails")],
    ["i x", "pictures or LiDAR points on or off", ["i"], () => toggle("pictures")],
    ["c", "next camera large, or all", ["c"], () => pictures?.next()],
    ["h", "LiDAR points by height or intensity", ["h"], colorPoints],
    ["e", "next warning or collision of the replay", ["e"], nextEvent],
    ["a / u", "list of agents, search in it, doubtful ones", ["a"], buttons["list-toggle"]],
    ["v", "metrics", ["v"], () => data.metrics.length && byId("metrics").showModal()],
    ["Esc", "choose nobody", ["Escape"], () => choose(null)],
    ["?", "this list", ["?"], buttons["help-toggle"]],
  ], [
    [["ArrowRight"], jump(0.1)], [["End"], () => seek(data.end)], [[">", "."], () => setRate(1)],
    [["-", "_"], () => zoom(1 / 1.25)], [["p"], () => neighbor(-1)], [["t"], () => toggle("truth")],
    [["r"], () => toggle("replay")], [["l"], () => toggle("names")], [["d"], () => toggle("predictions")],
    [["o"], () => toggle("ends")], [["m"], () => toggle("lanes")], [["g"], () => toggle("ground")],
    [["x"], () => toggle("points")], [["u"], () => doubtful.length && showDoubtful()], [["/"], () => byId("search").focus()],
  ]);
  listenToPointers(byId("map"), {
    drag: (dx, dy) => { follow(false); view.drag(dx, dy); requestDraw(); },
    zoom,
    click: (sx, sy, margin) => editor?.click(sx, sy, margin) || choose(agentAt(sx, sy, margin)),
    grab: (sx, sy) => editor?.grab(sx, sy) ?? false,
    pull: (sx, sy) => editor.drag(sx, sy),
    hover: (sx, sy) => hover(sx === null ? null : agentAt(sx, sy, 3)),
  });
  window.addEventListener("hashchange", readAddress);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    applyTheme(data.layers);
    showPointColors();
    list.show();
    listDoubtful();
    listWarnings();
    listCollisions();
    details.show();
    drawPresence();
    requestDraw();
  });
  new ResizeObserver(resize).observe(byId("map"));
  watchPixelRatio();
};

// Draw again when the window moves to a screen with another pixel ratio.
const watchPixelRatio = () => {
  const now = matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`);
  now.addEventListener("change", () => {
    resize();
    watchPixelRatio();
  }, { once: true });
};

const neighbor = (step) => {
  const here = tracks.indexOf(state.chosen), count = tracks.length;
  if (count) chooseVisible(tracks[here < 0 ? (step > 0 ? 0 : count - 1) : (here + step + count) % count]);
};

const list = new List(tracks, { choose: (track) => editor?.mergeWith(track) || chooseVisible(track), hover }), details = new Details(data, seek);
const pictures = data.recording?.pictures ? new Pictures(data.recording.pictures, tracks, { choose: chooseVisible, hover, ready: requestDraw }) : null;

const start = () => {
  const moving = tracks.filter((track) => !track.stationary && !track.ego).length, agents = tracks.length - (ego ? 1 : 0);
  const parts = [`${(data.end - data.begin).toFixed(1)} s`, `${counted(agents, "agent")}, ${moving} moving`];
  if (data.warnings.length) parts.push(data.warned);
  if (data.features.lanes.length) parts.push(counted(data.features.lanes.length, "lane"));
  if (doubtful.length) parts.push(`${doubtful.length} doubtful`);
  if (!ego) parts.push("no ego");
  if (data.origin) parts.push(`origin ${data.origin}`);
  byId("whole").textContent = `/ ${data.end.toFixed(1)} s`;
  byId("name").textContent = data.name || "scenario";
  byId("summary").textContent = parts.join(" · ");
  Object.assign(byId("scrub"), { min: data.begin, max: data.end, value: data.begin });
  byId("follow").disabled = tracks.length === 0;
  for (const [layer, name] of Object.entries(LAYER_NAMES)) {
    if (!hasLayer(layer)) continue;
    const button = element("button", { id: `layer-${layer}`, type: "button", "aria-pressed": true, class: layer }, name);
    button.addEventListener("click", () => toggle(layer));
    byId("layers").append(button);
  }
  if (data.points?.entry.intensity) {
    const color = element("button", { id: "points-color", type: "button" });
    color.addEventListener("click", colorPoints);
    byId("layers").append(color);
    showPointColors();
  }
  for (const note of data.recording?.notes ?? []) byId("notes").append(element("p", {}, note));
  byId("pictures").hidden = pictures === null;
  pictures?.showAhead();
  byId("doubts-toggle").hidden = doubtful.length === 0;
  markEvents();
  listWarnings();
  listDoubtful();
  listCollisions();
  fillMetrics(data.metrics);
  setRate(0);
  showPlay();
  listen();
  resize();
  readAddress();
};
