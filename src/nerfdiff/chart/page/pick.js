// Advice: the cheapest configuration whose metric is within x of the best.
function pick(within) {
  const better = sign(state.metric), found = points();
  const best = found.reduce((a, b) => (better * (mean(b, state.metric) - mean(a, state.metric)) > 0 ? b : a));
  // half a unit of the last digit stored, so that 23.4 is within 0.1 of 23.5
  const slack = 1e-6 * Math.abs(mean(best, state.metric));
  const near = found.filter((number) => better * (mean(best, state.metric) - mean(number, state.metric)) <= within + slack);
  const cheapest = near.reduce((a, b) => {
    const difference = mean(b, state.cost) - mean(a, state.cost) || better * (mean(a, state.metric) - mean(b, state.metric));
    return difference < 0 ? b : a;
  });
  return { best, cheapest };
}

function drawPick() {
  const metric = metricOf(state.metric), within = state.within[state.metric];
  $("pick").hidden = !points().length;
  if ($("pick").hidden) return;
  if (document.activeElement !== $("within")) $("within").value = within;
  $("within-unit").textContent = metric.unit;
  const { best, cheapest } = pick(within);
  const link = (number) => {
    const open = (event) => {
      event.preventDefault();
      choose(number);
    };
    return element("a", { href: "#", textContent: nameOf(number), onclick: open });
  };
  const numbersOf = (number) => `${metric.name} ${metricText(metric.field, mean(number, metric.field))} at ${costText(state.cost, mean(number, state.cost))}`;
  const ratio = mean(best, state.cost) / mean(cheapest, state.cost);
  const superlative = costOf(state.cost).unit === "s" ? "fastest" : "cheapest";
  const cost = superlative === "fastest" ? "" : ` in ${costOf(state.cost).name}`;
  const rest = best === cheapest
    ? " It is the best itself."
    : [` The best, `, link(best), `, has ${numbersOf(best)}`, isFinite(ratio) ? `: ${digits(ratio)} times as much.` : "."];
  $("advice").replaceChildren(`of the best ${metric.name}, the ${superlative}${cost} is `, link(cheapest), `: ${numbersOf(cheapest)}.`, ...[rest].flat());
  $("advice").dataset.pick = cheapest;
}
