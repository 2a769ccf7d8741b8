// Boxes of agents in a picture: as the page's writer projected them, in pixels of the camera.

const BOX_EDGES = [
  [0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7],
  [0, 7], [3, 4],  // across the front
];
const MIN_NAMED_PX = 44;

class Outline {
  // entry: agent, whether the rest are eight corners or else segments, coordinates.
  constructor([agent, corners, ...values], tracks) {
    this.track = tracks[agent];
    this.path = new Path2D();
    const x = values.filter((_, k) => k % 2 === 0), y = values.filter((_, k) => k % 2 === 1);
    Object.assign(this, { x0: Math.min(...x), y0: Math.min(...y), x1: Math.max(...x), y1: Math.max(...y) });
    const line = (a, b, c, d) => { this.path.moveTo(a, b); this.path.lineTo(c, d); };
    if (corners) for (const [a, b] of BOX_EDGES) line(values[2 * a], values[2 * a + 1], values[2 * b], values[2 * b + 1]);
    else for (let k = 0; k < values.length; k += 4) line(values[k], values[k + 1], values[k + 2], values[k + 3]);
  }

  contains(x, y, margin) { return x >= this.x0 - margin && x <= this.x1 + margin && y >= this.y0 - margin && y <= this.y1 + margin; }

  draw(ctx, scale, chosen, hovered) {
    const strong = this.track === chosen || this.track === hovered;
    ctx.lineJoin = "round";
    for (const [color, width] of [["rgba(0,0,0,.55)", strong ? 5 : 3], [this.track.inPicture, strong ? 2.6 : 1.4]]) {
      ctx.strokeStyle = color;
      ctx.lineWidth = width / scale;
      ctx.stroke(this.path);
    }
    if (this.track !== chosen) return;
    ctx.fillStyle = this.track.inPicture;
    ctx.globalAlpha = 0.16;
    ctx.fillRect(this.x0, this.y0, this.x1 - this.x0, this.y1 - this.y0);
    ctx.globalAlpha = 1;
  }
}

// White or black, whichever is better read on a color.
const inkOn = (hex) => (luminance(channels(hex)) > 0.32 ? "#101418" : "#FFFFFF");

// Names above boxes, the nearest first, where they are wide enough and no name is there yet; always of the chosen and hovered.
const nameOutlines = (ctx, outlines, scale, width, chosen, hovered) => {
  const taken = [];
  ctx.font = theme.names;
  ctx.textAlign = "center";
  ctx.textBaseline = "alphabetic";
  const rank = ({ track }) => (track === chosen || track === hovered ? 0 : 1);
  for (const outline of [...outlines].reverse().sort((a, b) => rank(a) - rank(b))) {
    const forced = rank(outline) === 0;
    if (!forced && (!state.shown.names || (outline.x1 - outline.x0) * scale < MIN_NAMED_PX)) continue;
    const half = ctx.measureText(outline.track.label).width / 2 + 2;
    const x = Math.min(Math.max(((outline.x0 + outline.x1) / 2) * scale, half), width - half), y = Math.max(outline.y0 * scale - 4, 12);
    if (!forced && taken.some(([left, right, top]) => x - half < right && x + half > left && Math.abs(y - top) < 15)) continue;
    taken.push([x - half, x + half, y]);
    ctx.fillStyle = outline.track.inPicture;
    ctx.fillRect(x - half - 1, y - 11, 2 * half + 2, 14);
    ctx.fillStyle = inkOn(outline.track.inPicture);
    ctx.fillText(outline.track.label, x, y);
  }
};
