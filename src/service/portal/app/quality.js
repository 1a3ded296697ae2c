// Tables of branches and of quality.
import { card, h, table } from "./dom.js";
import { roleKind } from "./along.js";
import { number, roleName, signed, t } from "./text.js";

const withBand = (value, band, digits) => (band ? [number(value, digits), h("br"), h("small", { class: "soft" }, `${number(band[0], digits)} – ${number(band[1], digits)}`)] : number(value, digits));

export function branchCard(found) {
  const rows = found.branches.map((b) => [
    h("span", { class: "name" }, h("span", { class: `dot ${roleKind(b)}`, "aria-hidden": "true" }), roleName(b)),
    number(b.length_mm),
    withBand(b.diameter_mm, b.diameter_band95, 2),
    number(b.tortuosity, 3),
    b.stenosis ? `${number(100 * (1 - b.stenosis.area_ratio), 0)} %` : "–",
    b.helix ? number(b.helix.torsion_per_mm, 3) : "–",
  ]);
  const columns = [{ title: t("branch.branch") }, ...["length", "diameter", "tortuosity", "stenosis", "torsion"].map((k) => ({ title: t(`branch.${k}`), number: true }))];
  return card(t("branch.title"), table(t("branch.title"), columns, rows));
}

export function qualityCard({ input, segmentation, implicit, surface }) {
  const mm = (x) => `${number(x, 3)} mm`;
  const d = surface.displacement_px;
  const rows = [
    ["quality.slices", `${input.slices}${input.missing_slices.length > 0 ? ` (${t("quality.missing", { n: input.missing_slices.length })})` : ""}`],
    ["quality.spacing", `${input.spacing_mm.map((x) => number(x, 3)).join(" × ")} mm`],
    ["quality.contours", `${segmentation.contours}, ${t(`axis.${segmentation.axis}`)}`],
    ["quality.residual", t("quality.residual_of", { rms: mm(implicit.residual_rms_mm), max: mm(implicit.residual_max_mm) })],
    ["quality.mesh", t("quality.triangles", { n: surface.triangles, count: number(surface.triangles, 0) })],
    ["quality.area", `${number(surface.area_mm2, 0)} mm², ${number(surface.volume_mm3, 0)} mm³`],
    ["quality.topology", t(surface.watertight ? "quality.closed" : "quality.open", { euler: surface.euler, pieces: surface.components })],
    ["quality.angles", `${number(surface.min_angle_deg)}° – ${number(surface.max_angle_deg)}°`],
    ...(surface.quality ? [["quality.shapes", t("quality.shapes_of", { aspect: number(surface.quality.max_aspect, 2), skew: number(surface.quality.max_skew, 2) })]] : []),
    ["quality.error", mm(surface.max_error_mm)],
    ["quality.smoothing", t("quality.smoothing_of", { min: signed(d.min, 2), max: signed(d.max, 2), rms: number(d.rms, 2) })],
    ...(surface.quality ? [["quality.volume", `${signed(surface.quality.volume_change_percent, 2)} %`]] : []),
  ];
  return card(t("quality.title"), table(t("quality.title"), [{ title: t("quality.what") }, { title: t("quality.value") }], rows.map(([key, value]) => [t(key), value])));
}
