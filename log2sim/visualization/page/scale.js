// The scale bar and, where the map knows it, the north.

const drawScaleBar = ({ ctx, view }, north) => {
  const meters = niceStep(110 / view.scale), width = meters * view.scale;
  const x = 16, y = view.height - 16;
  ctx.fillStyle = theme.paper;
  ctx.strokeStyle = theme.ink;
  ctx.lineWidth = 1;
  ctx.fillRect(x + width / 2, y - 5, width / 2, 5);
  ctx.strokeRect(x, y - 5, width, 5);
  ctx.fillStyle = theme.ink;
  ctx.fillRect(x, y - 5, width / 2, 5);
  ctx.font = theme.figures;
  ctx.textAlign = "left";
  ctx.fillText("0", x, y - 10);
  ctx.textAlign = "right";
  ctx.fillText(meters >= 1000 ? `${meters / 1000} km` : `${meters} m`, x + width, y - 10);
  if (north) drawNorth(ctx, x + 8, y - 30);
};

// An arrow to the top, which is north, with its foot at a place of the screen.
const drawNorth = (ctx, x, y) => {
  for (const [side, color] of [[-1, theme.ink], [1, theme.paper]]) {
    ctx.beginPath();
    ctx.moveTo(x, y - 26);
    ctx.lineTo(x + side * 7, y);
    ctx.lineTo(x, y - 6);
    ctx.closePath();
    ctx.fillStyle = color;
    ctx.fill();
    ctx.stroke();
  }
  ctx.fillStyle = theme.ink;
  ctx.font = theme.names;
  ctx.textAlign = "center";
  ctx.fillText("N", x, y - 30);
};
