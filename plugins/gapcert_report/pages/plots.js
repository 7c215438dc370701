"use strict";
// Makes the pictures of a report answer: values at the pointer, zoom, series on and off. Without it, and in print, the page is
// complete; it adds nothing to the answer.
const plots = [];

const html = (tag, set, ...inside) => {
  const e = Object.assign(document.createElement(tag), set);
  e.append(...inside);
  return e;
};
const draw = (tag, set) => {
  const e = document.createElementNS(document.querySelector("svg").namespaceURI, tag);
  for (const k in set) e.setAttribute(k, set[k]);
  return e;
};
const button = (text, label, act) => {
  const b = html("button", { type: "button", title: label, onclick: act }, text);
  b.setAttribute("aria-label", label);
  return b;
};
const clamp = (v, low, high) => Math.min(Math.max(v, low), high);

// A reader of the screen hears of a cursor when it comes to rest.
const voice = html("p", { className: "unseen" });
voice.setAttribute("role", "status");
let speaking;
const say = text => {
  clearTimeout(speaking);
  speaking = setTimeout(() => { voice.textContent = text; }, 300);
};

const power = n => "10" + String(n).replace(/./g, c => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"[c === "-" ? 0 : +c + 1]);
const number = v => {
  if (!Number.isFinite(v)) return "–";
  const e = v ? Math.floor(Math.log10(Math.abs(v))) : 0;
  if (e >= -3 && e < 6) return String(+v.toPrecision(Math.max(4, e + 1))).replace("-", "−");
  return `${+(v / 10 ** e).toPrecision(4)} × ${power(e)}`.replace("-", "−");
};
const measured = (text, unit) => unit ? text + (unit.startsWith("10") ? " × " : " ") + unit : text;
const unpack = p => {
  if (p.n !== undefined) return Float64Array.from({ length: p.n }, (_, i) => p.first + i * p.step);
  if (p.runs) return p.runs.flatMap(([v, n]) => Array(n).fill(v ?? NaN));
  const bytes = Uint8Array.from(atob(p.f32), c => c.charCodeAt(0));
  return Float64Array.from(new Float32Array(bytes.buffer), v => v + p.offset);
};
const nearest = (xs, x) => {
  let best = -1;
  for (let i = 0, least = Infinity; i < xs.length; i++) {
    const d = Math.abs(xs[i] - x);
    if (d < least) [least, best] = [d, i];
  }
  return best;
};

class Plot {
  constructor(figure, data) {
    Object.assign(this, { figure, data, off: new Set(), pointers: new Map() });
    this.holder = figure.querySelector(".plot");
    this.picture = this.holder.querySelector("svg");
    [this.left, this.top, this.right, this.bottom] = data.box;
    const ends = a => a.limits.map(v => a.log ? Math.log10(v) : v);
    this.full = { x: ends(data.x), y: ends(data.y) };
    this.view = { x: [...this.full.x], y: [...this.full.y] };
    this.plane = data.series.some(s => s.kind === "map" || s.kind === "path");
    this.cursor = draw("g", { class: "cursor" });
    this.picture.append(this.cursor);
    this.tip = html("div", { className: "tip", hidden: true });
    this.holder.append(this.tip);
    this.holder.tabIndex = 0;
    const named = { role: "application", "aria-roledescription": "plot", "aria-label": data.title, "aria-describedby": "help" };
    for (const k in named) this.holder.setAttribute(k, named[k]);
    this.legend();
    this.tools();
    this.listen();
  }

  // Arrays are unpacked when they are first asked for: a page opens faster.
  get series() {
    this.unpacked ??= this.data.series.map(s => ({ ...s, parts: s.parts.map(p =>
      Object.fromEntries(Object.entries(p).map(([k, v]) => [k, v.n ?? v.f32 ?? v.runs ? unpack(v) : v]))) }));
    return this.unpacked;
  }

  legend() {
    for (const item of this.figure.querySelectorAll(".legend li")) {
      const i = this.data.series.findIndex(s => s.name === item.textContent);
      if (i < 0 || this.data.series.length < 2) continue;
      const b = html("button", { type: "button" }, ...item.childNodes);
      b.setAttribute("aria-pressed", "true");
      b.onclick = () => {
        const hide = !this.off.delete(i);
        if (hide) this.off.add(i);
        b.setAttribute("aria-pressed", String(!hide));
        for (const e of this.picture.querySelectorAll(`[data-s="s${i}"]`)) e.classList.toggle("off", hide);
        if (this.at) this.show(this.at);
      };
      item.append(b);
    }
  }

  tools() {
    const box = html("div", { className: "tools" }, button("−", "Zoom out", () => this.zoom(1 / 1.5)),
      button("+", "Zoom in", () => this.zoom(1.5)), button("0", "Show all", () => this.reset()),
      button("Copy", "Copy the values that were read last", () => this.copy()),
      button("CSV", "Save the values of this picture as CSV", () => this.save()));
    box.setAttribute("role", "group");
    box.setAttribute("aria-label", `${this.data.title}: tools`);
    this.figure.append(box);
  }

  // From data to points of the SVG, and from a pointer to data.
  share(key, v) {
    const [a, b] = this.view[key];
    return ((this.data[key].log ? Math.log10(v) : v) - a) / (b - a);
  }
  px(key, v) {
    const t = this.share(key, v);
    return key === "x" ? this.left + t * (this.right - this.left) : this.bottom - t * (this.bottom - this.top);
  }
  place(e) {
    const r = this.picture.getBoundingClientRect(), s = this.picture.viewBox.baseVal.width / r.width;
    return [((e.clientX - r.left) * s - this.left) / (this.right - this.left),
      (this.bottom - (e.clientY - r.top) * s) / (this.bottom - this.top)];
  }
  value(key, share) {
    const [a, b] = this.view[key], v = a + share * (b - a);
    return this.data[key].log ? 10 ** v : v;
  }

  // The samples that a cursor stops at: those of the densest series in sight.
  stops() {
    const parts = this.series.filter((s, i) => !this.off.has(i) && "line band dots".includes(s.kind)).flatMap(s => s.parts);
    return parts.reduce((most, p) => p.x.length > most.length ? p.x : most, []);
  }
  cell(at) {
    const map = this.series.find(s => s.kind === "map");
    if (!map) return null;
    const p = map.parts[0], index = (v, [a, b], n) => Math.floor((v - a) / (b - a) * n);
    const i = index(at.x, p.x, p.columns), j = index(at.y, p.y, p.rows);
    if (i < 0 || j < 0 || i >= p.columns || j >= p.rows) return null;
    const centre = (k, [a, b], n) => a + (k + 0.5) / n * (b - a);
    return { map, p, v: p.values[j * p.columns + i], x: centre(i, p.x, p.columns), y: centre(j, p.y, p.rows) };
  }
  snap(at) {
    if (this.plane) return this.cell(at) ?? at;
    const xs = this.stops(), i = nearest(xs, at.x);
    return i < 0 ? at : { x: xs[i], y: at.y };
  }

  // [name, text, y of dots] of every series in sight at a place.
  read(at) {
    const { unit } = this.data.y, wide = Math.abs(this.value("x", 1) - this.value("x", 0)), out = [];
    const tell = (...v) => measured(
      v.length === 2 && v[0] === -v[1] ? `± ${number(Math.abs(v[1]))}` : v.map(number).join(" … "), unit);
    this.series.forEach((s, k) => {
      if (this.off.has(k)) return;
      if (s.kind === "map") {
        const c = this.cell(at), [what, u] = s.name.replace("]", "").split(" [");
        if (c) out.push([what, c.p.names ? c.p.names[c.v] ?? "none" : measured(number(c.v), u), []]);
      } else if (s.kind === "path") {
        const p = this.closest(s, at);
        if (p) out.push([s.name, `${number(p.x)}, ${number(p.y)}`, []]);
      } else if (s.kind === "level") {
        out.push([s.name, tell(...s.parts.map(p => p.y[0])), []]);
      } else {
        const near = s.parts.map(p => [p, nearest(p.x, at.x)])
          .filter(([p, i]) => i >= 0 && Math.abs(p.x[i] - at.x) <= (s.kind === "dots" ? 0.01 : 0.005) * wide + 1e-12);
        if (!near.length) return;
        const [p, i] = near.at(-1);
        if (s.kind === "band") out.push([s.name, tell(p.low[i], p.high[i]), []]);
        else {
          const y = near.map(([q, j]) => q.y[j]).filter(Number.isFinite);
          const many = y.length > 1 ? `${tell(Math.min(...y), Math.max(...y))} (${y.length})` : tell(...y);
          if (y.length) out.push([s.name, p.low ? `${many} (${tell(p.low[i], p.high[i])})` : many, y]);
        }
      }
    });
    return out;
  }
  closest(s, at) {
    let best = null, least = 12;
    for (const p of s.parts) for (let i = 0; i < p.x.length; i++) {
      const d = Math.hypot(this.px("x", p.x[i]) - this.px("x", at.x), this.px("y", p.y[i]) - this.px("y", at.y));
      if (d < least) [least, best] = [d, { x: p.x[i], y: p.y[i] }];
    }
    return best;
  }

  show(place, alone) {
    const at = this.snap(place), x = this.px("x", at.x), y = this.px("y", at.y);
    // A linked picture that does not reach so far has nothing to tell.
    if (alone && Math.abs(this.px("x", place.x) - x) > 5) return this.hide(true);
    this.at = at;
    if (!alone && this.data.link) for (const p of plots) if (p !== this && p.data.link === this.data.link) p.show(place, true);
    this.cursor.replaceChildren();
    if (!(x >= this.left - 0.5 && x <= this.right + 0.5)) return void (this.tip.hidden = true);
    const lines = this.read(at), across = this.plane && y >= this.top && y <= this.bottom;
    const level = across ? `M${this.left} ${y}H${this.right}` : "";
    this.cursor.append(draw("path", { d: `M${x} ${this.top}V${this.bottom}${level}` }));
    for (const v of lines.flatMap(l => l[2])) {
      const cy = this.px("y", v);
      if (cy >= this.top && cy <= this.bottom) this.cursor.append(draw("circle", { cx: x, cy, r: 2.4 }));
    }
    const where = [["x", at.x], ...(this.plane ? [["y", at.y]] : [])]
      .map(([k, v]) => `${this.data[k].name} ${measured(number(v), this.data[k].unit)}`).join(", ");
    this.tip.replaceChildren(html("b", {}, where), ...lines.map(([name, text]) => html("span", {}, `${name}: ${text}`)));
    this.tip.hidden = false;
    this.tip.classList.toggle("flip", x > (this.left + this.right) / 2);
    this.told = [where, ...lines.map(([name, text]) => `${name}: ${text}`)].join("\n");
  }
  hide(alone) {
    this.at = null;
    this.cursor.replaceChildren();
    this.tip.hidden = true;
    if (!alone && this.data.link) for (const p of plots) if (p !== this && p.data.link === this.data.link) p.hide(true);
  }

  zoom(factor, about = []) {
    ["x", "y"].forEach((key, k) => {
      const [a, b] = this.view[key], [low, high] = this.full[key];
      const s = clamp(about[k] ?? (this.at && (this.plane || key === "x") ? this.share(key, this.at[key]) : 0.5), 0, 1);
      const wide = clamp((b - a) / factor, (high - low) / 50, high - low), start = clamp(a + s * (b - a - wide), low, high - wide);
      this.view[key] = [start, start + wide];
    });
    this.apply();
  }
  pan(dx, dy) {
    for (const [key, d] of [["x", dx], ["y", dy]]) {
      const [a, b] = this.view[key], [low, high] = this.full[key];
      const move = clamp(d * (b - a), low - a, high - b);
      this.view[key] = [a + move, b + move];
    }
    this.apply();
  }
  reset() {
    this.view = { x: [...this.full.x], y: [...this.full.y] };
    this.apply();
  }
  get zoomed() { return this.view.x[1] - this.view.x[0] < 0.999 * (this.full.x[1] - this.full.x[0]); }

  apply() {
    this.moved ??= this.take();
    const grow = key => (this.full[key][1] - this.full[key][0]) / (this.view[key][1] - this.view[key][0]);
    const first = key => this.data[key].log ? 10 ** this.full[key][0] : this.full[key][0];
    const kx = grow("x"), tx = this.px("x", first("x")) - kx * this.left;
    const ky = grow("y"), ty = this.px("y", first("y")) - ky * this.bottom;
    for (const g of this.moved) {
      const text = g.querySelector("text");
      if (text) {
        const x = +text.getAttribute("x"), y = +text.getAttribute("y");
        g.setAttribute("transform", `translate(${kx * x + tx - x} ${ky * y + ty - y})`);
        continue;
      }
      g.setAttribute("transform", `matrix(${kx} 0 0 ${ky} ${tx} ${ty})`);
      // Markers keep their size; what is placed at 0 is an area of the data.
      for (const u of g.querySelectorAll("use")) {
        const x = u.getAttribute("x"), y = u.getAttribute("y");
        if (x !== "0") u.setAttribute("transform", `translate(${x} ${y}) scale(${1 / kx} ${1 / ky}) translate(${-x} ${-y})`);
      }
    }
    this.holder.classList.toggle("zoomed", this.zoomed);
    this.ticks();
    if (this.at) this.show(this.at);
  }
  take() {
    const id = `clip${plots.indexOf(this)}`, clip = draw("clipPath", { id });
    clip.append(draw("rect", { x: this.left, y: this.top, width: this.right - this.left, height: this.bottom - this.top }));
    this.scale = draw("g", { class: "scale" });
    this.picture.append(clip, this.scale);
    return [...this.picture.querySelectorAll(".axes [data-s]")].map(g => {
      const inner = draw("g", {});
      inner.append(...g.childNodes);
      for (const e of inner.querySelectorAll("[clip-path]")) e.removeAttribute("clip-path");
      g.setAttribute("clip-path", `url(#${id})`);
      g.append(inner);
      return inner;
    });
  }
  ticks() {
    this.scale.replaceChildren();
    if (!this.zoomed) return;
    for (const key of ["x", "y"]) for (const [v, text] of this.marks(key)) {
      const p = this.px(key, v), flat = key === "x";
      const t = draw("text", flat ? { x: p, y: this.bottom + 14, "text-anchor": "middle" }
        : { x: this.left - 7, y: p + 3.4, "text-anchor": "end" });
      t.textContent = text.replace("-", "−");
      this.scale.append(draw("path", { d: flat ? `M${p} ${this.bottom}v3.5` : `M${this.left} ${p}h-3.5` }), t);
    }
  }
  marks(key) {
    const { log } = this.data[key], [low, high] = this.view[key], out = [];
    if (log && high - low > 1.5) {
      for (let n = Math.ceil(low); n <= high; n++) out.push([10 ** n, power(n)]);
      return out;
    }
    const [a, b] = log ? [10 ** low, 10 ** high] : [low, high], rough = (b - a) / 4.5, e = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].find(m => m * e >= rough) * e, digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    for (let i = Math.ceil(a / step - 1e-9); i * step <= b + 1e-9 * step; i++) {
      out.push([i * step, digits > 6 ? number(i * step) : (i * step).toFixed(digits)]);
    }
    return out;
  }

  listen() {
    const on = (name, act, how) => this.holder.addEventListener(name, act, how);
    const at = e => {
      const [x, y] = this.place(e).map(v => clamp(v, 0, 1));
      return { x: this.value("x", x), y: this.value("y", y) };
    };
    on("pointerdown", e => {
      if (e.button) return;
      this.pointers.set(e.pointerId, e);
      if (this.zoomed || this.pointers.size > 1) this.holder.setPointerCapture(e.pointerId);
      if (e.pointerType !== "mouse") this.show(at(e));
    });
    on("pointermove", e => {
      const before = this.pointers.get(e.pointerId);
      if (!before) return e.pointerType === "mouse" ? this.show(at(e)) : undefined;
      this.pointers.set(e.pointerId, e);
      const [x, y] = this.place(e), [x0, y0] = this.place(before);
      const other = [...this.pointers.values()].find(p => p.pointerId !== e.pointerId);
      if (other) {
        const apart = p => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY), [ox, oy] = this.place(other);
        this.zoom(apart(e) / Math.max(1, apart(before)), [(x + ox) / 2, (y + oy) / 2]);
      } else if (this.zoomed) this.pan(x0 - x, y0 - y);
      else this.show(at(e));
    });
    for (const name of ["pointerup", "pointercancel"]) on(name, e => this.pointers.delete(e.pointerId));
    on("pointerleave", e => { if (e.pointerType === "mouse" && !this.pointers.size) this.hide(); });
    on("dblclick", () => this.reset());
    // A wheel scrolls the page, unless it is meant for the picture.
    on("wheel", e => {
      if (!e.ctrlKey && !e.metaKey && document.activeElement !== this.holder) return;
      e.preventDefault();
      this.zoom(Math.exp(-clamp(e.deltaY, -100, 100) / 250), this.place(e));
    }, { passive: false });
    on("keydown", e => this.key(e));
    on("blur", () => this.hide());
  }
  key(e) {
    const closer = () => this.zoom(1.5), farther = () => this.zoom(1 / 1.5);
    const act = { "+": closer, "=": closer, "-": farther, 0: () => this.reset(), Escape: () => this.hide() }[e.key];
    const go = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
    if (e.ctrlKey || e.metaKey || e.altKey || !(act || go && (this.plane || !go[1]))) return;
    e.preventDefault();
    if (act) return act();
    const many = e.shiftKey ? 10 : 1;
    this.show(this.at ? this.step(go[0] * many, go[1] * many) : { x: this.value("x", 0.5), y: this.value("y", 0.5) });
    for (const k of ["x", "y"]) {
      const v = this.data[k].log ? Math.log10(this.at[k]) : this.at[k], [a, b] = this.view[k];
      const over = v < a ? (v - a) / (b - a) - 0.1 : v > b ? (v - b) / (b - a) + 0.1 : 0;
      if (over && this.zoomed && (this.plane || k === "x")) this.pan(k === "x" ? over : 0, k === "y" ? over : 0);
    }
    if (!this.tip.hidden) say(this.told.replaceAll("\n", "; "));
  }
  step(dx, dy) {
    if (!this.plane) {
      const xs = [...this.stops()].filter(Number.isFinite).sort((a, b) => a - b);
      return xs.length ? { x: xs[clamp(nearest(xs, this.at.x) + dx, 0, xs.length - 1)], y: this.at.y } : this.at;
    }
    const c = this.cell(this.at), [ends, parts] = c ? [c.p, null] : [this.full, 60];
    const wide = (k, n) => Math.abs(ends[k][1] - ends[k][0]) / (parts ?? n);
    const move = (k, d, n) => clamp(this.at[k] + d * wide(k, n), ...(c ? this.inside(c.p[k], n) : this.full[k]));
    return { x: move("x", dx, c?.p.columns), y: move("y", dy, c?.p.rows) };
  }
  inside([a, b], n) { return [a + (b - a) / n / 2, b - (b - a) / n / 2]; }

  async copy() {
    if (!this.told) return say("Nothing was read yet");
    try {
      await navigator.clipboard.writeText(this.told);
    } catch {
      const area = html("textarea", { value: this.told });
      document.body.append(area);
      area.select();
      document.execCommand("copy");
      area.remove();
    }
    say("Copied");
  }
  table() {
    const label = a => a.unit ? `${a.name} [${a.unit}]` : a.name, columns = [], { x, y } = this.data;
    for (const s of this.series) for (const p of s.parts) {
      if (s.kind === "level") columns.push([s.name, p.y]);
      else if (s.kind === "map") {
        const middle = ([a, b], n, i) => a + (i + 0.5) / n * (b - a), all = [...p.values];
        columns.push([label(x), all.map((_, i) => middle(p.x, p.columns, i % p.columns))],
          [label(y), all.map((_, i) => middle(p.y, p.rows, Math.floor(i / p.columns)))],
          [p.names ? "class" : s.name, p.names ? all.map(v => p.names[v] ?? "") : all]);
      } else {
        const unit = y.unit && ` [${y.unit}]`, same = columns.findLast(c => c[0] === label(x));
        if (!same || same[1].length !== p.x.length || same[1].some((v, i) => v !== p.x[i])) columns.push([label(x), p.x]);
        if (p.y) columns.push([s.name + unit, p.y]);
        if (p.low) columns.push([`${s.name}, low${unit}`, p.low], [`${s.name}, high${unit}`, p.high]);
      }
    }
    return columns;
  }
  save() {
    const columns = this.table(), rows = Math.max(...columns.map(c => c[1].length));
    const cell = v => typeof v === "string" ? `"${v.replaceAll('"', '""')}"` : Number.isFinite(v) ? +v.toPrecision(7) : "";
    const lines = [columns.map(c => cell(c[0])), ...Array.from({ length: rows }, (_, i) => columns.map(c => cell(c[1][i])))];
    const url = URL.createObjectURL(new Blob([lines.map(l => l.join(",")).join("\r\n") + "\r\n"], { type: "text/csv" }));
    html("a", { href: url, download: `${this.data.title.replace(/[^\p{L}\p{N}]+/gu, "_")}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  }
}
