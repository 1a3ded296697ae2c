// Sending: choose or drop, see it go up, see what would be understood, mend what is missing, reconstruct.
import { check } from "./check.js";
import { button, card, field, h, redraw } from "./dom.js";
import { problemBox } from "./faults.js";
import { bytes, duration, t } from "./text.js";
import { begin, transfers, watchTransfers } from "./transfer.js";

// A dropped folder's files; hidden ones are left out.
async function filesOf(entry) {
  if (entry.isFile) return [await new Promise((ok, no) => entry.file(ok, no))];
  const reader = entry.createReader();
  const found = [];
  for (;;) {
    const some = await new Promise((ok, no) => reader.readEntries(ok, no));
    if (some.length === 0) return found;
    for (const each of some) if (!each.name.startsWith(".")) found.push(...(await filesOf(each)));
  }
}

// What was dropped as scans {files, name}: each folder, zip or volume is one, loose files together are one.
async function scansOf(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (entries.length === 0) return [{ files: [...transfer.files] }];
  const scans = [];
  const loose = [];
  for (const entry of entries) {
    const files = await filesOf(entry);
    if (entry.isDirectory || /\.(zip|nii|nii\.gz|mha|nrrd)$/i.test(entry.name)) scans.push({ files, name: entry.name });
    else loose.push(...files);
  }
  return [...scans, { files: loose }].filter((scan) => scan.files.length > 0);
}

function dropZone() {
  const take = (files, name) => { if (files.length > 0) begin(files, name); };
  const files = h("input", { id: "files", type: "file", multiple: true, class: "unseen", onchange: (e) => { take([...e.target.files]); e.target.value = ""; } });
  const folder = h("input", { id: "folder", type: "file", webkitdirectory: true, class: "unseen", onchange: (e) => { take([...e.target.files].filter((f) => !f.name.startsWith(".")), e.target.files[0]?.webkitRelativePath.split("/")[0]); e.target.value = ""; } });
  const zone = h("div", { id: "drop", class: "drop" },
    h("p", { class: "drop-title" }, t("send.drop")),
    h("p", { class: "soft" }, t("send.kinds")),
    h("div", { class: "actions" },
      files, h("label", { for: "files", class: "button" }, t("send.files")),
      folder, h("label", { for: "folder", class: "button quiet" }, t("send.folder"))));
  for (const kind of ["dragover", "dragenter"]) zone.addEventListener(kind, (e) => { e.preventDefault(); zone.classList.add("over"); });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", async (e) => {
    e.preventDefault();
    zone.classList.remove("over");
    for (const { files: scan, name } of await scansOf(e.dataTransfer)) begin(scan, name);
  });
  return zone;
}

function progress(transfer) {
  const { speed, left } = transfer.pace;
  const parts = [`${bytes(transfer.done)} / ${bytes(transfer.size)}`];
  if (Number.isFinite(speed) && transfer.state === "sending") parts.push(`${bytes(speed)}/s`, t("send.left", { time: duration(left) }));
  if (transfer.waiting) parts.push(t("send.waiting"));
  const label = t(`transfer.${transfer.state}`);
  return [
    h("progress", { max: 1, value: transfer.size ? transfer.done / transfer.size : 0, "aria-label": label }),
    h("span", { class: "soft" }, `${label} · ${parts.join(" · ")}`),
  ];
}

function controls(transfer) {
  const act = (key, work) => button(t(key), work, { class: "quiet", "data-key": `${transfer.number}-${key}` });
  return [
    transfer.state === "sending" ? act("action.pause", () => transfer.pause()) : null,
    ["paused", "failed"].includes(transfer.state) ? act("action.resume", () => transfer.resume()) : null,
    act("action.remove", () => transfer.remove()),
  ];
}

// One scan's card: its bar, then the check.
function scanCard(transfer, signal) {
  const bar = h("div", { class: "bar" });
  const trouble = h("div");
  const checked = h("div");
  const buttons = h("div", { class: "actions" });
  const count = t("count.files", { n: transfer.files.length });
  const title = transfer.files.length === 1 ? transfer.files[0].name : transfer.name ? `${transfer.name} (${count})` : count;
  const element = h("section", { class: "card scan", "aria-label": `${title} (${transfer.number})` },
    h("div", { class: "scan-head" }, h("h2", {}, title), buttons), bar, trouble, checked);
  let begun = false;
  const update = () => {
    const going = !["sent", "removed"].includes(transfer.state);
    redraw(buttons, [transfer.state, Boolean(transfer.job)], () => (transfer.job ? [] : controls(transfer)));
    bar.hidden = !going;
    if (going) bar.replaceChildren(...progress(transfer));
    redraw(trouble, transfer.fault?.message ?? null, () =>
      transfer.fault ? problemBox(transfer.fault.problem ?? { detail: transfer.fault.message }, t("send.failed")) : []);
    if (transfer.state === "sent" && !begun) {
      begun = true;
      check(checked, transfer, signal);
    }
  };
  update();
  return { element, update };
}

export async function showSend(box, { signal }) {
  const list = h("div", { class: "stack", id: "scans" });
  const cards = new Map();
  box.append(h("h1", {}, t("title.send")),
    h("div", { class: "send-grid" },
      h("div", { class: "stack" }, card(null, dropZone()), card(t("send.how"), h("ol", { class: "how" }, ["one", "two", "three"].map((k) => h("li", {}, t(`send.how.${k}`)))), h("p", { class: "soft" }, t("send.privacy")))),
      list));
  const draw = () => {
    for (const transfer of transfers) if (!cards.has(transfer)) cards.set(transfer, scanCard(transfer, signal));
    for (const [transfer, made] of cards) if (!transfers.includes(transfer)) { made.element.remove(); cards.delete(transfer); }
    transfers.forEach((transfer, i) => {
      const { element, update } = cards.get(transfer);
      if (list.children[i] !== element) list.insertBefore(element, list.children[i] ?? null);
      update();
    });
    if (transfers.length === 0) redraw(list, "none", () => h("p", { class: "empty" }, t("send.none")));
    else if (list.dataset.shown) { delete list.dataset.shown; list.querySelector(".empty")?.remove(); }
  };
  watchTransfers(draw, signal);
  draw();
}
