// Angle against fitting distance as SVG. Colours come from classes: the page's policy allows no inline style.

const SVG = "http://www.w3.org/2000/svg";
const SIZE = { width: 520, height: 300, left: 44, right: 12, top: 12, bottom: 40 };

function s(name, attributes = {}, text) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

// A step of 1, 2 or 5 times a power of ten that cuts a span into about n parts.
function stepOf(span, n) {
  const raw = span / n;
  const power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((m) => m * power >= raw);
}

function ticks(low, high, n) {
  const step = stepOf(high - low, n);
  const out = [];
  for (let i = Math.ceil(low / step); i * step <= high + step * 1e-9; i += 1) out.push(i * step);
  return out;
}

// curves: [{name, x: [], y: []}]; null values make gaps. Returns the figure's elements, or null without a point.
export function plot(curves, labels) {
  const finite = (v) => typeof v === "number" && Number.isFinite(v);
  const shown = curves.filter((c) => c.x.some((x, i) => finite(x) && finite(c.y[i])));
  if (shown.length === 0) return null;
  const xs = shown.flatMap((c) => c.x.filter(finite));
  const ys = shown.flatMap((c) => c.y.filter(finite));
  const [x0, x1] = [Math.min(...xs), Math.max(...xs)];
  const pad = Math.max((Math.max(...ys) - Math.min(...ys)) * 0.08, 0.5);
  const [y0, y1] = [Math.min(...ys) - pad, Math.max(...ys) + pad];
  const px = (x) => SIZE.left + ((x - x0) / (x1 - x0 || 1)) * (SIZE.width - SIZE.left - SIZE.right);
  const py = (y) => SIZE.height - SIZE.bottom - ((y - y0) / (y1 - y0)) * (SIZE.height - SIZE.top - SIZE.bottom);
  const svg = s("svg", { class: "plot", viewBox: `0 0 ${SIZE.width} ${SIZE.height}`, role: "img", "aria-label": `${labels.y} against ${labels.x}` });
  for (const y of ticks(y0, y1, 5)) {
    svg.append(s("line", { class: "axis", x1: SIZE.left, x2: SIZE.width - SIZE.right, y1: py(y), y2: py(y) }));
    svg.append(s("text", { x: SIZE.left - 6, y: py(y) + 4, "text-anchor": "end" }, String(+y.toPrecision(6))));
  }
  for (const x of x1 > x0 ? ticks(x0, x1, 6) : [x0]) {
    svg.append(s("text", { x: px(x), y: SIZE.height - SIZE.bottom + 16, "text-anchor": "middle" }, String(+x.toPrecision(6))));
  }
  svg.append(s("text", { x: SIZE.width / 2, y: SIZE.height - 6, "text-anchor": "middle" }, labels.x));
  svg.append(s("text", { x: 12, y: SIZE.height / 2, "text-anchor": "middle", transform: `rotate(-90 12 ${SIZE.height / 2})` }, labels.y));
  const legend = document.createElement("ul");
  legend.className = "legend";
  shown.forEach((curve, i) => {
    let path = "";
    let open = false;
    curve.x.forEach((x, k) => {
      const good = finite(x) && finite(curve.y[k]);
      if (good) path += `${open ? "L" : "M"}${px(x).toFixed(1)} ${py(curve.y[k]).toFixed(1)}`;
      open = good;
    });
    svg.append(s("path", { class: `curve s${i % 5}`, d: path }));
    const item = document.createElement("li");
    const mark = s("svg", { viewBox: "0 0 22 10", "aria-hidden": "true" });
    mark.append(s("line", { class: `s${i % 5}`, x1: 0, x2: 22, y1: 5, y2: 5 }));
    item.append(mark, curve.name);
    legend.append(item);
  });
  return [svg, legend];
}
