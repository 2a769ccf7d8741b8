// Time, playback rate, and the address with time and agent.

const RATES = [0.1, 0.2, 0.5, 1, 2, 5, 10];
const PLAY = "M6 3.5v13l11-6.5z", PAUSE = "M5.5 3.5h3.2v13H5.5zM11.3 3.5h3.2v13h-3.2z";
const MAX_MARKS = 300;
let writing = 0;

const seek = (t) => {
  if (!Number.isFinite(t)) return;
  state.t = Math.min(Math.max(t, data.begin), data.end);
  requestDraw();
  if (!state.playing) updateAddress();
};

const play = () => {
  if (state.t >= data.end) state.t = data.begin;
  state.playing = true;
  before = performance.now();
  showPlay();
  requestDraw();
};

const pause = () => {
  state.playing = false;
  showPlay();
  updateAddress();
};

const showPlay = () => {
  byId("play-shape").setAttribute("d", state.playing ? PAUSE : PLAY);
  byId("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
};

const setRate = (step) => {
  state.rate = RATES[Math.min(Math.max(RATES.indexOf(state.rate) + step, 0), RATES.length - 1)];
  byId("rate").textContent = `${state.rate}×`;
};

// When the chosen agent is present, above the slider; pale where it was not observed.
const drawPresence = () => {
  const canvas = byId("presence"), ctx = scaledContext(canvas), track = state.chosen;
  if (!track || !canvas.clientWidth) return;
  const sx = (t) => ((t - data.begin) / Math.max(data.end - data.begin, 1e-3)) * canvas.clientWidth;
  const bar = (from, to, color) => {
    ctx.fillStyle = color;
    ctx.fillRect(sx(from), 0, Math.max(sx(to) - sx(from), 2), canvas.clientHeight);
  };
  if (track.permanent) bar(data.begin, data.end, theme.parked_edge);
  else if (track.t.length === 1) bar(track.first, track.first, track.line);
  for (let k = 0, from = 0; k + 1 < track.t.length; k++) {
    if (k + 2 < track.t.length && track.filled[k + 1] === track.filled[k]) continue;
    bar(track.t[from], track.t[k + 1], track.filled[k] ? track.pale : track.stationary ? theme.parked_edge : track.line);
    from = k + 1;
  }
};

// A mark below the slider for each collision of the replay, red unless the scenario has it itself.
const markEvents = () => {
  const whole = Math.max(data.end - data.begin, 1e-3), inset = 8;  // half the slider's knob, where its ends are
  byId("events").append(...data.events.slice(0, MAX_MARKS).map((event) => {
    const fresh = event.belongs_to === "replay", whose = fresh ? "" : `, in the ${event.belongs_to} itself`;
    const what = `${event.agents.join(" and ")} collide at ${event.t_s.toFixed(2)} s${whose}`;
    const button = element("button", { type: "button", title: what, "aria-label": what, class: fresh ? "new" : "known" });
    button.style.left = `calc(${inset}px + (100% - ${2 * inset}px) * ${(event.t_s - data.begin) / whole})`;
    button.addEventListener("click", () => showEvent(event));
    return button;
  }));
};

const showEvent = (event) => {
  pause();
  seek(event.t_s);
  chooseVisible(tracks.find((track) => event.agents.includes(track.id)) ?? null);
};

const nextEvent = () => {
  const next = data.events.find((event) => event.t_s > state.t + 1e-6) ?? data.events[0];
  if (next) showEvent(next);
};

// The address holds time and agent, so that a link can be shared; browsers limit how often it changes.
const updateAddress = () => {
  clearTimeout(writing);
  writing = setTimeout(() => {
    const parts = new URLSearchParams({ t: state.t.toFixed(2) });
    if (state.chosen) parts.set("agent", state.chosen.id);
    try {
      history.replaceState(null, "", `#${parts}`);
    } catch {
      // Some browsers do not allow this for pages opened as files.
    }
  }, 300);
};

const readAddress = () => {
  const parts = new URLSearchParams(location.hash.slice(1));
  const t = parts.get("t"), id = parts.get("agent");
  if (id !== null) choose(tracks.find((track) => track.id === id) ?? null);
  if (t !== null && t.trim() !== "") seek(Number(t));
};
