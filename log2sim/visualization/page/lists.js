// Doubtful agents, events and metrics, each one click away.

const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

// A line of a list: the marker of an agent, if there is one, and words; a click acts.
const lineOf = (track, words, act) => {
  const button = element("button", { type: "button" }), item = element("li");
  if (track) button.append(mark(track));
  button.append(element("span", { class: "why" }, words));
  button.addEventListener("click", act);
  item.append(button);
  return item;
};

// A list with its title, hidden where it is empty.
const fillLines = (id, title, lines) => {
  byId(id).hidden = lines.length === 0;
  byId(`${id}-count`).textContent = title;
  byId(`${id}-agents`).replaceChildren(...lines);
};

// The doubtful agents with their reasons; a click chooses one when the doubt begins.
const listDoubtful = () => fillLines("doubtful", counted(doubtful.length, "doubtful agent"), doubtful.map((track) =>
  lineOf(track, `${track.id}: ${track.doubts.map(([reason]) => reason).join(", ")}`, () => {
    const starts = track.doubts.map(([, start]) => start).filter((start) => start !== null);
    if (starts.length) seek(Math.min(...starts));
    chooseVisible(track);
  })));

// Show the list with the doubtful agents, wherever it is hidden.
const showDoubtful = () => {
  if (byId("agent-list").getClientRects().length === 0) {
    choose(null);
    if (byId("agent-list").getClientRects().length === 0) showList();
  }
  byId("doubtful").open = true;
  byId("doubtful-count").focus();
};

// Tables and summaries of figures.
const fillMetrics = (metrics) => {
  byId("metrics-toggle").hidden = metrics.length === 0;
  byId("figures").replaceChildren(...metrics.flatMap(([title, text]) => [element("h3", {}, title), element("pre", { tabindex: 0 }, text)]));
};
