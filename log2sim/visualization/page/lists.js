// Doubtful agents and metrics, each one click away.

// The doubtful agents with their reasons; a click chooses one when the doubt begins.
const listDoubtful = () => {
  byId("doubtful").hidden = doubtful.length === 0;
  byId("doubtful-count").textContent = `${doubtful.length} doubtful agent${doubtful.length === 1 ? "" : "s"}`;
  byId("doubtful-agents").replaceChildren(...doubtful.map((track) => {
    const button = element("button", { type: "button" }), item = element("li");
    const why = track.doubts.map(([reason]) => reason).join(", ");
    button.append(mark(track), element("span", { class: "why" }, `${track.id}: ${why}`));
    button.addEventListener("click", () => {
      const starts = track.doubts.map(([, start]) => start).filter((start) => start !== null);
      if (starts.length) seek(Math.min(...starts));
      chooseVisible(track);
    });
    item.append(button);
    return item;
  }));
};

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
