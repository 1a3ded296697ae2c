// All results beside one another: table, filter by a range, scatter and box plots, CSV.
import { card, download, field, h, select, table } from "./dom.js";
import { cohort, csv, quantities } from "./cohort-data.js";
import { boxes, scatter } from "./spread.js";
import { finite } from "./plot.js";
import { setQuery } from "./router.js";
import { angleName, has, number, t, when } from "./text.js";

export function quantityName(key) {
  const [family, role] = [key.split(".")[0], key.split(".").slice(1).join(".")];
  if (family === "angle") return angleName(role);
  return role ? t(`cohort.${family}_of`, { role: has(`role.${role}`) ? t(`role.${role}`) : role }) : t(`cohort.${family}`);
}

const KINDS = ["", "reconstruction", "variant"];

export async function showCohort(box, { query, signal }) {
  const asked = Object.fromEntries(["from", "to", "kind"].map((key) => [key, query.get(key) ?? ""]));
  const body = h("div", { class: "stack" });
  const status = h("p", { class: "soft", role: "status" });
  const read = async () => {
    setQuery(asked);
    status.textContent = t("cohort.reading");
    const rows = await cohort({ created_after: midnight(asked.from, 0), created_before: midnight(asked.to, 1), job_kind: asked.kind }, signal);
    if (signal.aborted) return;
    status.textContent = t("cohort.count", { n: rows.length });
    if (rows.length === 0) return body.replaceChildren(h("p", { class: "empty" }, t("cohort.none")));
    const keys = quantities(rows);
    const angles = keys.filter((key) => key.startsWith("angle."));
    const view = { rows, keys, x: angles[0] ?? keys[0], y: angles[1] ?? keys[1] ?? keys[0], by: angles[0] ?? keys[0], low: "", high: "" };
    build(body, view);
    view.draw();
  };
  const again = (key, value) => { asked[key] = value; read().catch((e) => window.dispatchEvent(new CustomEvent("fault", { detail: e }))); };
  const day = (key) => field(t(`cohort.${key}`), h("input", { type: "date", value: asked[key], onchange: (e) => again(key, e.target.value) }));
  const kind = field(t("cohort.kind"), select(KINDS.map((key) => [key, t(`cohort.kind_${key || "all"}`)]), asked.kind, (value) => again("kind", value)));
  box.append(h("h1", {}, t("title.cohort")), card(t("cohort.jobs"), h("div", { class: "filters" }, day("from"), day("to"), kind), status), body);
  await read();
}

// The beginning of a day, or of a later one, where the reader is.
function midnight(day, later) {
  if (!day) return "";
  const [year, month, date] = day.split("-").map(Number);
  return new Date(year, month - 1, date + later).toISOString();
}

function build(body, view) {
  const options = view.keys.map((key) => [key, quantityName(key)]);
  const pick = (name) => field(t(`cohort.${name}`), select(options, view[name], (key) => { view[name] = key; view.draw(); }));
  const bound = (name) => {
    const input = h("input", { type: "number", step: "any", value: view[name], oninput: () => { view[name] = input.value; view.draw(); } });
    return field(t(`cohort.${name}`), input);
  };
  const [dots, spread, list] = [h("div"), h("div"), h("div")];
  const count = h("p", { class: "soft", role: "status" });
  const shown = () => view.rows.filter((row) => {
    const v = row[view.by];
    return (view.low === "" || (finite(v) && v >= Number(view.low))) && (view.high === "" || (finite(v) && v <= Number(view.high)));
  });
  const save = h("button", { type: "button", onclick: () => download("cohort.csv", csv(shown(), view.keys), "text/csv") }, t("cohort.csv"));
  view.draw = () => {
    const rows = shown();
    count.textContent = t("cohort.shown", { n: rows.length, of: view.rows.length });
    dots.replaceChildren(scatter(rows, view.x, view.y, quantityName) ?? h("p", { class: "empty" }, t("cohort.too_few")));
    const angles = view.keys.filter((key) => key.startsWith("angle."));
    spread.replaceChildren(boxes(rows, angles, quantityName, t("cohort.degrees")) ?? h("p", { class: "empty" }, t("cohort.too_few")));
    list.replaceChildren(tableOf(rows, view.keys));
  };
  body.replaceChildren(
    card(t("cohort.filter"), h("div", { class: "filters" }, pick("by"), bound("low"), bound("high"), save), count),
    h("div", { class: "cohort-plots" },
      card(t("cohort.scatter"), h("div", { class: "filters" }, pick("x"), pick("y")), dots),
      card(t("cohort.boxes"), spread)),
    card(t("cohort.table"), list));
}

function tableOf(rows, keys) {
  const few = keys.filter((key) => /^(angle|diameter)\./.test(key) || ["slices", "warnings"].includes(key));
  const columns = [{ title: t("queue.job") }, { title: t("queue.sent") }, ...few.map((key) => ({ title: quantityName(key), number: true }))];
  return table(t("cohort.table"), columns, rows.slice(0, 500).map((row) => [
    h("a", { href: `#/jobs/${row.id}` }, row.id.slice(-8)), when(row.at),
    ...few.map((key) => number(row[key], /slices|warnings/.test(key) ? 0 : key.startsWith("diameter") ? 2 : 1))]), { class: "cohort" });
}
