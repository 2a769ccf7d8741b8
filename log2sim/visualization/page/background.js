// The map of the ground below everything.

const GROUND_ALPHA = 0.75;

const loadBackground = (entry) => {
  if (!entry) return null;
  const image = new Image();
  image.onload = () => requestDraw();
  image.src = entry.source;
  return { image, extent: entry.extent_m };
};

const drawBackground = ({ ctx, view }, { image, extent: [x0, x1, y0, y1] }) => {
  if (!image.complete || !image.naturalWidth) return;
  ctx.globalAlpha = GROUND_ALPHA;
  ctx.drawImage(image, view.sx(x0), view.sy(y1), (x1 - x0) * view.scale, (y1 - y0) * view.scale);
  ctx.globalAlpha = 1;
};
