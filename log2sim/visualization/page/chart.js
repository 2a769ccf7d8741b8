// A small plot over time. Curves are drawn when they change; the cursor is an element that moves.

const MARGIN = { left: 34, right: 8, top: 8, bottom: 18 };

const element = (tag, attributes = {}, text = null) => {
  const out = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) out.setAttribute(key, value);
  if (text !== null) out.textContent = text;
  return out;
};

// The 2D context of a canvas at the resolution of the screen, in CSS pixels.
const scaledContext = (canvas) => {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(canvas.clientHeight * ratio);
  const ctx = canvas.getContext("2d");
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  return ctx;
};

class Chart {
  // minSpan: smallest range of the value axis; seek: called with a time when the plot is clicked or dragged on.
  constructor(parent, title, minSpan, { begin, end }, seek) {
    this.minSpan = minSpan;
    this.begin = begin;
    this.end = Math.max(end, begin + 1e-3);
    this.figure = element("figure");
    const caption = element("figcaption", {}, title);
    this.value = element("output");
    caption.append(this.value);
    const plot = element("div", { class: "plot" });
    this.canvas = element("canvas", { role: "img", "aria-label": `${title} over time` });
    this.cursor = element("div", { class: "cursor" });
    plot.append(this.canvas, this.cursor);
    this.figure.append(caption, plot);
    parent.append(this.figure);
    const at = (event) => {
      const inner = this.canvas.clientWidth - MARGIN.left - MARGIN.right;
      seek(this.begin + ((event.offsetX - MARGIN.left) / inner) * (this.end - this.begin));
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      at(event);
    });
    this.canvas.addEventListener("pointermove", (event) => event.buttons && at(event));
  }

  sx(t) {
    const inner = this.canvas.clientWidth - MARGIN.left - MARGIN.right;
    return MARGIN.left + ((t - this.begin) / (this.end - this.begin)) * inner;
  }

  // series: {t, v, filled or null, color, dashes, width}, the first on top.
  show(series) {
    this.series = series;
    this.figure.hidden = series.length === 0;
    if (this.figure.hidden || !this.canvas.clientWidth) return;
    const ctx = scaledContext(this.canvas), height = this.canvas.clientHeight;
    let low = 0, high = this.minSpan;
    for (const { v } of series) {
      for (let k = 0; k < v.length; k++) {
        low = Math.min(low, v[k]);
        high = Math.max(high, v[k]);
      }
    }
    const step = niceStep((high - low) / 2);
    [low, high] = [Math.floor(low / step + 1e-9) * step, Math.ceil(high / step - 1e-9) * step];
    const sy = (v) => height - MARGIN.bottom - ((v - low) / (high - low)) * (height - MARGIN.top - MARGIN.bottom);
    this.axes(ctx, low, high, step, sy, height);
    for (const one of [...series].reverse()) this.curve(ctx, one, sy);
  }

  axes(ctx, low, high, step, sy, height) {
    ctx.font = `10px ${theme.font}`;
    ctx.lineWidth = 1;
    ctx.strokeStyle = theme.grid;
    ctx.fillStyle = theme.muted;
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    ctx.beginPath();
    for (let k = Math.round(low / step); k <= Math.round(high / step); k++) {
      const y = Math.round(sy(k * step)) + 0.5;
      ctx.moveTo(MARGIN.left, y);
      ctx.lineTo(this.canvas.clientWidth - MARGIN.right, y);
      ctx.fillText(String(Number((k * step).toPrecision(6))), MARGIN.left - 6, y);
    }
    ctx.stroke();
    const seconds = niceStep((this.end - this.begin) / 3);
    ctx.textBaseline = "alphabetic";
    ctx.textAlign = "center";
    for (let k = Math.ceil(this.begin / seconds - 1e-9); k * seconds <= this.end + 1e-9; k++) {
      const text = `${Number((k * seconds).toPrecision(6))}`, half = ctx.measureText(text).width / 2;
      ctx.fillText(text, Math.min(this.sx(k * seconds), this.canvas.clientWidth - half - 1), height - 4);
    }
  }

  curve(ctx, { t, v, filled, color, dashes, width }, sy) {
    ctx.strokeStyle = color;
    ctx.lineWidth = width;
    ctx.lineJoin = "round";
    let kind = -1;
    for (let k = 0; k + 1 < t.length; k++) {
      const next = filled ? filled[k] : 0;
      if (next !== kind) {
        if (kind >= 0) ctx.stroke();
        kind = next;
        ctx.setLineDash(kind ? DASHED : dashes);
        ctx.beginPath();
        ctx.moveTo(this.sx(t[k]), sy(v[k]));
      }
      ctx.lineTo(this.sx(t[k + 1]), sy(v[k + 1]));
    }
    if (kind >= 0) ctx.stroke();
    ctx.setLineDash(SOLID);
  }

  mark(t, text) {
    this.cursor.style.transform = `translateX(${this.sx(t)}px)`;
    this.value.textContent = text;
  }
}
