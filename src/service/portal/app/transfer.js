// Scans on their way to the service: packed, sent by tus in parts, taken up again after a break, a lost network or an ended
// session. Transfers live outside any view, so that they go on while the user looks at something else.
import { call, Fault, json, post, signedIn } from "./net.js";
import { available, Upload } from "./tus.js";
import { inOrder, inside, zipOf } from "./zip.js";

// Bytes of one request: after each the session is looked at again, and what arrived stays.
const PART = 4 << 20;
const AGAIN_MS = [0, 1000, 3000, 5000, 10_000, 20_000, 30_000];
// Speed is the mean of the last seconds.
const MEMORY_MS = 5000;

export const transfers = [];
const listeners = new Set();
let counted = () => {};

export function onTransfers(handler) {
  counted = handler;
}

// Calls the handler at every change until the signal aborts.
export function watchTransfers(handler, signal) {
  listeners.add(handler);
  signal.addEventListener("abort", () => listeners.delete(handler), { once: true });
}

let numbers = 0;

class Transfer {
  // name: the folder's, for the reader alone; it is not sent.
  constructor(files, name) {
    numbers += 1;
    this.number = numbers;
    this.files = files;
    this.name = name;
    this.size = files.reduce((n, f) => n + f.size, 0);
    this.state = "packing";
    this.done = 0;
    this.marks = [];
    this.fault = null;
    this.plan = {};
    this.priority = 0;
  }

  change(values) {
    Object.assign(this, values);
    for (const handler of listeners) handler(this);
    counted(transfers.filter((t) => ["packing", "sending"].includes(t.state)).length);
  }

  // Bytes a second over the last seconds, and the seconds left.
  get pace() {
    const [first, last] = [this.marks[0], this.marks.at(-1)];
    const speed = first && last.at > first.at ? ((last.done - first.done) / (last.at - first.at)) * 1000 : NaN;
    return { speed, left: (this.size - this.done) / speed };
  }

  async start() {
    try {
      const one = this.files.length === 1;
      const body = one ? this.files[0] : await zipOf(this.files, (n) => this.change({ done: this.done + n }));
      if (this.state !== "packing") return;
      this.change({ body, done: 0, size: body.size, state: available ? "sending" : "sent" });
      if (available) this.send(one ? `scan${/(\.nii)?\.[A-Za-z0-9]{1,6}$/.exec(this.files[0].name)?.[0] ?? ""}` : "scan.zip");
    } catch (error) {
      this.change({ state: "failed", fault: error });
    }
  }

  send(filename) {
    const status = (error) => error.originalResponse?.getStatus() ?? 0;
    this.upload = new Upload(this.body, {
      endpoint: "/v1/uploads",
      chunkSize: PART,
      retryDelays: AGAIN_MS,
      metadata: { filename },
      storeFingerprintForResuming: false,
      onShouldRetry: (error) => ![400, 401, 403, 404, 410, 413, 415, 460, 507].includes(status(error)),
      onProgress: (done) => {
        const at = performance.now();
        this.marks = [...this.marks.filter((m) => at - m.at < MEMORY_MS), { at, done }];
        this.change({ done });
      },
      onSuccess: () => this.change({ state: "sent", done: this.size, address: this.upload.url.split("/").pop() }),
      onError: async (error) => {
        if (status(error) !== 401) return this.change({ state: "failed", fault: faultOf(error) });
        this.change({ waiting: true });
        await signedIn();
        this.change({ waiting: false });
        if (this.state === "sending") this.upload.start();
      },
    });
    this.upload.start();
  }

  pause() {
    this.upload?.abort();
    this.change({ state: "paused", marks: [] });
  }

  resume() {
    this.change({ state: this.upload ? "sending" : "packing", fault: null, marks: [], done: this.upload ? this.done : 0 });
    if (this.upload) this.upload.start();
    else this.start();
  }

  async remove() {
    const sent = this.state === "sent" && !this.job;
    this.change({ state: "removed" });
    transfers.splice(transfers.indexOf(this), 1);
    this.change({});
    if (this.upload && !sent) await this.upload.abort(true).catch(() => {});
    if (sent && this.address) await call(`/v1/uploads/${this.address}`, { method: "DELETE", headers: { "tus-resumable": "1.0.0" } }).catch(() => {});
  }

  // Asks what would be understood, or makes the job.
  async submit({ validate = false, signal } = {}) {
    const query = validate ? "?validate=true" : `?priority=${this.priority}`;
    if (this.address) return (await post(`/v1/jobs${query}`, { upload: this.address, plan: this.plan }, { signal })).json();
    const form = new FormData();
    form.append("plan", JSON.stringify(this.plan));
    inOrder(this.files).forEach((file, i) => form.append("input", file, inside(file, i)));
    return json(`/v1/jobs${query}`, { method: "POST", body: form, signal });
  }
}

// A scan that a job holds already: checked and reconstructed again without being sent.
export class Held {
  // known: the code of the fault that the reader has seen already.
  constructor(id, plan, known) {
    Object.assign(this, { number: `held-${id}`, id, plan, known, priority: 0, job: null });
  }

  change() {}

  async submit({ validate = false, signal } = {}) {
    const query = validate ? "?validate=true" : `?priority=${this.priority}`;
    return (await post(`/v1/jobs${query}`, { job: this.id, plan: this.plan }, { signal })).json();
  }
}

function faultOf(error) {
  const body = error.originalResponse?.getBody();
  try {
    return new Fault(JSON.parse(body));
  } catch {
    return error;
  }
}

export function begin(files, name) {
  const transfer = new Transfer(files, name);
  transfers.unshift(transfer);
  transfer.change({});
  transfer.start();
  return transfer;
}
