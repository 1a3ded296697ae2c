// The rows of the cohort: one per finished job, from the service's table. The one place that knows its shape.
import { json } from "./net.js";

const QUANTITIES = "deg,diameter_mm,length_mm,stenosis_area_ratio";
const KEYS = { diameter_mm: "diameter", length_mm: "length", stenosis_area_ratio: "stenosis" };

// What a row of the service's table is called here, or null where it is not shown: of several junctions the main one's
// angles count, as in the report.
function keyOf(line, main) {
  if (line.kind === "angle") return line.id === main ? `angle.${line.name}` : null;
  return line.name === "other" ? null : `${KEYS[line.quantity]}.${line.name}`;
}

// asked: {created_after?, created_before?, job_kind?}. Newest first.
export async function cohort(asked, signal) {
  const query = new URLSearchParams({ quantity: QUANTITIES });
  for (const [key, value] of Object.entries(asked)) if (value) query.set(key, value);
  const found = await json(`/v1/cohort?${query}`, { signal });
  const rows = new Map(found.results.map((r) => [r.job, { id: r.job, at: r.created_at, slices: r.slices, spacing: r.slice_spacing_mm, warnings: r.warnings, volume: r.volume_mm3 }]));
  const main = new Map(found.results.map((r) => [r.job, r.main_junction]));
  for (const line of found.rows) {
    const key = keyOf(line, main.get(line.job));
    if (key) rows.get(line.job)[key] ??= line.quantity === "stenosis_area_ratio" && line.value !== null ? 100 * (1 - line.value) : line.value;
  }
  return [...rows.values()];
}

// The paper's angles come first, in its order.
const ORDER = ["graft_proximal", "graft_distal_planar", "distal_normal", "proximal_distal", "graft_distal"].map((name) => `angle.${name}`);
const rank = (key) => (ORDER.includes(key) ? ORDER.indexOf(key) : ORDER.length + (key.startsWith("angle.") ? 0 : 1));

// Keys of values that some row has.
export const quantities = (rows) => [...new Set(rows.flatMap((row) => Object.keys(row)))].filter((key) => rows.some((row) => typeof row[key] === "number"))
  .sort((a, b) => rank(a) - rank(b) || (a < b ? -1 : 1));

export function csv(rows, keys) {
  const cell = (x) => (x === null || x === undefined ? "" : /[",\n]/.test(String(x)) ? `"${String(x).replaceAll('"', '""')}"` : String(x));
  return [["id", "at", ...keys], ...rows.map((row) => ["id", "at", ...keys].map((key) => row[key]))].map((line) => line.map(cell).join(",")).join("\r\n") + "\r\n";
}
