// Data, display state and animation frames, which are only drawn while something moves.

const data = load(byId("data").textContent);
const tracks = data.layers.scenario, ego = tracks.find((track) => track.ego) ?? null;
const doubtful = [];
// Names and doubts of tracks that are new.
const prepareTracks = () => {
  for (const track of tracks) track.label = track.id.length > 24 ? `${track.id.slice(0, 23)}…` : track.id;
  doubtful.splice(0, doubtful.length, ...tracks.filter((track) => track.doubts.length > 0));
  for (const track of doubtful) track.label += "?";
};
prepareTracks();
let editor = null;  // of corrections
const state = {
  t: data.begin, rate: 1, playing: false, follow: false, chosen: null, hovered: null,
  shown: { scenario: true, truth: true, replay: true, trails: true, names: true, predictions: true, ends: true, lanes: true, ground: true, pictures: true, points: true },
};
applyTheme(data.layers);
data.points?.applyTheme();
const view = new View(), painter = new Painter(byId("map"), view);
let queued = false, before = 0, dimmed = 0, labelled = "";

const requestDraw = () => {
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
  if (state.playing) requestDraw();
};

const draw = (now) => {
  const leader = state.follow ? (state.chosen ?? ego) : null;
  if (leader) {
    leader.moveTo(state.t);
    if (leader.present) [view.x, view.y] = [leader.px, leader.py];
  }
  painter.paint(data, state.t, state.shown, state.chosen, state.hovered);
  editor?.draw(painter.ctx, mapSurface);
  if (state.shown.pictures) pictures?.paint(state.t, state.chosen, state.hovered);
  const text = state.t.toFixed(2);
  if (text !== labelled) {
    byId("time").textContent = labelled = text;
    byId("scrub").value = state.t;
    byId("scrub").setAttribute("aria-valuetext", `${text} s`);
  }
  details.tick(state.t);
  if (now - dimmed > 250 || !state.playing) {
    list.dim();
    dimmed = now;
  }
};
