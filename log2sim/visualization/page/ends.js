// Which end of a cooperative log observed an agent when: the sensors on the vehicle, or those at the road.

const ENDS = ["vehicle", "road"];

const observes = (track, end, t) => {
  const spans = track.observedBy?.[end] ?? SOLID;  // none
  for (let k = 0; k < spans.length; k++) if (t >= spans[k][0] - 1e-4 && t <= spans[k][1] + 1e-4) return true;
  return false;
};

// Who observes it now, and since when each end does first; empty where the scenario does not say.
const observers = (track, t) => {
  if (track.observedBy === null) return "";
  const now = ENDS.filter((end) => observes(track, end, t)).join(" and ") || "nobody";
  const first = ENDS.filter((end) => track.observedBy[end]).map((end) => `${end} from ${track.observedBy[end][0][0].toFixed(1)} s`);
  return `${now} (${first.join(", ")})`;
};

// Rings around agents that one end alone observes, in its color; thin ones around what stands.
const drawEnds = (painter, tracks, t) => {
  for (let i = 0; i < tracks.length; i++) {
    const track = tracks[i];
    if (!track.present || track.observedBy === null) continue;
    const vehicle = observes(track, "vehicle", t);
    if (vehicle !== observes(track, "road", t)) painter.ring(track, vehicle ? theme.vehicle : theme.road, track.stationary ? 0.7 : 1.6);
  }
};
