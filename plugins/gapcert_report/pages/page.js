// Around the pictures: tables that sort, light and dark, print, and what to press. It follows plots.js.
const HELP = "Pictures: point at one, or focus it and press the arrow keys (with Shift in steps of ten), to read values; " +
  "+ and − zoom, and so does the wheel with Ctrl or in a focused picture; drag to move, 0 or a double click shows all. " +
  "An entry of a legend hides what it names. Headings sort a table.";
const worth = text => {
  const plain = text.replace(/,/g, "").replace("−", "-").trim();
  const digits = t => t.replace(/./gu, c => { const i = "⁻⁰¹²³⁴⁵⁶⁷⁸⁹".indexOf(c); return i > 0 ? i - 1 : "-"; });
  const [, , m, e] = plain.match(/^((-?[\d.]+)\s*×\s*)?10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)/) ?? [];
  return e ? (m ?? 1) * 10 ** digits(e) : parseFloat(plain);
};
const sortable = table => {
  const body = table.tBodies[0], first = [...body.rows];
  if (first.length < 4) return;
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, i) => {
    head.append(html("button", { type: "button", className: "sort", onclick() {
      const next = { ascending: "descending", descending: "none" }[head.getAttribute("aria-sort")] ?? "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      if (next !== "none") head.setAttribute("aria-sort", next);
      const sign = next === "descending" ? -1 : 1, key = row => row.cells[i].textContent;
      const order = (a, b) => {
        const [x, y] = [worth(a), worth(b)];
        return Number.isNaN(x) || Number.isNaN(y) ? Number.isNaN(x) - Number.isNaN(y) || sign * a.localeCompare(b) : sign * (x - y);
      };
      body.append(...(next === "none" ? first : [...first].sort((a, b) => order(key(a), key(b)))));
    } }, ...head.childNodes));
  });
};

for (const figure of document.querySelectorAll("figure")) {
  const values = figure.querySelector("script[type='application/json']");
  if (values) plots.push(new Plot(figure, JSON.parse(values.textContent)));
}
document.querySelectorAll("table").forEach(sortable);
const footer = document.querySelector("footer");
footer.prepend(html("p", { id: "help" }, HELP));
footer.append(voice);

const themes = ["auto", "light", "dark"], root = document.documentElement;
const theme = html("button", { type: "button", className: "theme", onclick() {
  root.dataset.theme = themes[(themes.indexOf(root.dataset.theme ?? "auto") + 1) % 3];
  theme.textContent = `Theme: ${root.dataset.theme}`;
} }, "Theme: auto");
document.querySelector("header").append(theme);

let opened = [];
addEventListener("beforeprint", () => {
  opened = [...document.querySelectorAll("details:not([open])")];
  for (const d of opened) d.open = true;
  for (const p of plots) p.hide(true);
});
addEventListener("afterprint", () => { for (const d of opened) d.open = false; });
