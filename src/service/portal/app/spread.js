// Scatter and box plots of the cohort.
import { h, s } from "./dom.js";
import { axes, finite } from "./plot.js";
import { number, t } from "./text.js";

const padded = (values) => {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const room = Math.max((high - low) * 0.08, Math.abs(high) * 0.01, 1e-6);
  return [low - room, high + room];
};

// Quartiles by linear interpolation, the most used of the nine definitions (type 7).
export function quantile(sorted, part) {
  const at = part * (sorted.length - 1);
  const [low, high] = [sorted[Math.floor(at)], sorted[Math.ceil(at)]];
  return low + (high - low) * (at - Math.floor(at));
}

// Pearson's r; null where a spread is zero.
export function correlation(x, y) {
  const mean = (v) => v.reduce((a, b) => a + b, 0) / v.length;
  const [mx, my] = [mean(x), mean(y)];
  const sum = (f) => x.reduce((n, _, i) => n + f(i), 0);
  const [xy, xx, yy] = [sum((i) => (x[i] - mx) * (y[i] - my)), sum((i) => (x[i] - mx) ** 2), sum((i) => (y[i] - my) ** 2)];
  return xx > 0 && yy > 0 ? xy / Math.sqrt(xx * yy) : null;
}

export function scatter(rows, kx, ky, nameOf) {
  const good = rows.filter((row) => finite(row[kx]) && finite(row[ky]));
  if (good.length < 1) return null;
  const [x, y] = [kx, ky].map((key) => good.map((row) => row[key]));
  const { svg, px, py } = axes({ x: padded(x), y: padded(y), xLabel: nameOf(kx), yLabel: nameOf(ky), label: t("cohort.scatter_of", { x: nameOf(kx), y: nameOf(ky), n: good.length }) });
  for (const row of good) {
    svg.append(s("circle", { class: "point", cx: px(row[kx]), cy: py(row[ky]), r: 4 }, s("title", {}, `${row.id.slice(-8)}: ${number(row[kx], 2)}, ${number(row[ky], 2)}`)));
  }
  const r = good.length > 2 ? correlation(x, y) : null;
  return h("div", {}, svg, h("p", { class: "soft" }, `n = ${good.length}${r === null ? "" : `, r = ${number(r, 2)}`}`));
}

// Box from quartile to quartile, median, whiskers to the last value within 1.5 boxes, points beyond.
export function boxes(rows, keys, nameOf, unit) {
  const sets = keys.map((key) => ({ key, values: rows.map((row) => row[key]).filter(finite).sort((a, b) => a - b) })).filter((set) => set.values.length > 0);
  if (sets.length === 0) return null;
  const size = { width: 560, height: 46 + sets.length * 44, left: 190, right: 16, top: 8, bottom: 40 };
  const { svg, px } = axes({ x: padded(sets.flatMap((set) => set.values)), y: [0, sets.length], xLabel: unit, yLabel: "", label: t("cohort.boxes"), size });
  for (const old of [...svg.querySelectorAll(".grid, text[text-anchor=end]")]) old.remove();
  sets.forEach(({ key, values }, i) => {
    const y = size.top + 22 + i * 44;
    const [q1, q2, q3] = [0.25, 0.5, 0.75].map((part) => quantile(values, part));
    const inside = values.filter((v) => v >= q1 - 1.5 * (q3 - q1) && v <= q3 + 1.5 * (q3 - q1));
    const words = `${nameOf(key)}: ${number(q2)} (${number(q1)} – ${number(q3)})`;
    svg.append(s("g", { class: `boxed a${i % 6}` }, s("title", {}, words),
      s("line", { x1: px(inside[0]), x2: px(inside.at(-1)), y1: y, y2: y }),
      s("rect", { x: px(q1), y: y - 10, width: Math.max(1, px(q3) - px(q1)), height: 20 }),
      s("line", { class: "median", x1: px(q2), x2: px(q2), y1: y - 10, y2: y + 10 }),
      values.filter((v) => !inside.includes(v)).map((v) => s("circle", { cx: px(v), cy: y, r: 3 }))),
    label(nameOf(key), size.left - 10, y));
  });
  return svg;
}

// A name on two lines where it is long.
function label(name, x, y) {
  const cut = name.length > 24 ? name.lastIndexOf(" ", 24) : -1;
  const lines = cut > 0 ? [name.slice(0, cut), name.slice(cut + 1)] : [name];
  return s("text", { x, y: y + 4 - (lines.length - 1) * 7, "text-anchor": "end" }, lines.map((line, i) => s("tspan", { x, dy: i === 0 ? 0 : 14 }, line)));
}
