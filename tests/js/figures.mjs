// One vessel, one set of figures: what the portal, report.html, the command line's table, angles.csv and the cohort show of a
// result is the number of result.json, in all digits that are shown. The service's result.json is the command line's to the byte.
import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { mkdtempSync, readdirSync, readFileSync, rmSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const { chromium } = createRequire(import.meta.url)("playwright-core");
const { VASCULUM_BIN: binary, VASCULUM_SCAN: scan, VASCULUM_OUT: out } = process.env;
const LONG = 120_000;

const text = readFileSync(join(out, "result.json"), "utf8");
const truth = JSON.parse(text);
const { angles } = truth.junctions[0];
const data = mkdtempSync(join(tmpdir(), "vasculum-figures-"));
const server = spawn(binary, ["serve", "--no-auth", "--listen", "127.0.0.1:0", "--data-dir", data], { env: { ...process.env, RUST_LOG: "error" } });
const address = await new Promise((resolve, reject) => {
  setTimeout(() => reject(new Error("the service does not listen")), 20_000).unref();
  server.stdout.on("data", (chunk) => { const found = String(chunk).match(/listening on (http:\/\/\S+)/); if (found) resolve(found[1]); });
});
const browser = await chromium.launch({ executablePath: "/usr/bin/chromium", args: ["--no-sandbox", "--disable-dev-shm-usage", "--disable-background-networking", "--use-gl=angle", "--use-angle=swiftshader"] });
const page = await (await browser.newContext({ viewport: { width: 1280, height: 900 }, locale: "en-US" })).newPage();

// Minus signs, degrees, dashes and blanks of print, as plain numbers.
const plain = (cell) => cell.replaceAll("−", "-").replaceAll("°", "").replaceAll("\n", " ").replace(/\s+/g, " ").trim();
const fixed = (x, digits) => { const t = x.toFixed(digits); return /[1-9]/.test(t) ? t : t.replace("-", ""); };
const band = (b, digits) => b.map((x) => fixed(x, digits)).join(" – ");
const rowsOf = async (table) => (await table.locator("tbody tr").evaluateAll((rows) => rows.map((row) => [...row.cells].map((cell) => cell.innerText)))).map((row) => row.map(plain));
let compared = 0;
const same = (shown, wanted, what) => { assert.deepEqual(shown, wanted, what); compared += [shown].flat().length; };

async function sent() {
  const form = new FormData();
  form.append("plan", JSON.stringify(JSON.parse(readFileSync(join(out, "provenance.json"), "utf8")).plan));
  for (const name of readdirSync(join(scan, "dicom"))) form.append("input", new Blob([readFileSync(join(scan, "dicom", name))]), name);
  const { id } = await (await fetch(`${address}/v1/jobs`, { method: "POST", body: form })).json();
  for (let k = 0; k < 5; k += 1) if ((await (await fetch(`${address}/v1/jobs/${id}?wait=60`)).json()).finished_at) break;
  assert.equal(await (await fetch(`${address}/v1/jobs/${id}/artefacts/result.json`)).text(), text, "the service and the command line make the same result.json");
  return id;
}

async function portal(id) {
  await page.goto(`${address}/#/jobs/${id}`);
  await page.locator("table.angles tbody tr").nth(4).waitFor({ timeout: LONG });
  const shown = await rowsOf(page.locator("table.angles"));
  same(shown.map((row) => row.slice(1)), angles.map((a) => [fixed(a.value, 1), band(a.band95, 1)]), "angles in the portal");
  const branches = await rowsOf(page.locator("section", { has: page.getByRole("heading", { name: "Branches", exact: true }) }).locator("table"));
  same(branches.map((row) => row.slice(1)), truth.branches.map((b) => [
    fixed(b.length_mm, 1), `${fixed(b.diameter_mm, 2)} ${band(b.diameter_band95, 2)}`, fixed(b.tortuosity, 3),
    b.stenosis ? `${fixed(100 * (1 - b.stenosis.area_ratio), 0)} %` : "–", b.helix ? fixed(b.helix.torsion_per_mm, 3) : "–",
  ]), "branches in the portal");
  const quality = await page.locator("section", { has: page.getByRole("heading", { name: "Quality", exact: true }) }).innerText();
  const s = truth.surface;
  for (const figure of [truth.input.spacing_mm.map((x) => fixed(x, 3)).join(" × "), fixed(truth.implicit.residual_rms_mm, 3), fixed(truth.implicit.residual_max_mm, 3), s.triangles.toLocaleString("en-US"), Math.round(s.volume_mm3).toLocaleString("en-US"), fixed(s.max_error_mm, 3), fixed(s.displacement_px.rms, 2)]) {
    assert.ok(plain(quality).includes(figure), `${figure} in the portal's ${quality}`);
    compared += 1;
  }
  await page.goto(`${address}/#/cohort`);
  await page.locator("table.cohort tbody tr").waitFor({ timeout: LONG });
  const [line] = await rowsOf(page.locator("table.cohort"));
  same(line.slice(2, 2 + angles.length), angles.map((a) => fixed(a.value, 1)), "angles in the cohort");
}

async function report() {
  await page.goto(pathToFileURL(join(out, "report.html")).href);
  const captioned = (words) => page.locator("table", { has: page.locator("caption", { hasText: words }) });
  const shown = await rowsOf(captioned(/^Junction/));
  same(shown.map((row) => row.slice(1)), angles.map((a) => [fixed(a.value, 1), band(a.band95, 1), band(a.window_diameters, 1)]), "angles in the report");
  const branches = await rowsOf(captioned(/^Branches/));
  const sorted = [...truth.branches].sort((a, b) => (a.role === "other") - (b.role === "other") || a.id - b.id);
  same(branches.map((row) => row.slice(1)), sorted.map((b) => [fixed(b.length_mm, 1), fixed(b.diameter_mm, 2), fixed(b.tortuosity, 3), b.helix ? fixed(b.helix.torsion_per_mm, 3) : "–"]), "branches in the report");
  const quality = Object.fromEntries(await rowsOf(captioned("Quality")));
  same(quality.Spacing, `${truth.input.spacing_mm.map((x) => fixed(x, 3)).join(" × ")} mm`);
  same(quality.Surface, `${truth.surface.triangles} triangles, ${fixed(truth.surface.area_mm2, 0)} mm², ${fixed(truth.surface.volume_mm3, 0)} mm³`);
  const q = truth.surface.quality;
  same(quality["Mesh error"], `${fixed(q.face_max_mm, 3)} mm, ${fixed(q.face_rms_mm, 4)} rms`);
}

function commandLine() {
  const lines = execFileSync(binary, ["show", out], { encoding: "utf8" }).split("\n").map((line) => line.trim().split(/\s+/));
  for (const a of angles) {
    const line = lines.find((words) => words[0] === a.name);
    same(line.slice(1), [fixed(a.value, 2), fixed(a.band95[0], 2), "..", fixed(a.band95[1], 2)], `${a.name} on the command line`);
  }
}

function tables() {
  const [head, ...rows] = readFileSync(join(out, "angles.csv"), "utf8").trim().split(/\r?\n/).map((line) => line.split(","));
  const cell = (row, name) => row[head.indexOf(name)];
  for (const a of angles) {
    const row = rows.find((r) => cell(r, "angle") === a.name && cell(r, "kind") === "value");
    same(["value_deg", "band95_low_deg", "band95_high_deg", "window_from_diameters", "window_to_diameters"].map((name) => Number(cell(row, name))), [a.value, ...a.band95, ...a.window_diameters], `${a.name} in angles.csv`);
    const curve = rows.filter((r) => cell(r, "angle") === a.name && cell(r, "kind") === "by_distance");
    same(curve.map((r) => [Number(cell(r, "distance_diameters")), cell(r, "value_deg") === "" ? null : Number(cell(r, "value_deg"))]), a.by_distance.diameters.map((x, k) => [x, a.by_distance.value[k]]), `${a.name} by distance`);
  }
}

let failed = null;
try {
  tables();
  commandLine();
  await report();
  await portal(await sent());
  console.log(`figures: ${compared} rows and figures of portal, report, cohort, command line and angles.csv are those of result.json`);
} catch (error) {
  failed = error;
}
await browser.close();
server.kill();
await new Promise((resolve) => server.once("exit", resolve));
rmSync(data, { recursive: true, force: true });
if (failed) {
  console.error(failed);
  process.exit(1);
}
