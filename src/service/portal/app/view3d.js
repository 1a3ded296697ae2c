// The 3D viewer: surface.glb (wall, caps and medial lines), angles as arcs with labels, a slice as a plane that may cut the
// wall, a marker. Drawn in mm, Y to the head, Z to the front, as surface.glb lies; LPS points are turned on the way in.
import {
  AmbientLight, Box3, CanvasTexture, CatmullRomCurve3, Color, DirectionalLight, DoubleSide, Group, Mesh,
  MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, Plane, PlaneGeometry, Raycaster, Scene, SphereGeometry,
  SRGBColorSpace, TubeGeometry, Vector2, Vector3, WebGLRenderer, Matrix4,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { arcPoints } from "./arcs.js";
import { apart, commonDisplacement, displacementColours, shapeColour, smallestAngle, triangleColours } from "./walls.js";

export const available = true;

const lps = ([x, y, z]) => new Vector3(x, z, -y);
const toLps = ({ x, y, z }) => [x, -z, y];
const ROLES = ["graft", "proximal", "distal", "host_a", "host_b"];
const DIRECTIONS = { front: new Vector3(0, 0, 1), left: new Vector3(1, 0, 0), head: new Vector3(0, 1, 0.001) };
const OPACITY = 0.42;
// Triangles from which a clear wall is drawn in one pass, half the work of two; what is lost, far before near, was not seen at 800,000.
const ONE_PASS = 300_000;
// Half the width and height of an angle's label, pixels.
const TAG = [50, 20];
// A junction is seen with this many of its graft's diameters around it: a tree has more vessels than one picture can show.
const NEAR = 18;
// Seen a little from above and from the side, so that a slice is no mere line.
const TILT = [0.2, 0.16];

class Viewer {
  constructor(box, { label, found, junction, onPick }) {
    Object.assign(this, { box, found, junction, onPick });
    this.renderer = new WebGLRenderer({ antialias: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.localClippingEnabled = true;
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(30, 1, 0.1, 10_000);
    const lamp = new DirectionalLight(0xffffff, 2.1);
    lamp.position.set(0.4, 0.6, 1);
    this.camera.add(lamp);
    this.body = new Group();
    this.arcs = new Group();
    this.scene.add(new AmbientLight(0xffffff, 1.3), this.camera, this.body, this.arcs);
    this.labels = document.createElement("div");
    this.labels.className = "labels";
    this.canvas = this.renderer.domElement;
    for (const [key, value] of Object.entries({ tabindex: "0", role: "application", "aria-label": label })) this.canvas.setAttribute(key, value);
    box.replaceChildren(this.canvas, this.labels);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.listen();
    this.fit();
  }

  listen() {
    this.observer = new ResizeObserver(() => this.fit());
    this.observer.observe(this.box);
    this.themed = () => { this.colours(); this.draw(); };
    window.addEventListener("theme", this.themed);
    let down = null;
    this.canvas.addEventListener("pointerdown", (e) => { down = [e.clientX, e.clientY]; });
    this.canvas.addEventListener("pointerup", (e) => {
      if (down && Math.hypot(e.clientX - down[0], e.clientY - down[1]) < 4) this.pick(e);
    });
    this.canvas.addEventListener("keydown", (e) => this.keys(e));
  }

  css(name) { return getComputedStyle(this.box).getPropertyValue(name).trim() || "#888888"; }

  async load(parts) {
    const loader = new GLTFLoader();
    for (const { bytes, kind } of parts) {
      const { scene } = await loader.parseAsync(bytes, "");
      const group = new Group();
      group.userData.kind = kind;
      this.body.add(group);
      scene.updateMatrixWorld(true);
      const meshes = [];
      const lines = [];
      scene.traverse((node) => (node.isMesh ? meshes : node.isLine ? lines : []).push(node));
      for (const mesh of meshes) group.add(this.wallOf(mesh, kind));
      this.bounds = new Box3().setFromObject(this.body);
      this.extent = this.bounds.getSize(new Vector3()).length();
      for (const line of lines) group.add(this.lineOf(line, kind));
    }
    this.colours();
    this.look(this.junction?.plane_normal ? "plane" : "front");
  }

  wallOf(mesh, kind) {
    mesh.geometry.scale(1000, 1000, 1000);
    // Of two surfaces the first is solid: what shines through the second's haze is where they agree.
    const solid = kind === "side-a";
    const material = new MeshStandardMaterial({ roughness: 0.6, metalness: 0, transparent: !solid, opacity: solid ? 1 : OPACITY, side: DoubleSide, depthWrite: solid });
    // A clear wall is drawn in two passes, its far side first; beyond this size one has to do.
    material.forceSinglePass = (mesh.geometry.index?.count ?? 0) > 3 * ONE_PASS;
    const made = new Mesh(mesh.geometry, material);
    made.userData = { wall: true, kind, smooth: mesh.geometry };
    made.renderOrder = solid ? 0 : 2;
    return made;
  }

  lineOf(line, kind) {
    const at = line.geometry.getAttribute("position");
    const points = Array.from({ length: at.count }, (_, i) => new Vector3(at.getX(i), at.getY(i), at.getZ(i)).multiplyScalar(1000));
    line.geometry.dispose();
    const role = line.userData.role ?? line.parent?.userData.role;
    const made = new Mesh(tube(points, this.extent * 0.0035), new MeshBasicMaterial());
    made.userData = { role: ROLES.includes(role) ? role : "other", kind };
    return made;
  }

  colours() {
    this.scene.background = new Color(this.css("--scene"));
    this.body.traverse((node) => {
      if (!node.isMesh) return;
      const { wall, role, kind } = node.userData;
      if (wall && !node.material.vertexColors) node.material.color.set(this.css(kind ? `--${kind}` : "--wall"));
      if (role) node.material.color.set(this.css(kind ? `--${kind}` : `--${role.replace("_", "-")}`));
    });
    for (const node of this.arcs.children) node.material.color.set(this.css(`--angle-${node.userData.index % 6}`));
  }

  each(work) { this.body.traverse((node) => node.userData.wall && work(node)); }

  // clear, solid, displacement, patches (of: {FaceId, PatchId} by triangle and {shade}, a patch's colour by name), quality or
  // none. What a legend needs to tell: {most} of the displacement in mm, {patches} with the number of each.
  wall(mode, of = {}) {
    const coloured = ["displacement", "patches", "quality"].includes(mode);
    const told = {};
    const values = (node) => node.userData.smooth.getAttribute("_displacement_mm");
    if (mode === "displacement") {
      const walls = [];
      this.each((node) => walls.push(values(node)));
      told.most = commonDisplacement(walls);
    }
    if (mode === "patches") told.patches = [...new Set(of.PatchId.filter((_, t) => of.FaceId[t] === 0))].sort((a, b) => a - b);
    this.each((node) => {
      const { smooth } = node.userData;
      if (node.geometry !== smooth) node.geometry.dispose();
      node.geometry = smooth;
      if (mode === "displacement") smooth.setAttribute("color", displacementColours(values(node), told.most));
      if (mode === "patches") node.geometry = this.patched(smooth, of);
      if (mode === "quality") node.geometry = shaped(smooth);
      const solid = coloured || mode === "solid";
      Object.assign(node.material, { opacity: solid ? 1 : OPACITY, transparent: !solid, depthWrite: solid, vertexColors: coloured, needsUpdate: true });
      if (coloured) node.material.color.set(0xffffff);
      node.visible = mode !== "none";
    });
    this.colours();
    this.draw();
    return told;
  }

  // A cap is no patch: it keeps the wall's colour.
  patched(smooth, { FaceId, PatchId, shade }) {
    const face = smooth.userData.face_id ?? 0;
    const mine = PatchId.filter((_, t) => FaceId[t] === face);
    const made = apart(smooth);
    if (made.getAttribute("position").count !== 3 * mine.length) throw new Error("surface.vtp has other triangles than surface.glb");
    const shades = new Map([...new Set(mine)].map((id) => [id, new Color(this.css(face === 0 ? `--${shade(id)}` : "--wall"))]));
    triangleColours(made, (t) => shades.get(mine[t]));
    return made;
  }

  // Arcs with labels at a junction; size is the graft's diameter there. Another junction is looked at.
  angles(junction, list, size) {
    const elsewhere = this.junction?.node !== junction?.node;
    Object.assign(this, { junction, size });
    if (elsewhere && junction) this.look("plane");
    give(this.arcs);
    this.arcs.clear();
    this.labels.replaceChildren();
    this.tags = list.map((arc, i) => {
      const radius = size * (2.2 + 0.8 * i);
      const points = arcPoints(arc, radius).map(lps);
      const vertex = lps(arc.vertex);
      const thin = this.extent * 0.0022;
      for (const [shape, width] of [[points, 1.6], [[vertex, lps(arcPoints(arc, radius * 1.25)[0])], 1], [[vertex, lps(arcPoints(arc, radius * 1.25).at(-1))], 1]]) {
        const made = new Mesh(tube(shape, thin * width), new MeshBasicMaterial({ depthTest: false, transparent: true }));
        made.userData = { index: arc.index };
        made.renderOrder = 5;
        this.arcs.add(made);
      }
      const tag = document.createElement("span");
      tag.className = `tag a${arc.index % 6}`;
      tag.title = arc.title;
      const note = document.createElement("small");
      note.textContent = arc.note;
      tag.append(arc.text, note);
      this.labels.append(tag);
      return { tag, at: points[16], vertex };
    });
    this.colours();
    this.draw();
  }

  // The plane of the slices' present tile; cut takes away what lies on the viewer's side of it.
  plane(slices, { cut = false, plane = true } = {}) {
    // Moving along a curve asks often for the plane that is there.
    const key = slices && JSON.stringify([slices.k, slices.part, cut, plane]);
    if (this.laid === key) return;
    this.laid = key;
    if (this.sheet) {
      this.scene.remove(this.sheet);
      this.sheet.material.map?.dispose();
      give(this.sheet);
      this.sheet = null;
    }
    const wanted = slices && cut ? [this.knife(slices)] : null;
    this.each((node) => { node.material.clippingPlanes = wanted; });
    if (slices && plane) this.scene.add(this.sheet = this.sheetOf(slices));
    this.draw();
  }

  knife(slices) {
    const normal = lps(slices.normal);
    return new Plane().setFromNormalAndCoplanarPoint(normal, lps(slices.origin));
  }

  sheetOf(slices) {
    const { u, v, pixel_mm: mm } = slices.atlas;
    const [left, top, columns, rows] = slices.part;
    const map = new CanvasTexture(slices.tile());
    map.colorSpace = SRGBColorSpace;
    const sheet = new Mesh(new PlaneGeometry(columns * mm, rows * mm), new MeshBasicMaterial({ map, side: DoubleSide, transparent: true, opacity: 0.7, depthWrite: false }));
    const [x, y] = [lps(u), lps(v).negate()];
    const centre = slices.toPatient([left + (columns - 1) / 2, top + (rows - 1) / 2]);
    sheet.matrixAutoUpdate = false;
    sheet.matrix.copy(new Matrix4().makeBasis(x, y, x.clone().cross(y)).setPosition(lps(centre)));
    sheet.renderOrder = 1;
    return sheet;
  }

  mark(point) {
    if (!this.marker) {
      this.marker = new Mesh(new SphereGeometry(this.extent * 0.009, 24, 16), new MeshBasicMaterial({ color: 0xffb000, depthTest: false, transparent: true }));
      this.marker.renderOrder = 6;
      this.scene.add(this.marker);
    }
    this.marker.position.copy(lps(point));
    this.draw();
  }

  pick(e) {
    const box = this.canvas.getBoundingClientRect();
    const at = new Vector2(((e.clientX - box.left) / box.width) * 2 - 1, 1 - ((e.clientY - box.top) / box.height) * 2);
    const ray = new Raycaster();
    ray.setFromCamera(at, this.camera);
    const hit = ray.intersectObject(this.body, true).find((h) => h.object.visible);
    if (hit) this.onPick?.(toLps(hit.point));
  }

  // plane (onto the junction's plane, from the side nearer to the front), front, left or head.
  look(name) {
    const normal = this.junction?.plane_normal ? lps(this.junction.plane_normal) : DIRECTIONS.front;
    const from = name === "plane" ? normal.clone().multiplyScalar(normal.z < 0 ? -1 : 1) : DIRECTIONS[name];
    const near = name === "plane" && this.junction?.axes_point && this.size ? Math.min(1, (NEAR * this.size) / this.extent) : 1;
    const centre = near < 1 ? lps(this.junction.axes_point) : this.bounds.getCenter(new Vector3());
    if (name === "plane") from.add(new Vector3(TILT[0], TILT[1], 0).multiplyScalar(from.length()));
    const distance = (0.56 * near * this.extent) / Math.tan((this.camera.fov * Math.PI) / 360);
    Object.assign(this.camera, { near: this.extent / 200, far: this.extent * 20 });
    this.camera.position.copy(centre).addScaledVector(from.clone().normalize(), distance);
    this.controls.target.copy(centre);
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.draw();
  }

  keys(e) {
    const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
    const zoom = { "+": 0.9, "=": 0.9, "-": 1.1 }[e.key];
    if (!turn && !zoom) return;
    e.preventDefault();
    const offset = this.camera.position.clone().sub(this.controls.target);
    if (zoom) offset.multiplyScalar(zoom);
    else {
      offset.applyAxisAngle(new Vector3(0, 1, 0), (turn[0] * Math.PI) / 24);
      const side = new Vector3(0, 1, 0).cross(offset).normalize();
      offset.applyAxisAngle(side, (turn[1] * Math.PI) / 24);
    }
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.box;
    if (width === 0 || height === 0 || (width === this.width && height === this.height)) return;
    Object.assign(this, { width, height });
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.paint();
  }

  draw() {
    this.wanted ??= requestAnimationFrame(() => { this.wanted = null; this.paint(); });
  }

  paint() {
    if (this.gone) return;
    this.renderer.render(this.scene, this.camera);
    const { clientWidth: width, clientHeight: height } = this.box;
    const seen = (p) => { const q = p.clone().project(this.camera); return [((q.x + 1) / 2) * width, ((1 - q.y) / 2) * height]; };
    const placed = [];
    for (const { tag, at, vertex } of this.tags ?? []) {
      const [from, to] = [seen(vertex), seen(at)];
      const long = Math.hypot(to[0] - from[0], to[1] - from[1]) || 1;
      const way = [(to[0] - from[0]) / long, (to[1] - from[1]) / long];
      // Outside of its arc, as far as its own size asks; further out where it would cover another.
      let off = Math.abs(way[0]) * TAG[0] + Math.abs(way[1]) * TAG[1] + 4;
      const place = () => [Math.min(width - TAG[0], Math.max(TAG[0], to[0] + way[0] * off)), Math.min(height - TAG[1], Math.max(TAG[1], to[1] + way[1] * off))];
      let [x, y] = place();
      for (let k = 0; k < 30 && placed.some((q) => Math.abs(q[0] - x) < 2 * TAG[0] && Math.abs(q[1] - y) < 2 * TAG[1]); k += 1) {
        off += 6;
        [x, y] = place();
      }
      placed.push([x, y]);
      tag.style.transform = `translate(-50%, -50%) translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    }
  }

  dispose() {
    this.gone = true;
    if (this.wanted) cancelAnimationFrame(this.wanted);
    this.observer.disconnect();
    window.removeEventListener("theme", this.themed);
    this.controls.dispose();
    this.sheet?.material.map?.dispose();
    give(this.scene);
    this.renderer.dispose();
    this.renderer.forceContextLoss();
    this.box.replaceChildren();
  }
}

const tube = (points, radius) => new TubeGeometry(points.length > 2 ? new CatmullRomCurve3(points, false, "centripetal") : new CatmullRomCurve3(points), Math.min(400, Math.max(2, points.length * 2)), radius, 8);

function give(root) {
  root.traverse((node) => {
    node.geometry?.dispose();
    node.material?.dispose?.();
  });
}

function shaped(smooth) {
  const made = apart(smooth);
  const position = made.getAttribute("position");
  triangleColours(made, (t) => shapeColour(smallestAngle(position, t)));
  return made;
}

// parts: [{bytes of surface.glb, kind}]; kind names a colour where several surfaces lie over one another.
export async function open(box, parts, options) {
  const viewer = new Viewer(box, options);
  // Not drawn here: the frame that `look` asked for shows the wall with the angles, which come in the same turn. A million
  // triangles take more than half a second without a GPU.
  await viewer.load(parts);
  return viewer;
}
