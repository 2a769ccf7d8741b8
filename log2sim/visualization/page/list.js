// The searchable list of agents. Names come from the file and are only set as text.

const MAX_ROWS = 500;
const SHAPES = {
  vehicle: "M2 2h8v8h-8z", two_wheeler: "M6 .8L11.2 6 6 11.2.8 6z",
  pedestrian: "M6 1.5a4.5 4.5 0 1 1 0 9a4.5 4.5 0 1 1 0-9z", other: "M6 1.2L11 10.4H1z",
};

const byId = (id) => document.getElementById(id);

// The marker of an agent in its color, as in the legends of the pictures.
const mark = (track) => {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 12 12");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", SHAPES[track.group]);
  path.style.fill = track.fill;
  path.style.stroke = track.stationary ? track.edge : "none";
  svg.append(path);
  return svg;
};

class List {
  // actions: choose(track or null), hover(track or null)
  constructor(tracks, actions) {
    this.tracks = tracks;
    this.actions = actions;
    this.chosen = null;
    this.rows = new Map();
    const search = byId("search");
    search.addEventListener("input", () => this.show());
    search.addEventListener("keydown", (event) => {
      const first = this.rows.keys().next().value;
      if (event.key === "Enter" && first) actions.choose(first);
    });
    this.show();
  }

  show() {
    const words = byId("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = this.tracks.filter((track) => {
      const text = `${track.id} ${track.category} ${track.stationary ? "static" : "moving"} ${track.doubts.length ? "doubtful" : ""}`.toLowerCase();
      return words.every((word) => text.includes(word));
    });
    this.rows.clear();
    byId("agents").replaceChildren(...found.slice(0, MAX_ROWS).map((track) => this.row(track)));
    this.dim();
    const rest = found.length - MAX_ROWS;
    byId("more").hidden = rest <= 0 && found.length > 0;
    byId("more").textContent = found.length ? `${rest} more; search for them` : "No agent matches.";
  }

  row(track) {
    const button = element("button", { type: "button" });
    const kind = track.stationary ? `${track.category}, static` : track.category;
    button.append(mark(track), element("span", { class: track.doubts.length ? "id doubt" : "id" }, track.id), element("span", { class: "kind" }, kind));
    button.setAttribute("aria-pressed", track === this.chosen);
    button.addEventListener("click", () => this.actions.choose(track === this.chosen ? null : track));
    button.addEventListener("pointerenter", () => this.actions.hover(track));
    button.addEventListener("pointerleave", () => this.actions.hover(null));
    const item = element("li");
    item.append(button);
    this.rows.set(track, button);
    return item;
  }

  choose(track) {
    this.rows.get(this.chosen)?.setAttribute("aria-pressed", false);
    this.chosen = track;
    this.rows.get(track)?.setAttribute("aria-pressed", true);
  }

  // Dim the rows of absent agents.
  dim() {
    for (const [track, row] of this.rows) {
      if (row.dimmed !== !track.present) row.classList.toggle("away", (row.dimmed = !track.present));
    }
  }
}
