// The portal as a user meets it, in headless Chromium against the binary: sign in, send a scan whose upload breaks off and
// whose session ends on the way, see what was understood, reconstruct, read the three angles (equal to result.json of the
// command line), point from 3D to slice and back, correct a role, compare, download, print on one page, cancel, mend a failed
// job, read the cohort, make a key, show a result in another page. On every view in light and dark: axe-core finds nothing. No console error, no request
// to another origin, a policy without unsafe-*, at most 400 kB of code. Leaves screenshots in VASCULUM_WORK.
import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { mkdtempSync, readdirSync, readFileSync, rmSync } from "node:fs";
import { createServer } from "node:http";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { brotliCompressSync } from "node:zlib";

const require = createRequire(import.meta.url);
const { chromium } = require("playwright-core");
const axe = readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
const { VASCULUM_BIN: binary, VASCULUM_SCAN: scan, VASCULUM_OUT: out, VASCULUM_WORK: work } = process.env;
const MOST_CODE = 400_000;
const LONG = 120_000;
const ANGLES = {
  graft_proximal: "Graft – proximal",
  graft_distal_planar: "Graft – distal, in the plane",
  distal_normal: "Distal – normal of the plane",
};

// A page of another origin, which shows what its address names in a frame.
const host = createServer((request, response) => {
  response.setHeader("content-type", "text/html");
  response.end(`<title>Host</title><iframe title="result" width="1200" height="700" src="${decodeURIComponent(request.url.slice(2))}"></iframe>`);
});
await new Promise((resolve) => host.listen(0, "127.0.0.1", resolve));
const hostAddress = `http://127.0.0.1:${host.address().port}`;
const data = mkdtempSync(join(tmpdir(), "vasculum-portal-"));
const server = spawn(binary, ["serve", "--listen", "127.0.0.1:0", "--data-dir", data, "--frame-ancestor", hostAddress], { env: { ...process.env, RUST_LOG: "error" } });
const [address, admin] = await new Promise((resolve, reject) => {
  let text = "";
  setTimeout(() => reject(new Error("the service does not listen")), 20_000).unref();
  server.stdout.on("data", (chunk) => {
    text += chunk;
    const found = [text.match(/listening on (http:\/\/\S+)/)?.[1], text.match(/vsk_[0-9a-f]+/)?.[0]];
    if (found.every(Boolean)) resolve(found);
  });
});
const browser = await chromium.launch({
  executablePath: "/usr/bin/chromium",
  args: ["--no-sandbox", "--disable-dev-shm-usage", "--disable-background-networking", "--use-gl=angle", "--use-angle=swiftshader"],
});
const context = await browser.newContext({ viewport: { width: 1280, height: 720 }, locale: "en-GB", colorScheme: "light", permissions: ["clipboard-read", "clipboard-write"] });
const page = await context.newPage();
const faults = [];
const scripts = new Map();
// A refusal that the test asks for is told by the browser as an error, too.
let refusals = [];
const watch = (p) => {
  p.on("console", (m) => {
    if (m.type() !== "error") return;
    const refused = /status of (\d+)/.exec(m.text())?.[1];
    if (!(refused && refusals.includes(Number(refused))) && !(refusals.includes("broken") && /ERR_FAILED/.test(m.text()))) faults.push(m.text());
  });
  p.on("pageerror", (e) => faults.push(String(e)));
  p.on("request", (r) => {
    if (![address, "blob:", "data:"].some((start) => r.url().startsWith(start))) faults.push(`foreign request ${r.url()}`);
  });
  p.on("response", async (r) => {
    if (/\/portal\/.*\.(js|json|css)$/.test(r.url())) scripts.set(r.url(), await r.body().catch(() => Buffer.alloc(0)));
  });
};
watch(page);

const api = async (path, options = {}) => fetch(address + path, { ...options, headers: { authorization: `Bearer ${admin}`, ...options.headers } });
const read = async (path) => (await api(path)).json();
const shot = async (name) => {
  await page.evaluate(() => window.scrollTo(0, 0));
  await page.screenshot({ path: join(work, `portal-${name}.png`) });
};
const until = async (what, check) => {
  for (let k = 0; k < 240; k += 1) {
    const found = await check();
    if (found) return found;
    await new Promise((resolve) => setTimeout(resolve, 500));
  }
  throw new Error(`never: ${what}`);
};
const jobOfPage = async () => {
  await page.waitForURL(/#\/jobs\/[0-9a-f-]{36}/);
  return page.url().match(/#\/jobs\/([0-9a-f-]{36})/)[1];
};
const open = async (hash, ready) => {
  await page.goto(`${address}/${hash}`);
  await page.locator(ready).first().waitFor({ timeout: LONG });
};

// axe-core in both schemes. It runs outside the page's own policy, as an extension would.
async function accessible(name) {
  const session = await context.newCDPSession(page);
  for (const colorScheme of ["light", "dark"]) {
    await page.emulateMedia({ colorScheme });
    await session.send("Runtime.evaluate", { expression: axe });
    const found = await page.evaluate(() => axe.run(document));
    const told = found.violations.map((v) => `${v.id}: ${v.nodes.map((n) => n.target.join(" ")).slice(0, 3).join(", ")}`);
    assert.deepEqual(told, [], `${name}, ${colorScheme}`);
    assert.ok(found.passes.length > 10, "axe-core looked");
  }
  await page.emulateMedia({ colorScheme: "light" });
  await session.detach();
  const beyond = await page.evaluate(() => document.documentElement.scrollWidth - window.innerWidth);
  assert.ok(beyond <= 0, `${name} is ${beyond} px too wide`);
}

async function signIn(key) {
  await page.getByLabel("API key", { exact: true }).fill(key);
  await page.locator("#sign-in button").click();
}

async function begin() {
  const front = await fetch(address);
  const policy = front.headers.get("content-security-policy");
  assert.match(policy, /default-src 'none'/);
  assert.doesNotMatch(policy, /unsafe/);
  await page.goto(address);
  await page.locator("#sign-in").waitFor();
  await accessible("the sign-in");
  refusals = [401];
  await signIn("vsk_00");
  await page.getByText("This API key is unknown or revoked").waitFor();
  await signIn(admin);
  await page.locator("#queue").waitFor({ state: "attached" });
  await page.getByText("No job yet").waitFor();
  refusals = [];
  await accessible("the empty queue");
}

// The session ends when the first bytes are on their way, and the connection breaks at the next ones.
async function sendThroughTrouble() {
  await open("#/admin", ".admin-grid form");
  await page.getByLabel("What it is for").fill("a clinic");
  await page.getByRole("button", { name: "Make a key" }).click();
  const clinic = await page.getByRole("textbox", { name: "The new key" }).inputValue();
  assert.match(clinic, /^vsk_[0-9a-f]{64}$/);
  await accessible("a new key");
  await page.getByRole("button", { name: "Close" }).click();
  await accessible("the administration");
  await page.locator(".audit tbody").getByText("made a key").first().waitFor();
  await page.getByLabel("What", { exact: true }).selectOption({ label: "made a key" });
  await until("an audit of one kind", async () => (await page.locator(".audit tbody tr").evaluateAll((rows) => rows.every((row) => row.cells[2].innerText === "made a key"))));
  await page.getByLabel("What", { exact: true }).selectOption("");
  await shot("admin");
  refusals = [401, "broken"];
  await page.getByRole("button", { name: "Sign out" }).click();
  await signIn(clinic);
  await open("#/send", "#drop");
  await accessible("sending");
  const id = (await read("/v1/keys")).items.find((k) => k.label === "a clinic").id;
  let patches = 0;
  await page.route("**/v1/uploads/*", async (route) => {
    if (route.request().method() !== "PATCH") return route.continue();
    patches += 1;
    if (patches === 1) await api(`/v1/keys/${id}`, { method: "DELETE" });
    if (patches === 2) return route.abort();
    return route.continue();
  });
  await page.setInputFiles("#files", readdirSync(join(scan, "dicom")).map((name) => join(scan, "dicom", name)));
  await page.getByText("waits for you to sign in").waitFor();
  await signIn(admin);
  await page.locator(".check-picture canvas").waitFor({ timeout: LONG });
  assert.ok(patches >= 3, `the upload went on: ${patches} calls`);
  await page.unroute("**/v1/uploads/*");
  refusals = [];
}

async function checkAndReconstruct(truth) {
  const facts = page.locator(".facts");
  const [row, column, slice] = truth.input.spacing_mm.map((x) => x.toFixed(3));
  await facts.getByText(`${row} × ${column} × ${slice} mm`).waitFor();
  assert.match(await facts.innerText(), new RegExp(`× ${truth.input.slices}\\b`));
  assert.ok((await page.locator(".check-picture .contour").count()) > 0, "the vessel that was found is drawn");
  await page.getByText("Say which vessel is meant").click();
  await page.getByLabel("Seed point").check();
  await page.locator(".check-picture .overlay").click({ position: { x: 90, y: 90 } });
  await page.getByText("1 seed point").waitFor();
  await page.getByText("Priority and plan").click();
  const written = () => page.getByLabel("Plan (JSON)").inputValue().then(JSON.parse);
  assert.equal((await written()).segmentation.seeds_mm.length, 1, "what is placed stands in the plan's text");
  await page.getByLabel("Circle").check();
  const picture = await page.locator(".check-picture .overlay").boundingBox();
  await page.mouse.move(picture.x + 120, picture.y + 120);
  await page.mouse.down();
  await page.mouse.move(picture.x + 160, picture.y + 120);
  await page.mouse.up();
  await page.getByText(/circle on slice/).waitFor();
  const drawn = (await written()).segmentation.region;
  const wanted = (40 / picture.width) * Number(/(\d+) × \d+ × \d+/.exec(await facts.innerText())[1]);
  assert.ok(Math.abs(drawn.radius_px - wanted) < 0.02 * wanted, `a circle of ${drawn.radius_px} pixels, drawn as ${wanted}`);
  await page.getByRole("button", { name: "Take all away" }).click();
  await page.getByText("Nothing is placed").waitFor({ timeout: LONG, state: "attached" });
  await accessible("a checked scan");
  await shot("send");
  await page.getByText("Priority and plan").click();
  await page.getByLabel("Plan (JSON)").fill(readFileSync(join(scan, "plan.json"), "utf8"));
  await page.locator("details", { hasText: "Priority and plan" }).getByRole("button", { name: "Check again" }).click();
  await page.locator(".check-picture canvas").waitFor({ timeout: LONG });
  await page.getByRole("button", { name: "Reconstruct" }).click();
  const id = await jobOfPage();
  await page.locator(".steps li").first().waitFor();
  await page.locator(".result-views canvas").first().waitFor({ timeout: LONG });
  return id;
}

const row = (text) => page.locator("table.angles tr", { has: page.getByText(text, { exact: true }) });

async function readResult(id, truth) {
  const found = await read(`/v1/jobs/${id}/result`);
  const rows = readFileSync(join(out, "angles.csv"), "utf8");
  for (const [name, words] of Object.entries(ANGLES)) {
    const angle = (result) => result.junctions[0].angles.find((a) => a.name === name);
    const shown = Number((await row(words).locator("strong").innerText()).replace("°", ""));
    assert.equal(shown, Number(angle(found).value.toFixed(1)), `${name} of the job`);
    assert.equal(shown, Number(angle(truth).value.toFixed(1)), `${name} of the command line`);
    assert.ok(rows.includes(name));
    const band = angle(found).band95.map((x) => x.toFixed(1)).join(" – ");
    await row(words).getByText(band).waitFor();
    await page.locator(".tag", { hasText: `${shown.toFixed(1)}°` }).waitFor();
  }
  assert.equal(found.input.digest, truth.input.digest, "what arrived after the breaks is the scan");
  await page.waitForFunction(() => document.querySelector(".slice-tools output")?.textContent.includes("mm"));
  await accessible("a result");
}

// The slider moves the plane in 3D, a press on the vessel in 3D moves the slice, and a curve's cursor both.
async function coupled() {
  const told = page.locator(".slice-tools output");
  const slider = page.locator(".slice-tools input");
  const canvas = page.locator(".scene canvas");
  const before = await canvas.screenshot();
  await slider.fill("3");
  await page.waitForTimeout(600);
  assert.notDeepEqual(await canvas.screenshot(), before, "the plane moved");
  const first = await told.innerText();
  const box = await canvas.boundingBox();
  // The vessel crosses the middle line of the picture somewhere.
  for (let dx = -90; dx <= 90; dx += 15) {
    await canvas.click({ position: { x: box.width / 2 + dx, y: box.height / 2 } });
    await page.waitForTimeout(200);
    if ((await told.innerText()) !== first) break;
  }
  const second = await told.innerText();
  assert.notEqual(second, first, "a press on the surface goes to its slice");
  const plot = page.getByRole("slider", { name: /Along the branches/ });
  await plot.focus();
  await page.keyboard.press("End");
  await page.waitForTimeout(200);
  assert.notEqual(await told.innerText(), second, "the cursor along a branch goes to its slice");
  await walls(canvas);
  await page.getByLabel("Cut at the slice").check();
  await page.locator(".ramp").waitFor();
  await page.waitForTimeout(600);
  await shot("result");
}

// Every way to colour the wall shows another picture, and a legend that says what the colours are.
async function walls(canvas) {
  const seen = new Set();
  const ways = { clear: null, solid: null, none: null, quality: /smallest angle.*30°.*60°/s, patches: /distal.*proximal.*graft/s, displacement: /≥ 0\.\d+ mm.*outward/s };
  for (const [way, legend] of Object.entries(ways)) {
    await page.locator(".scene-tools select").selectOption(way);
    await until(`the legend of ${way}`, async () => (legend ? legend.test(await page.locator(".ramp").innerText()) : !(await page.locator(".ramp").isVisible())));
    await page.waitForTimeout(600);
    seen.add((await canvas.screenshot()).toString("base64"));
  }
  assert.equal(seen.size, Object.keys(ways).length, "each way to show the wall is another picture");
}

async function correctRoles(id, truth) {
  await page.getByText("Correct who is who").click();
  await page.getByRole("button", { name: "Swap proximal and distal" }).click();
  await page.getByRole("button", { name: "Measure with these roles" }).click();
  await page.waitForFunction((old) => !location.hash.includes(old), id);
  const next = await jobOfPage();
  await page.locator(".result-views canvas").first().waitFor({ timeout: LONG });
  const found = await read(`/v1/jobs/${next}/result`);
  const angle = (result, name) => result.junctions[0].angles.find((a) => a.name === name).value;
  assert.ok(Math.abs(angle(found, "graft_proximal") - angle(truth, "graft_distal")) < 1e-6, "what was distal is proximal now");
  return next;
}

// Asks for a variant, waits for it in the list and opens it beside its parent.
async function vary(id) {
  await open(`#/jobs/${id}`, ".scene canvas");
  await page.getByText("Make variants", { exact: true }).click();
  await page.getByLabel("Degrees").fill("60, sixty");
  await page.getByRole("button", { name: "Make them" }).click();
  await page.getByText("Give one or more numbers").waitFor();
  await page.getByLabel("Change", { exact: true }).selectOption("curvature");
  await page.getByLabel("Torsion, 1/mm").waitFor();
  await page.getByLabel("Change", { exact: true }).selectOption("angle");
  await page.getByLabel("Degrees").fill("60");
  await page.getByRole("button", { name: "Make them" }).click();
  const line = page.locator(".vary tr", { has: page.getByRole("link", { name: "graft at 60.0° to proximal", exact: true }) });
  const beside = line.getByRole("link", { name: /Compare with this result/ });
  await beside.waitFor({ timeout: LONG });
  await accessible("a result with a variant");
  await page.locator(".vary").scrollIntoViewIfNeeded();
  await page.screenshot({ path: join(work, "portal-vary.png") });
  await beside.click();
  await page.locator(".compare-top table").first().waitFor({ timeout: LONG });
  const cells = await page.locator("tr", { has: page.getByText("Graft – proximal", { exact: true }) }).locator("td").allInnerTexts();
  assert.ok(Math.abs(Number(cells[2].replace("°", "")) - 60) <= 0.3, `the variant is beside its parent: ${cells}`);
  await page.locator(".scene canvas").waitFor({ timeout: LONG });
  await page.waitForTimeout(1500);
  await shot("vary-compare");
}

async function compare(a, b, truth) {
  await open(`#/compare?a=${a}&b=${b}`, ".compare-top table");
  const other = await read(`/v1/jobs/${b}/result`);
  const value = (result) => result.junctions[0].angles.find((x) => x.name === "graft_proximal").value;
  const apart = (value(other) - value(truth)).toFixed(1);
  const line = page.locator("tr", { has: page.getByText("Graft – proximal", { exact: true }) });
  assert.equal(await line.locator("strong").innerText(), `${apart > 0 ? "+" : ""}${apart}°`.replace("-", "−"));
  await page.locator(".scene canvas").waitFor({ timeout: LONG });
  await page.waitForTimeout(1500);
  await accessible("a comparison");
  await shot("compare");
}

async function download(id) {
  await open(`#/jobs/${id}`, "table.files");
  const [file] = await Promise.all([page.waitForEvent("download"), page.getByRole("link", { name: "angles.csv" }).click()]);
  assert.equal(readFileSync(await file.path(), "utf8"), await (await api(`/v1/jobs/${id}/artefacts/angles.csv`)).text());
  await page.getByRole("button", { name: "Copy a curl command for result.json" }).click();
  const command = await page.evaluate(() => navigator.clipboard.readText());
  assert.ok(command.startsWith("curl ") && command.includes(`/v1/jobs/${id}/artefacts/result.json`) && !command.includes(admin));
  const report = await context.newPage();
  watch(report);
  await report.goto(`${address}/v1/jobs/${id}/artefacts/report.html`);
  const colours = await report.evaluate(() => getComputedStyle(document.querySelector(".swatch rect")).fill);
  assert.notEqual(colours, "rgb(0, 0, 0)", "the report's colours pass its policy");
  const pdf = (await report.pdf({ preferCSSPageSize: true, printBackground: true })).toString("latin1");
  assert.equal(pdf.match(/\/Type\s*\/Page[^s]/g).length, 1, "the report prints on one page");
  await report.close();
}

function post(plan, files) {
  const form = new FormData();
  form.append("plan", JSON.stringify(plan));
  for (const [name, bytes] of files) form.append("input", new Blob([bytes]), name);
  return api("/v1/jobs", { method: "POST", body: form }).then((r) => r.json());
}

// Rows that change at every poll keep their buttons: a press that outlasts a poll counts.
async function pressLong(button) {
  const box = await button.boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  await page.mouse.down();
  await page.waitForTimeout(1500);
  await page.mouse.up();
}

async function queue() {
  const files = readdirSync(join(scan, "dicom")).map((name) => [name, readFileSync(join(scan, "dicom", name))]);
  // So many that the last one still waits when the page is there.
  const sent = [];
  for (let k = 0; k < 6; k += 1) sent.push(await post({}, files));
  const [first, last] = [sent[0], sent.pop()];
  await open("#/jobs", "#queue tr");
  const line = page.locator("#queue tr", { has: page.locator(`a[href="#/jobs/${last.id}"]`) });
  await line.getByRole("button", { name: /Raise the priority/ }).click({ timeout: LONG });
  await until("a raised priority", async () => (await read(`/v1/jobs/${last.id}`)).priority === 10);
  await accessible("the queue");
  await shot("queue");
  await pressLong(line.getByRole("button", { name: /^Cancel/ }));
  await line.getByText("cancelled").waitFor();
  for (const job of sent.slice(1)) {
    await api(`/v1/jobs/${job.id}/cancel`, { method: "POST" });
    await until("an ended job", async () => ["cancelled", "succeeded"].includes((await read(`/v1/jobs/${job.id}`)).state));
    assert.equal((await api(`/v1/jobs/${job.id}`, { method: "DELETE" })).status, 204);
  }
  await page.getByLabel("State").selectOption("succeeded");
  // the first of them may have ended by now
  const done = async () => (await read("/v1/jobs?state=succeeded")).items.length;
  await until("a filtered queue", async () => (await page.locator("#queue tr").count()) === (await done()));
  await page.getByLabel("State").selectOption("");
  await page.getByRole("button", { name: "Size" }).click();
  await page.locator('th[aria-sort="descending"]', { hasText: "Size" }).waitFor();
  await warned(first.id);
  assert.equal((await api(`/v1/jobs/${first.id}`, { method: "DELETE" })).status, 204);
}

// A warning's place is gone to by a press: roles by rule speak of the junction.
async function warned(id) {
  await until("a job with warnings", async () => (await read(`/v1/jobs/${id}`)).state === "succeeded");
  await open(`#/jobs/${id}`, ".slice-tools output");
  const told = page.locator(".slice-tools output");
  const { position } = (await read(`/v1/jobs/${id}/result`)).warnings.find((w) => w.code === "roles.by_rule").where;
  await page.locator(".slice-tools input").fill("3");
  const far = await told.innerText();
  await page.locator(".warning li", { hasText: "roles.by_rule" }).getByRole("button", { name: /^Show/ }).click();
  assert.notEqual(await told.innerText(), far, "the slice is another one");
  const z = Number(/z = (-?[\d.]+) mm/.exec(await told.innerText())[1]);
  assert.ok(Math.abs(z - position[2]) <= 0.76, `slice at ${z}, the warning at ${position[2]}`);
}

async function mendFailed() {
  // Grey noise: no vessel is in it.
  let state = 1;
  const noise = () => (state = (state * 48271) % 2147483647) % 20;
  const slices = Array.from({ length: 6 }, (_, k) => [`s${k}.pgm`, Buffer.concat([Buffer.from("P5 64 64 255\n"), Buffer.from(Array.from({ length: 4096 }, () => 90 + noise()))])]);
  const job = await post({ geometry: { pixel_spacing_mm: [0.5, 0.5], slice_spacing_mm: 2 } }, slices);
  const ended = await until("a failed job", async () => {
    const now = await read(`/v1/jobs/${job.id}`);
    return now.state === "failed" && now;
  });
  await open(`#/jobs/${job.id}`, ".fault");
  await page.getByText("segmentation.no_vessel").first().waitFor();
  await page.getByText("What to do").first().waitFor();
  await page.getByRole("button", { name: "Look at the scan and mend the plan" }).click();
  await page.locator(".check-picture canvas").waitFor({ timeout: LONG });
  await accessible("a failed job");
  await shot("failed");
  await open("#/jobs?state=failed", "#queue tr");
  await page.getByRole("button", { name: /^Try again/ }).click();
  await until("a second try that failed too", async () => {
    const now = await read(`/v1/jobs/${job.id}`);
    return now.state === "failed" && now.started_at > ended.started_at;
  });
}

// Plain images say what they lack, and are understood once it is given.
async function plainImages(truth) {
  await open("#/send", "#drop");
  const scans = await page.locator(".scan").count();
  const pictures = readdirSync(join(scan, "png")).filter((name) => name.endsWith(".png"));
  refusals = [422];
  await page.setInputFiles("#files", pictures.map((name) => join(scan, "png", name)));
  await page.getByText("input.geometry_missing").waitFor({ timeout: LONG });
  assert.equal(await page.getByRole("button", { name: "Reconstruct" }).count(), 0, "nothing to reconstruct yet");
  await accessible("images without geometry");
  refusals = [];
  for (const [label, k] of [["Row step", 0], ["Column step", 1], ["Slice spacing", 2]]) {
    await page.getByLabel(label).fill(String(truth.input.spacing_mm[k]));
  }
  await page.locator("details form").getByRole("button", { name: "Check again" }).click();
  await page.locator(".check-picture .contour").first().waitFor({ timeout: LONG, state: "attached" });
  await page.getByText("plain images", { exact: true }).waitFor();
  await page.getByRole("button", { name: "Remove" }).first().click();
  await until("an erased upload", async () => (await page.locator(".scan").count()) === scans);
}

async function cohort() {
  await open("#/cohort", ".cohort-plots .point");
  const points = (n) => until(`${n} results`, async () => (await page.locator(".cohort-plots .point").count()) === n);
  await points(3);
  await page.getByLabel("What", { exact: true }).selectOption("reconstruction");
  await points(2);
  await page.getByLabel("Sent from").fill("2999-01-01");
  await page.getByText("No finished job with numbers").waitFor();
  await page.getByLabel("Sent from").fill("");
  await points(2);
  const [file] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Save as CSV" }).click()]);
  const lines = readFileSync(await file.path(), "utf8").trim().split("\r\n");
  assert.equal(lines.length, 3);
  assert.ok(lines[0].includes("angle.graft_proximal"));
  await accessible("the cohort");
  await shot("cohort");
}

// Another page shows the result by a link, and nothing else of the portal.
async function framed(id) {
  await open(`#/jobs/${id}`, ".scene canvas");
  await page.getByRole("button", { name: "Link for a frame" }).click();
  const link = await page.getByRole("textbox", { name: "Link" }).inputValue();
  await accessible("a link");
  await page.getByRole("button", { name: "Close" }).click();
  const stranger = await browser.newContext({ viewport: { width: 1280, height: 800 } });
  const outside = await stranger.newPage();
  const wrong = [];
  outside.on("pageerror", (e) => wrong.push(String(e)));
  outside.on("console", (m) => m.type() === "error" && wrong.push(m.text()));
  await outside.goto(`${hostAddress}/?${encodeURIComponent(link)}`);
  const frame = outside.frameLocator("iframe");
  await frame.locator(".tag").nth(2).waitFor({ timeout: LONG });
  await frame.locator(".slice-tools output", { hasText: "mm" }).waitFor();
  assert.equal(await frame.getByRole("button", { name: /Erase|Run again|Measure/ }).count(), 0);
  assert.equal(await frame.getByRole("link", { name: "Jobs" }).count(), 0);
  await outside.screenshot({ path: join(work, "portal-framed.png") });
  assert.deepEqual(wrong, []);
  await outside.goto(`${hostAddress}/?${encodeURIComponent(`${address}/`)}`);
  await until("a refused frame", () => wrong.some((text) => /frame-ancestors/.test(text)));
  await stranger.close();
}

async function german() {
  await page.getByLabel("Language").selectOption("de");
  await page.getByRole("link", { name: "Aufträge" }).waitFor();
  const [en, de] = await Promise.all(["en", "de"].map(async (name) => (await fetch(`${address}/portal/${name}.json`)).json()));
  assert.deepEqual(Object.keys(de), Object.keys(en), "the languages have the same texts");
  assert.equal(await page.evaluate(() => document.documentElement.lang), "de");
  await page.getByLabel("Sprache").selectOption("en");
}

// What a key may not do is not offered: a reader's result has no button that changes something, an auditor begins at the audit.
async function lesserRoles(id) {
  const keyOf = async (role) => (await (await api("/v1/keys", { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify({ label: role, role }) })).json()).key;
  const visit = async (role, ready) => {
    const other = await browser.newContext({ viewport: { width: 1280, height: 720 }, locale: "en-GB" });
    const view = await other.newPage();
    watch(view);
    await view.goto(`${address}/#key=${await keyOf(role)}`);
    await view.locator(ready).first().waitFor();
    return view;
  };
  const reader = await visit("read", "#queue tr");
  assert.deepEqual(await reader.getByRole("button", { name: /^(Cancel|Try again|Raise|Lower)/ }).count(), 0);
  await reader.goto(`${address}/#/jobs/${id}`);
  await reader.locator(".scene canvas").waitFor({ timeout: LONG });
  assert.equal(await reader.getByRole("button", { name: /^(Run again|Erase|Link|Measure|Make them)/ }).count(), 0);
  await reader.getByRole("link", { name: "Report", exact: true }).waitFor();
  await reader.context().close();
  const auditor = await visit("auditor", ".audit tbody tr");
  assert.match(auditor.url(), /#\/admin$/);
  await auditor.context().close();
}

// Results opened and closed give back what they took.
async function lean(id) {
  const session = await context.newCDPSession(page);
  const heap = async () => {
    await session.send("HeapProfiler.collectGarbage");
    return (await session.send("Runtime.getHeapUsage")).usedSize;
  };
  const visit = async () => {
    await open(`#/jobs/${id}`, ".scene canvas");
    await open("#/jobs", "#queue tr");
  };
  for (let k = 0; k < 3; k += 1) await visit();
  const before = await heap();
  for (let k = 0; k < 6; k += 1) await visit();
  const grown = (await heap()) - before;
  assert.ok(grown < 3e6, `six results opened and closed left ${grown} bytes`);
}

let failed = null;
try {
  const truth = JSON.parse(readFileSync(join(out, "result.json"), "utf8"));
  await begin();
  await sendThroughTrouble();
  const id = await checkAndReconstruct(truth);
  await readResult(id, truth);
  await coupled();
  const other = await correctRoles(id, truth);
  await compare(id, other, truth);
  await vary(id);
  await download(id);
  await queue();
  await mendFailed();
  await plainImages(truth);
  await cohort();
  await framed(id);
  await german();
  await lesserRoles(id);
  await lean(id);
  const code = [...scripts.values()].reduce((n, body) => n + brotliCompressSync(body).length, 0);
  assert.ok(code > 50_000 && code <= MOST_CODE, `${code} bytes of code`);
  assert.deepEqual(faults, []);
  console.log(`portal: sent, read, corrected, compared, printed; 10 views without a finding of axe-core; ${code} bytes of code`);
} catch (error) {
  failed = error;
  await shot("failure").catch(() => {});
}
await browser.close();
server.kill();
host.close();
host.closeAllConnections();
await new Promise((resolve) => server.once("exit", resolve));
rmSync(data, { recursive: true, force: true });
if (failed) {
  console.error(failed, faults);
  process.exit(1);
}
