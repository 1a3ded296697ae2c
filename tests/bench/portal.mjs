// `cargo xtask bench portal`: from the address of a result to its drawn wall, in headless Chromium without a GPU and without
// a cache, by turns for a wall of some 40,000 triangles and one of a million; and the heap over 50 results opened and closed.
// Arguments: the binary, a folder for the scan, visits of each.
import { execFileSync, spawn } from "node:child_process";
import { mkdirSync, readdirSync, readFileSync, rmSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const { chromium } = createRequire(import.meta.url)("playwright-core");
const [binary, work, visits] = process.argv.slice(2);
// Edges in mm that give about as many triangles on the demo scan's wall; what the drawn wall may take, s.
const WALLS = [{ edge: 0.355, most: 1.5 }, { edge: 0.07, most: 4 }];
const LONG = 300_000;
const RESULTS = 50;

rmSync(work, { recursive: true, force: true });
mkdirSync(work, { recursive: true });
execFileSync(binary, ["phantom", "anastomosis", "--out", join(work, "scan")], { stdio: "ignore" });
const server = spawn(binary, ["serve", "--listen", "127.0.0.1:0", "--no-auth", "--data-dir", join(work, "data")], { env: { ...process.env, RUST_LOG: "error" } });
const address = await new Promise((resolve, reject) => {
  let text = "";
  setTimeout(() => reject(new Error("the service does not listen")), 20_000).unref();
  server.stdout.on("data", (chunk) => {
    text += chunk;
    const found = text.match(/listening on (http:\/\/\S+)/)?.[1];
    if (found) resolve(found);
  });
});
const read = async (path) => (await fetch(address + path)).json();

// A finished job with edges of the given length.
async function reconstruct(edge) {
  const slices = join(work, "scan", "dicom");
  const plan = JSON.parse(readFileSync(join(work, "scan", "plan.json"), "utf8"));
  plan.surface = { ...plan.surface, edge_mm: [edge, edge + 0.002] };
  const form = new FormData();
  form.append("plan", JSON.stringify(plan));
  for (const name of readdirSync(slices)) form.append("input", new Blob([readFileSync(join(slices, name))]), name);
  const { id } = await fetch(`${address}/v1/jobs`, { method: "POST", body: form }).then((r) => r.json());
  for (;;) {
    const { state } = await read(`/v1/jobs/${id}`);
    if (state === "succeeded") return id;
    if (state === "failed") throw new Error(`a wall of ${edge} mm was not made`);
    await new Promise((resolve) => setTimeout(resolve, 500));
  }
}

// Runs in the page before its own code: notes when the wall and the angles stand on the canvas. Reading a pixel back waits
// until all that was asked to be drawn is drawn.
function watchWall() {
  const look = () => {
    if (!document.querySelector(".labels .tag")) return requestAnimationFrame(look);
    return requestAnimationFrame(() => {
      const gl = document.querySelector(".scene canvas").getContext("webgl2");
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      window.wallDrawn = performance.now();
    });
  };
  requestAnimationFrame(look);
}

async function visit(browser, id) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 720 }, locale: "en-GB" });
  const page = await context.newPage();
  await page.addInitScript(watchWall);
  await page.goto(`${address}/#/jobs/${id}`);
  const wall = await (await page.waitForFunction(() => window.wallDrawn, null, { timeout: LONG })).jsonValue();
  const contents = await (await page.waitForFunction(() => performance.getEntriesByName("first-contentful-paint")[0]?.startTime)).jsonValue();
  await context.close();
  return { wall: wall / 1000, contents: contents / 1000 };
}

const median = (values) => [...values].sort((a, b) => a - b)[values.length >> 1];
const told = (values) => `${median(values).toFixed(2)} (${Math.min(...values).toFixed(2)} to ${Math.max(...values).toFixed(2)})`;

async function heapOver(browser, id) {
  const page = await browser.newPage();
  const session = await page.context().newCDPSession(page);
  const heap = async () => {
    await session.send("HeapProfiler.collectGarbage");
    return (await session.send("Runtime.getHeapUsage")).usedSize / 1e6;
  };
  const open = async (hash, ready) => {
    await page.goto(`${address}/${hash}`);
    await page.locator(ready).first().waitFor({ timeout: LONG });
  };
  const seen = [];
  for (let k = 1; k <= RESULTS; k += 1) {
    await open(`#/jobs/${id}`, ".labels .tag");
    await open("#/jobs", "#queue tr");
    if (k % 10 === 0) seen.push(await heap());
  }
  return seen;
}

const missed = [];
try {
  const walls = [];
  for (const { edge, most } of WALLS) {
    const id = await reconstruct(edge);
    walls.push({ id, most, triangles: (await read(`/v1/jobs/${id}/result`)).surface.triangles, seen: [] });
  }
  const browser = await chromium.launch({
    executablePath: "/usr/bin/chromium",
    args: ["--no-sandbox", "--disable-dev-shm-usage", "--disable-background-networking", "--use-gl=angle", "--use-angle=swiftshader"],
  });
  for (let k = 0; k < Number(visits); k += 1) for (const wall of walls) wall.seen.push(await visit(browser, wall.id));
  console.log("triangles   first contents, s        wall and angles drawn, s: median (least to most)   bar");
  for (const { triangles, seen, most } of walls) {
    const drawn = seen.map((s) => s.wall);
    console.log(`${String(triangles).padStart(9)}   ${told(seen.map((s) => s.contents)).padEnd(22)}   ${told(drawn).padEnd(52)}   ${most}`);
    if (!(median(drawn) <= most)) missed.push(`${triangles} triangles: ${median(drawn).toFixed(2)} s, at most ${most} are wanted`);
  }
  const heaps = await heapOver(browser, walls[0].id);
  console.log(`heap after ${heaps.map((_, k) => 10 * (k + 1)).join(", ")} results opened and closed: ${heaps.map((h) => h.toFixed(2)).join(", ")} MB`);
  await browser.close();
} finally {
  server.kill();
}
if (missed.length > 0) throw new Error(missed.join("; "));
