// Every configuration of the panel, to sort, to filter and to take away as CSV.
let table = null, DataTable = null;

async function loadTables() {
  ({ default: DataTable } = await import(`data:text/javascript;base64,${$("tables").textContent}`));
}

function columns() {
  const members = panel().members;
  const keys = [...new Set(members.flatMap((number) => Object.keys(data.configurations[number].labels)))];
  const label = (key) => ({ title: key, csv: key, text: (number) => data.configurations[number].labels[key] ?? "" });
  const measure = ({ field, name, unit }) => ({ title: `${name}${unit ? `, ${unit}` : ""}`, field });
  const measured = [...data.metrics, ...data.costs].filter(({ field }) => members.some((number) => value(number, field)));
  return [
    { title: "frontier", csv: "frontier", text: (number) => (frontierOf(state.metric, state.cost).includes(number) ? "yes" : "") },
    ...keys.map(label),
    ...measured.map(measure),
    { title: "seeds", csv: "seeds", text: (number) => data.configurations[number].runs.map((run) => run.seed).join(" ") },
    { title: "failed", csv: "failed", text: (number) => data.configurations[number].failed || "" },
  ];
}

function cellOf(column) {
  // what is shown is HTML, what is sorted and filtered is not
  if (column.text) return (number, type) => (type === "display" ? DataTable.util.escapeHtml(String(column.text(number))) : column.text(number));
  return (number, type) => {
    const found = value(number, column.field);
    if (type === "sort" || type === "type") return found ? found[0] : null;
    return found ? estimate(column.field, found).replace(/ [A-Za-z]+$/, "") : "–";
  };
}

function drawTable() {
  table?.destroy();
  const made = columns();
  $("table").replaceChildren(element("thead", {}, element("tr", {}, ...made.map(({ title }) => element("th", { textContent: title })))));
  table = new DataTable($("table"), {
    data: panel().members.map((number) => [number]),
    columns: made.map((column) => ({ data: 0, className: column.field ? "dt-right" : "dt-left", render: cellOf(column) })),
    order: made.flatMap((column, at) => (column.field === state.metric ? [[at, sign(state.metric) > 0 ? "desc" : "asc"]] : [])),
    deferRender: true, pageLength: 25, scrollX: true, autoWidth: false,
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
  const ends = (column) => (column.field ? [column.field, `${column.field}_low`, `${column.field}_high`] : [column.csv]);
  const cells = (column, number) => (column.field ? [0, 1, 2].map((at) => value(number, column.field)?.[at] ?? "") : [column.text(number)]);
  const lines = table.rows({ search: "applied", order: "applied" }).data().toArray().map(([number]) => table.made.flatMap((column) => cells(column, number)));
  return [table.made.flatMap(ends), ...lines].map((line) => line.map(inert).map(quoted).join(",") + "\n").join("");
}

function saveCsv() {
  const link = element("a", { href: URL.createObjectURL(new Blob([tableCsv()], { type: "text/csv" })), download: "chosen_configurations.csv" });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
