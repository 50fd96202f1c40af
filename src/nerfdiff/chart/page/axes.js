// Where things stand: a logarithmic cost, with a place of its own for zero, and a metric that is better upwards.
const wide = window.matchMedia("(min-width: 801px)"); // as in style.css
const WIDE = () => wide.matches;

// The axis of the costs `found`: its range in powers of ten, and where a cost stands.
function costAxis(found, room) {
  const positive = found.filter((cost) => cost > 0);
  const [low, high] = positive.length ? [Math.min(...positive), Math.max(...positive)] : [1, 1];
  const zero = found.some((cost) => !(cost > 0)) ? low / 3 : null;
  const ends = [Math.log10(zero ?? low), Math.log10(high)], short = Math.max(0.4 - (ends[1] - ends[0]), 0) / 2;
  ends[0] -= short;
  ends[1] += short;
  const span = ends[1] - ends[0];
  const edge = ends[1] + 0.05 * span; // beyond it is room for what has no cost
  const range = [ends[0] - 0.05 * span, edge + room * span];
  const axis = { type: "log", range, title: { text: costTitle() }, gridcolor: "#e8ecf1", zeroline: false, minor: { showgrid: false } };
  const ticks = [];
  const steps = span > (WIDE() ? 4 : 2) ? [1] : span > 1 ? [1, 2, 5] : [1, 1.5, 2, 3, 4, 5, 7];
  for (let power = Math.floor(range[0]); power <= edge; power++)
    for (const tick of steps.map((step) => step * 10 ** power)) if (tick > low * (zero === null ? 0 : 0.6) && tick < 10 ** edge) ticks.push(tick);
  Object.assign(axis, { tickvals: [...(zero === null ? [] : [zero]), ...ticks] });
  axis.ticktext = axis.tickvals.map((tick) => (tick === zero ? "0" : digits(tick)));
  return { axis, range, zero, at: (cost) => (cost > 0 ? cost : zero), edge: 10 ** edge, share: (edge - range[0]) / (range[1] - range[0]) };
}

function costTitle() {
  const { name, unit } = costOf(state.cost);
  return `${name}${unit && !name.includes("seconds") ? `, ${unit}` : ""} (logarithmic)`;
}

function metricAxis(found) {
  const { name, unit, better } = metricOf(state.metric);
  const [low, high] = [Math.min(...found), Math.max(...found)];
  const pad = 0.06 * (high - low || Math.abs(high) || 1);
  const up = [low - pad, high + pad];
  const shown = byDifference() ? `${name}, difference to ${nameOf(panel().reference)}` : name;
  const text = `${shown}${unit ? `, ${unit}` : ""}${better === "higher" ? "" : " (up is better)"}`;
  const range = better === "higher" ? up : up.reverse();
  return { range, title: { text: markup(text), standoff: 8 }, gridcolor: "#e8ecf1", zeroline: false, nticks: 8, tickformat: byDifference() ? "+" : "" };
}

// Plotly takes text for markup.
const markup = (text) => text.replaceAll("&", "&amp;").replaceAll("<", "&lt;");

// Pixels from each label's marker to the label, so that labels in a column do not cover each other.
function spreadLabels(values, range, height, line) {
  const pixels = values.map((at) => ((range[1] - at) / (range[1] - range[0])) * height);
  const order = pixels.map((_, at) => at).sort((a, b) => pixels[a] - pixels[b]);
  const placed = [];
  order.forEach((at, rank) => (placed[rank] = Math.max(pixels[at], rank ? placed[rank - 1] + line : 0)));
  for (let rank = placed.length - 1, floor = height; rank >= 0; rank--, floor = placed[rank + 1] - line)
    placed[rank] = Math.min(placed[rank], floor);
  const shifts = [];
  order.forEach((at, rank) => (shifts[at] = placed[rank] - pixels[at]));
  return shifts;
}

// Pixels above or below each marker at which its label covers none placed before.
function freeLines(places, xs, ys, [width, height], size) {
  const at = ([x, y]) => ({ left: ((x - xs[0]) / (xs[1] - xs[0])) * width, top: ((ys[1] - y) / (ys[1] - ys[0])) * height, half: 6 });
  const taken = places.map(at);
  return places.map((place) => {
    const { left, top } = at(place), letters = place[2];
    const half = 0.3 * size * letters + 2;
    const free = (shift) => taken.every((other) => Math.abs(other.left - left) > other.half + half || Math.abs(other.top - top - shift) > size + 2);
    const shift = [-16, 16, -30, 30, -44, 44].find(free) ?? -16;
    taken.push({ left, half, top: top + shift });
    return shift;
  });
}
