// Line plots as SVG, with bands, and a cursor for mouse and keys. Colours come from classes, so that they follow the theme
// and print; the page's policy allows no inline style.
import { h, s } from "./dom.js";
import { number } from "./text.js";

const SIZE = { width: 560, height: 260, left: 50, right: 14, top: 12, bottom: 42 };
export const finite = (v) => typeof v === "number" && Number.isFinite(v);

// A step of 1, 2 or 5 times a power of ten that cuts a span into about n parts.
function stepOf(span, n) {
  const raw = span / n;
  const power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((m) => m * power >= raw * (1 - 1e-9));
}

export function ticks(low, high, n) {
  if (!(high > low)) return [low];
  const step = stepOf(high - low, n);
  const out = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i += 1) out.push(i * step);
  return out;
}

const short = (x) => String(+x.toPrecision(6)).replace("-", "−");

function extent(values, pad) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const room = Math.max((high - low) * pad, Math.abs(high) * 1e-3, 1e-9);
  return pad > 0 ? [low - room, high + room] : [low, high];
}

// Axes of a figure: {svg, px, py}.
export function axes({ x, y, xLabel, yLabel, label, size = SIZE }) {
  const upright = ticks(y[0], y[1], 5);
  // Room for the numbers and the upright name.
  if (size === SIZE) size = { ...SIZE, left: 34 + 7.4 * Math.max(...upright.map((v) => short(v).length)) };
  const px = (v) => size.left + ((v - x[0]) / (x[1] - x[0] || 1)) * (size.width - size.left - size.right);
  const py = (v) => size.height - size.bottom - ((v - y[0]) / (y[1] - y[0] || 1)) * (size.height - size.top - size.bottom);
  const svg = s("svg", { class: "plot", viewBox: `0 0 ${size.width} ${size.height}`, role: "img", "aria-label": label ?? `${yLabel} / ${xLabel}` });
  for (const v of upright) {
    svg.append(s("line", { class: "grid", x1: size.left, x2: size.width - size.right, y1: py(v), y2: py(v) }),
      s("text", { x: size.left - 7, y: py(v) + 4, "text-anchor": "end" }, short(v)));
  }
  for (const v of ticks(x[0], x[1], 7)) svg.append(s("text", { x: px(v), y: size.height - size.bottom + 18, "text-anchor": "middle" }, short(v)));
  svg.append(s("line", { class: "axis", x1: size.left, x2: size.width - size.right, y1: size.height - size.bottom, y2: size.height - size.bottom }),
    s("text", { class: "name", x: (size.left + size.width - size.right) / 2, y: size.height - 6, "text-anchor": "middle" }, xLabel),
    s("text", { class: "name", x: 13, y: (size.height - size.bottom) / 2, "text-anchor": "middle", transform: `rotate(-90 13 ${(size.height - size.bottom) / 2})` }, yLabel));
  return { svg, px, py, size };
}

function pathOf(curve, px, py) {
  let path = "";
  let open = false;
  curve.x.forEach((x, k) => {
    const good = finite(x) && finite(curve.y[k]);
    if (good) path += `${open ? "L" : "M"}${px(x).toFixed(1)} ${py(curve.y[k]).toFixed(1)}`;
    open = good;
  });
  return path;
}

function bandOf({ x, low, high }, px, py) {
  const good = x.map((v, k) => k).filter((k) => finite(x[k]) && finite(low[k]) && finite(high[k]));
  const edge = (values, order) => order.map((k) => `${px(x[k]).toFixed(1)} ${py(values[k]).toFixed(1)}`).join("L");
  return good.length > 1 ? `M${edge(high, good)}L${edge(low, [...good].reverse())}Z` : "";
}

const swatch = (kind) => s("svg", { viewBox: "0 0 22 10", "aria-hidden": "true" }, s("line", { class: `curve ${kind}`, x1: 0, x2: 22, y1: 5, y2: 5 }));

// curves: [{name, kind, x, y, low?, high?, dashed?}], kind being a colour class; null values are gaps.
// labels: {x, y, title}; onCursor(x) follows the pointer; mark(x) of the answer moves the cursor from outside.
export function plot(curves, labels, { onCursor, digits = 1, spans = [] } = {}) {
  const shown = curves.filter((c) => c.x.some((x, i) => finite(x) && finite(c.y[i])));
  if (shown.length === 0) return null;
  const x = extent(shown.flatMap((c) => c.x.filter((v, k) => finite(v) && finite(c.y[k]))), 0);
  const y = extent(shown.flatMap((c) => [c.y, c.low ?? [], c.high ?? []].flat().filter(finite)), 0.06);
  if (labels.zero) y[0] = Math.min(0, y[0]);
  const { svg, px, py, size } = axes({ x, y, xLabel: labels.x, yLabel: labels.y, label: labels.title });
  for (const span of spans) svg.prepend(s("rect", { class: `span ${span.kind}`, x: px(Math.max(span.from, x[0])), y: size.top, width: Math.max(0, px(Math.min(span.to, x[1])) - px(Math.max(span.from, x[0]))), height: size.height - size.top - size.bottom }));
  for (const c of shown) if (c.low) svg.append(s("path", { class: `band ${c.kind}`, d: bandOf(c, px, py) }));
  for (const c of shown) svg.append(s("path", { class: `curve ${c.kind}${c.dashed ? " dashed" : ""}${c.dotted ? " dotted" : ""}`, d: pathOf(c, px, py) }));
  const line = s("line", { class: "cursor", y1: size.top, y2: size.height - size.bottom, visibility: "hidden" });
  svg.append(line);
  const values = shown.map(() => h("span", { class: "value" }));
  const at = h("span", { class: "soft" });
  const legend = h("ul", { class: "legend" }, shown.map((c, i) => c.name && h("li", {}, swatch(`${c.kind}${c.dashed ? " dashed" : ""}`), c.name, " ", values[i])), h("li", {}, at));
  const mark = (v) => {
    const on = finite(v) && v >= x[0] - 1e-9 && v <= x[1] + 1e-9;
    line.setAttribute("visibility", on ? "visible" : "hidden");
    if (on) for (const end of ["x1", "x2"]) line.setAttribute(end, px(v));
    values.forEach((value, i) => { value.textContent = on ? number(nearest(shown[i], v), digits) : ""; });
    at.textContent = on ? `${labels.x}: ${number(v, 1)}` : "";
  };
  if (onCursor) follow(svg, size, x, mark, onCursor, labels);
  return { elements: [svg, legend], mark };
}

// The value at the sample nearest to x.
function nearest(curve, x) {
  let best = -1;
  curve.x.forEach((v, k) => { if (finite(v) && (best < 0 || Math.abs(v - x) < Math.abs(curve.x[best] - x))) best = k; });
  return curve.y[best];
}

function follow(svg, size, [x0, x1], mark, onCursor, labels) {
  let at = (x0 + x1) / 2;
  const go = (v) => {
    at = Math.min(x1, Math.max(x0, v));
    mark(at);
    svg.setAttribute("aria-valuenow", at.toFixed(2));
    onCursor(at);
  };
  for (const [key, value] of Object.entries({ role: "slider", tabindex: "0", "aria-valuemin": x0.toFixed(2), "aria-valuemax": x1.toFixed(2), "aria-valuenow": at.toFixed(2), "aria-label": `${labels.title ?? labels.y}: ${labels.x}` })) svg.setAttribute(key, value);
  svg.addEventListener("pointermove", (e) => {
    const box = svg.getBoundingClientRect();
    const u = ((e.clientX - box.left) / box.width) * size.width;
    go(x0 + ((u - size.left) / (size.width - size.left - size.right)) * (x1 - x0));
  });
  svg.addEventListener("keydown", (e) => {
    const step = { ArrowLeft: -1, ArrowRight: 1, PageDown: -10, PageUp: 10 }[e.key];
    if (e.key === "Home") go(x0);
    else if (e.key === "End") go(x1);
    else if (step) go(at + (step * (x1 - x0)) / 100);
    else return;
    e.preventDefault();
  });
}
