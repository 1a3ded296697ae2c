// The portal in headless Chromium: a scan is sent, the job ends, the result view shows the three angles, with no console
// error and no request to another origin. Leaves a screenshot in VASCULUM_WORK.
import { spawn } from "node:child_process";
import { createRequire } from "node:module";
import { mkdtempSync, readdirSync, readFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";

const { chromium } = createRequire(import.meta.url)("playwright-core");
const { VASCULUM_BIN: binary, VASCULUM_SCAN: scan, VASCULUM_WORK: work } = process.env;
const data = mkdtempSync(join(tmpdir(), "vasculum-portal-"));
const server = spawn(binary, ["serve", "--no-auth", "--listen", "127.0.0.1:0", "--data-dir", data]);
const fail = (why) => {
  console.error(`portal: ${why}`);
  server.kill();
  process.exit(1);
};
const address = await new Promise((resolve) => {
  let text = "";
  const late = setTimeout(() => fail("the service does not listen"), 20000);
  server.stdout.on("data", (chunk) => {
    text += chunk;
    const found = text.match(/listening on (http:\/\/\S+)/);
    if (!found) return;
    clearTimeout(late);
    resolve(found[1]);
  });
});
const form = new FormData();
form.append("plan", new Blob([readFileSync(join(scan, "plan.json"))]));
for (const name of readdirSync(join(scan, "dicom"))) form.append("input", new Blob([readFileSync(join(scan, "dicom", name))]), name);
const job = await (await fetch(`${address}/v1/jobs`, { method: "POST", body: form })).json();
let state = job.state;
for (let k = 0; k < 300 && !["succeeded", "failed", "cancelled"].includes(state); k++) {
  state = (await (await fetch(`${address}/v1/jobs/${job.id}?wait=2`)).json()).state;
}
if (state !== "succeeded") fail(`the job ended as ${state}`);

const browser = await chromium.launch({
  executablePath: "/usr/bin/chromium",
  args: ["--no-sandbox", "--disable-dev-shm-usage", "--disable-background-networking", "--use-gl=angle", "--use-angle=swiftshader"],
});
const page = await browser.newPage({ viewport: { width: 1280, height: 720 } });
const faults = [];
page.on("console", (m) => m.type() === "error" && faults.push(m.text()));
page.on("pageerror", (e) => faults.push(String(e)));
page.on("request", (r) => !r.url().startsWith(address) && !r.url().startsWith("blob:") && !r.url().startsWith("data:") && faults.push(`foreign request ${r.url()}`));
await page.goto(`${address}/#/jobs/${job.id}`);
for (const name of ["Graft – proximal", "Graft – distal, in the plane", "Distal – normal of the plane"]) {
  await page.getByText(name, { exact: true }).first().waitFor({ timeout: 20000 }).catch(() => fail(`the result view does not show ${name}`));
}
await page.waitForTimeout(3000);
await page.screenshot({ path: join(work, "portal.png") });
await browser.close();
server.kill();
if (faults.length > 0) fail(faults.join("\n"));
console.log("portal: the result view shows the three angles, no console error, no foreign request");
process.exit(0);
