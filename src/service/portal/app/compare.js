// Two jobs side by side: angles and their differences, areas along the branches, both surfaces over one another.
import { QUANTITIES, curvesOf } from "./along.js";
import { card, field, h, select, table } from "./dom.js";
import { filePath, json, lasting } from "./net.js";
import { plot } from "./plot.js";
import { mainJunction } from "./result.js";
import { setQuery } from "./router.js";
import { pane, surfaceOf, viewButtons } from "./scene.js";
import { angleName, countRoles, number, roleName, signed, t, when } from "./text.js";

export async function showCompare(box, { query, signal }) {
  const list = (await json("/v1/jobs?state=succeeded&limit=200", { signal })).items;
  box.append(h("h1", {}, t("title.compare")));
  if (list.length === 0) return box.append(h("p", { class: "empty" }, t("compare.none")));
  const chosen = { a: query.get("a") ?? list[0].id, b: query.get("b") ?? "" };
  const body = h("div", { class: "stack" });
  const options = [["", t("compare.choose")], ...list.map((job) => [job.id, `${job.id.slice(-8)} · ${when(job.created_at)}`])];
  let drawing = new AbortController();
  const draw = () => {
    setQuery(chosen);
    drawing.abort();
    drawing = new AbortController();
    signal.addEventListener("abort", () => drawing.abort(), { once: true });
    return both(body, chosen, drawing.signal);
  };
  const pick = (side) => field(t(`compare.${side}`), select(options, chosen[side], (id) => { chosen[side] = id; draw().catch((e) => window.dispatchEvent(new CustomEvent("fault", { detail: e }))); }, { class: `side-${side}` }));
  box.append(card(null, h("div", { class: "filters" }, pick("a"), pick("b"))), body);
  await draw();
}

async function both(body, { a, b }, signal) {
  if (!a || !b) return body.replaceChildren(h("p", { class: "empty" }, t("compare.two")));
  body.replaceChildren(h("p", { class: "busy", role: "status" }, t("result.reading")));
  const [first, second] = await Promise.all([a, b].map((id) => lasting(filePath(id, "result.json"))));
  if (signal.aborted) return;
  countRoles(first);
  const three = pane(t("compare.overlay"), [{ bytes: surfaceOf(a, signal), kind: "side-a" }, { bytes: surfaceOf(b, signal), kind: "side-b" }], { found: first, junction: mainJunction(first), signal });
  three.tools.append(viewButtons(three.viewer, mainJunction(first)), h("span", { class: "key side-a" }, t("compare.a")), h("span", { class: "key side-b" }, t("compare.b")));
  body.replaceChildren(...[
    h("div", { class: "compare-top" }, three.element, h("div", { class: "stack" }, angles(first, second), branches(first, second))),
    areas(first, second),
  ].filter(Boolean));
}

function angles(first, second) {
  const [ja, jb] = [mainJunction(first), mainJunction(second)];
  const names = [...new Set([...(ja?.angles ?? []), ...(jb?.angles ?? [])].map((x) => x.name))];
  const of = (j, name) => j?.angles?.find((x) => x.name === name);
  const apart = (x, y) => x?.band95 && y?.band95 && (x.band95[0] > y.band95[1] || y.band95[0] > x.band95[1]);
  const cell = (x) => (x?.value == null ? "–" : [number(x.value), "°", x.band95 ? [h("br"), h("small", { class: "soft" }, `${number(x.band95[0])} – ${number(x.band95[1])}`)] : null]);
  const rows = names.map((name) => {
    const [x, y] = [of(ja, name), of(jb, name)];
    const known = x?.value != null && y?.value != null;
    return [angleName(name), cell(x), cell(y), known ? h("strong", {}, `${signed(y.value - x.value)}°`) : "–", known && x.band95 && y.band95 ? t(apart(x, y) ? "compare.apart" : "compare.overlap") : "–"];
  });
  return card(t("angles.title"), table(t("angles.title"), [{ title: t("angles.angle") }, { title: t("compare.a"), number: true }, { title: t("compare.b"), number: true }, { title: t("compare.difference"), number: true }, { title: t("compare.bands") }], rows), h("p", { class: "soft" }, t("compare.note")));
}

// Branches of one role in both.
function pairs(first, second) {
  return first.branches.filter((b) => b.role !== "other").map((x) => [x, second.branches.find((y) => y.role === x.role)]).filter(([, y]) => y);
}

function branches(first, second) {
  const rows = pairs(first, second).flatMap(([x, y]) => [["diameter_mm", "branch.diameter", 2], ["length_mm", "branch.length", 1]].map(([key, title, digits]) =>
    [`${roleName(x)}, ${t(title)}`, number(x[key], digits), number(y[key], digits), h("strong", {}, signed(y[key] - x[key], digits))]));
  return rows.length > 0 ? card(t("branch.title"), table(t("branch.title"), [{ title: t("branch.branch") }, { title: t("compare.a"), number: true }, { title: t("compare.b"), number: true }, { title: t("compare.difference"), number: true }], rows)) : null;
}

function areas(first, second) {
  const figures = pairs(first, second).map(([x, y]) => {
    const side = (b, kind, dashed) => curvesOf([b], QUANTITIES[0], () => ({ name: t(`compare.${kind}`), kind: `side-${kind}`, dashed }))[0];
    const figure = plot([side(x, "a"), side(y, "b")], { x: t("along.distance"), y: t("along.area_unit"), title: roleName(x), zero: true }, { onCursor: () => {} });
    return figure ? h("div", {}, h("h3", {}, roleName(x)), ...figure.elements) : null;
  });
  return card(t("compare.areas"), h("div", { class: "figures" }, figures));
}
