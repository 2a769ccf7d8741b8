// A small plot over time with a cursor. The curves are drawn when they change, the cursor is an element that moves.

const MARGIN = { left: 34, right: 8, top: 8, bottom: 18 };

const element = (tag, attributes = {}, text = null) => {
  const out = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) out.setAttribute(key, value);
  if (text !== null) out.textContent = text;
  return out;
};

// A pen on a canvas that is as sharp as the screen, in CSS pixels.
const sharpPen = (canvas) => {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(canvas.clientHeight * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  return pen;
};

class Chart {
  // least: height of the axis at least; seek: called with a time when the plot is clicked or dragged on.
  constructor(parent, title, least, { begin, end }, seek) {
    this.least = least;
    this.begin = begin;
    this.end = Math.max(end, begin + 1e-3);
    this.figure = element("figure");
    const caption = element("figcaption", {}, title);
    this.value = element("output");
    caption.append(this.value);
    const stage = element("div", { class: "plot" });
    this.canvas = element("canvas", { role: "img", "aria-label": `${title} over time` });
    this.cursor = element("div", { class: "cursor" });
    stage.append(this.canvas, this.cursor);
    this.figure.append(caption, stage);
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
    const pen = sharpPen(this.canvas), height = this.canvas.clientHeight;
    let low = 0, high = this.least;
    for (const { v } of series) {
      for (let k = 0; k < v.length; k++) {
        low = Math.min(low, v[k]);
        high = Math.max(high, v[k]);
      }
    }
    const step = niceStep((high - low) / 2);
    [low, high] = [Math.floor(low / step + 1e-9) * step, Math.ceil(high / step - 1e-9) * step];
    const sy = (v) => height - MARGIN.bottom - ((v - low) / (high - low)) * (height - MARGIN.top - MARGIN.bottom);
    this.axes(pen, low, high, step, sy, height);
    for (const one of [...series].reverse()) this.curve(pen, one, sy);
  }

  axes(pen, low, high, step, sy, height) {
    pen.font = `10px ${theme.font}`;
    pen.lineWidth = 1;
    pen.strokeStyle = theme.grid;
    pen.fillStyle = theme.muted;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    pen.beginPath();
    for (let k = Math.round(low / step); k <= Math.round(high / step); k++) {
      const y = Math.round(sy(k * step)) + 0.5;
      pen.moveTo(MARGIN.left, y);
      pen.lineTo(this.canvas.clientWidth - MARGIN.right, y);
      pen.fillText(String(Number((k * step).toPrecision(6))), MARGIN.left - 6, y);
    }
    pen.stroke();
    const seconds = niceStep((this.end - this.begin) / 3);
    pen.textBaseline = "alphabetic";
    pen.textAlign = "center";
    for (let k = Math.ceil(this.begin / seconds - 1e-9); k * seconds <= this.end + 1e-9; k++) {
      const text = `${Number((k * seconds).toPrecision(6))}`, half = pen.measureText(text).width / 2;
      pen.fillText(text, Math.min(this.sx(k * seconds), this.canvas.clientWidth - half - 1), height - 4);
    }
  }

  curve(pen, { t, v, filled, color, dashes, width }, sy) {
    pen.strokeStyle = color;
    pen.lineWidth = width;
    pen.lineJoin = "round";
    let kind = -1;
    for (let k = 0; k + 1 < t.length; k++) {
      const next = filled ? filled[k] : 0;
      if (next !== kind) {
        if (kind >= 0) pen.stroke();
        kind = next;
        pen.setLineDash(kind ? DASHED : dashes);
        pen.beginPath();
        pen.moveTo(this.sx(t[k]), sy(v[k]));
      }
      pen.lineTo(this.sx(t[k + 1]), sy(v[k + 1]));
    }
    if (kind >= 0) pen.stroke();
    pen.setLineDash(SOLID);
  }

  mark(t, text) {
    this.cursor.style.transform = `translateX(${this.sx(t)}px)`;
    this.value.textContent = text;
  }
}
