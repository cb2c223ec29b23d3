"use strict";
// Pointing along the needle marks the place in both views.
for (const figure of document.querySelectorAll(".arc")) {
  const points = JSON.parse(figure.dataset.points), start = +figure.dataset.start, end = +figure.dataset.end;
  const frame = figure.closest(".frame"), line = figure.querySelector("line.cursor"), text = figure.querySelector("text.cursor");
  const circles = ["left", "right"].map((side) => frame.querySelector(`.cut-out.${side} .cursor`));
  const show = (x) => {
    line.setAttribute("x1", x); line.setAttribute("x2", x); text.setAttribute("x", x + 5);
    const share = (x - start) / (end - start), at = points[Math.round(share * (points.length - 1))];
    text.textContent = at ? `${(share * figure.dataset.length).toFixed(1)} mm` : "";
    circles.forEach((circle, side) => {
      circle.setAttribute("cx", at ? at[2 * side] : -1e4); circle.setAttribute("cy", at ? at[2 * side + 1] : -1e4);
    });
  };
  figure.addEventListener("pointermove", (event) => {
    const x = new DOMPoint(event.clientX, event.clientY).matrixTransform(figure.getScreenCTM().inverse()).x;
    show(Math.min(Math.max(x, 0), figure.viewBox.baseVal.width));
  });
  figure.addEventListener("pointerleave", () => show(-9));
}
// The heads of the index sort it; a dash, which is no number, comes last.
for (const table of document.querySelectorAll(".sortable")) {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.firstElementChild.addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") !== "ascending";
    heads.forEach((each) => each.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const key = (row) => row.cells[column].textContent.trim();
    const rows = [...body.rows].sort((a, b) => {
      const [x, y] = [parseFloat(key(a)), parseFloat(key(b))];
      if (isNaN(x) !== isNaN(y)) return isNaN(x) ? 1 : -1;
      return (up ? 1 : -1) * (isNaN(x) ? key(a).localeCompare(key(b)) : x - y);
    });
    body.append(...rows);
  }));
}
// j and k: the next pair and the one before.
document.addEventListener("keydown", (event) => {
  if ((event.key !== "j" && event.key !== "k") || event.ctrlKey || event.metaKey || event.altKey) return;
  const frames = [...document.querySelectorAll(".frame")], tops = frames.map((frame) => frame.getBoundingClientRect().top - 60);
  const next = event.key === "j" ? frames[tops.findIndex((top) => top > 4)] : frames[tops.findLastIndex((top) => top < -4)];
  if (next) { next.scrollIntoView(); history.replaceState(null, "", `#${next.id}`); }
});
