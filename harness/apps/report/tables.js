"use strict";
// Tables: rows become cards where columns do not fit, and sort by a click: up, down, as they were.
function size(cell) {
  const text = cell.firstChild ? cell.firstChild.textContent.trim() : "";
  if (text.startsWith("∞")) return Infinity;
  const value = parseFloat(text);
  return Number.isNaN(value) ? null : value;
}

function compare(a, b) {
  const [x, y] = [size(a), size(b)];
  if (!a.classList.contains("n") && !b.classList.contains("n")) return a.textContent.localeCompare(b.textContent);
  if (x === null || y === null) return (x === null) - (y === null);
  return x === y ? 0 : x - y;
}

function prepare(table) {
  const heads = [...table.querySelectorAll(".heads th")];
  const groups = [...table.querySelectorAll(".groups th")].flatMap((th) => Array(th.colSpan).fill(th.textContent));
  const labels = heads.map((th, i) => (groups[i] ? `${groups[i]}: ` : "") + th.textContent);
  const body = table.tBodies[0];
  const rows = [...body.rows];
  const lengthy = heads.map((_, i) => labels[i].length > 36 || rows.some((row) => row.cells[i].textContent.length > 32));
  for (const row of rows) [...row.cells].forEach((cell, i) => {
    cell.dataset.label = labels[i];
    if (lengthy[i] && cell.textContent !== "–") cell.classList.add("whole");
  });
  heads.forEach((th, i) => {
    if (rows.length && rows.every((row) => row.cells[i].classList.contains("n"))) th.classList.add("n");
    th.firstElementChild.addEventListener("click", () => {
      const next = { ascending: "descending", descending: "none" }[th.getAttribute("aria-sort")] ?? "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      th.setAttribute("aria-sort", next);
      const sign = next === "descending" ? -1 : 1;
      const order = next === "none" ? rows : [...rows].sort((a, b) => sign * compare(a.cells[i], b.cells[i]));
      for (const open of body.querySelectorAll(".detail")) open.remove();
      body.append(...order);
      table.dispatchEvent(new Event("sorted"));
    });
  });
}
for (const table of document.querySelectorAll("table")) prepare(table);
