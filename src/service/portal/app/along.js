// Area, radius and curvature along the branches, with a cursor that is the same point in 3D and on the slices.
import { card, field, h, select } from "./dom.js";
import { finite, plot } from "./plot.js";
import { roleName, t } from "./text.js";

export const roleKind = (branch) => `r-${["graft", "proximal", "distal", "host_a", "host_b"].includes(branch.role) ? branch.role : "other"}`;

const QUANTITIES = [
  { key: "area", of: (s) => s.area_mm2, error: (s) => s.area_error_mm2, digits: 1, zero: true },
  { key: "radius", of: (s) => s.radius_inscribed_mm, second: (s) => s.radius_area_mm, digits: 2, zero: true },
  { key: "curvature", of: (s) => s.curvature_per_mm, error: (s) => s.curvature_error_per_mm, digits: 4 },
];

export const nearestSample = (samples, abscissa) =>
  samples.abscissa_mm.reduce((best, x, i) => (Math.abs(x - abscissa) < Math.abs(samples.abscissa_mm[best] - abscissa) ? i : best), 0);

// 95 % of a standard error on both sides.
const edge = (y, error, side) => (error ? y.map((v, i) => (finite(v) && finite(error[i]) ? v + side * 1.96 * error[i] : null)) : undefined);

export function curvesOf(branches, quantity, dress = (b) => ({ name: roleName(b), kind: roleKind(b) })) {
  return branches.flatMap((b) => {
    const { abscissa_mm: x } = b.samples;
    const y = quantity.of(b.samples) ?? [];
    const error = quantity.error?.(b.samples);
    // Within the junction a section cuts more than one branch: that part is drawn apart, without a band.
    const within = b.samples.in_junction ?? [];
    const part = (values, inside) => values?.map((v, i) => (Boolean(within[i]) === inside ? v : null));
    const curves = [
      { ...dress(b), x, y: part(y, false), low: part(edge(y, error, -1), false), high: part(edge(y, error, 1), false) },
      { ...dress(b), name: "", x, y: part(y, true), dotted: true },
    ];
    if (quantity.second) curves.push({ ...dress(b), name: `${dress(b).name}, ${t("along.equal_area")}`, x, y: part(quantity.second(b.samples) ?? [], false), dashed: true });
    return curves;
  });
}

export { QUANTITIES };

// With more branches than this one is shown at a time: curves of one colour cannot be told apart.
const TOGETHER = 5;

export function along(found, focus) {
  const branches = found.branches.filter((b) => b.samples?.abscissa_mm?.length > 1);
  if (branches.length === 0) return null;
  const part = {};
  const state = { quantity: QUANTITIES[0], branch: branches[0], mark: () => {} };
  const box = h("div");
  const move = (abscissa) => {
    const { samples } = state.branch;
    focus.tell(part, { point: samples.position[nearestSample(samples, abscissa)], branch: state.branch.id });
  };
  const draw = () => {
    const q = state.quantity;
    const figure = plot(curvesOf(branches.length > TOGETHER ? [state.branch] : branches, q), { x: t("along.distance"), y: t(`along.${q.key}_unit`), title: t("along.title"), zero: q.zero }, { onCursor: move, digits: q.digits });
    box.replaceChildren(...(figure?.elements ?? [h("p", { class: "empty" }, t("along.none"))]));
    state.mark = figure?.mark ?? (() => {});
  };
  const follow = (id) => {
    state.branch = branches.find((b) => String(b.id) === String(id));
    if (branches.length > TOGETHER) draw();
  };
  // A point of the slices or the surface is the nearest sample of all branches.
  focus.join(part, ({ point }) => {
    if (!point) return;
    const far = (b, i) => Math.hypot(...b.samples.position[i].map((x, k) => x - point[k]));
    const best = branches.flatMap((b) => b.samples.position.map((_, i) => ({ b, i, d: far(b, i) }))).reduce((a, c) => (c.d < a.d ? c : a));
    if (best.b !== state.branch && branches.length > TOGETHER) {
      follow(best.b.id);
      list.value = String(best.b.id);
    }
    state.mark(best.b.samples.abscissa_mm[best.i]);
  });
  const choose = (name, items, pick, current) => h("div", { class: "choices", role: "radiogroup", "aria-label": t(`along.${name}`) },
    items.map(([key, text]) => h("label", { class: "choice" }, h("input", { type: "radio", name: `along-${name}`, checked: key === current, onchange: () => pick(key) }), text)));
  const list = select(branches.map((b) => [String(b.id), roleName(b)]), String(state.branch.id), follow);
  const cursor = branches.length > TOGETHER ? field(t("branch.branch"), list)
    : branches.length > 1 ? h("div", { class: "choices" }, h("span", { class: "soft" }, t("along.cursor")), choose("cursor", branches.map((b) => [b.id, roleName(b)]), follow, state.branch.id)) : null;
  draw();
  return card(t("along.title"),
    choose("quantity", QUANTITIES.map((q) => [q.key, t(`along.${q.key}`)]), (key) => { state.quantity = QUANTITIES.find((q) => q.key === key); draw(); }, state.quantity.key),
    box, cursor,
    h("p", { class: "soft" }, t("along.note")));
}
