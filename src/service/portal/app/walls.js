// How the wall can be coloured: by the displacement of the smoothing, by its patches, by the shapes of its triangles.
import { BufferAttribute, Color } from "three";

// Blue, white, red, as the legend shows it (style 3-result.css).
const RAMP = ["#2166ac", "#f7f7f7", "#b2182b"].map((c) => new Color(c));
// Smallest angles at the ends of the ramp: below 30 degrees flow solvers complain, no triangle has more than 60.
export const SHAPES = [30, 60];
// Of a hundred vertices one may lie beyond the ends of the displacement's ramp: one spot else leaves the rest white.
const WITHIN = 0.99;

const mixed = new Color();
function ramp(f) {
  const g = Math.max(-1, Math.min(1, f));
  return mixed.copy(RAMP[1]).lerp(RAMP[g < 0 ? 0 : 2], Math.abs(g));
}

// The absolute displacement that the given part of all vertices stays below, mm.
export function commonDisplacement(attributes) {
  const all = attributes.flatMap((a) => Array.from(a.array, Math.abs)).sort((a, b) => a - b);
  return Math.max(all[Math.floor((all.length - 1) * WITHIN)] ?? 0, 1e-6);
}

export function displacementColours(values, most) {
  const colours = new Float32Array(values.count * 3);
  for (let i = 0; i < values.count; i += 1) ramp(values.getX(i) / most).toArray(colours, 3 * i);
  return new BufferAttribute(colours, 3);
}

// The same triangles with corners of their own, so that a colour ends at an edge.
export function apart(geometry) {
  const made = geometry.toNonIndexed();
  made.userData = geometry.userData;
  return made;
}

// One colour for each triangle of a geometry without index.
export function triangleColours(geometry, colourOf) {
  const n = geometry.getAttribute("position").count / 3;
  const colours = new Float32Array(9 * n);
  for (let t = 0; t < n; t += 1) {
    const colour = colourOf(t);
    for (let corner = 0; corner < 3; corner += 1) colour.toArray(colours, 9 * t + 3 * corner);
  }
  geometry.setAttribute("color", new BufferAttribute(colours, 3));
}

// The smallest angle of a triangle, degrees: that across the shortest side.
export function smallestAngle(position, t) {
  const at = (k) => [position.getX(3 * t + k), position.getY(3 * t + k), position.getZ(3 * t + k)];
  const [p, q, r] = [at(0), at(1), at(2)];
  const far = (a, b) => (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2;
  const [a, b, c] = [far(p, q), far(q, r), far(r, p)].sort((x, y) => x - y);
  return (Math.acos(Math.max(-1, Math.min(1, (b + c - a) / (2 * Math.sqrt(b * c))))) * 180) / Math.PI;
}

export function shapeColour(degrees) {
  const middle = (SHAPES[0] + SHAPES[1]) / 2;
  return ramp((middle - degrees) / (middle - SHAPES[0]));
}
