// A click on a column's heading sorts its table: numbers by value, largest first, then the other way round.
document.addEventListener("click", (event) => {
  const heading = event.target.closest("th");
  const body = heading && heading.closest("table").tBodies[0];
  if (!body) return;
  const column = heading.cellIndex, upward = heading.dataset.order === "down";
  heading.dataset.order = upward ? "up" : "down";
  const key = (row) => row.cells[column].textContent.trim();
  const number = (row) => parseFloat(key(row).replace(/[,<+ ]/g, "").replace("\u2212", "-"));
  const sorted = [...body.rows].sort((a, b) => {
    const [x, y] = [number(a), number(b)];
    if (isNaN(x) || isNaN(y)) return isNaN(x) - isNaN(y) || key(a).localeCompare(key(b)) * (upward ? -1 : 1);
    return upward ? x - y : y - x;
  });
  body.append(...sorted);
});
