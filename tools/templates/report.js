// Tables of class "sort": a click (or Enter) on a heading sorts by that column, a second one the other way round.
const number = (text) => { const found = text.replace(/,/g, "").match(/[-+]?\d+(\.\d+)?(e[-+]?\d+)?/i); return found ? parseFloat(found[0]) : NaN; };
const shown = (row, column) => row.cells[column].firstChild ? row.cells[column].firstChild.textContent.trim() : "";
function sort(heading) {
  const table = heading.closest("table"), column = heading.cellIndex, rows = [...table.tBodies[0].rows];
  const words = heading.classList.contains("l");
  const up = heading.ariaSort ? heading.ariaSort === "descending" : words;
  const value = words ? shown : (row, index) => number(shown(row, index));
  const compare = words ? (a, b) => a.localeCompare(b, undefined, { numeric: true }) : (a, b) => a - b;
  const known = rows.filter((row) => words || !isNaN(value(row, column)));
  known.sort((a, b) => (up ? 1 : -1) * compare(value(a, column), value(b, column)));
  table.tBodies[0].append(...known, ...rows.filter((row) => !known.includes(row)));
  for (const other of heading.parentNode.cells) other.removeAttribute("aria-sort");
  heading.setAttribute("aria-sort", up ? "ascending" : "descending");
}
for (const heading of document.querySelectorAll("table.sort th")) {
  heading.tabIndex = 0;
  heading.title = "sort";
  heading.onclick = () => sort(heading);
  heading.onkeydown = (event) => { if (event.key === "Enter") sort(heading); };
}
// A link into a folded part opens it.
const unfold = () => { const goal = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1))); if (goal) { for (let at = goal.closest("details"); at; at = at.parentNode.closest("details")) at.open = true; goal.scrollIntoView(); } };
addEventListener("hashchange", unfold);
unfold();
