// What colours and shapes mean. A button hides its points, and shows them again.
const around = (count, radius = () => 1) =>
  `M${[...Array(count).keys()].map((at) => {
    const angle = (2 * Math.PI * at) / count - Math.PI / 2;
    return `${(radius(at) * Math.cos(angle)).toFixed(3)},${(radius(at) * Math.sin(angle)).toFixed(3)}`;
  }).join("L")}Z`;
const CROSS = "M-.36,-1H.36V-.36H1V.36H.36V1H-.36V.36H-1V-.36H-.36Z";
// as Plotly draws them: a path, and by how many degrees it is turned
const OUTLINES = {
  circle: [around(24), 0], square: [around(4, () => 1.25), 45], "triangle-up": [around(3, () => 1.15), 0], x: [CROSS, 45],
  star: [around(10, (at) => (at % 2 ? 0.5 : 1.25)), 0], "triangle-down": [around(3, () => 1.15), 180], cross: [CROSS, 0],
  pentagon: [around(5), 0], hourglass: ["M-1,-1H1L-1,1H1Z", 0], hexagon: [around(6), 90],
  "triangle-left": [around(3, () => 1.15), -90], "triangle-right": [around(3, () => 1.15), 90],
};

function svg(tag, attributes, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, text] of Object.entries(attributes)) made.setAttribute(name, text);
  made.append(...children);
  return made;
}

function symbol(shape, colour) {
  const [d, turn] = OUTLINES[shape];
  return svg("svg", { viewBox: "-1.4 -1.4 2.8 2.8", width: 15, height: 15, "aria-hidden": true }, svg("path", { d, fill: colour, transform: `rotate(${turn})` }));
}

const line = (dash) =>
  svg("svg", { viewBox: "0 0 26 10", width: 26, height: 10, "aria-hidden": true }, svg("path", { d: "M0,5H26", stroke: "#1d2430", "stroke-width": 1.8, "stroke-dasharray": dash }));

const hiddenKey = (name) => `${state.panel} ${state.colour} ${name}`;
const isHidden = (name) => state.hidden.has(hiddenKey(name));

function drawLegend(numbers, { numeric, groups }, published) {
  const own = groups.filter(({ legend }) => legend !== null).map(({ legend, colour }) => {
    const parts = [symbol(state.colour === "strategy" ? data.marks[legend][1] : "circle", colour), element("span", { className: "name" }, legend)];
    if (numeric) return element("span", { className: "entry" }, ...parts);
    const button = element("button", { type: "button", className: "entry", title: "hide or show; with Shift: this one alone" }, ...parts);
    button.setAttribute("aria-pressed", !isHidden(legend));
    button.dataset.group = legend;
    button.onclick = (event) => {
      const key = hiddenKey(legend);
      if (event.shiftKey) for (const group of groups) state.hidden[group.legend === legend ? "delete" : "add"](hiddenKey(group.legend));
      else state.hidden[state.hidden.has(key) ? "delete" : "add"](key);
      drawAll();
      document.querySelector(`#legend [data-group="${CSS.escape(legend)}"]`)?.focus();
    };
    return button;
  });
  const shapes = state.colour === "strategy" ? [] : [...new Set(numbers.map((number) => data.configurations[number].strategy))].sort();
  const key = (mark, text) => element("span", { className: "entry" }, mark, element("span", { className: "name" }, text));
  const more = [
    ...shapes.map((name) => key(symbol(data.marks[name][1], "#5c6675"), name)),
    key(line(""), "frontier"),
    ...(canDiffer() ? [key(line("4 4"), nameOf(panel().reference))] : []),
    ...(numbers.some((number) => data.configurations[number].adaptive) ? [key(element("i", { className: "adaptive" }), "adaptive budget")] : []),
    ...(published.length ? [key(element("span", { className: "paper" }, "◇"), "published")] : []),
  ];
  $("legend").replaceChildren(...own, ...more);
}
