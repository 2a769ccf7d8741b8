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

// When the chosen agent is present, above the slider; pale where it was not observed. Below that, when each end observes it.
const drawPresence = () => {
  const canvas = byId("presence");
  canvas.classList.toggle("ends", Boolean(state.chosen?.observedBy));
  const ctx = scaledContext(canvas), track = state.chosen;
  if (!track || !canvas.clientWidth) return;
  const sx = (t) => ((t - data.begin) / Math.max(data.end - data.begin, 1e-3)) * canvas.clientWidth;
  const bar = (from, to, color, top = 0, height = 3) => {
    ctx.fillStyle = color;
    ctx.fillRect(sx(from), top, Math.max(sx(to) - sx(from), 2), height);
  };
  ENDS.forEach((end, k) => {
    for (const [from, to] of track.observedBy?.[end] ?? []) bar(from, to, theme[end], 4 + 3 * k, 2);
  });
  if (track.permanent) bar(data.begin, data.end, theme.parked_edge);
  else if (track.t.length === 1) bar(track.first, track.first, track.line);
  for (let k = 0, from = 0; k + 1 < track.t.length; k++) {
    if (k + 2 < track.t.length && track.filled[k + 1] === track.filled[k]) continue;
    bar(track.t[from], track.t[k + 1], track.filled[k] ? track.pale : track.stationary ? theme.parked_edge : track.line);
    from = k + 1;
  }
};

// Warnings and collisions in order of time.
const marked = [...data.warnings, ...data.events].sort((a, b) => a.t_s - b.t_s);

const describe = (event) => {
  if (event.brief) return event.brief;
  const whose = event.belongs_to === "replay" ? "" : `, in the ${event.belongs_to} itself`;
  return `${event.agents.join(" and ")} collide at ${event.t_s.toFixed(2)} s${whose}`;
};

// Marks below the slider: for collisions of the replay, red unless the scenario has them itself, and for warnings while they last.
const markEvents = () => {
  const whole = Math.max(data.end - data.begin, 1e-3), inset = 8;  // half the slider's knob, where its ends are
  const at = (t) => `calc(${inset}px + (100% - ${2 * inset}px) * ${(t - data.begin) / whole})`;
  for (const [from, to] of data.warnings.flatMap((warning) => warning.spans)) {
    const span = element("div");
    span.style.left = at(from);
    span.style.width = `calc((100% - ${2 * inset}px) * ${(to - from) / whole})`;
    byId("events").append(span);
  }
  byId("events").append(...marked.slice(0, MAX_MARKS).map((event) => {
    const kind = event.brief ? "warned" : event.belongs_to === "replay" ? "new" : "known", what = describe(event);
    const button = element("button", { type: "button", title: what, "aria-label": what, class: kind });
    button.style.left = at(event.t_s);
    button.addEventListener("click", () => showEvent(event));
    return button;
  }));
  byId("events").append(...data.events.slice(0, MAX_MARKS).map((event) => {
    const label = element("span", { class: event.belongs_to === "replay" ? "label new" : "label" }, event.agents.join(" × "));
    label.style.left = at(event.t_s);
    return label;
  }));
  byId("timeline").classList.toggle("labeled", data.events.length > 0);
};

const showEvent = (event) => {
  pause();
  seek(event.t_s);
  chooseVisible(tracks.find((track) => event.agents.includes(track.id)) ?? null);
};

const nextEvent = () => {
  const next = marked.find((event) => event.t_s > state.t + 1e-6) ?? marked[0];
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
