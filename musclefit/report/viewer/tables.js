// Tables of a report page: folded rows join their table, a click on a heading sorts, a field filters.
"use strict";
(() => {
  const SUPERSCRIPTS = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  const SHOWN = 25, FILTERED_FROM = 11;

  // The number that a cell shows, or its text where it shows none; null for an empty cell.
  function valueOf(cell) {
    const text = (cell ? cell.innerText : "").trim();
    const plain = text.split("\n")[0].replace(/[\u202f\u00a0\s]/g, "").replace(/−/g, "-");
    const power = plain.match(/^(-?[\d.]+)×10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)/);
    if (power) {
      const exponent = [...power[2]].map((c) => (c === "⁻" ? "-" : SUPERSCRIPTS.indexOf(c))).join("");
      return Number(power[1]) * 10 ** Number(exponent);
    }
    if (plain === "" || plain === "–") return null;
    const number = plain.match(/^[≤✓✗]?(-?[\d,]*\.?\d+)/);
    return number ? Number(number[1].replace(/,/g, "")) : text.toLowerCase();
  }

  // Empty cells come last, whichever way a table is sorted.
  function inOrder(a, b, down) {
    if (a === null || b === null) return (a === null) - (b === null);
    return down ? compared(a, b) : compared(b, a);
  }

  function compared(a, b) {
    if (typeof a === "number" && typeof b === "number") return a - b;
    if (typeof a === "number") return -1;
    if (typeof b === "number") return 1;
    return a < b ? -1 : a > b ? 1 : 0;
  }

  function prepare(table) {
    const body = table.tBodies[0];
    const rows = [...body.rows];
    const state = { all: rows.length <= SHOWN, sought: "" };
    const tools = document.createElement("div");
    tools.className = "table-tools";
    const said = document.createElement("span");
    said.setAttribute("aria-live", "polite");
    const field = document.createElement("input");
    field.type = "search";
    field.placeholder = "Filter rows";
    field.setAttribute("aria-label", "Filter the rows of this table");
    const more = document.createElement("button");
    more.type = "button";

    function show() {
      let matching = 0;
      for (const row of body.rows) {
        const fits = row.textContent.toLowerCase().includes(state.sought);
        matching += fits;
        row.hidden = !fits || (!state.all && !state.sought && matching > SHOWN);
      }
      const shown = state.all || state.sought ? matching : Math.min(matching, SHOWN);
      said.textContent = `${shown} of ${rows.length} rows`;
      more.hidden = rows.length <= SHOWN || state.sought !== "";
      more.textContent = state.all ? "Show the first 25" : "Show all rows";
    }

    field.addEventListener("input", () => { state.sought = field.value.trim().toLowerCase(); show(); });
    more.addEventListener("click", () => { state.all = !state.all; show(); });
    if (rows.length >= FILTERED_FROM) {
      tools.append(field, said, more);
      (table.closest(".scroll") || table).before(tools);
      show();
    }

    [...table.tHead.rows[0].cells].forEach((head, column) => {
      if (!head.textContent.trim()) return;
      const button = document.createElement("button");
      button.type = "button";
      button.className = "sort";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "descending" || (!head.hasAttribute("aria-sort") && !head.classList.contains("n"));
        for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
        head.setAttribute("aria-sort", down ? "ascending" : "descending");
        const keyed = [...body.rows].map((row) => [valueOf(row.cells[column]), row]);
        keyed.sort((a, b) => inOrder(a[0], b[0], down));
        body.append(...keyed.map((pair) => pair[1]));
        show();
      });
    });
  }

  for (const details of document.querySelectorAll("details.more-rows")) {
    const table = details.previousElementSibling.querySelector("table");
    table.tBodies[0].append(...details.querySelector("tbody").rows);
    details.remove();
  }
  for (const table of document.querySelectorAll("main table")) {
    if (table.tHead && table.tBodies.length === 1 && !table.querySelector("[colspan]")) prepare(table);
  }
  addEventListener("beforeprint", () => {
    for (const row of document.querySelectorAll("main tbody tr[hidden]")) row.hidden = false;
    for (const details of document.querySelectorAll("main details")) details.open = true;
  });
})();
