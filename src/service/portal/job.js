// One job's page: what happens, what was found, what to download.
import { bytes, call, count, h, json, number, place, when } from "./api.js";
import { plot } from "./plot.js";

const FINAL = ["succeeded", "failed", "cancelled"];
const ANGLES = {
  graft_proximal: "Graft – proximal",
  graft_distal_planar: "Graft – distal, in the plane",
  distal_normal: "Distal – normal of the plane",
  proximal_distal: "Proximal – distal",
  graft_distal: "Graft – distal",
};

// Shows a job in a box until the signal aborts.
export async function showJob(box, id, signal, notice) {
  const address = `/v1/jobs/${encodeURIComponent(id)}`;
  box.replaceChildren(h("p", {}, "Reading the job …"));
  let job = await json(address, { signal });
  const redraw = () => !signal.aborted && draw(box, job, address, notice, signal);
  redraw();
  while (!signal.aborted && !FINAL.includes(job.state)) {
    // The stream ends with the job; a broken one is taken up again.
    await follow(address, signal, (progress) => {
      Object.assign(job, progress);
      const state = box.querySelector("#job-state");
      if (state) state.replaceChildren(...stateLine(job));
    });
    job = await json(address, { signal });
    redraw();
  }
}

// The job's events, read as a stream so that a session by cookie or by key serves alike.
async function follow(address, signal, onProgress) {
  const response = await call(`${address}/events`, { headers: { accept: "text/event-stream" }, signal });
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const blocks = (rest + value).split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) {
      const data = block.split("\n").filter((line) => line.startsWith("data:")).map((line) => line.slice(5)).join("\n");
      if (data) onProgress(JSON.parse(data));
    }
  }
}

function stateLine(job) {
  const parts = [h("span", { class: `state ${job.state}` }, job.state)];
  if (job.state === "running") {
    parts.push(" ", h("progress", { max: 1, value: job.progress ?? 0, "aria-label": "Progress" }));
    parts.push(` ${job.stage ?? "starting"}`);
    if (typeof job.eta_s === "number") parts.push(`, about ${Math.ceil(job.eta_s)} s left`);
  }
  return parts;
}

function actions(job, address, notice) {
  const act = (label, path, method, after) =>
    h("button", {
      type: "button",
      class: "quiet",
      onclick: async (event) => {
        event.target.disabled = true;
        try {
          await call(path, { method });
          after();
        } catch (error) {
          notice(error);
          event.target.disabled = false;
        }
      },
    }, label);
  const again = () => window.dispatchEvent(new Event("hashchange"));
  return h("div", { class: "actions" },
    FINAL.includes(job.state) ? null : act("Cancel", `${address}/cancel`, "POST", () => {}),
    job.state === "failed" ? act("Run again", `${address}/retry`, "POST", again) : null,
    FINAL.includes(job.state) ? act("Erase", address, "DELETE", () => { location.hash = "#/"; }) : null);
}

function draw(box, job, address, notice, signal) {
  const title = h("div", { class: "title" }, h("h1", {}, `Job ${job.id}`), h("span", { id: "job-state" }, stateLine(job)), actions(job, address, notice));
  const facts = h("p", {}, `Sent ${when(job.created_at)} · ${count(job.input.files, "file", "files")}, ${bytes(job.input.bytes)} · attempt ${job.attempt} of ${job.max_attempts}`);
  box.replaceChildren(title, facts);
  if (job.error) box.append(fault(job.error));
  if (job.state === "succeeded") result(box, address, signal).catch(notice);
}

function fault(problem) {
  const rows = (problem.errors ?? []).map((e) => h("li", {}, h("code", {}, e.code ?? ""), ` ${e.message ?? ""}${place(e.where)}`));
  return h("section", { class: "card fault" }, h("h2", {}, "Why it failed"), h("p", {}, h("code", {}, problem.code), ` ${problem.detail}`), h("ul", {}, rows));
}

async function result(box, address, signal) {
  const scene = h("div", { class: "scene" }, "Reading the surface …");
  const left = h("div", { class: "stack" }, h("section", { class: "card" }, h("h2", {}, "Surface and medial lines"), scene));
  const right = h("div", { class: "stack" });
  box.append(h("div", { class: "columns" }, left, right));
  const [found, files] = await Promise.all([
    json(`${address}/artefacts/result.json`, { signal }),
    json(`${address}/artefacts`, { signal }),
  ]);
  if (found.warnings?.length > 0) right.append(warnings(found.warnings));
  for (const junction of found.junctions ?? []) right.append(angles(junction));
  right.append(downloads(files.items));
  left.append(...curves(found.junctions ?? []), branches(found.branches ?? []));
  await view(scene, files.items, signal);
}

function warnings(list) {
  return h("section", { class: "card" }, h("h2", {}, "Warnings"),
    h("ul", { class: "warnings" }, list.map((w) => h("li", {}, h("code", {}, w.code), ` ${w.message}${place(w.where)}`))));
}

function angles(junction) {
  const row = (a) => {
    const band = a.band95 ? `${number(a.band95[0])} – ${number(a.band95[1])}` : "–";
    return h("tr", {}, h("td", {}, ANGLES[a.name] ?? a.name), h("td", { class: "number" }, number(a.value)), h("td", { class: "number" }, band));
  };
  return h("section", { class: "card" }, h("h2", {}, `Angles at junction ${junction.node}`),
    h("div", { class: "scroll" }, h("table", { class: "angles" },
      h("thead", {}, h("tr", {}, h("th", {}, "Angle"), h("th", { class: "number" }, "Degrees"), h("th", { class: "number" }, "95 % band"))),
      h("tbody", {}, (junction.angles ?? []).map(row)))));
}

function curves(junctions) {
  return junctions.flatMap((junction) => {
    const lines = (junction.angles ?? []).filter((a) => a.by_distance?.diameters?.length > 0)
      .map((a) => ({ name: ANGLES[a.name] ?? a.name, x: a.by_distance.diameters, y: a.by_distance.value }));
    const figure = plot(lines, { x: "fitting distance, graft diameters", y: "angle, degrees" });
    return figure ? [h("section", { class: "card" }, h("h2", {}, "Angle against fitting distance"), figure)] : [];
  });
}

function branches(list) {
  const row = (b) => h("tr", {}, h("td", {}, b.role ?? `branch ${b.id}`), h("td", { class: "number" }, number(b.length_mm)), h("td", { class: "number" }, number(b.diameter_mm, 2)), h("td", { class: "number" }, number(b.tortuosity, 3)));
  return h("section", { class: "card" }, h("h2", {}, "Branches"),
    h("div", { class: "scroll" }, h("table", {},
      h("thead", {}, h("tr", {}, h("th", {}, "Role"), h("th", { class: "number" }, "Length, mm"), h("th", { class: "number" }, "Diameter, mm"), h("th", { class: "number" }, "Tortuosity"))),
      h("tbody", {}, list.map(row)))));
}

function downloads(files) {
  const row = (f) => h("tr", {}, h("td", {}, h("a", { href: f.href, download: f.name }, f.name)), h("td", { class: "number" }, bytes(f.bytes)));
  return h("section", { class: "card" }, h("h2", {}, "Files"),
    h("div", { class: "scroll" }, h("table", {}, h("tbody", {}, files.map(row)))));
}

async function view(scene, files, signal) {
  const file = files.find((f) => f.name === "surface.glb");
  if (!file) return scene.replaceChildren("This job made no surface.glb.");
  const view3d = await import("./view3d.js");
  if (!view3d.available) return scene.replaceChildren("This build lacks the 3D view (npm was missing). Download surface.glb instead.");
  try {
    const data = await (await call(file.href, { signal })).arrayBuffer();
    const giveBack = await view3d.show(scene, data);
    if (signal.aborted) giveBack();
    else signal.addEventListener("abort", giveBack, { once: true });
  } catch (error) {
    if (error.name !== "AbortError") scene.replaceChildren(`The surface cannot be shown here: ${error.message}`);
  }
}
