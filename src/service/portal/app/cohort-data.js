// The rows of the cohort: one per finished job, from its result. The one place that knows where they come from.
import { filePath, json, lasting } from "./net.js";
import { mainJunction } from "./result.js";

const AT_ONCE = 6;
const MOST = 1000;

function rowOf(job, found) {
  const junction = mainJunction(found);
  const row = { id: job.id, at: job.created_at, priority: job.priority, slices: found.input.slices, spacing: found.input.spacing_mm[2], warnings: found.warnings.length, volume: found.surface.volume_mm3 };
  for (const angle of junction?.angles ?? []) row[`angle.${angle.name}`] = angle.value;
  for (const branch of found.branches) {
    if (branch.role === "other") continue;
    row[`diameter.${branch.role}`] = branch.diameter_mm;
    row[`length.${branch.role}`] = branch.length_mm;
    if (branch.stenosis) row[`stenosis.${branch.role}`] = 100 * (1 - branch.stenosis.area_ratio);
  }
  return row;
}

// Calls onRows with the rows so far, newest first, and how many are still to come.
export async function cohort(onRows, signal) {
  const jobs = [];
  let next = "/v1/jobs?state=succeeded&limit=200";
  while (next && jobs.length < MOST) {
    const page = await json(next, { signal });
    jobs.push(...page.items);
    next = page.next;
  }
  const rows = new Array(jobs.length);
  let done = 0;
  const work = jobs.map((job, i) => ({ job, i }));
  const take = async () => {
    for (let one = work.shift(); one && !signal.aborted; one = work.shift()) {
      // A job may be erased, or may have made no numbers: it is left out.
      rows[one.i] = await lasting(filePath(one.job.id, "result.json")).then((found) => rowOf(one.job, found)).catch(() => null);
      done += 1;
      if (done % 10 === 0) onRows(rows.filter(Boolean), jobs.length - done);
    }
  };
  await Promise.all(Array.from({ length: AT_ONCE }, take));
  if (!signal.aborted) onRows(rows.filter(Boolean), 0);
}

// Keys of values that some row has.
export const quantities = (rows) => [...new Set(rows.flatMap((row) => Object.keys(row)))].filter((key) => rows.some((row) => typeof row[key] === "number")).sort();

export function csv(rows, keys) {
  const cell = (x) => (x === null || x === undefined ? "" : /[",\n]/.test(String(x)) ? `"${String(x).replaceAll('"', '""')}"` : String(x));
  return [["id", "at", ...keys], ...rows.map((row) => ["id", "at", ...keys].map((key) => row[key]))].map((line) => line.map(cell).join(",")).join("\r\n") + "\r\n";
}
