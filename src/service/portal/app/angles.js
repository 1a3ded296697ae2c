// The angles of a junction: the table with bands, each to be shown in 3D or not, and their dependence on the fit's window.
import { card, h, table } from "./dom.js";
import { plot } from "./plot.js";
import { angleName, number, t } from "./text.js";

// The three of the paper (and their like at other junctions) are shown at first; the rest on demand.
const FIRST = 3;

const band = (a) => (a.band95 ? `${number(a.band95[0])} – ${number(a.band95[1])}` : "–");

// Names of the angles that are shown at first.
export const firstShown = (junction) => (junction?.angles ?? []).filter((a) => a.value !== null).slice(0, FIRST).map((a) => a.name);

export function angleCard(junction, onShown) {
  const list = junction.angles ?? [];
  const on = new Set(firstShown(junction));
  const toggle = (a) => {
    on.has(a.name) ? on.delete(a.name) : on.add(a.name);
    onShown([...on]);
  };
  const right = { class: "number" };
  const rows = list.map((a, i) => h("tr", {},
    h("td", {}, h("label", { class: "choice" },
      h("input", { type: "checkbox", checked: on.has(a.name), disabled: a.value === null, onchange: () => toggle(a), "aria-label": t("angles.show", { name: angleName(a.name) }) }),
      h("span", { class: `dot a${i % 6}`, "aria-hidden": "true" }), angleName(a.name))),
    // The reason is among the warnings.
    a.value === null ? h("td", { ...right, colspan: 2 }, h("span", { class: "soft missing" }, t("angles.missing"))) : [h("td", right, h("strong", {}, `${number(a.value)}°`)), h("td", right, band(a))]));
  const vmtk = junction.vmtk?.in_plane?.length ? h("p", { class: "soft" }, t("angles.vmtk", { angles: junction.vmtk.in_plane.map((x) => number(x)).map((x) => `${x}°`).join(", ") })) : null;
  return card(t("angles.title"),
    table(t("angles.title"), [{ title: t("angles.angle") }, { title: t("angles.value"), number: true }, { title: t("angles.band"), number: true }], rows, { class: "angles" }),
    h("p", { class: "soft" }, t("angles.note")), vmtk);
}

// The change against the reported value, since the angles of a junction lie up to 120 degrees apart.
export function distanceCard(junction, names) {
  const measured = (junction.angles ?? []).map((a, i) => ({ ...a, i })).filter((a) => names.includes(a.name) && a.by_distance?.diameters?.length > 0);
  const curves = measured.map((a) => {
    const { diameters: x, value } = a.by_distance;
    const half = a.band95 ? (a.band95[1] - a.band95[0]) / 2 : null;
    const y = value.map((v) => (v === null ? null : v - a.value));
    return { name: angleName(a.name), kind: `a${a.i % 6}`, x, y, low: half === null ? undefined : y.map((v) => (v === null ? null : v - half)), high: half === null ? undefined : y.map((v) => (v === null ? null : v + half)) };
  });
  const windows = measured.map((a) => a.window_diameters).filter(Boolean);
  const spans = windows.length > 0 ? [{ kind: "window", from: Math.max(...windows.map((w) => w[0])), to: Math.min(...windows.map((w) => w[1])) }] : [];
  const figure = plot(curves, { x: t("angles.distance"), y: t("angles.change"), title: t("angles.by_distance") }, { onCursor: () => {}, digits: 2, spans });
  return figure ? card(t("angles.by_distance"), ...figure.elements, h("p", { class: "soft" }, t("angles.by_distance_note"))) : null;
}
