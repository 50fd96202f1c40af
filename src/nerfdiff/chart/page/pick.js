// Three configurations to begin with, and the cheapest whose metric is within x of the best.
function linkTo(number) {
  const link = element("button", { type: "button", className: "link" }, nameOf(number));
  link.onclick = () => choose(number);
  return link;
}

function copyButton(text, label) {
  const button = element("button", { type: "button", className: "copy" }, label);
  const said = (word) => {
    button.textContent = word;
    setTimeout(() => (button.textContent = label), 2000);
  };
  button.onclick = () => navigator.clipboard.writeText(text).then(() => said("copied"), () => said("not allowed: mark it by hand"));
  return navigator.clipboard ? button : null;
}

function drawPicks() {
  $("picks").replaceChildren(...answers().picks.map(({ name, number, reason }) => {
    const card = element("article", { className: "pick" }, element("h2", {}, name));
    card.dataset.pick = name;
    card.dataset.number = number ?? "";
    if (number === null) {
      card.append(element("p", { className: "note" }, reason));
      return card;
    }
    const { strategy, runs } = data.configurations[number], [colour, shape] = data.marks[strategy];
    const { command } = runs[0];
    card.querySelector("h2").append(" ", symbol(shape, colour), linkTo(number));
    card.append(element("p", {}, reason));
    if (command) card.append(element("div", { className: "run" }, element("code", { tabIndex: 0, title: command }, command), copyButton(command, "copy")));
    return card;
  }));
}

function within(metric, distance) {
  const better = sign(metric), found = points();
  const best = found.reduce((a, b) => (better * (mean(b, metric) - mean(a, metric)) > 0 ? b : a));
  // half a unit of the last digit stored, so that 23.4 is within 0.1 of 23.5
  const slack = 1e-6 * Math.abs(mean(best, metric));
  const near = found.filter((number) => better * (mean(best, metric) - mean(number, metric)) <= distance + slack);
  const cheapest = near.reduce((a, b) => {
    const dearer = mean(b, state.cost) - mean(a, state.cost) || better * (mean(a, metric) - mean(b, metric));
    return dearer < 0 ? b : a;
  });
  return { best, cheapest };
}

// Whether the best is more than noise: those that no interval tells from it.
function levelWith(best) {
  const found = answers().level[state.metric];
  if (found?.best !== best) return ["No interval says whether its lead is noise."];
  const others = found.level.filter((number) => number !== best);
  if (!others.length) return ["No other is level with it."];
  const told = others.slice(0, 4).flatMap((number, at) => [at ? ", " : "", linkTo(number)]);
  return ["Level with it, as far as intervals say: ", ...told, others.length > 4 ? ` and ${others.length - 4} more.` : "."];
}

function drawAdvice() {
  const metric = metricOf(state.metric), distance = state.within[state.metric];
  $("pick").hidden = !points().length;
  if ($("pick").hidden) return;
  if (document.activeElement !== $("within")) $("within").value = distance;
  $("within-unit").textContent = metric.unit;
  const { best, cheapest } = within(state.metric, distance);
  const numbersOf = (number) => `${metric.name} ${metricText(metric.field, mean(number, metric.field))} at ${costText(state.cost, mean(number, state.cost))}`;
  const ratio = mean(best, state.cost) / mean(cheapest, state.cost);
  const superlative = costOf(state.cost).unit === "s" ? "fastest" : "cheapest";
  const cost = superlative === "fastest" ? "" : ` in ${costOf(state.cost).name}`;
  const rest = best === cheapest
    ? [" It is the best itself. "]
    : [` The best, `, linkTo(best), `, has ${numbersOf(best)}`, isFinite(ratio) ? `: ${digits(ratio)} times as much. ` : ". "];
  $("advice").replaceChildren(`of the best ${metric.name}, the ${superlative}${cost} is `, linkTo(cheapest), `: ${numbersOf(cheapest)}.`, ...rest, ...levelWith(best));
  $("advice").dataset.pick = cheapest;
}
