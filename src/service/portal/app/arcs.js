// The angles of a junction as arcs: where they stand, between which directions. Pure vectors, LPS mm.

const ROLES = ["graft", "proximal", "distal", "host_a", "host_b"];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (a, f) => a.map((x) => x * f);
const unit = (a) => scaled(a, 1 / (Math.hypot(...a) || 1));
const degrees = (a, b) => (Math.acos(Math.max(-1, Math.min(1, dot(a, b)))) * 180) / Math.PI;

// An arc that would show another angle than the reported one is not drawn.
const MISS = 5;

// An angle's name as the parties that it speaks of, and what stands behind them (`planar`, `normal` or nothing).
function read(name) {
  const parties = [];
  let rest = name;
  for (;;) {
    const party = ROLES.find((r) => rest === r || rest.startsWith(`${r}_`)) ?? /^branch_\d+(?=_|$)/.exec(rest)?.[0];
    if (!party) return { parties, rest };
    parties.push(party);
    rest = rest.slice(party.length).replace(/^_/, "");
  }
}

const orders = (list) => (list.length < 2 ? [list] : list.flatMap((x, i) => orders(list.toSpliced(i, 1)).map((rest) => [x, ...rest])));

// The unit direction of each party away from the junction. A branch carries the role of its first junction: where that is
// another one, the three are told apart by the angles between them.
function directions(found, junction) {
  const legs = found.branches.filter((b) => (junction.branches ?? []).includes(b.id) && b.direction)
    .map((b) => ({ names: [b.role, `branch_${b.id}`], direction: scaled(unit(b.direction), b.from_node === junction.node ? 1 : -1) }));
  const pairs = (junction.angles ?? []).map((a) => ({ ...read(a.name), value: a.value })).filter((a) => a.value !== null);
  const names = [...new Set(pairs.flatMap((a) => a.parties))];
  const named = names.map((name) => legs.find((leg) => leg.names.includes(name))?.direction);
  if (named.every(Boolean) || legs.length !== names.length) return Object.fromEntries(names.map((name, i) => [name, named[i]]));
  const plain = pairs.filter((a) => a.parties.length === 2 && a.rest === "");
  const miss = (order) => plain.reduce((sum, a) => {
    const [x, y] = a.parties.map((name) => order[names.indexOf(name)].direction);
    return sum + Math.abs(degrees(x, y) - a.value);
  }, 0);
  const best = orders(legs).reduce((found, order) => (miss(order) < miss(found) ? order : found));
  return Object.fromEntries(names.map((name, i) => [name, best[i].direction]));
}

// {name, index, value, band, vertex, from, to} of each angle that can be drawn.
export function arcsOf(found, junction) {
  if (!junction) return [];
  const vertex = junction.axes_point ?? junction.medial_point;
  const away = directions(found, junction);
  const normal = junction.plane_normal ? unit(junction.plane_normal) : null;
  return (junction.angles ?? []).flatMap((angle, index) => {
    if (angle.value === null) return [];
    const { parties, rest } = read(angle.name);
    const [from, second] = parties.map((name) => away[name]);
    let to = second;
    if (rest === "normal") to = normal;
    if (rest === "planar" && second && normal) to = unit(second.map((x, k) => x - dot(second, normal) * normal[k]));
    const fits = from && to && Math.abs(degrees(from, to) - angle.value) < MISS;
    return fits ? [{ name: angle.name, index, value: angle.value, band: angle.band95, vertex, from, to }] : [];
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
