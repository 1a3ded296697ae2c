// tus-js-client sends a volume through a line that breaks twenty times; what arrives is what was sent.
import { spawn } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import net from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import * as tus from "tus-js-client";

const BREAKS = 20;
const folder = mkdtempSync(join(tmpdir(), "vasculum-"));
const server = spawn(
  process.env.VASCULUM_BIN,
  ["serve", "--no-auth", "--listen", "127.0.0.1:0", "--workers", "0", "--data-dir", join(folder, "data")],
  { stdio: ["ignore", "pipe", "inherit"], env: { ...process.env, RUST_LOG: "error" } },
);
const address = await new Promise((found) => {
  let said = "";
  server.stdout.on("data", (text) => {
    said += text;
    const line = said.match(/listening on (http:\/\/\S+)/);
    if (line) found(new URL(line[1]));
  });
});

// A line that is cut after a number of bytes; the numbers look random and are the same at every run.
let seed = 12345;
const next = (below) => (seed = (seed * 1103515245 + 12345) % 2147483648) % below;
let breaks = 0;
const line = net.createServer((client) => {
  const onward = net.connect(Number(address.port), address.hostname);
  let left = breaks < BREAKS ? 60000 + next(400000) : Infinity;
  const cut = () => (client.destroy(), onward.destroy());
  client.on("data", (bytes) => {
    if (left - bytes.length < 0) {
      breaks += 1;
      onward.write(bytes.subarray(0, Math.max(left, 0)), cut);
      left = Infinity;
      return;
    }
    left -= bytes.length;
    onward.write(bytes);
  });
  onward.pipe(client);
  client.on("end", () => onward.end());
  client.on("error", cut);
  onward.on("error", cut);
});
await new Promise((ready) => line.listen(0, "127.0.0.1", ready));

try {
  // Behind the line the Host header must still name the service (DNS rebinding guard).
  const bytes = readFileSync(join(process.env.VASCULUM_SCAN, "scan.mha"));
  const upload = await new Promise((done, failed) => {
    const sent = new tus.Upload(bytes, {
      endpoint: `http://127.0.0.1:${line.address().port}/v1/uploads`,
      headers: { Host: address.host },
      metadata: { filename: "scan.mha" },
      retryDelays: Array(200).fill(20),
      onError: failed,
      onSuccess: () => done(sent),
    });
    sent.start();
  });
  if (breaks < BREAKS) throw new Error(`the line broke only ${breaks} times`);
  const id = new URL(upload.url).pathname.split("/").pop();
  const checked = async (body, headers) => {
    const answer = await fetch(new URL("/v1/jobs?validate=true", address), { method: "POST", body, headers });
    const found = await answer.json();
    if (answer.status !== 200) throw new Error(JSON.stringify(found));
    return found.input.digest;
  };
  const form = new FormData();
  form.append("input", new Blob([bytes]), "scan.mha");
  const [resumed, direct] = [
    await checked(JSON.stringify({ upload: id }), { "content-type": "application/json" }),
    await checked(form, {}),
  ];
  if (resumed !== direct) throw new Error(`${resumed} is not ${direct}`);
  console.log(`tus-js-client: ${bytes.length} bytes over ${breaks} breaks arrived whole (${resumed})`);
} finally {
  line.close();
  line.closeAllConnections?.();
  server.kill();
  rmSync(folder, { recursive: true, force: true });
}
process.exit(0);
