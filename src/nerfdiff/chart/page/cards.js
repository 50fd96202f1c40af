// A small chart per metric, which is also how one chooses it.
function drawCards() {
  const there = data.metrics.filter(({ field }) => members().some((number) => value(number, field)));
  $("metrics").replaceChildren(...there.map(({ field, name, better }) => {
    const canvas = element("canvas", { width: 268, height: 88 });
    const best = frontierOf(field, state.cost).at(-1);
    const text = best === undefined ? "not with this cost" : `best ${metricText(field, mean(best, field))}`;
    const title = `${name} ${better === "higher" ? "↑" : "↓"}`, small = element("small", {}, text);
    const card = element("button", { className: "card", type: "button" }, title, element("br"), small, canvas);
    card.onclick = () => change({ metric: field });
    card.dataset.metric = field;
    card.setAttribute("aria-pressed", field === state.metric);
    sketch(canvas, field);
    return card;
  }));
}

function sketch(canvas, field) {
  const pen = canvas.getContext("2d"), better = sign(field);
  const found = members().filter((number) => value(number, field) && value(number, state.cost));
  if (!found.length) return;
  const costs = found.map((number) => mean(number, state.cost)).filter((cost) => cost > 0);
  const least = costs.reduce((a, b) => Math.min(a, b), Infinity) / 3;
  const along = (number) => Math.log10(mean(number, state.cost) || least), up = (number) => better * mean(number, field);
  const ends = (numbers, of) => numbers.reduce(([low, high], number) => [Math.min(low, of(number)), Math.max(high, of(number))], [Infinity, -Infinity]);
  const [left, right] = ends(found, along), [bottom, top] = ends(found, up);
  const place = (number) => [8 + (252 * (along(number) - left)) / (right - left || 1), 80 - (72 * (up(number) - bottom)) / (top - bottom || 1)];
  pen.fillStyle = "rgba(92,102,117,0.3)";
  for (const number of found) {
    const [x, y] = place(number);
    pen.fillRect(x - 2, y - 2, 4, 4);
  }
  pen.strokeStyle = "#0b62b8";
  pen.lineWidth = 3;
  pen.beginPath();
  let before = null;
  for (const number of frontierOf(field, state.cost)) {
    const [x, y] = place(number);
    if (before !== null) pen.lineTo(x, before);
    before === null ? pen.moveTo(x, y) : pen.lineTo(x, y);
    before = y;
  }
  if (before !== null) pen.lineTo(262, before);
  pen.stroke();
}
