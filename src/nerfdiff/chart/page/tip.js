// What a point is, beside the pointer.
function tipOf(found) {
  if (found.published) {
    const entry = found.published;
    const said = `${metricOf(state.metric).name} ${metricText(state.metric, entry.metrics[state.metric])}`;
    const text = element("div", {}, `published: ${said} at ${entry.image_size} pixels`);
    return [element("b", {}, entry.method), text, element("div", { className: "note" }, entry.source)];
  }
  const entry = data.configurations[found];
  const line = (field) => element("div", {}, `${(metricOf(field) ?? costOf(field)).name} ${estimate(field, value(found, field))}`);
  const seeds = entry.runs.length === 1 ? `seed ${entry.runs[0].seed}` : `${entry.runs.length} seeds`;
  const failed = entry.failed ? element("div", { className: "bad" }, `${entry.failed} more failed`) : null;
  const fell = entry.fell_back ? element("div", { className: "bad" }, entry.fell_back) : null;
  const runs = element("div", { className: "note" }, `${seeds}, ${entry.scenes ?? "?"} scenes`);
  return [element("b", {}, nameOf(found)), line(state.metric), line(state.cost), runs, failed, fell, overrideList(entry)];
}

function showTip(event) {
  const tip = $("tip");
  tip.replaceChildren(...tipOf(event.points[0].customdata).filter(Boolean));
  tip.hidden = false;
  const [x, y] = [event.event.clientX, event.event.clientY], { width, height } = tip.getBoundingClientRect();
  tip.style.left = `${Math.max(4, Math.min(x + 14, window.innerWidth - width - 6))}px`;
  tip.style.top = `${Math.max(4, y + 14 + height > window.innerHeight ? y - height - 10 : y + 14)}px`;
}

function listen() {
  if ($("plot").dataset.listening || !$("plot").on) return;
  $("plot").dataset.listening = "yes";
  $("plot").on("plotly_hover", showTip);
  $("plot").on("plotly_unhover", () => ($("tip").hidden = true));
  $("plot").on("plotly_click", (event) => {
    $("tip").hidden = true;
    const found = event.points[0].customdata;
    if (typeof found === "number") choose(found);
  });
}
