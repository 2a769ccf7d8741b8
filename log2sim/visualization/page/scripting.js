// For scripts and tests, and the start of everything.

// The agent of an id as it is at the present time; null when it is absent.
const presentTrack = (id) => {
  const track = tracks.find((other) => other.id === id);
  track?.moveTo(state.t);
  return track?.present ? track : null;
};

window.log2sim = {
  get time() { return state.t; },
  set time(t) { seek(t); },
  get agents() { return tracks.map((track) => track.id); },
  get chosen() { return state.chosen?.id ?? null; },
  choose: (id) => choose(tracks.find((track) => track.id === id) ?? null),
  play, pause,
  corrections: () => editor?.made ?? [],
  // Position of an agent's center on the canvas, CSS pixels; null when it is absent.
  placeOf: (id) => {
    const track = presentTrack(id);
    return track && [view.sx(track.px), view.sy(track.py)];
  },
  // Position of a place of the map on the canvas, CSS pixels.
  pixelOf: (x, y) => [view.sx(x), view.sy(y)],
  // Position of a place of the ground in the picture of a camera, CSS pixels of the window; null where it is not in it.
  inPicture: (name, x, y, up = 0) => {
    const tile = pictures?.tiles.find((other) => other.name === name), surface = editor?.cameras.get(name)?.surface(tile);
    const pixel = surface?.to(x, y, editor.groundAt(x, y) + up), box = tile?.canvas.getBoundingClientRect();
    return pixel ? [pixel[0] + box.left, pixel[1] + box.top] : null;
  },
  // Its heading in rad, counter-clockwise from east; null when it is absent.
  headingOf: (id) => presentTrack(id)?.pyaw ?? null,
  get pixelsPerMeter() { return view.scale; },
  // For each camera the time of the picture shown, s; null while there is none.
  get pictures() {
    const shown = (tile) => (tile.shown < 0 || !tile.decoded.get(tile.shown) ? null : tile.t[tile.shown]);
    return Object.fromEntries((pictures?.tiles ?? []).map((tile) => [tile.name, shown(tile)]));
  },
  // Time of the LiDAR points shown and how many they are; null while there are none.
  get points() {
    const k = data.points ? nearest(data.points.t, state.t, data.points.reach) : -1, points = k < 0 ? null : data.points.decoded.get(k);
    return points ? [data.points.t[k], points.x.length] : null;
  },
};
start();
