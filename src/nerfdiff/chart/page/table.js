// Every configuration of the panel, to sort, to filter and to take away as CSV.
let table = null, DataTable = null;

async function loadTables() {
  ({ default: DataTable } = await import(`data:text/javascript;base64,${$("tables").textContent}`));
}

// The strategy, the chosen metric and the seconds first; then how it compares, and all else.
function columns() {
  const own = members(), { reference } = panel(), seconds = costOf("scene_s") ? "scene_s" : state.cost;
  const keys = [...new Set(own.flatMap((number) => Object.keys(data.configurations[number].labels)))].filter((key) => key !== "strategy");
  const text = (title, csv, of) => ({ title, csv, text: of });
  const measure = ({ field, name, unit }) => ({ title: `${name}${unit && !name.includes("seconds") ? `, ${unit}` : ""}`, field });
  const there = ({ field }) => own.some((number) => value(number, field));
  const first = [metricOf(state.metric), costOf(seconds), ...(state.cost === seconds ? [] : [costOf(state.cost)])].filter(there);
  const rest = [...data.metrics, ...data.costs].filter((each) => there(each) && !first.includes(each));
  const compared = own.some((number) => difference(number, state.metric));
  const { name } = metricOf(state.metric), to = reference === null ? "its reference" : nameOf(reference);
  return [
    text("strategy", "strategy", (number) => data.configurations[number].strategy),
    ...first.map(measure),
    ...(compared ? [{ title: `Δ ${name} to ${to}`, difference: state.metric }, text("verdict", "verdict", (number) => verdict(number, state.metric))] : []),
    ...keys.map((key) => text(key, key, (number) => data.configurations[number].labels[key] ?? "")),
    text("frontier", "frontier", (number) => (frontierOf(state.metric, state.cost).includes(number) ? "yes" : "")),
    ...rest.map(measure),
    text("seeds", "seeds", (number) => data.configurations[number].runs.map((run) => run.seed).join(" ")),
    text("failed", "failed", (number) => data.configurations[number].failed || ""),
  ];
}

function cellOf(column) {
  // what is shown is HTML, what is sorted and filtered is not
  if (column.text) return (number, type) => (type === "display" ? DataTable.util.escapeHtml(String(column.text(number))) : column.text(number));
  const found = column.field ? (number) => value(number, column.field) : (number) => difference(number, column.difference);
  const shown = column.field ? (number) => plain(column.field, mean(number, column.field)).replace(/ [A-Za-z]+$/, "") : (number) => differenceText(number, column.difference, false);
  return (number, type) => {
    if (type === "sort" || type === "type") return found(number)?.[0] ?? null;
    return found(number) ? shown(number) : "–";
  };
}

function drawTable() {
  const asked = table?.search() ?? "";
  table?.destroy();
  const made = columns();
  $("table").replaceChildren(element("thead", {}, element("tr", {}, ...made.map(({ title }) => element("th", { textContent: title })))));
  table = new DataTable($("table"), {
    data: members().map((number) => [number]),
    columns: made.map((column) => ({ data: 0, className: column.text ? "dt-left" : "dt-right", render: cellOf(column) })),
    order: made.flatMap((column, at) => (column.field === state.metric ? [[at, sign(state.metric) > 0 ? "desc" : "asc"]] : [])),
    deferRender: true, pageLength: 25, scrollX: true, autoWidth: false, search: { search: asked },
    createdRow: (row) => (row.tabIndex = -1),
    drawCallback: () => $("table").tBodies[0]?.rows[0]?.setAttribute("tabindex", 0), // from it arrows go on
    columnControl: [["search"]],
    language: { search: "filter:", info: "_START_ to _END_ of _TOTAL_", infoFiltered: "(of _MAX_)" },
  });
  table.made = made;
  table.on("click", "tbody tr", function () {
    const row = table.row(this).data();
    if (row) choose(row[0], true);
  });
}

function tableCsv() {
  const inert = (text) => (typeof text === "string" && /^[=+\-@\t\r]/.test(text) ? `'${text}` : text); // as text.py does
  const quoted = (text) => (/[",\r\n]/.test(text) ? `"${String(text).replaceAll('"', '""')}"` : String(text ?? ""));
  const nameIn = (column) => column.field ?? `${column.difference}_difference`;
  const ends = (column) => (column.text ? [column.csv] : ["", "_low", "_high"].map((end) => nameIn(column) + end));
  const found = (column, number) => (column.field ? value(number, column.field) : difference(number, column.difference));
  const cells = (column, number) => (column.text ? [column.text(number)] : [0, 1, 2].map((at) => found(column, number)?.[at] ?? ""));
  const lines = table.rows({ search: "applied", order: "applied" }).data().toArray().map(([number]) => table.made.flatMap((column) => cells(column, number)));
  return [table.made.flatMap(ends), ...lines].map((line) => line.map(inert).map(quoted).join(",") + "\n").join("");
}

function saveCsv() {
  const link = element("a", { href: URL.createObjectURL(new Blob([tableCsv()], { type: "text/csv" })), download: "chosen_configurations.csv" });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
