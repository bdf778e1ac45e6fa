// Frames of a turntable, one at a time under a slider.
for (const table of document.querySelectorAll(".turntable")) {
  const frames = table.querySelectorAll(".frames > *");
  const slider = table.querySelector(".control input");
  const show = () => frames.forEach((frame, k) => frame.classList.toggle("shown", k == slider.value));
  slider.addEventListener("input", show);
  table.classList.add("turning");
  show();
}
// Tables whose headings sort; a row with fewer cells has no figures, and goes last.
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  const of = (row, k) => row.cells.length > k ? row.cells[k].dataset.value : "";
  [...table.tHead.rows[0].cells].forEach((head, k) => head.addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") === "ascending";
    [...table.tHead.rows[0].cells].forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const whole = table.tHead.rows[0].cells.length;
    const rows = [...body.rows].sort((a, b) => {
      const [x, y] = [of(a, k), of(b, k)];
      if (k && (a.cells.length < whole) !== (b.cells.length < whole)) return a.cells.length - b.cells.length > 0 ? -1 : 1;
      const order = head.classList.contains("number") ? x - y : x.localeCompare(y);
      return down ? -order : order;
    });
    body.append(...rows);
  }));
}
