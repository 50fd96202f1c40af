// What a point is, beside the pointer or the point that has the keyboard's attention.
function tipOf(found) {
  if (found.published) {
    const entry = found.published;
    const said = `${metricOf(state.metric).name} ${metricText(state.metric, entry.metrics[state.metric])}`;
    const text = element("div", {}, `published: ${said} at ${entry.image_size} pixels`);
    return [element("b", {}, entry.method), text, element("div", { className: "note" }, entry.source)];
  }
  const entry = data.configurations[found];
  const line = (field) => element("div", {}, `${(metricOf(field) ?? costOf(field)).name} ${plain(field, mean(found, field))}`);
  const bad = (text) => element("div", { className: "bad" }, text);
  const seeds = entry.runs.length === 1 ? `seed ${entry.runs[0].seed}` : `${entry.runs.length} seeds`;
  return [
    element("b", {}, nameOf(found)), line(state.metric), against(found), line(state.cost),
    element("div", { className: "note" }, `${seeds}, ${entry.scenes ?? "?"} scenes`),
    entry.failed ? bad(`${entry.failed} more failed`) : null, entry.fell_back ? bad(entry.fell_back) : null,
    ...(entry.small ? [element("img", { src: entry.small, alt: "its first views" }), overrideList(entry, true)] : [overrideList(entry)]),
  ];
}

function against(number) {
  const says = verdict(number, state.metric);
  if (!difference(number, state.metric)) return says ? element("div", {}, says) : null;
  const words = `${differenceText(number, state.metric)} against ${referenceName(number)}: `;
  return element("div", {}, words, element("b", {}, says));
}

function showTip(found, x, y) {
  const tip = $("tip");
  tip.replaceChildren(...tipOf(found).filter(Boolean));
  tip.hidden = false;
  const { width, height } = tip.getBoundingClientRect();
  tip.style.left = `${Math.max(4, Math.min(x + 14, window.innerWidth - width - 6))}px`;
  tip.style.top = `${Math.max(4, y + 14 + height > window.innerHeight ? Math.min(y - 14, window.innerHeight) - height : y + 14)}px`;
}

const hideTip = () => ($("tip").hidden = true);

function listen() {
  if ($("plot").dataset.listening || !$("plot").on) return;
  $("plot").dataset.listening = "yes";
  $("plot").on("plotly_hover", ({ points: [{ customdata }], event }) => showTip(customdata, event.clientX, event.clientY));
  $("plot").on("plotly_unhover", hideTip);
  $("plot").on("plotly_click", (event) => {
    hideTip();
    const found = event.points[0].customdata;
    if (typeof found === "number") choose(found);
  });
}
