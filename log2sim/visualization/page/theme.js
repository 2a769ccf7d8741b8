// Colors from the style sheet and the agents; all strings are made here, none while drawing.

const theme = {};

const channels = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));

// Relative luminance, WCAG 2.
const luminance = (rgb) => {
  const [r, g, b] = rgb.map((c) => (c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};

// The color, mixed with white on a dark background until its contrast is three to one.
const readable = (rgb, ground) => {
  const below = luminance(ground);
  let out = rgb;
  for (let mix = 0; mix < 0.8 && below < 0.2 && (luminance(out) + 0.05) / (below + 0.05) < 3.4; mix += 0.05) {
    out = rgb.map((c) => c + (255 - c) * mix);
  }
  return out.map(Math.round);
};

const css = ([r, g, b], alpha) => `rgba(${r},${g},${b},${alpha})`;

const applyTheme = (layers) => {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["paper", "ground", "ink", "muted", "grid", "frame", "parked-face", "parked-edge", "accent", "alert", "warn", "vehicle", "road",
    "lane", "lane-arrow", "marking", "yellow-marking", "border",
    "signal-red", "signal-red-yellow", "signal-yellow", "signal-green", "signal-off", "signal-unknown"]) {
    theme[name.replaceAll("-", "_")] = style.getPropertyValue(`--${name}`).trim();
  }
  theme.font = style.getPropertyValue("--font").trim();
  theme.names = `600 11px ${theme.font}`;
  theme.figures = `11px ${theme.font}`;
  const ground = channels(theme.ground), ink = channels(theme.ink);
  theme.halo = css(channels(theme.paper), 0.9);
  theme.headingMark = css(channels(theme.paper), 0.85);
  theme.truth = css(ink, 0.9);
  const colors = new Map();
  for (const track of layers.scenario) {
    const rgb = track.ego ? ink : track.base ? readable(channels(track.base), ground) : channels(theme.parked_face);
    const strength = track.leading || track.stationary ? 1 : 0.6;
    track.line = css(rgb, 1);
    track.fill = css(rgb, strength);
    track.pale = css(rgb, 0.22);
    track.trail = css(rgb, 0.65 * strength);
    track.edge = track.stationary ? theme.parked_edge : theme.paper;
    track.headingMark = track.paint ?? (track.stationary ? theme.parked_edge : theme.headingMark);
    track.stripes = track.stationary ? theme.muted : theme.paper;
    track.outline = track.stationary ? theme.muted : track.line;
    colors.set(track.id, track.stationary ? theme.parked_edge : track.line);
  }
  for (const track of layers.replay ?? []) track.line = colors.get(track.id) ?? theme.ink;
  for (const track of layers.truth ?? []) track.line = theme.truth;
};
