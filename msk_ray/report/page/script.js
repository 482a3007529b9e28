"use strict";
// Sorting a table by one of its columns: a click or the Enter key on its heading. Cells carry their value in data-value.
function sortTable(table, column, down) {
  const headings = [...table.tHead.rows[0].cells];
  headings.forEach((other) => other.removeAttribute("aria-sort"));
  headings[column].setAttribute("aria-sort", down ? "descending" : "ascending");
  const value = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent.trim();
  const compare = (a, b) => {
    const [x, y] = [value(a), value(b)];
    if (x === "" || y === "") return x === y ? 0 : x === "" ? 1 : -1; // rows without a value stay at the end
    const [m, n] = [Number(x), Number(y)];
    const order = Number.isNaN(m) || Number.isNaN(n) ? x.localeCompare(y) : m - n;
    return down ? -order : order;
  };
  const body = table.tBodies[0];
  [...body.rows].sort(compare).forEach((row) => body.append(row));
}
// A table that is wider than its frame shows a shadow where it goes on.
function shade(frame) {
  frame.classList.toggle("more", frame.scrollLeft + frame.clientWidth < frame.scrollWidth - 1);
}
function prepare() {
  document.querySelectorAll("table[data-sortable]").forEach((table) => {
    [...table.tHead.rows[0].cells].forEach((heading, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = heading.textContent;
      heading.replaceChildren(button);
      button.addEventListener("click", () => sortTable(table, column, heading.getAttribute("aria-sort") !== "descending"));
    });
  });
  document.querySelectorAll(".pick").forEach((button) => {
    button.addEventListener("click", () => page.pick(+button.closest("tr").dataset.trial));
  });
  document.querySelectorAll(".scroll").forEach((frame) => {
    frame.addEventListener("scroll", () => shade(frame), { passive: true });
    shade(frame);
  });
  page.load();
}
const filterForm = document.getElementById("filter");
filterForm.addEventListener("submit", (event) => event.preventDefault());
filterForm.addEventListener("input", () => page.filter());
filterForm.addEventListener("reset", (event) => { event.preventDefault(); page.reset(); });
let width = innerWidth;
addEventListener("resize", () => {
  if (innerWidth === width) return; // a phone's bars come and go
  width = innerWidth;
  page.resize();
  page.draw();
  document.querySelectorAll(".scroll").forEach(shade);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => page.draw());
// On paper everything is open, in black on white, and as wide as the paper.
addEventListener("beforeprint", () => {
  document.querySelectorAll("details").forEach((d) => { d.open = true; });
  document.documentElement.classList.add("paper");
  page.draw();
  page.resize();
});
addEventListener("afterprint", () => {
  document.documentElement.classList.remove("paper");
  page.draw();
  page.resize();
});
prepare();
