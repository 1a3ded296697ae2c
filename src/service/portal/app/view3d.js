// The 3D viewer: surface.glb (wall, caps and medial lines), angles as arcs with labels, a slice as a plane that may cut the
// wall, a marker. Drawn in mm, Y to the head, Z to the front, as surface.glb lies; LPS points are turned on the way in.
import {
  AmbientLight, BufferAttribute, Box3, CanvasTexture, CatmullRomCurve3, Color, DirectionalLight, DoubleSide, Group, Mesh,
  MeshBasicMaterial, MeshStandardMaterial, PerspectiveCamera, Plane, PlaneGeometry, Raycaster, Scene, SphereGeometry,
  SRGBColorSpace, TubeGeometry, Vector2, Vector3, WebGLRenderer, Matrix4,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
import { arcPoints } from "./arcs.js";

export const available = true;

const lps = ([x, y, z]) => new Vector3(x, z, -y);
const toLps = ({ x, y, z }) => [x, -z, y];
const ROLES = ["graft", "proximal", "distal", "host_a", "host_b"];
const DIRECTIONS = { front: new Vector3(0, 0, 1), left: new Vector3(1, 0, 0), head: new Vector3(0, 1, 0.001) };
const OPACITY = 0.42;
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
    const made = new Mesh(mesh.geometry, material);
    made.userData = { wall: true, kind };
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

  // clear, solid, displacement or none.
  wall(mode) {
    const most = Math.max(...["min", "max"].map((k) => Math.abs(this.found?.surface.displacement_mm?.[k] ?? 0)), 1e-9);
    this.each((node) => {
      const solid = mode === "solid" || mode === "displacement";
      const values = node.geometry.getAttribute("_displacement_mm");
      const coloured = mode === "displacement" && values;
      if (coloured && !node.geometry.getAttribute("color")) node.geometry.setAttribute("color", rampColours(values, most));
      Object.assign(node.material, { opacity: solid ? 1 : OPACITY, transparent: !solid, depthWrite: solid, vertexColors: Boolean(coloured), needsUpdate: true });
      if (coloured) node.material.color.set(0xffffff);
      node.visible = mode !== "none";
    });
    this.colours();
    this.draw();
  }

  // Arcs with labels; size is the graft's diameter.
  angles(list, size) {
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
      return { tag, at: lps(arcPoints(arc, radius * 1.12)[16]) };
    });
    this.colours();
    this.draw();
  }

  // The plane of the slices' present tile; cut takes away what lies on the viewer's side of it.
  plane(slices, { cut = false, plane = true } = {}) {
    // Moving along a curve asks often for the plane that is there.
    const key = slices && JSON.stringify([slices.k, cut, plane]);
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
    const { u, v, tile: [columns, rows], pixel_mm: mm } = slices.atlas;
    const map = new CanvasTexture(slices.tile());
    map.colorSpace = SRGBColorSpace;
    const sheet = new Mesh(new PlaneGeometry(columns * mm, rows * mm), new MeshBasicMaterial({ map, side: DoubleSide, transparent: true, opacity: 0.7, depthWrite: false }));
    const [x, y] = [lps(u), lps(v).negate()];
    const centre = slices.toPatient([(columns - 1) / 2, (rows - 1) / 2]);
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
    const centre = this.bounds.getCenter(new Vector3());
    if (name === "plane") from.add(new Vector3(TILT[0], TILT[1], 0).multiplyScalar(from.length()));
    const distance = (0.56 * this.extent) / Math.tan((this.camera.fov * Math.PI) / 360);
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
    if (width === 0 || height === 0) return;
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
    const placed = [];
    for (const { tag, at } of this.tags ?? []) {
      const p = at.clone().project(this.camera);
      const x = Math.min(width - 60, Math.max(60, ((p.x + 1) / 2) * width));
      let y = Math.min(height - 24, Math.max(24, ((1 - p.y) / 2) * height));
      // A label that would cover another goes below it.
      while (placed.some((q) => Math.abs(q.x - x) < 104 && Math.abs(q.y - y) < 38)) y += 6;
      placed.push({ x, y });
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

// Blue inward, white none, red outward.
function rampColours(values, most) {
  const colours = new Float32Array(values.count * 3);
  const [low, middle, high] = ["#2166ac", "#f7f7f7", "#b2182b"].map((c) => new Color(c));
  const mixed = new Color();
  for (let i = 0; i < values.count; i += 1) {
    const f = Math.max(-1, Math.min(1, values.getX(i) / most));
    mixed.copy(middle).lerp(f < 0 ? low : high, Math.abs(f));
    mixed.toArray(colours, 3 * i);
  }
  return new BufferAttribute(colours, 3);
}

// parts: [{bytes of surface.glb, kind}]; kind names a colour where several surfaces lie over one another.
export async function open(box, parts, options) {
  const viewer = new Viewer(box, options);
  await viewer.load(parts);
  viewer.fit();
  return viewer;
}
