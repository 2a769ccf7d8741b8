// The pictures of the cameras at the time, with the boxes of the agents: all in a row, or one large.

const AHEAD = 3;

class CameraTile {
  constructor(entry, agents, act) {
    Object.assign(this, { name: entry.name, t: entry.t_s, calibration: entry, width: entry.size_px[0], height: entry.size_px[1], act, shown: -1 });
    this.reach = reachOf(this.t);
    this.outlines = entry.outlines.map(() => null);
    this.read = (k) => editor?.outlines(this, k) ?? (this.outlines[k] ??= entry.outlines[k].map((values) => new Outline(values, agents)).filter(({ track }) => track));
    const decode = (k) => createImageBitmap(new Blob([bytesOf(entry.jpeg[k])], { type: "image/jpeg" }));
    this.decoded = new Decoded(decode, (picture) => picture.close(), act.ready);
    this.element = element("div", { class: "tile" });
    this.element.style.setProperty("--aspect", this.width / this.height);
    this.canvas = element("canvas", { role: "img", "aria-label": `Picture of ${this.name}` });
    this.caption = element("span", { class: "caption" });
    this.element.append(this.canvas, this.caption);
    this.listen();
  }

  listen() {
    const at = (event) => this.trackAt(event.offsetX, event.offsetY, event.pointerType === "touch" ? 10 : 2);
    this.canvas.addEventListener("pointermove", (event) => event.pointerType === "mouse" && this.act.hover(at(event)));
    this.canvas.addEventListener("pointerleave", () => this.act.hover(null));
    this.canvas.addEventListener("click", (event) => this.act.choose(at(event)));
    this.canvas.addEventListener("dblclick", () => this.act.enlarge(this));
  }

  // The nearest agent whose box is at a place of the tile.
  trackAt(x, y, margin) {
    const scale = this.canvas.clientWidth / this.width, found = this.shown < 0 ? [] : this.read(this.shown);
    return found.findLast((outline) => outline.contains(x / scale, y / scale, margin / scale))?.track ?? null;
  }

  // Show the picture of a time, or the one before while it is decoded; drawn again only when something changes.
  paint(t, chosen, hovered) {
    if (!this.canvas.clientWidth) return;
    const k = nearest(this.t, t, this.reach);
    if (k >= 0) this.decoded.ask(Array.from({ length: AHEAD }, (_, i) => k + i).filter((i) => i < this.t.length));
    if (k < 0 || this.decoded.get(k) !== undefined) this.shown = k;
    const names = state.shown.names && state.shown.scenario;
    const key = [this.shown, chosen, hovered, this.canvas.clientWidth, this.canvas.clientHeight, names, state.shown.scenario, theme.ink, editor?.changes];
    if (this.key?.every((value, i) => value === key[i])) return;
    this.key = key;
    const ctx = scaledContext(this.canvas), { clientWidth: width, clientHeight: height } = this.canvas;
    const picture = this.shown < 0 ? null : this.decoded.get(this.shown);
    const what = this.shown < 0 ? ": no picture" : picture === null ? ": picture cannot be shown" : ` · ${this.t[this.shown].toFixed(2)} s`;
    this.caption.textContent = `${this.name}${what}`;
    ctx.fillStyle = theme.frame;
    ctx.fillRect(0, 0, width, height);
    if (!picture) return;
    ctx.imageSmoothingQuality = "high";
    ctx.drawImage(picture, 0, 0, width, height);
    if (!state.shown.scenario) return;
    const scale = width / this.width, outlines = this.read(this.shown);
    ctx.save();
    ctx.scale(scale, scale);
    for (const outline of outlines) outline.draw(ctx, scale, chosen, hovered);
    for (const outline of outlines) if (outline.track === chosen) outline.draw(ctx, scale, chosen, hovered);
    ctx.restore();
    nameOutlines(ctx, outlines, scale, width, chosen, hovered);
    editor?.paintPicture(this, ctx);
  }
}

class Pictures {
  constructor(entry, tracks, act) {
    const named = new Map(tracks.map((track) => [track.id, track])), agents = entry.agents.map((id) => named.get(id) ?? null);
    const enlarge = (tile) => this.enlarge(this.large === tile ? null : tile);
    this.tiles = entry.cameras.map((camera) => new CameraTile(camera, agents, { ...act, enlarge }));
    this.large = null;
    byId("tiles").append(...this.tiles.map((tile) => tile.element));
    byId("pictures").classList.toggle("single", this.tiles.length === 1);
    byId("tiles").style.setProperty("--aspect", this.tiles[0].width / this.tiles[0].height);
    this.choices = this.tiles.length > 1 ? [null, ...this.tiles] : this.tiles;
    this.buttons = this.choices.map((tile) => {
      const button = element("button", { type: "button" }, tile?.name ?? "All");
      button.addEventListener("click", () => this.enlarge(this.tiles.length > 1 || this.large === null ? tile : null));
      return button;
    });
    byId("cameras").append(...this.buttons);
    this.enlarge(null);
    this.ahead = this.tiles[entry.ahead];
  }

  // Show one camera large, or all in a row.
  enlarge(tile) {
    this.large = tile;
    byId("pictures").classList.toggle("one", tile !== null);
    for (const other of this.tiles) other.element.hidden = tile !== null && other !== tile;
    this.choices.forEach((other, k) => this.buttons[k].setAttribute("aria-pressed", other === tile));
    requestDraw();
  }

  // Where not all are visible, begin with the camera that looks ahead.
  showAhead() {
    const { offsetLeft, offsetWidth } = this.ahead.element, row = byId("tiles");
    row.scrollLeft = offsetLeft - row.offsetLeft - (row.clientWidth - offsetWidth) / 2;
  }

  next() {
    const k = this.tiles.indexOf(this.large) + 1;
    this.enlarge(this.tiles[k] ?? null);
  }

  paint(t, chosen, hovered) {
    for (const tile of this.tiles) tile.paint(t, chosen, hovered);
  }
}
