// The angles of a junction as arcs: where they stand, between which directions. Pure vectors, LPS mm.

const ROLES = ["graft", "proximal", "distal", "host_a", "host_b"];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (a, f) => a.map((x) => x * f);
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));
const degrees = (a, b) => (Math.acos(Math.max(-1, Math.min(1, dot(a, b)))) * 180) / Math.PI;

// The branches that an angle's name speaks of, and what stands behind them (`planar`, `normal` or nothing).
function read(name, branches) {
  const parties = [];
  let rest = name;
  for (;;) {
    const role = ROLES.find((r) => rest === r || rest.startsWith(`${r}_`));
    const numbered = /^branch_(\d+)(_|$)/.exec(rest);
    if (!role && !numbered) return { parties, rest };
    parties.push(branches.find((b) => (role ? b.role === role : b.id === Number(numbered[1]))));
    rest = rest.slice(role ? role.length : numbered[0].replace(/_$/, "").length).replace(/^_/, "");
  }
}

// {name, index, value, band, vertex, from, to} of each angle that can be drawn.
export function arcsOf(found, junction) {
  if (!junction) return [];
  const meeting = found.branches.filter((b) => (junction.branches ?? []).includes(b.id));
  const vertex = junction.axes_point ?? junction.medial_point;
  return (junction.angles ?? []).flatMap((angle, index) => {
    if (angle.value === null) return [];
    const { parties, rest } = read(angle.name, meeting);
    const [first, second] = parties.map((b) => (b?.direction ? unit(b.direction) : null));
    const normal = junction.plane_normal ? unit(junction.plane_normal) : null;
    let to = second;
    if (rest === "normal") to = normal;
    if (rest === "planar" && second && normal) to = unit(second.map((x, k) => x - dot(second, normal) * normal[k]));
    if (!first || !to) return [];
    // A branch between two junctions has one direction; from its other end it is the opposite.
    const signs = rest === "normal" ? [[1, 1], [-1, 1]] : [[1, 1], [-1, 1], [1, -1], [-1, -1]];
    const miss = ([a, b]) => Math.abs(degrees(scaled(first, a), scaled(to, b)) - angle.value);
    const [a, b] = signs.reduce((best, s) => (miss(s) < miss(best) - 5 ? s : best));
    return [{ name: angle.name, index, value: angle.value, band: angle.band95, vertex, from: scaled(first, a), to: scaled(to, b) }];
  });
}

// Points of the arc between two unit vectors at a radius around the vertex.
export function arcPoints({ vertex, from, to }, radius, n = 32) {
  const angle = Math.acos(Math.max(-1, Math.min(1, dot(from, to))));
  const side = unit(to.map((x, k) => x - dot(from, to) * from[k]));
  return Array.from({ length: n + 1 }, (_, i) => {
    const a = (angle * i) / n;
    return vertex.map((x, k) => x + radius * (from[k] * Math.cos(a) + side[k] * Math.sin(a)));
  });
}
